"""Map of a capture that is being taken: new images are matched, and COLMAP's mapper continues the last map."""

from collections.abc import Mapping

import pycolmap
from jaxtyping import UInt8
from numpy import ndarray

from jcr.features.matchers import Matcher
from jcr.features.pair_search import MatchedPairs
from jcr.features.sift import SiftFeatures
from jcr.progress import silent
from jcr.records import Capture, Reconstruction
from jcr.sfm.colmap import map_images, starting_intrinsics
from jcr.sfm.model import (
    adjust_robustly,
    intrinsics_of,
    quiet_colmap,
    reconstruction_of,
    rows_of,
    working_cameras,
)

REMAPPED_UP_TO = 5
"""Largest number of images for which every update maps from scratch, because the first pair may have been a poor one."""


class LiveMap:
    """Map (camera poses and tracks) that grows while the images of a capture are being taken."""

    def __init__(self, capture: Capture) -> None:
        """Create a map without images; intrinsics that the capture does not have are estimated during the mapping."""
        self._all_intrinsics, self._known, _ = starting_intrinsics(capture)
        self._cameras = working_cameras(self._all_intrinsics, self._known)
        camera = self._cameras[0]
        self._features = SiftFeatures([], (camera.width, camera.height), 1, silent)
        self._matcher = Matcher(self._features, camera, self._known, seed=0)
        self._names: list[str] = []
        self._matched: MatchedPairs | None = None
        self._model: pycolmap.Reconstruction | None = None
        self._places: list[int] = []

    @property
    def registered(self) -> list[int]:
        """Rows of the capture's images that have a camera pose in the map, ascending."""
        return sorted(self._places[row] for row in self._rows())

    def matched_with(self, place: int) -> tuple[int, int]:
        """Return how many other images match the image in row `place` of the capture, with and against their poses.

        Against their poses are matches that the rotation of the gripper between the two images contradicts.
        """
        row, found = self._places.index(place), self._matched
        pairs = ((), ()) if found is None else (found.geometries, found.contradicted)
        agreeing, contradicted = (sum(row in key for key in keys) for keys in pairs)
        return agreeing, contradicted

    def update(self, capture: Capture, new: Mapping[str, UInt8[ndarray, "h w 3"]]) -> None:
        """Update the map to the images of a capture; `new` contains, by name, the images added since the last update.

        Images that are no longer in the capture are removed, and the map then begins anew. It also does so in every
        update with REMAPPED_UP_TO images or fewer, or while fewer than three quarters of the images are registered.
        """
        for name in [name for name in self._names if name not in capture.images]:
            row = self._names.index(name)
            self._features.remove(row)
            self._matcher.remove_image(row)
            self._names.remove(name)
            self._model = None  # The model names images by their rows, which have changed.
        for name in capture.images:
            if name not in self._names:
                self._features.add(new[name])
                self._names.append(name)
        self._places = [capture.images.index(name) for name in self._names]
        begun = self._model if len(self._names) > REMAPPED_UP_TO else None
        if begun is not None and 4 * begun.num_reg_images() < 3 * len(self._names):
            # A map that many images do not fit has gone astray, with its intrinsics. With one half in place of three
            # quarters, a real capture stays so for three more images.
            begun = None
        with quiet_colmap():
            self._matched, self._model = map_images(
                self._matcher,
                capture.base_from_gripper[self._places],
                self._all_intrinsics[0],
                self._cameras,
                self._names,
                silent,
                begun,
            )
            if self._model is not None and self._model is not begun:
                adjust_robustly(self._model, fix_intrinsics=self._known)

    def _rows(self) -> list[int]:
        """Return the rows of the registered images, counted in the order of the matcher; empty with fewer than two."""
        return [] if self._model is None or self._model.num_reg_images() < 2 else rows_of(self._model)

    def reconstruction(self) -> Reconstruction | None:
        """Return the map as a reconstruction; None with fewer than two registered images."""
        rows = sorted(self._rows(), key=lambda row: self._places[row])
        if self._model is None or not rows:
            return None
        intrinsics = intrinsics_of(self._model.camera(1), self._all_intrinsics[0], self._known)
        return reconstruction_of(self._model, rows, intrinsics, [self._places[row] for row in rows])
