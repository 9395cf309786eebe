"""Map of a capture that is being taken: every image is matched as in a batch, with features and pairs kept in memory.

The cameras of the last map, and new ones by absolute pose from its points, prime the next map.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.camera import resized
from jcr.estimation.absolute_pose import absolute_pose
from jcr.features.matchers import Matcher
from jcr.features.sift_features import SiftFeatures
from jcr.features.verify import Geometries
from jcr.progress import silent
from jcr.records import Capture, Intrinsics, Reconstruction
from jcr.sfm.colmap import starting_intrinsics
from jcr.sfm.mapping import (
    adjust_robustly,
    enter,
    intrinsics_of,
    map_of_pairs,
    matched_pairs,
    quiet_colmap,
    tracks_of,
    working_cameras,
)
from jcr.sfm.options import ColmapOptions
from jcr.sfm.pose_primed import LEAST_POINTS, Cameras, map_from_cameras, poses_of

OPTIONS = ColmapOptions()
"""Options of a calibration without options."""
FEW = 5
"""Number of images up to which COLMAP maps all with each new one; the first pair may have been an unlucky one."""
ENOUGH = 1e-3
"""Relative change of the cost that ends an adjustment; the calibration of each state adjusts the images again."""
LAST_PASS = (4.0, 1, 0.5)
"""Pass of pose-primed mapping (pose_primed.PASSES) from cameras that are known to a pixel."""


class LiveMap:
    """Cameras and tracks of the images of a capture that is being taken."""

    def __init__(self, capture: Capture) -> None:
        """Begin a map without images; the intrinsics are those of the capture, or estimated."""
        self._all_intrinsics, self._known, _ = starting_intrinsics(capture)
        camera = working_cameras(self._all_intrinsics, self._known, OPTIONS.working_size_px)[0]
        self._features = SiftFeatures([], (camera.width, camera.height), 1, silent)
        self._matcher = Matcher(self._features, np.ones(2), camera, self._known, OPTIONS.seed)
        self._names: list[str] = []
        self._geometries: Geometries = {}
        self._model: pycolmap.Reconstruction | None = None
        self._places: list[int] = []

    @property
    def registered(self) -> list[int]:
        """Rows of the capture with a camera in the map."""
        return sorted(self._places[row] for row in self._rows())

    def matched_with(self, place: int) -> int:
        """Return the number of other images that an image matches and the gripper poses do not contradict."""
        row = self._places.index(place)
        return sum(row in key for key in self._geometries)

    def update(self, capture: Capture, new: Mapping[str, UInt8[ndarray, "h w 3"]]) -> None:
        """Map the images of a capture; `new` holds those that the map has not, and images that are gone leave it."""
        with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-live-") as folder:
            database = Path(folder) / "database.db"
            cameras = enter(
                database, len(capture), self._all_intrinsics, self._known, OPTIONS.working_size_px
            )
            self._take(capture, new)
            poses = capture.base_from_gripper[self._places]
            matched = matched_pairs(
                database,
                self._matcher,
                poses,
                self._all_intrinsics[0],
                cameras,
                self._known,
                self._names,
                silent,
            )
            self._geometries = matched.geometries
            begun = self._extended(database, matched.geometries)
            self._model = map_of_pairs(database, self._matcher, matched, cameras, poses, silent, begun)
            if self._model is not None and self._model is not begun:
                adjust_robustly(self._model, fix_intrinsics=self._known)

    def _take(self, capture: Capture, new: Mapping[str, UInt8[ndarray, "h w 3"]]) -> None:
        """Remove the features of images that the capture no longer has, and find those of new ones."""
        for name in [name for name in self._names if name not in capture.images]:
            row = self._names.index(name)
            self._features.remove(row)
            self._matcher.image_removed(row)
            self._names.remove(name)
            self._model = None  # Its images are named by their rows.
        for name in capture.images:
            if name not in self._names:
                self._features.add(new[name])
                self._matcher.image_added()
                self._names.append(name)
        place = {name: row for row, name in enumerate(capture.images)}
        self._places = [place[name] for name in self._names]

    def _extended(self, database: Path, geometries: Geometries) -> pycolmap.Reconstruction | None:
        """Return a map primed by the last one; None where COLMAP is to map all images."""
        if self._model is None or len(self._names) <= FEW:
            return None
        rows = self._rows()
        cameras: Cameras = dict(zip(rows, poses_of(self._model, rows), strict=True))
        for row in sorted(set(range(len(self._names))) - set(rows)):
            if (pose := self._resected(self._model, row, geometries)) is not None:
                cameras[row] = pose

        def adjust(made: pycolmap.Reconstruction, scale_px: float) -> None:
            adjust_robustly(made, self._known, ENOUGH, scale_px)

        model = map_from_cameras(database, self._model.camera(1), cameras, adjust, (LAST_PASS,))
        return model if model.num_reg_images() >= len(rows) else None

    def _resected(
        self, model: pycolmap.Reconstruction, row: int, geometries: Geometries
    ) -> Float[ndarray, "4 4"] | None:
        """Return recon_from_camera of a new image from its matches with points of the last map; None where few agree."""
        points: dict[int, ndarray] = {}
        for key, geometry in geometries.items():
            other = key[1 - key.index(row)] if row in key else row
            if other == row or not model.exists_image(other + 1):
                continue
            observed, matches = model.image(other + 1).points2D, np.asarray(geometry.inlier_matches, int)
            for mine, theirs in matches if key[0] == row else matches[:, ::-1]:
                if observed[int(theirs)].has_point3D():
                    points[int(mine)] = model.point3D(observed[int(theirs)].point3D_id).xyz
        if len(points) < LEAST_POINTS:
            return None
        camera = model.camera(1)
        intrinsics = resized(self._intrinsics(), camera.width, camera.height)
        x_px = self._matcher.x_px[row][list(points)]
        found = absolute_pose(x_px, np.array(list(points.values())), intrinsics, gate_px=LAST_PASS[0])
        return None if found is None or found.inlier.sum() < LEAST_POINTS else found.a_from_camera

    def _intrinsics(self) -> Intrinsics:
        """Return the intrinsics of the images, given or of the map."""
        given = self._all_intrinsics[0]
        return given if self._known or self._model is None else intrinsics_of(self._model.camera(1), given)

    def _rows(self) -> list[int]:
        """Return the rows, among the matcher's images, of the images that the model has registered."""
        if self._model is None or self._model.num_reg_images() < 2:
            return []
        return sorted(image_id - 1 for image_id in self._model.reg_image_ids())

    def reconstruction(self) -> Reconstruction | None:
        """Return the map as a reconstruction, rows counted as in the capture; None with fewer than two cameras."""
        rows = sorted(self._rows(), key=lambda row: self._places[row])
        if self._model is None or not rows:
            return None
        intrinsics = self._intrinsics()
        return Reconstruction(
            image_index=np.array([self._places[row] for row in rows]),
            recon_from_camera=poses_of(self._model, rows),
            intrinsics=intrinsics,
            tracks=tracks_of(self._model, [row + 1 for row in rows], (intrinsics.width, intrinsics.height)),
            backend="colmap",
        )
