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
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from jcr.files import read_bytes, written_whole
from jcr.match.gate import Key
from jcr.match.matchers import Features, Matcher
from jcr.match.verify import Geometries
from jcr.records import Capture

FOLDER = "live/features"
"""In the folder of a capture."""
FORMAT = "jcr.features/2"
"""To be changed with whatever changes the features, the matches or the geometries of a pair."""
_MATRICES = ("E", "F", "H")

Sift = tuple[Float[ndarray, "k 2"], Float32[ndarray, "k 128"]]
"""Keypoints (px; pixel centres are whole numbers) and their unit descriptors."""
MatchedPair = tuple[Int[ndarray, "m 2"], pycolmap.TwoViewGeometry | None]
"""Rows of all keypoints that match, right or wrong, and the geometry of most; None where too few agree on one."""


def file_digest(file: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(read_bytes(file)).hexdigest()


@dataclass(frozen=True)
class KeptFeatures:
    """What is kept of the images of a capture, by their rows."""

    folder: Path
    is_written: bool
    """Whether what is found is written, too: only a capture that is being taken changes its folder."""
    digests: list[str] = field(default_factory=list)
    """Of the images' files."""

    @staticmethod
    def of(capture: Capture) -> "KeptFeatures | None":
        """To be read, of a capture that was calibrated while it was taken; None of another."""
        if not (capture.folder / FOLDER).is_dir():
            return None
        digests = [file_digest(capture.folder / name) for name in capture.images]
        return KeptFeatures(capture.folder / FOLDER, False, digests)

    @staticmethod
    def growing(folder: Path) -> "KeptFeatures":
        """To be read and written, of the folder of a capture, so far without images."""
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        return KeptFeatures(folder / FOLDER, True)

    def features(self, row: int, size: tuple[int, int]) -> Sift | None:
        """Of an image at a working size (px); None where there are none."""
        file = _read(self._of_image(row, size))
        return None if file is None else (file["x_px"], file["descriptors"])

    def keep_features(self, row: int, size: tuple[int, int], found: Sift) -> None:
        """Write the features of an image at a working size (px)."""
        _write(self._of_image(row, size), {"x_px": found[0], "descriptors": found[1]})

    def pair(self, key: Key, depends: str) -> MatchedPair | None:
        """Of two images; None where it is not known. `depends`: all by which geometries of the same images differ."""
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
        super().__init__(features, np.ones(2), camera, known, seed)
        self._kept, self._depends = kept, _camera_text(camera, known, seed)

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> Geometries:
        """Verified two-view geometries of pairs; neither the rotations of the images (rad) nor `coarse` change them."""
        there = {key: self._kept.pair(key, self._depends) for key in pairs}
        new = [k for k, key in enumerate(pairs) if there[key] is None]
        found = super().geometries([pairs[k] for k in new], rolls[new])
        for key, one in there.items():
            if one is not None:
                self.raw[key], geometry = one
                if geometry is not None:
                    found[key] = geometry
            elif self._kept.is_written:
                self._kept.keep_pair(key, self._depends, (self.raw[key], found.get(key)))
        return {key: found[key] for key in pairs if key in found}

    def images_added(self) -> None:
        """Take note of images that the features have since the last pairs."""
        self.x_px = self._at_work()


def _camera_text(camera: pycolmap.Camera, known: bool, seed: int) -> str:
    """All of a matcher by which geometries of the same images differ."""
    return f"{camera.model.name} {camera.width} {camera.height} {camera.params.tolist()} {known} {seed}"


def _name(*depends: str) -> str:
    return hashlib.sha256("\n".join((FORMAT, *depends)).encode()).hexdigest()[:32]


def _write(path: Path, arrays: dict[str, ndarray]) -> None:
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _read(path: Path) -> dict[str, ndarray] | None:
    """All arrays of a file; None where there is none, or a damaged one: it is made again."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return dict(file)
    except Exception:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        return None
