"""Search for image pairs that match and that the gripper poses confirm.

Pairs with little rotation between them are matched first. They give the rotation R_X of gripper_from_camera, by which
images are then rotated upright.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.camera import guessed_intrinsics, unproject
from jcr.estimation.closed_form import motions
from jcr.features.matchers import Geometries, Matcher, matrices, still_cells
from jcr.features.pair_choice import (
    ALL_PAIRS_UP_TO,
    FIRST_NEIGHBOURS,
    NEIGHBOURS,
    hand_eye_of_pairs,
    near_pairs,
    pairs_of_common_scene,
    repeats,
)
from jcr.features.pair_verification import (
    SYSTEMATIC,
    SYSTEMATIC_OF_GUESS,
    Gate,
    Key,
    Motions,
    Pair,
    RotationOfX,
    agreeing_motions,
    classify_pairs,
)
from jcr.features.two_view import starting_motions
from jcr.features.upright import by_quarters, rolls
from jcr.geometry import Transform, rotation_angle
from jcr.progress import Progress, silent
from jcr.records import Intrinsics

WORTH_SAYING = 0.1
"""Share of contradicted pairs above which the user is told of them; a few wrong pairs are normal."""
AS_TAKEN = math.radians(50)
"""Largest angle (rad) of the gripper's motion at which a network matches the images without rotating them first."""
GUESSED_AT_ONCE = 6
"""Number of pairs that are matched at all multiples of 90° before R_X is estimated again."""
GUESSED_AT_MOST = 30
"""Largest number of pairs that are matched at all multiples of 90°."""
FOCALS = np.geomspace(0.35, 2.5, 40)
"""Focal lengths that are tried where no intrinsics are given, as multiples of the long side."""
FOCAL_TOLERANCE = math.radians(1.5)
"""Standard deviation, rad, of the angles' difference by which a pair supports a focal length."""
LEAST_SUPPORT = 3.0
"""Least sum of the pairs' supports (0 to 1 each) with which the best focal length is determined."""
FOCAL_MATCHES = 200
"""Largest number of matches of a pair by which points in front of both cameras are counted."""


@dataclass(frozen=True, kw_only=True)
class MatchedPairs:
    """Result of the search for matching pairs: their two-view geometries, the intrinsics used, notes and warnings."""

    geometries: Geometries
    """Two-view geometries for the mapper, by pair."""
    intrinsics: Intrinsics
    """Intrinsics at the working size, given or estimated from the gripper's angles."""
    contradicted: tuple[Key, ...] = ()
    """Pairs that match and are not for the mapper, because the gripper's rotation between them is another."""
    x: Transform | None = None
    """Rough estimate of gripper_from_camera by the confirmed pairs; None if they do not determine it."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(kw_only=True)
class _Search:
    """State of the search for matching pairs: geometries found, image rotations tried, intrinsics, gripper motions."""

    matcher: Matcher
    motion: Motions
    intrinsics: Intrinsics
    """Intrinsics at the size of matching, given or estimated."""
    repeats: Bool[ndarray, "n n"]
    """True for pairs of images between which the gripper did not move."""
    pairs: dict[Key, Pair] = field(default_factory=dict)
    tried: set[tuple[int, int, int, int]] = field(default_factory=set)
    """Rows of the two images and the angles (degrees) that they were rotated by, for each attempt to match a pair."""

    @property
    def systematic(self) -> float:
        """Assumed bound on the systematic difference of camera and gripper rotation, as a share of the angle."""
        return SYSTEMATIC if self.matcher.known else SYSTEMATIC_OF_GUESS

    def classify(self, known: RotationOfX | None = None) -> Gate:
        """Classify all pairs by the gripper's motion; `known` is used if they do not determine a hand-eye rotation."""
        return classify_pairs(list(self.pairs.values()), self.motion, self.systematic, known)

    def match(self, rotations: Mapping[Key, tuple[float, float]]) -> None:
        """Match pairs with their two images rotated by angles (rad); keep the better geometry of each pair.

        `rotations` has the angles of the first and of the second image, clockwise on the screen. Rotations that were
        tried before are left out.
        """
        todo = {}
        for key, both in rotations.items():
            if not self.matcher.features.needs_upright:
                both = (0.0, 0.0)
            both = by_quarters(both[0]), by_quarters(both[1])
            how = (*key, round(math.degrees(both[0])), round(math.degrees(both[1])))
            if how not in self.tried:
                self.tried.add(how)
                todo[key] = both
        if not todo:
            return
        found = self.matcher.geometries(list(todo), np.array(list(todo.values())), self.repeats)
        for key, geometry in found.items():
            if self._is_better(pair := self.matcher.pair(self.intrinsics, key, geometry)):
                self.pairs[key] = pair

    def match_by_quarters(self, pairs: Sequence[Key], found: Gate) -> Gate:
        """Match pairs with the second image rotated by 0, 90, 180 and 270° until the hand-eye rotation is known.

        At most GUESSED_AT_MOST pairs are matched, each only at the rotations that the gripper's angle allows. Returns
        the pairs, classified by the gripper; `found` is the classification before.
        """
        # Camera and gripper rotate by the same angle, and one image is rolled against the other by this angle at most.
        most = {key: float(rotation_angle(self.motion[key][:3, :3])) + math.pi / 4 for key in pairs}
        for start in range(0, min(len(pairs), GUESSED_AT_MOST), GUESSED_AT_ONCE):
            for quarter in range(4):
                guess, roll = (0.0, quarter * math.pi / 2), min(quarter, 4 - quarter) * math.pi / 2
                some = pairs[start : start + GUESSED_AT_ONCE]
                self.match({key: guess for key in some if roll <= most[key]})
            found = self.classify()
            if found.of_x is not None:
                break
        return found

    def match_upright(self, pairs: Sequence[Key], upright: Float[ndarray, " n"], found: Gate) -> Gate:
        """Match pairs with each image rotated by its angle `upright` (rad); classify all pairs by the gripper's motion.

        `found` is the classification before, whose hand-eye rotation is used if the pairs do not determine one.
        """
        self.match({(i, j): (float(upright[i]), float(upright[j])) for i, j in pairs})
        return self.classify(found.of_x)

    def hide_still_parts(self) -> None:
        """Find the cells of the image that stay while the gripper moves; verify all matches without these cells.

        Pairs with too few other matches are removed.
        """
        moving = [key for key in self.matcher.raw if not self.repeats[key]]
        size = self.intrinsics.width, self.intrinsics.height
        still = still_cells(self.matcher.features.x_px, self.matcher.raw, size, moving)
        if not still.any():
            return
        self.matcher.still = still
        for key in list(self.pairs):
            rows, moved = self.matcher.raw[key], not self.repeats[key]
            geometry = self.matcher.verified(key, rows, moved)
            if geometry is None:
                del self.pairs[key]
            else:
                self.pairs[key] = self.matcher.pair(self.intrinsics, key, geometry)

    def matched(self, believed: Collection[Key] | None = None) -> MatchedPairs:
        """Return the result of the search with the pairs `believed`; None: with all."""
        pairs = {key: pair for key, pair in self.pairs.items() if believed is None or key in believed}
        geometries = {key: pair.geometry for key, pair in pairs.items()}
        return MatchedPairs(geometries=geometries, intrinsics=self.intrinsics)

    def _is_better(self, new: Pair) -> bool:
        """Test whether the new geometry of a pair replaces the one in `pairs`.

        It does if it alone agrees with the gripper's angle. If both or neither agree, the new geometry needs more than
        half as many matches as the old one.
        """
        if new.key not in self.pairs:
            return True
        old, angle = self.pairs[new.key], float(rotation_angle(self.motion[new.key][:3, :3]))
        first, second = (bool(agreeing_motions(pair, angle, self.systematic)) for pair in (new, old))
        # The later geometry is preferred: its images are rotated upright, so that all pairs share their keypoints.
        return first if first != second else 2 * len(new.rows) > len(old.rows)

    def gate(self) -> Gate:
        """Estimate unknown intrinsics from the gripper's angles, then classify all pairs by the gripper's motion."""
        if not self.matcher.known and (intrinsics := self._intrinsics_by_robot()) is not None:
            self.intrinsics = intrinsics
            for key, pair in self.pairs.items():
                self.pairs[key] = self.matcher.pair(intrinsics, key, pair.geometry)
        return self.classify()

    def _intrinsics_by_robot(self) -> Intrinsics | None:
        """Return undistorted intrinsics whose focal length makes camera and gripper rotate by the same angles.

        The focal length is the one for which the rotation angles between images, from matches, agree best with those
        of the gripper poses. The image size of the result is the size of matching. Returns None where too few pairs
        agree on a focal length (LEAST_SUPPORT).
        """
        size = self.intrinsics.width, self.intrinsics.height
        x_px, angle = self.matcher.features.x_px, np.asarray(rotation_angle(self.motion[..., :3, :3]))
        rotated = [pair for pair in self.pairs.values() if angle[pair.key] > math.radians(8)]
        best, support = None, LEAST_SUPPORT
        for focal in FOCALS.tolist():
            intrinsics, agreeing = guessed_intrinsics(size, focal), 0.0
            for pair in rotated:
                essential, homography = matrices(pair.geometry, intrinsics)
                some = zip(pair.key, pair.rows[:FOCAL_MATCHES].T, strict=True)
                ray_i, ray_j = (unproject(intrinsics, x_px[row][own])[:, :2] for row, own in some)
                found = starting_motions(ray_i, ray_j, essential if homography is None else None, homography)
                if found:
                    of_camera = rotation_angle(np.stack([rotation for rotation, _ in found]))
                    gap = np.abs(of_camera - angle[pair.key]).min()
                    agreeing += float(np.exp(-0.5 * (gap / FOCAL_TOLERANCE) ** 2))
            if agreeing > support:
                best, support = intrinsics, agreeing
        return best


def match_with_robot(
    matcher: Matcher,
    base_from_gripper: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    names: Sequence[str],
    report: Progress = silent,
) -> MatchedPairs:
    """Match pairs of images and return those that the gripper poses do not contradict.

    `intrinsics` are at the size in which images are matched; they are an initial estimate unless the matcher's are
    known. If the hand-eye rotation cannot be found from the pairs, the pairs are not checked against the robot poses,
    which may be of another convention.
    """
    report("matching", 0.0)
    n, features = len(base_from_gripper), matcher.features
    motion = motions(base_from_gripper)
    angle = np.asarray(rotation_angle(motion[..., :3, :3]))
    matcher.still = None
    search = _Search(matcher=matcher, motion=motion, intrinsics=intrinsics, repeats=repeats(motion))
    everything = (
        list(combinations(range(n), 2)) if n <= features.every_pair else near_pairs(motion, NEIGHBOURS)
    )
    at_once = n <= ALL_PAIRS_UP_TO and not features.needs_upright
    first = everything if at_once else near_pairs(motion, FIRST_NEIGHBOURS)
    as_taken = (0.0, 0.0)
    search.match({key: as_taken for key in first if not features.needs_upright or angle[key] < AS_TAKEN})
    search.hide_still_parts()
    report("matching", 0.3)
    found = search.gate()
    if found.of_x is None and features.needs_upright:
        confirmed = {pair.key for pair in found.confirmed}
        left = sorted(set(everything) - confirmed, key=lambda key: float(angle[key]))
        found = search.match_by_quarters(left, found)
    report("matching", 0.5)
    if found.of_x is None:
        search.match(dict.fromkeys(everything, as_taken))
        found = search.gate()
    if found.of_x is None:
        matched = search.matched()
    else:
        upright = rolls(base_from_gripper[:, :3, :3] @ found.of_x.rotation)
        some = pairs_of_common_scene(features.x_px, search.intrinsics, found, motion)
        found = search.match_upright(some or everything, upright, found)
        report("matching", 0.8)
        rows = [row for pair in found.confirmed for row in pair.key]
        lonely = set(np.flatnonzero(np.bincount(rows, minlength=n) < 2).tolist())
        if lonely:
            found = search.match_upright([key for key in everything if lonely & set(key)], upright, found)
        matched = _pairs_to_map(search, found, names)
    if matcher.still is not None:
        percent = 100 * matcher.still.mean()
        note = f"{percent:.0f} % of the image stay while the gripper moves, fingers or a logo: left out"
        matched = replace(matched, notes=(*matched.notes, note))
    report("matching", 1.0)
    return matched


def match_alone(
    matcher: Matcher, intrinsics: Intrinsics, count: int, report: Progress = silent
) -> MatchedPairs:
    """Match all pairs of `count` images without gripper poses, and return those with a two-view geometry.

    `intrinsics` are at the size in which images are matched. Parts of the image that stay in all images are left out.
    """
    report("matching", 0.0)
    matcher.still = None
    still = np.tile(np.eye(4), (count, count, 1, 1))
    search = _Search(
        matcher=matcher, motion=still, intrinsics=intrinsics, repeats=np.zeros((count, count), dtype=bool)
    )
    search.match(dict.fromkeys(combinations(range(count), 2), (0.0, 0.0)))
    search.hide_still_parts()
    report("matching", 1.0)
    return search.matched()


def _pairs_to_map(search: _Search, found: Gate, names: Sequence[str]) -> MatchedPairs:
    """Return the pairs that are to be mapped, with notes and warnings for the user about the other pairs.

    To be mapped are the pairs that the robot poses do not contradict, and all pairs of an image whose pose is wrong.
    Pairs too uncertain to be judged are mapped only if the intrinsics are unknown.
    """
    notes, warnings = tuple[str, ...](), tuple[str, ...]()
    stale = _contradicted_by_all(found, search.motion)
    believed = {pair.key for pair in found.confirmed}
    believed |= {pair.key for pair in found.contradicted if stale & set(pair.key)}
    # With given intrinsics, undecided pairs are dropped: nothing confirms their matches.
    believed |= set() if search.matcher.known else {pair.key for pair in found.undecided}
    count, total = len(found.contradicted), len(found.contradicted) + len(found.confirmed)
    if count > WORTH_SAYING * total:
        notes = (
            f"the robot contradicts {count} of {total} matched pairs of images by their relative rotation: left out",
        )
    if stale:
        listed = ", ".join(names[row] for row in sorted(stale))
        warnings = (
            f"the matches of {listed} agree with each other and contradict the reported gripper rotation; check the "
            "pose of each",
        )
    contradicted = tuple(pair.key for pair in found.contradicted if pair.key not in believed)
    x = hand_eye_of_pairs(found, search.motion)
    return replace(search.matched(believed), contradicted=contradicted, x=x, notes=notes, warnings=warnings)


def _contradicted_by_all(found: Gate, motion: Motions) -> set[int]:
    """Return the rows of images with a wrong gripper pose: their pairs contradict it and agree on one correction.

    An image needs three such pairs or more, whose corrections differ by less than 3° in the median.
    """
    assert found.of_x is not None
    x = found.of_x.rotation
    confirmed = {row for pair in found.confirmed for row in pair.key}
    stale = set()
    for row in {row for pair in found.contradicted for row in pair.key} - confirmed:
        # Rotation of the gripper pose that would make each pair agree; correct pairs need the same rotation.
        corrections = []
        for pair in found.contradicted:
            if row in pair.key and (set(pair.key) - {row}) & confirmed:
                of_gripper, camera = motion[pair.key][:3, :3], x @ pair.motions[0].rotation @ x.T
                corrections.append(of_gripper.T @ camera if pair.key[1] == row else of_gripper @ camera.T)
        if len(corrections) >= 3:
            all_of = np.array(corrections)
            together = rotation_angle(np.swapaxes(all_of, 1, 2)[:, None] @ all_of[None])
            if np.median(together) < math.radians(3):
                stale.add(row)
    return stale
