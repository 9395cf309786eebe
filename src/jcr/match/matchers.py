"""The kinds of features as matchers for `stage`: SIFT through COLMAP's database, networks through their own matchers."""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.match.gate import Key
from jcr.match.stage import Geometries
from jcr.match.verify import (
    matched,
    read_geometries,
    read_keypoints,
    verification,
    write_keypoints,
)
from jcr.records import Intrinsics

FeatureName = Literal["sift", "xfeat", "aliked"]


class SiftMatcher:
    """SIFT that was extracted into a database; it does not mind how images are rotated."""

    minds_roll = False
    every_pair = 24

    def __init__(self, database: Path, count: int, seed: int) -> None:
        self._database, self._seed = database, seed
        self.x_px = read_keypoints(database, count)
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}
        with closing(pycolmap.Database.open(database)) as db:
            self._camera = db.read_camera(1)

    def geometries(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> Geometries:
        """Matched by COLMAP, on all cores."""
        asked = set(pairs)
        lines = "".join(f"{i:05d}.png {j:05d}.png\n" for i, j in pairs)
        with tempfile.NamedTemporaryFile("w", encoding="utf-8", suffix=".txt") as listed:
            listed.write(lines)
            listed.flush()
            pairing = pycolmap.ImportedPairingOptions()
            pairing.match_list_path = listed.name
            pycolmap.match_image_pairs(
                self._database,
                pairing_options=pairing,
                verification_options=verification(self._seed),
                device=pycolmap.Device.cpu,
            )
        with closing(pycolmap.Database.open(self._database)) as db:
            for i, j in pairs:
                if db.exists_matches(i + 1, j + 1):
                    self.raw[i, j] = np.asarray(db.read_matches(i + 1, j + 1), dtype=int)
        return {key: found for key, found in read_geometries(self._database).items() if key in asked}

    def verified(self, key: Key, rows: Int[ndarray, "m 2"]) -> pycolmap.TwoViewGeometry | None:
        """The geometry of some of a pair's matches."""
        known = self._camera.has_prior_focal_length
        return matched(self.x_px, self._camera, *key, rows, self._seed, known)

    def descriptors(self, row: int, roll: float) -> tuple[int, Float[ndarray, "k d"]]:
        """0, and the unit descriptors of all keypoints; the roll changes nothing."""
        with closing(pycolmap.Database.open(self._database)) as db:
            data = np.asarray(db.read_descriptors(row + 1).data, dtype=np.float32)
        return 0, data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-9)


class LearnedMatcher:
    """Features of a network, in a database from which COLMAP maps."""

    minds_roll = True
    every_pair = 12

    def __init__(
        self,
        kind: Literal["xfeat", "aliked"],
        images: Sequence[UInt8[ndarray, "h w 3"]],
        database: Path,
        camera: pycolmap.Camera,
        lens: Intrinsics,
        known: bool,
        seed: int,
        report: Callable[[str, float], None],
    ) -> None:
        from jcr.match.learned import LearnedFeatures

        self._features = LearnedFeatures(kind, images)
        height, width = images[0].shape[:2]
        self._scale = np.array([lens.width / width, lens.height / height])
        self._database = database
        self._camera, self._known, self._seed, self._report = camera, known, seed, report
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}

    @property
    def x_px(self) -> list[Float[ndarray, "_ 2"]]:
        """Keypoints found so far, at the working size; more come with every angle by which an image is rotated."""
        return [(x + 0.5) * self._scale - 0.5 for x in self._features.x_px]

    def geometries(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> Geometries:
        """Matched pair by pair."""
        found = {}
        for k, ((i, j), (roll_i, roll_j)) in enumerate(zip(pairs, rolls, strict=True)):
            self._report("matching", k / len(pairs))
            rows = self._features.match(i, j, roll_i, roll_j)
            self.raw[i, j] = rows
            geometry = self.verified((i, j), rows)
            if geometry is not None:
                found[i, j] = geometry
        write_keypoints(self._database, self.x_px)
        return found

    def verified(self, key: Key, rows: Int[ndarray, "m 2"]) -> pycolmap.TwoViewGeometry | None:
        """The geometry of some of a pair's matches."""
        return matched(self.x_px, self._camera, *key, rows, self._seed, self._known)

    def descriptors(self, row: int, roll: float) -> tuple[int, Float[ndarray, "k d"]]:
        """Row of the first keypoint, and unit descriptors from there on, the image rotated by an angle (rad)."""
        return self._features.descriptors(row, roll)
