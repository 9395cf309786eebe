"""Two-view geometries of matched keypoints by COLMAP's robust estimation, with all their readings, for any features."""

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_dilation, label

from jcr.camera import HALF_PIXEL, unproject
from jcr.features.gate import Key, Pair
from jcr.features.two_view import readings
from jcr.records import Intrinsics

FeatureName = Literal["auto", "sift", "xfeat"]
"""Kinds of features; auto stands for sift, unless a rejected result is followed by xfeat."""
Geometries = dict[Key, pycolmap.TwoViewGeometry]

MIN_INLIERS = 25
"""Least number of inliers; with COLMAP's 15 a view of a board was registered 30 cm off, by the wrong squares."""
STATIONARY_PX = 4.0
"""Largest way of a match that keeps its pixel while the gripper moves: of its fingers, or text drawn into the images."""
CELL_PX = 16
NEAR_PX = 2.5
"""Largest distance of a keypoint's positions in two images that counts as no motion."""
LEAST_PAIRS, LEAST_SHARE = 4, 0.2
"""Least number and share of the pairs with matches in a cell; by chance a point keeps its pixel in one or two."""
LEAST_CELLS = 3


@runtime_checkable
class Features(Protocol):
    """Keypoints of a capture's images, of any kind."""

    x_px: list[Float[ndarray, "_ 2"]]
    """Keypoints of every image found so far, px; pixel centres are whole numbers."""

    @property
    def minds_roll(self) -> bool:
        """True if the features need images that are rotated upright."""
        ...

    @property
    def every_pair(self) -> int:
        """Captures of up to this many images have all pairs matched; of more, pairs grow in proportion to the images."""
        ...

    def matches(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> list[Int[ndarray, "_ 2"]]:
        """Return rows of matching keypoints of pairs, their images rotated (rad) before."""
        ...


@dataclass(frozen=True)
class ImageGeometry:
    """Keypoints, rays and intrinsics of the images at the working size."""

    x_px: Sequence[Float[ndarray, "_ 2"]]
    """Keypoints of every image; pixel centres are whole numbers."""
    intrinsics: Intrinsics
    """Given, or a guess."""
    rays: Sequence[Float[ndarray, "_ 2"]]
    """x/z, y/z of the keypoints through those intrinsics."""

    @staticmethod
    def of(x_px: Sequence[Float[ndarray, "_ 2"]], intrinsics: Intrinsics) -> "ImageGeometry":
        """Return the keypoints with their rays."""
        return ImageGeometry(x_px, intrinsics, [unproject(intrinsics, x)[:, :2] for x in x_px])


class Matcher:
    """Verified matches between a capture's images, all of one camera."""

    def __init__(
        self, features: Features, scale: Float[ndarray, "2"], camera: pycolmap.Camera, known: bool, seed: int
    ) -> None:
        """`camera` is at the working size, `scale` its pixels per pixel of the features; `known`: it is given."""
        self.features, self._scale = features, scale
        self._camera, self.known, self.seed = camera, known, seed
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}
        """All matches of the pairs that were tried last, right or wrong."""
        self.still: Bool[ndarray, "r c"] | None = None
        """Cells of the image that do not move while the gripper does, whose matches are left out."""
        self._verified: dict[tuple[Key, bytes], pycolmap.TwoViewGeometry | None] = {}
        """Geometries by pair and matches."""
        self._pairs: dict[tuple[Key, int, Intrinsics], tuple[Pair, pycolmap.TwoViewGeometry]] = {}
        """Pairs by the identity of their geometry, which is kept with them so that no other takes its place."""

    @property
    def x_px(self) -> list[Float[ndarray, "_ 2"]]:
        """Keypoints at the working size; more come with every angle by which an image is rotated."""
        return [(x + 0.5) * self._scale - 0.5 for x in self.features.x_px]

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], repeats: Bool[ndarray, "n n"]
    ) -> Geometries:
        """Return verified two-view geometries of pairs, their images rotated (rad) before.

        `repeats` are the pairs between whose images the gripper did not move.
        """
        new = [k for k, key in enumerate(pairs) if self.features.minds_roll or key not in self.raw]
        some = [pairs[k] for k in new]
        self.raw |= dict(zip(some, self.features.matches(some, rolls[new]), strict=True))
        x_px = self.x_px
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda key: self.verified(key, self.raw[key], x_px, not repeats[key]), pairs)
            return {key: geometry for key, geometry in zip(pairs, found, strict=True) if geometry is not None}

    def verified(
        self, key: Key, rows: Int[ndarray, "m 2"], x_px: Sequence[Float[ndarray, "_ 2"]], moved: bool
    ) -> pycolmap.TwoViewGeometry | None:
        """Return the geometry of some of a pair's matches, kept in memory; None where too few agree on one.

        Matches that keep their pixel are left out where the gripper `moved`, and those in `still` cells.
        """
        if moved:
            x_i, x_j = (x_px[image][own] for image, own in zip(key, rows.T, strict=True))
            rows = rows[np.linalg.norm(x_i - x_j, axis=1) > STATIONARY_PX]
        depends = key, np.ascontiguousarray(rows).tobytes()
        if depends not in self._verified:
            self._verified[depends] = matched(x_px, self._camera, key, rows, self.seed, self.known)
        found = self._verified[depends]
        if found is None or self.still is None:
            return found
        inliers = np.asarray(found.inlier_matches, dtype=int).reshape(-1, 2)
        shown, usable = (
            ~np.any(
                [hidden(x_px[image][own], self.still) for image, own in zip(key, of.T, strict=True)], axis=0
            )
            for of in (inliers, rows)
        )
        return found if shown.all() else self.verified(key, rows[usable], x_px, moved)

    def pair(self, view: ImageGeometry, key: Key, geometry: pycolmap.TwoViewGeometry) -> Pair:
        """Return a geometry with its readings through the view's intrinsics, kept in memory."""
        depends = key, id(geometry), view.intrinsics
        if depends not in self._pairs:
            rows = np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
            ray_i, ray_j = (view.rays[row][own] for row, own in zip(key, rows.T, strict=True))
            found = readings(ray_i, ray_j, view.intrinsics.fx, *matrices(geometry, view.intrinsics))
            self._pairs[depends] = Pair(key, rows, tuple(found)), geometry
        return self._pairs[depends][0]

    def image_removed(self, row: int) -> None:
        """Forget the pairs of an image that the features no longer have; the rows of later images are one less."""

        def after(key: Key) -> Key:
            """Return the rows of a pair without the image."""
            return key[0] - (key[0] > row), key[1] - (key[1] > row)

        self._pairs.clear()
        self.raw = {after(key): rows for key, rows in self.raw.items() if row not in key}
        self._verified = {
            (after(key), rows): one for (key, rows), one in self._verified.items() if row not in key
        }


def matched(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    camera: pycolmap.Camera,
    key: Key,
    rows: Int[ndarray, "m 2"],
    seed: int,
    known: bool,
) -> pycolmap.TwoViewGeometry | None:
    """Return the geometry on which most matches agree; None where too few do. `known`: the intrinsics are no guess."""
    if len(rows) < MIN_INLIERS:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    # With COLMAP's own (0.25, 3, 0.999, 10000) it takes four times as long and finds 1 % more inliers.
    options.ransac.min_inlier_ratio = max(0.25, MIN_INLIERS / len(rows))
    options.ransac.dyn_num_trials_multiplier = 1.0
    options.ransac.confidence, options.ransac.max_num_trials = 0.99, 2000
    options.min_num_inliers = MIN_INLIERS
    if known:  # a fundamental matrix bends itself to wrong matches, which an essential matrix cannot explain
        options.min_E_F_inlier_ratio = 0.0
    x_i, x_j = (x_px[row] + HALF_PIXEL for row in key)
    found = pycolmap.estimate_two_view_geometry(camera, x_i, camera, x_j, rows.astype(np.uint32), options)
    return found if len(found.inlier_matches) >= MIN_INLIERS else None


def matrices(
    found: pycolmap.TwoViewGeometry, intrinsics: Intrinsics
) -> tuple[Float[ndarray, "3 3"] | None, Float[ndarray, "3 3"] | None]:
    """Return essential matrix and homography of normalised coordinates, j from i, where COLMAP found one."""
    k = intrinsics.matrix + HALF_PIXEL * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    essential, homography = found.E, found.H
    if essential is None and found.F is not None:
        essential = k.T @ found.F @ k
    return essential, None if homography is None else np.linalg.inv(k) @ homography @ k


def still_cells(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    raw: Mapping[Key, Int[ndarray, "_ 2"]],
    size: tuple[int, int],
    moving: Iterable[Key],
) -> Bool[ndarray, "r c"]:
    """Return cells of the image in which matches keep their pixel in many of the `moving` pairs.

    Such are the gripper's own fingers, a logo, text drawn into the images.
    """
    shape = -(-size[1] // CELL_PX), -(-size[0] // CELL_PX)
    kept, seen = np.zeros(shape), np.zeros(shape)
    for key in moving:
        rows = raw[key]
        x_i, x_j = x_px[key[0]][rows[:, 0]], x_px[key[1]][rows[:, 1]]
        stays = np.linalg.norm(x_i - x_j, axis=1) < NEAR_PX
        cells = _cells(x_i, shape)
        for counts, some in ((seen, cells), (kept, cells[stays])):
            counts[tuple(np.unique(some, axis=0).T)] += 1
    still = (kept >= LEAST_PAIRS) & (kept > LEAST_SHARE * np.maximum(seen, 1))
    parts = np.zeros(shape, dtype=np.int32)
    label(still, structure=np.ones((3, 3)), output=parts)
    still &= (np.bincount(parts.ravel()) >= LEAST_CELLS)[parts]
    return binary_dilation(still, np.ones((3, 3))) if still.any() else still


def hidden(x_px: Float[ndarray, "k 2"], still: Bool[ndarray, "r c"]) -> Bool[ndarray, " k"]:
    """Test which keypoints lie in a part that does not move."""
    return still[tuple(_cells(x_px, still.shape).T)]


def _cells(x_px: Float[ndarray, "k 2"], shape: tuple[int, int]) -> Int[ndarray, "k 2"]:
    """Return the row and column of the cell of each keypoint."""
    return np.clip((x_px // CELL_PX).astype(int), 0, [shape[1] - 1, shape[0] - 1])[:, ::-1]
