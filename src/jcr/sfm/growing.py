"""A reconstruction to which images are added one at a time, with what was found of the others kept.

A new image is matched with those with which the robot says that it overlaps, its pairs are judged by the robot, it is
registered by COLMAP's incremental mapper, and what is near it is adjusted. While there are few images, and where images
stay out, all is mapped again from the features and matches that are kept: seldom, as the number of images grows by a
share each time.
"""

import tempfile
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.camera import unproject
from jcr.capture.images import read_image
from jcr.estimation.closed_form import motions
from jcr.features import gate as robot
from jcr.features.gate import Gate, Key, Pair
from jcr.features.kept import KeepingMatcher, KeptFeatures
from jcr.features.pairs import NEIGHBOURS, near_pairs, seen_in_common
from jcr.features.still import hidden
from jcr.features.verify import Geometries, View, pair_of, write_geometries, write_keypoints
from jcr.progress import silent
from jcr.records import Capture, Reconstruction
from jcr.sfm.colmap import starting_intrinsics
from jcr.sfm.mapping import (
    adjust_robustly,
    enter,
    intrinsics_of,
    map_incrementally,
    matched_pairs,
    pipeline_options,
    quiet_colmap,
    sift_features,
    tracks_of,
)
from jcr.sfm.options import ColmapOptions
from jcr.sfm.pose_primed import poses_of

OPTIONS = ColmapOptions()
"""Options of a calibration without options, which finds features and pairs of the same working size and seed."""
FEW = 5
"""Images up to which all are mapped again with each: the first pair may have been an unlucky one."""
AGAIN = 1.3
"""Growth of the number of images after which all are mapped again where images stay out of the map."""
ADJUSTED_TOGETHER = 16
"""Images up to which all cameras and points are adjusted with each, and not only those near the new image."""
ADJUSTED_AGAIN = 1.5
"""Growth of the number of images after which all are adjusted beyond that."""
LEAST_INLIERS = 15
"""Points by which an image is registered."""
LEAST_AGAINST = 3
"""Pairs of an image that contradict its gripper rotation, and none that confirms it: the pose may be wrong."""


class Growing:
    """Cameras and tracks of the images of a capture that is being taken; features are kept in the capture's folder."""

    def __init__(self, capture: Capture) -> None:
        """Map all images that the capture has, from features and pairs that its folder keeps where there are some."""
        self._temporary = tempfile.TemporaryDirectory(prefix="jcr-growing-")
        self._database = Path(self._temporary.name) / "database.db"
        self._capture = capture
        self._rows = list(range(len(capture)))
        self._all_intrinsics, self._known, _ = starting_intrinsics(capture)
        self._kept = KeptFeatures.growing(capture.folder)
        with quiet_colmap():
            self._map_all()

    def _map_all(self) -> None:
        capture, known = self._capture, self._known
        images = [read_image(capture.folder / name) for name in capture.images]
        for name, pose in zip(capture.images, capture.base_from_gripper, strict=True):
            self._kept.append(capture.folder / name, pose)
        cameras = enter(self._database, len(capture), self._all_intrinsics, known, OPTIONS.working_size_px)
        self._features = sift_features(images, cameras[0], silent, self._kept)
        self._matcher = KeepingMatcher(self._features, cameras[0], known, OPTIONS.seed, self._kept)
        poses = capture.base_from_gripper
        matched = matched_pairs(
            self._database,
            self._matcher,
            poses,
            self._all_intrinsics[0],
            cameras,
            known,
            capture.images,
            silent,
        )
        self._gate, self._still = matched.gate or Gate((), (), (), None), matched.still
        self._view = View.of(self._matcher.x_px, matched.intrinsics)
        self._geometries: Geometries = dict(matched.geometries)
        self._matched_with = {row: 0 for row in self._rows}
        for key in self._geometries:
            self._count_match(key)
        self._model = map_incrementally(self._database, len(capture), cameras, known, OPTIONS.seed, silent)
        self._mapped_of = self._adjusted_of = len(capture)
        if self._model is not None:
            adjust_robustly(self._model, fix_intrinsics=known)

    @property
    def is_to_be_mapped_again(self) -> bool:
        """Test whether all images are mapped again with the next one."""
        count = len(self._rows) + 1
        is_poor = self._model is None or self._gate.of_x is None
        if self._mapped_of <= FEW or is_poor:
            return self._mapped_of <= FEW or count > AGAIN * self._mapped_of
        return len(self.registered) < len(self._rows) and count > AGAIN * self._mapped_of

    @property
    def registered(self) -> list[int]:
        """Rows of the capture with a camera in the map."""
        if self._model is None:
            return []
        inside = {image_id - 1 for image_id in self._model.reg_image_ids()}
        return [place for place, row in enumerate(self._rows) if row in inside]

    def matched_with(self, place: int) -> int:
        """Return the number of other images that an image matches and the gripper poses do not contradict."""
        return self._matched_with[self._rows[place]]

    def add(self, capture: Capture, image: UInt8[ndarray, "h w 3"]) -> None:
        """Match and register the last image of a capture whose others are those that are here."""
        self._capture = capture
        row = len(self._view.x_px)
        self._rows.append(row)
        self._matched_with[row] = 0
        self._kept.append(capture.folder / capture.images[-1], capture.base_from_gripper[-1])
        self._features.add(image)
        self._matcher.images_added()
        x_px = self._matcher.x_px[row]
        rays = unproject(self._view.intrinsics, x_px)[:, :2]
        self._view = View([*self._view.x_px, x_px], self._view.intrinsics, [*self._view.rays, rays])
        with quiet_colmap():
            self._match(row)
            if self._model is not None:
                self._register([row, *self._left_out(row)])

    def remove(self, place: int) -> None:
        """Take an image out of the map; the capture is that without it from the next `add` on."""
        row = self._rows.pop(place)
        self._gate = replace(self._gate, confirmed=tuple(p for p in self._gate.confirmed if row not in p.key))
        self._geometries = {key: found for key, found in self._geometries.items() if row not in key}
        if self._model is not None and row + 1 in self._model.reg_image_ids():
            self._model.deregister_frame(self._model.image(row + 1).frame_id)

    def reconstruction(self) -> Reconstruction | None:
        """Return the map as a reconstruction, rows counted as in the capture; None with fewer than two cameras."""
        places = self.registered
        if self._model is None or len(places) < 2:
            return None
        rows = [self._rows[place] for place in places]
        intrinsics = (
            self._all_intrinsics[0]
            if self._known
            else intrinsics_of(self._model.camera(1), self._all_intrinsics[0])
        )
        return Reconstruction(
            image_index=np.array(places),
            recon_from_camera=poses_of(self._model, rows),
            intrinsics=intrinsics,
            tracks=tracks_of(self._model, [row + 1 for row in rows], (intrinsics.width, intrinsics.height)),
            backend="colmap",
        )

    def close(self) -> None:
        """Remove the working files."""
        self._temporary.cleanup()

    def _motion(self) -> Float[ndarray, "r r 4 4"]:
        """Return the motions between the grippers of all rows; removed images have the identity as pose."""
        poses = np.tile(np.eye(4), (len(self._view.x_px), 1, 1))
        poses[self._rows] = self._capture.base_from_gripper
        return motions(poses)

    def _partners(self, row: int, motion: Float[ndarray, "r r 4 4"]) -> list[Key]:
        """Pairs of a new image: with all of few images, of many with those near it and those that see the same."""
        if len(self._rows) <= self._matcher.every_pair:
            return [(other, row) for other in self._rows if other != row]
        rows = np.array(self._rows)
        near = near_pairs(motion[np.ix_(rows, rows)], NEIGHBOURS)
        pairs = {(int(rows[i]), int(rows[j])) for i, j in near}
        if self._gate.of_x is not None:
            pairs |= set(seen_in_common(self._view, self._gate, motion))
        return sorted(key for key in pairs if row in key and set(key) <= set(self._rows))

    def _match(self, row: int) -> None:
        """Geometries of a new image's pairs, without those that the robot contradicts."""
        motion = self._motion()
        todo = self._partners(row, motion)
        found = self._matcher.geometries(todo, np.zeros((len(todo), 2)))
        found = {key: self._moving(key, geometry) for key, geometry in found.items()}
        sound = {key: geometry for key, geometry in found.items() if geometry is not None}
        pairs = [pair_of(self._view, *key, geometry) for key, geometry in sound.items()]
        systematic = robot.SYSTEMATIC if self._known else robot.SYSTEMATIC_OF_GUESS
        judged = robot.judge(pairs, motion, systematic, self._gate.of_x)
        self._gate = replace(self._gate, confirmed=(*self._gate.confirmed, *judged.confirmed))
        believed = {pair.key for pair in self._believed(judged)}
        for key in sorted(believed):
            self._geometries[key] = sound[key]
            self._count_match(key)

    def _believed(self, judged: Gate) -> tuple[Pair, ...]:
        if not judged.confirmed and len(judged.contradicted) >= LEAST_AGAINST:
            # Its gripper pose is in doubt, not its matches: the calibration decides.
            return judged.contradicted
        return judged.confirmed if self._known else (*judged.confirmed, *judged.undecided)

    def _moving(self, key: Key, geometry: pycolmap.TwoViewGeometry) -> pycolmap.TwoViewGeometry | None:
        """Return the geometry, verified again without matches in parts that do not move with the scene."""
        if self._still is None:
            return geometry
        matcher = self._matcher
        raw, inside = matcher.raw[key], np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
        is_still = [
            hidden(matcher.x_px[key[0]][rows[:, 0]], self._still)
            | hidden(matcher.x_px[key[1]][rows[:, 1]], self._still)
            for rows in (raw, inside)
        ]
        return matcher.verified(key, raw[~is_still[0]]) if is_still[1].any() else geometry

    def _count_match(self, key: Key) -> None:
        for row in key:
            self._matched_with[row] += 1

    def _left_out(self, new: int) -> list[int]:
        """Other rows that match some image and are not in the map."""
        assert self._model is not None
        inside = {image_id - 1 for image_id in self._model.reg_image_ids()}
        return [r for r in self._rows if r not in inside and r != new and self._matched_with[r]]

    def _register(self, rows: Sequence[int]) -> None:
        """Register images, triangulate what they see, adjust what is near them, and now and then everything."""
        assert self._model is not None
        options = pipeline_options(self._known, OPTIONS.seed)
        mapping, triangulation = options.get_mapper(), options.get_triangulation()
        mapping.abs_pose_min_num_inliers = LEAST_INLIERS
        self._database.unlink()
        enter(
            self._database, len(self._view.x_px), self._all_intrinsics, self._known, OPTIONS.working_size_px
        )
        write_keypoints(self._database, self._view.x_px)
        write_geometries(self._database, self._geometries)
        with closing(pycolmap.Database.open(self._database)) as db:
            cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions())
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(self._model)
        for row in rows:
            if not cache.exists_image(row + 1) or not mapper.register_next_image(mapping, row + 1):
                continue
            mapper.triangulate_image(triangulation, row + 1)
            mapper.iterative_local_refinement(
                options.ba_local_max_refinements,
                options.ba_local_max_refinement_change,
                mapping,
                options.get_local_bundle_adjustment(),
                triangulation,
                row + 1,
            )
        mapper.end_reconstruction(False)
        count = len(self._rows)
        if count <= ADJUSTED_TOGETHER or count >= ADJUSTED_AGAIN * self._adjusted_of:
            adjust_robustly(self._model, fix_intrinsics=self._known)
            self._adjusted_of = count
