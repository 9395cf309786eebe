"""Search for the pairs of images that match and that the gripper poses confirm, for every kind of features.

Pairs that the gripper rotates little against each other are matched as they are; those that the robot confirms give X's
rotation, and with it every image is rotated upright before the others are matched. While too few agree, rotations by 90°
are guessed.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import motions
from jcr.features import gate as robot
from jcr.features.focal import focal_by_robot
from jcr.features.gate import Gate, Key, Pair
from jcr.features.matchers import Matcher
from jcr.features.pairs import FEW, FIRST_NEIGHBOURS, NEIGHBOURS, all_pairs, near_pairs, seen_in_common
from jcr.features.still import hidden, still_cells
from jcr.features.still import in_words as still_in_words
from jcr.features.verify import Geometries, View
from jcr.geometry import rotation_angle
from jcr.records import Intrinsics

WORTH_SAYING = 0.1
"""Share of the matched pairs: a few wrong ones are left out of every set."""
AS_TAKEN = math.radians(50)
"""Networks match images that are rotated against each other by up to this; no rotation is larger than its angle."""
STILL = (5e-3, math.radians(1))
"""m, rad: a gripper that moved by this moves the whole image."""
GUESSED_AT_ONCE = 6
"""Pairs whose rotations by 90° are guessed before the robot is asked again."""
GUESSED_AT_MOST = 30
ENOUGH = 150
"""Matches of a pair by its best keypoints, with which it needs no others."""


@dataclass(frozen=True, kw_only=True)
class Matched:
    """Verified pairs of a capture and the intrinsics that they were verified with."""

    geometries: Geometries
    """Geometries for the mapper."""
    gate: Gate | None
    """None where the robot poses were not used."""
    intrinsics: Intrinsics
    """Intrinsics at the working size, given or estimated from the gripper's angles."""
    still: Bool[ndarray, "r c"] | None = None
    """Parts of the image that do not move with the scene, as match.still has them; None where there are none."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """Notes and warnings for records.Reconstruction."""


@dataclass(kw_only=True)
class _Search:
    """State of the search for matching pairs."""

    matcher: Matcher
    motion: Float[ndarray, "n n 4 4"]
    view: View
    known: bool
    """True if the intrinsics are given."""
    geometries: Geometries = field(default_factory=dict)
    pairs: dict[Key, Pair] = field(default_factory=dict)
    still: Bool[ndarray, "r c"] | None = None
    """Parts of the image that do not move."""
    rotations: dict[Key, tuple[float, float]] = field(default_factory=dict)
    """Angles (rad) by which the images of each pair were rotated."""
    judged: tuple[list[Pair], Gate] | None = None
    """Pairs that were judged last, and their gate."""
    tried: set[tuple[int, int, int, int, bool]] = field(default_factory=set)
    """Pairs, the angles (degrees) by which their images were rotated, and whether of the best keypoints alone."""

    @property
    def systematic(self) -> float:
        return robot.SYSTEMATIC if self.known else robot.SYSTEMATIC_OF_GUESS

    def match(
        self,
        pairs: Iterable[Key],
        rolls: Float[ndarray, " n"] | None = None,
        guess: float = 0.0,
        coarse: bool = True,
    ) -> None:
        """Match pairs with images rotated by `rolls`, or the second of each by a guess; the better of two is kept.

        `coarse` as of the matcher.
        """
        self._match_rotated(
            {(i, j): (0.0, guess) if rolls is None else (rolls[i], rolls[j]) for i, j in pairs}, coarse
        )

    def match_in_full(self, pairs: Iterable[Key], rolls: Float[ndarray, " n"] | None = None) -> None:
        """Match pairs with few matches again with all keypoints, rotated by `rolls`, or as before."""
        few = [key for key in pairs if key not in self.pairs or len(self.pairs[key].rows) < ENOUGH]
        self._match_rotated(
            {(i, j): self.rotations[i, j] if rolls is None else (rolls[i], rolls[j]) for i, j in few}, False
        )

    def _match_rotated(self, rotations: dict[Key, tuple[float, float]], coarse: bool) -> None:
        """Match pairs, the images of each rotated by two angles (rad)."""
        if not self.matcher.minds_roll:
            rotations, coarse = dict.fromkeys(rotations, (0.0, 0.0)), False
        todo = {}
        for key, both in rotations.items():
            both = robot.by_quarters(both[0]), robot.by_quarters(both[1])
            how = (*key, round(math.degrees(both[0])), round(math.degrees(both[1])), coarse)
            if how not in self.tried:
                self.tried.add(how)
                todo[key] = both
        if not todo:
            return
        found = self.matcher.geometries(list(todo), np.array(list(todo.values())), coarse)
        if self.matcher.minds_roll:  # an image that is rotated brings keypoints of its own
            self.view = View.of(self.matcher.x_px, self.view.intrinsics)
        for key, geometry in found.items():
            clean = self._seen(key, geometry)
            if clean is None:
                continue
            pair = self.matcher.pair(self.view, key, clean)
            if key not in self.geometries or self._better(pair, self.pairs[key]):
                self.geometries[key], self.pairs[key], self.rotations[key] = clean, pair, todo[key]

    def hide_still_parts(self) -> None:
        """Take out what does not move in the image while the gripper does; pairs are verified again without it."""
        angle = np.asarray(rotation_angle(self.motion[..., :3, :3]))
        way = np.linalg.norm(self.motion[..., :3, 3], axis=-1)
        moving = [key for key in self.matcher.raw if angle[key] > STILL[1] or way[key] > STILL[0]]
        size = self.view.intrinsics.width, self.view.intrinsics.height
        still = still_cells(self.matcher.x_px, self.matcher.raw, size, moving)
        if not still.any():
            return
        self.still = still
        for key, geometry in list(self.geometries.items()):
            clean = self._seen(key, geometry)
            if clean is None:
                del self.geometries[key], self.pairs[key]
            elif clean is not geometry:
                self.geometries[key], self.pairs[key] = clean, self.matcher.pair(self.view, key, clean)

    def without_first_motion(self, pairs: Sequence[Pair]) -> dict[Key, tuple[Pair, pycolmap.TwoViewGeometry]]:
        """Return second geometries of pairs, from matches that are not in the first ones."""
        found = {}
        for pair in pairs:
            raw = self._visible(pair.key, self.matcher.raw.get(pair.key, np.zeros((0, 2), dtype=int)))
            taken = {(int(a), int(b)) for a, b in pair.rows}
            left = np.array([row for row in raw if (int(row[0]), int(row[1])) not in taken], dtype=int)
            if len(left) and (geometry := self.matcher.verified(pair.key, left)) is not None:
                found[pair.key] = self.matcher.pair(self.view, pair.key, geometry), geometry
        return found

    def second_motions_confirmed(self, found: Gate) -> Gate:
        """Return the gate after second geometries replaced contradicted ones, which a moved object may cause."""
        others = self.without_first_motion(found.contradicted)
        judged = robot.judge([pair for pair, _ in others.values()], self.motion, self.systematic, found.of_x)
        for pair in judged.confirmed:
            self.geometries[pair.key], self.pairs[pair.key] = others[pair.key][1], pair
        return self.gate(found) if judged.confirmed else found

    def _visible(self, key: Key, rows: Int[ndarray, "m 2"]) -> Int[ndarray, "visible 2"]:
        """Return the matches outside of parts of the image that do not move."""
        if self.still is None or not len(rows):
            return rows
        i, j = key
        dark = hidden(self.matcher.x_px[i][rows[:, 0]], self.still)
        return rows[~(dark | hidden(self.matcher.x_px[j][rows[:, 1]], self.still))]

    def _seen(self, key: Key, geometry: pycolmap.TwoViewGeometry) -> pycolmap.TwoViewGeometry | None:
        """Return the geometry, verified again without matches in parts that do not move."""
        inside = np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
        if len(self._visible(key, inside)) == len(inside):
            return geometry
        return self.matcher.verified(key, self._visible(key, self.matcher.raw[key]))

    def gate(self, known: Gate | None = None) -> Gate:
        """Return the gate of all pairs so far."""
        of_x, pairs = None if known is None else known.of_x, list(self.pairs.values())
        if self.judged is not None and self.judged[1].of_x is not None:
            before, found = self.judged
            if len(before) == len(pairs) and all(
                one is other for one, other in zip(before, pairs, strict=True)
            ):
                return found
        self.judged = pairs, robot.judge(pairs, self.motion, self.systematic, of_x)
        return self.judged[1]

    def _better(self, new: Pair, old: Pair) -> bool:
        """Test whether a pair's new geometry is confirmed where the old one is not, or has more matches."""
        first, second = (self._agrees(pair) for pair in (new, old))
        # The later one is of images rotated upright, whose keypoints all pairs share.
        return first if first != second else 2 * len(new.rows) > len(old.rows)

    def _agrees(self, pair: Pair) -> bool:
        angle = float(rotation_angle(self.motion[pair.key][:3, :3]))
        return any(
            abs(float(rotation_angle(r.rotation)) - angle)
            < robot.angle_tolerance(angle, r.angle_std(), self.systematic)
            for r in pair.readings
        )


def match_with_robot(
    matcher: Matcher,
    base_from_gripper: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    known: bool,
    names: Sequence[str],
    original: tuple[int, int],
    report: Callable[[float], None] = lambda fraction: None,
) -> Matched:
    """Match pairs of images and return those that the gripper poses do not contradict.

    `original` is the size of the images as they were taken, for notes. `intrinsics` are at the working size, and a first
    guess unless `known`. Where X's rotation cannot be found from the pairs, the robot poses are not used: they may be of
    another convention, or too few pairs match.
    """
    n = len(base_from_gripper)
    motion = motions(base_from_gripper)
    angle = np.asarray(rotation_angle(motion[..., :3, :3]))
    search = _Search(matcher=matcher, motion=motion, view=View.of(matcher.x_px, intrinsics), known=known)
    everything = all_pairs(n) if n <= matcher.every_pair else near_pairs(motion, NEIGHBOURS)
    at_once = n <= FEW and not matcher.minds_roll
    first = everything if at_once else near_pairs(motion, FIRST_NEIGHBOURS)
    search.match([key for key in first if not matcher.minds_roll or angle[key] < AS_TAKEN])
    search.hide_still_parts()
    report(0.3)
    found = _with_intrinsics(search, intrinsics)
    if found.of_x is None and matcher.minds_roll:
        found = _guessed(search, everything, angle, found)
    report(0.5)
    if found.of_x is None:
        search.match(everything)
        found = _with_intrinsics(search, intrinsics)
    if found.of_x is None:
        return _without_robot(search, original)
    upright = robot.rolls(robot.base_from_camera_rotations(base_from_gripper, found.of_x))
    found = _upright(search, seen_in_common(search.view, found, motion) or everything, upright, found)
    report(0.8)
    lonely = _without_partners(found, n)
    found = _upright(search, [key for key in everything if lonely & set(key)], upright, found)
    found = search.second_motions_confirmed(found)
    stale = _contradicted_by_all(found, motion)
    believed = _believed(found, stale, known)
    report(1.0)
    kept = {key: geometry for key, geometry in search.geometries.items() if key in believed}
    notes = (*_left_out(found), *_left_out_parts(search, original))
    warnings = _wrong_poses(stale, names)
    return Matched(
        geometries=kept,
        gate=found,
        intrinsics=search.view.intrinsics,
        still=search.still,
        notes=notes,
        warnings=warnings,
    )


def _without_robot(search: _Search, original: tuple[int, int]) -> Matched:
    """Return all pairs that match, where the gripper poses are not used."""
    search.match_in_full(list(search.geometries))
    return Matched(
        geometries=search.geometries,
        gate=None,
        intrinsics=search.view.intrinsics,
        still=search.still,
        notes=_left_out_parts(search, original),
    )


def _believed(found: Gate, stale: set[int], known: bool) -> set[Key]:
    """Return the pairs that the gripper poses do not contradict, and those of images whose pose is wrong."""
    believed = {pair.key for pair in found.confirmed}
    believed |= {pair.key for pair in found.contradicted if stale & set(pair.key)}
    # Of a pair whose rotation is not measured, only what the known rotation explains would be right.
    return believed if known else believed | {pair.key for pair in found.undecided}


def _upright(search: _Search, pairs: Sequence[Key], upright: Float[ndarray, " n"], found: Gate) -> Gate:
    """Match pairs with images rotated upright and return the gate after it."""
    search.match(pairs, upright)
    search.match_in_full(pairs, upright)
    return search.gate(found)


def _without_partners(found: Gate, count: int) -> set[int]:
    """Images that fewer than two confirmed pairs tie to others."""
    rows = [row for pair in found.confirmed for row in pair.key]
    return set(np.flatnonzero(np.bincount(rows, minlength=count) < 2).tolist())


def _with_intrinsics(search: _Search, guess: Intrinsics) -> Gate:
    """Return the gate with the given intrinsics, or with those for which most pairs agree with the gripper."""
    if search.known:
        return search.gate()
    size = guess.width, guess.height
    intrinsics = focal_by_robot(list(search.matcher.x_px), size, search.geometries.items(), search.motion)
    if intrinsics is not None:
        search.view = View.of(search.matcher.x_px, intrinsics)
        search.pairs = {
            key: search.matcher.pair(search.view, key, found) for key, found in search.geometries.items()
        }
    return search.gate()


def _guessed(search: _Search, pairs: Sequence[Key], angle: Float[ndarray, "n n"], found: Gate) -> Gate:
    """Match further pairs rotated by multiples of 90° until X's rotation is known, and return the gate."""
    confirmed = {pair.key for pair in found.confirmed}
    left = sorted((key for key in pairs if key not in confirmed), key=lambda key: float(angle[key]))
    for start in range(0, min(len(left), GUESSED_AT_MOST), GUESSED_AT_ONCE):
        for quarter in range(4):
            search.match(left[start : start + GUESSED_AT_ONCE], guess=quarter * math.pi / 2)
        found = search.gate()
        if found.of_x is not None:
            break
    return found


def _contradicted_by_all(found: Gate, motion: Float[ndarray, "n n 4 4"]) -> set[int]:
    """Images whose pairs agree with each other and contradict their gripper pose: the pose is wrong, not the matches."""
    assert found.of_x is not None
    x = found.of_x.rotation
    confirmed = {row for pair in found.confirmed for row in pair.key}
    suspects = {row for pair in found.contradicted for row in pair.key} - confirmed
    stale = set()
    for row in sorted(suspects):
        # By how much the gripper would have to be rotated for each pair; sound pairs ask for the same.
        corrections = []
        for pair in found.contradicted:
            if row not in pair.key or not (set(pair.key) - {row}) & confirmed:
                continue
            of_gripper = motion[pair.key][:3, :3]
            camera = x @ pair.readings[0].rotation @ x.T
            corrections.append(of_gripper.T @ camera if pair.j == row else of_gripper @ camera.T)
        if len(corrections) < 3:
            continue
        together = rotation_angle(
            np.swapaxes(np.array(corrections), 1, 2)[:, None] @ np.array(corrections)[None]
        )
        if np.median(together) < math.radians(3):
            stale.add(row)
    return stale


def _left_out(found: Gate) -> tuple[str, ...]:
    """Return a note about the pairs that the gripper poses contradict, where these are many."""
    count = len(found.contradicted)
    total = count + len(found.confirmed)
    if count <= WORTH_SAYING * total:
        return ()
    return (
        f"the robot contradicts {count} of {total} matched pairs of images by their relative rotation: left out",
    )


def _wrong_poses(stale: set[int], names: Sequence[str]) -> tuple[str, ...]:
    """Return a warning about gripper rotations that the matches contradict."""
    if not stale:
        return ()
    listed = ", ".join(names[row] for row in sorted(stale))
    return (
        f"the matches of {listed} agree with each other and contradict the reported gripper rotation; check its pose",
    )


def _left_out_parts(search: _Search, original: tuple[int, int]) -> tuple[str, ...]:
    """Return a note about the parts of the image whose matches are left out, because they do not move with the scene."""
    if search.still is None:
        return ()
    place = still_in_words(
        search.still, (search.view.intrinsics.width, search.view.intrinsics.height), original
    )
    return (
        f"a part of the image does not move while the gripper does, fingers or a logo: {place} px: left out",
    )
