"""Features and pairs of a capture's images, kept in its folder from one calibration to the next.

One file an image and one a pair, named by the SHA-256 of the images' files and of what else the content depends on: what
is read is what would be found again, bit for bit.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.features import sift, verify
from jcr.features.gate import Key
from jcr.features.matchers import Features, Matcher
from jcr.features.order import order_key
from jcr.features.sift import Sift
from jcr.features.verify import Geometries
from jcr.files import read_bytes, written_whole
from jcr.records import Capture

FOLDER = "live/features"
"""Folder of the kept features below that of a capture."""
FORMAT = "jcr.features/2"
"""Format of the files; it changes with the code that finds features, matches and geometries."""
THRESHOLDS = (
    sift.KEYPOINTS,
    sift.CONTRAST,
    sift.RATIO,
    sift.FARTHEST,
    verify.MIN_INLIERS,
    verify.STATIONARY_PX,
)
"""Constants on which features, matches and geometries depend; files made with others are not found."""
_MATRICES = ("E", "F", "H")

MatchedPair = tuple[Int[ndarray, "m 2"], pycolmap.TwoViewGeometry | None]
"""Rows of all keypoints that match, right or wrong, and the geometry of most; None where too few agree on one."""


def file_digest(file: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits."""
    return hashlib.sha256(read_bytes(file)).hexdigest()


@dataclass(frozen=True)
class KeptFeatures:
    """Features and pairs of a capture's images on disk, by the rows of the images."""

    folder: Path
    is_written: bool
    """True if new features and pairs are written; only a capture that is being taken changes its folder."""
    digests: list[str] = field(default_factory=list)
    """SHA-256 of the images' files."""
    order_keys: list[tuple[float, ...]] = field(default_factory=list)
    """Sort keys of the gripper poses: pairs are matched from the image that comes first in a reconstruction."""

    @staticmethod
    def of(capture: Capture) -> "KeptFeatures | None":
        """Return what a capture that was calibrated while it was taken keeps, to be read; None for other captures."""
        if not (capture.folder / FOLDER).is_dir():
            return None
        kept = KeptFeatures(capture.folder / FOLDER, False)
        for name, pose in zip(capture.images, capture.base_from_gripper, strict=True):
            kept.append(capture.folder / name, pose)
        return kept

    @staticmethod
    def growing(folder: Path) -> "KeptFeatures":
        """Return the store of a capture's folder, to be read and written, without images yet."""
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        return KeptFeatures(folder / FOLDER, True)

    def append(self, file: Path, base_from_gripper: Float[ndarray, "4 4"]) -> None:
        """Count one more image, in the next row."""
        self.digests.append(file_digest(file))
        self.order_keys.append(order_key(base_from_gripper))

    def in_order(self, key: Key) -> Key:
        """Return a pair with the image first that comes first in a reconstruction."""
        return key if self.order_keys[key[0]] <= self.order_keys[key[1]] else (key[1], key[0])

    def features(self, row: int, size: tuple[int, int]) -> Sift | None:
        """Return the features of an image at a working size (px); None where none are kept."""
        file = _read(self._of_image(row, size))
        return None if file is None else (file["x_px"], file["descriptors"])

    def keep_features(self, row: int, size: tuple[int, int], found: Sift) -> None:
        """Write the features of an image at a working size (px)."""
        _write(self._of_image(row, size), {"x_px": found[0], "descriptors": found[1]})

    def pair(self, key: Key, depends: str) -> MatchedPair | None:
        """Return the pair of two images; None where none is kept. `depends` names the settings of its geometry."""
        file = _read(self._of_pair(key, depends))
        if file is None:
            return None
        if "config" not in file:
            return file["raw"], None
        geometry = pycolmap.TwoViewGeometry(config=int(file["config"]))
        geometry.inlier_matches = file["inlier_matches"]
        for name in _MATRICES:
            if name in file:
                setattr(geometry, name, file[name])
        return file["raw"], geometry

    def keep_pair(self, key: Key, depends: str, found: MatchedPair) -> None:
        """Write the matches of two images and their geometry."""
        raw, geometry = found
        arrays = {"raw": raw}
        if geometry is not None:
            matrices = {name: getattr(geometry, name) for name in _MATRICES}
            arrays |= {name: matrix for name, matrix in matrices.items() if matrix is not None}
            arrays |= {"config": np.array(int(geometry.config)), "inlier_matches": geometry.inlier_matches}
        _write(self._of_pair(key, depends), arrays)

    def _of_image(self, row: int, size: tuple[int, int]) -> Path:
        return self.folder / f"image-{_name(self.digests[row], cv2.__version__, f'{size}')}.npz"

    def _of_pair(self, key: Key, depends: str) -> Path:
        digests = [self.digests[row] for row in key]
        return self.folder / f"pair-{_name(*digests, cv2.__version__, pycolmap.__version__, depends)}.npz"


class KeepingMatcher(Matcher):
    """SIFT matched once: pairs whose matches and geometries are kept are not matched again."""

    def __init__(
        self, features: Features, camera: pycolmap.Camera, known: bool, seed: int, kept: KeptFeatures
    ) -> None:
        """Read pairs from `kept`, and write new ones to it where it is to be written."""
        super().__init__(features, np.ones(2), camera, known, seed)
        self._kept, self._depends = kept, _camera_text(camera, known, seed)

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> Geometries:
        """Return verified two-view geometries of pairs; neither the rotations (rad) nor `coarse` change them."""
        matched_as = {key: self._kept.in_order(key) for key in pairs}
        there = {key: self._kept.pair(matched_as[key], self._depends) for key in pairs}
        new = [k for k, key in enumerate(pairs) if there[key] is None]
        made = super().geometries([matched_as[pairs[k]] for k in new], rolls[new])
        found = {}
        for key, one in there.items():
            if one is None:
                one = self.raw.pop(matched_as[key]), made.get(matched_as[key])
                if self._kept.is_written:
                    self._kept.keep_pair(matched_as[key], self._depends, one)
            self.raw[key], geometry = one if key == matched_as[key] else _reversed(one)
            if geometry is not None:
                found[key] = geometry
        return found

    def images_added(self) -> None:
        """Take note of images that the features have since the last pairs."""
        self.x_px = self._at_work()


def _camera_text(camera: pycolmap.Camera, known: bool, seed: int) -> str:
    """Return the settings of a matcher on which the geometries of two images depend."""
    return f"{camera.model.name} {camera.width} {camera.height} {camera.params.tolist()} {known} {seed}"


def _reversed(pair: MatchedPair) -> MatchedPair:
    """Return matches and geometry from the second image to the first."""
    rows, geometry = pair
    if geometry is not None:
        geometry.invert()
    return rows[:, ::-1], geometry


def _name(*depends: str) -> str:
    return hashlib.sha256("\n".join((FORMAT, *map(repr, THRESHOLDS), *depends)).encode()).hexdigest()[:32]


def _write(path: Path, arrays: dict[str, ndarray]) -> None:
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _read(path: Path) -> dict[str, ndarray] | None:
    """Return all arrays of a file; None where it is missing or damaged."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return dict(file)
    except Exception:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        return None
