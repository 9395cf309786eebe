"""Robust estimation of two-view geometries from matched keypoints by COLMAP, for any kind of features."""

import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from scipy.ndimage import binary_dilation, label

from jcr.camera import HALF_PIXEL, unproject
from jcr.features.pair_verification import Key, Pair
from jcr.features.two_view import camera_motions
from jcr.records import Intrinsics

FeatureName = Literal["auto", "sift", "xfeat"]
"""Kinds of features; auto means sift, and xfeat after a rejected result."""
Geometries = dict[Key, pycolmap.TwoViewGeometry]

MIN_INLIERS = 25
"""Least number of inliers of a two-view geometry; with COLMAP's 15 a view of a board was registered 30 cm off, by wrong
squares."""
STATIONARY_PX = 4.0
"""Largest displacement, px, of a match that is discarded if the gripper moved: it lies on the gripper's fingers, or on
text drawn into the images."""
CELL_PX = 16
"""Side, px, of the image cells in which stationary matches are counted."""
NEAR_PX = 2.5
"""Largest displacement, px, of a match that counts as stationary in a cell."""
LEAST_PAIRS, LEAST_SHARE = 4, 0.2
"""Least number, and least share of the pairs with matches in a cell, of pairs with a stationary match there. By chance,
a point keeps its pixel in one or two pairs."""
LEAST_CELLS = 3
"""Least number of connected cells that form a stationary part of the image."""


@runtime_checkable
class Features(Protocol):
    """Interface of one kind of features: keypoints and descriptors of a capture's images, and their matching."""

    x_px: list[Float[ndarray, "_ 2"]]
    """Keypoints of every image found so far, in pixels of the size of matching; pixel centres are whole numbers."""
    descriptors: list[Float32[ndarray, "_ d"]]
    """Descriptors of these keypoints, of unit length."""
    farthest: float
    """Largest distance of the descriptors of a match."""

    needs_upright: bool
    """True if images must be rotated upright before matching."""
    every_pair: int
    """Largest number of images of which all pairs are matched; of more images, only pairs of near viewpoints."""

    def matches(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> list[Int[ndarray, "_ 2"]]:
        """Return for each pair its m matches, as rows of keypoints of its first and of its second image (m,2).

        The two images are first rotated by `rolls` (rad), clockwise on the screen.
        """
        ...


class Matcher:
    """Verified matches between a capture's images, all of one camera; results are cached."""

    def __init__(self, features: Features, camera: pycolmap.Camera, known: bool, seed: int) -> None:
        """Create a matcher without matches; `camera` is COLMAP's camera of the images at the size of matching.

        `known` is true if the intrinsics of `camera` are given; `seed` is that of RANSAC.
        """
        self.features, self._camera, self.known, self.seed = features, camera, known, seed
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}
        """All matches of the pairs that were matched last, correct or wrong."""
        self.still: Bool[ndarray, "r c"] | None = None
        """Cells of the image that do not move while the gripper does; matches there are discarded."""
        self._verified: dict[tuple[Key, bytes], pycolmap.TwoViewGeometry | None] = {}
        """Verified geometries by pair and matches; None where the verification failed."""
        self._pairs: dict[tuple[Key, int, Intrinsics], Pair] = {}
        """Pairs by key, identity of the geometry, and intrinsics; the pair keeps the identity of its geometry unique."""

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], repeats: Bool[ndarray, "n n"]
    ) -> Geometries:
        """Return the two-view geometries of those of the p `pairs` that match.

        `repeats` marks pairs of images between which the gripper did not move.
        """
        new = [k for k, key in enumerate(pairs) if self.features.needs_upright or key not in self.raw]
        some = [pairs[k] for k in new]
        self.raw |= dict(zip(some, self.features.matches(some, rolls[new]), strict=True))
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda key: self.verified(key, self.raw[key], not repeats[key]), pairs)
            return {key: geometry for key, geometry in zip(pairs, found, strict=True) if geometry is not None}

    def verified(self, key: Key, rows: Int[ndarray, "m 2"], moved: bool) -> pycolmap.TwoViewGeometry | None:
        """Return the two-view geometry of the matches of image pair `key`; None with fewer than MIN_INLIERS inliers.

        `rows` has a match in each row: the rows of its keypoints in the first and in the second image. If the gripper
        `moved`, matches that keep their pixel are discarded. Matches in the cells of `self.still` are always discarded.
        The result is cached.
        """
        x_px = self.features.x_px
        if moved:
            x_i, x_j = (x_px[image][own] for image, own in zip(key, rows.T, strict=True))
            rows = rows[np.linalg.norm(x_i - x_j, axis=1) > STATIONARY_PX]
        depends = key, np.ascontiguousarray(rows).tobytes()
        if depends not in self._verified:
            self._verified[depends] = estimate_geometry(x_px, self._camera, key, rows, self.seed, self.known)
        found = self._verified[depends]
        if found is None or self.still is None:
            return found
        inliers = np.asarray(found.inlier_matches, dtype=int).reshape(-1, 2)
        still = self.still

        def is_hidden(rows: Int[ndarray, "m 2"]) -> Bool[ndarray, " m"]:
            return np.any([hidden(x_px[k][own], still) for k, own in zip(key, rows.T, strict=True)], axis=0)

        return found if not is_hidden(inliers).any() else self.verified(key, rows[~is_hidden(rows)], moved)

    def pair(self, intrinsics: Intrinsics, key: Key, geometry: pycolmap.TwoViewGeometry) -> Pair:
        """Return the inliers of image pair `key`, and the camera motions that its geometry allows; cached."""
        depends = key, id(geometry), intrinsics
        if depends not in self._pairs:
            rows = np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
            ray_i, ray_j = (
                unproject(intrinsics, self.features.x_px[row][own])[:, :2]
                for row, own in zip(key, rows.T, strict=True)
            )
            found = camera_motions(ray_i, ray_j, intrinsics.fx, *matrices(geometry, intrinsics))
            self._pairs[depends] = Pair(key, rows, tuple(found), geometry)
        return self._pairs[depends]

    def remove_image(self, row: int) -> None:
        """Remove all matches of image `row`, which the features no longer have; later rows decrease by one."""

        def after(key: Key) -> Key:
            """Return the image rows of a pair as they are counted after the removal of the image."""
            return key[0] - (key[0] > row), key[1] - (key[1] > row)

        self._pairs.clear()
        self.raw = {after(key): rows for key, rows in self.raw.items() if row not in key}
        self._verified = {
            (after(key), rows): one for (key, rows), one in self._verified.items() if row not in key
        }


def estimate_geometry(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    camera: pycolmap.Camera,
    key: Key,
    rows: Int[ndarray, "m 2"],
    seed: int,
    known: bool,
) -> pycolmap.TwoViewGeometry | None:
    """Return the two-view geometry of the matches of image pair `key`; None for fewer than MIN_INLIERS inliers.

    `rows` has a match in each row: the rows of its keypoints in the first and in the second image.
    """
    if len(rows) < MIN_INLIERS:
        return None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    # COLMAP's defaults (0.25, 3, 0.999, 10000) take four times as long and find 1 % more inliers.
    options.ransac.min_inlier_ratio = max(0.25, MIN_INLIERS / len(rows))
    options.ransac.dyn_num_trials_multiplier = 1.0
    options.ransac.confidence, options.ransac.max_num_trials = 0.99, 2000
    options.min_num_inliers = MIN_INLIERS
    if known:  # a fundamental matrix may fit wrong matches that no essential matrix fits
        options.min_E_F_inlier_ratio = 0.0
    x_i, x_j = (x_px[row] + HALF_PIXEL for row in key)
    found = pycolmap.estimate_two_view_geometry(camera, x_i, camera, x_j, rows.astype(np.uint32), options)
    return found if len(found.inlier_matches) >= MIN_INLIERS else None


def matrices(
    found: pycolmap.TwoViewGeometry, intrinsics: Intrinsics
) -> tuple[Float[ndarray, "3 3"] | None, Float[ndarray, "3 3"] | None]:
    """Return a geometry's essential matrix and homography, from rays of image i to image j; None if COLMAP has none.

    They apply to rays (x/z, y/z, 1): x_jᵀ E x_i = 0, and x_j is proportional to H x_i. `found` is in pixels of images
    with `intrinsics`.
    """
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
    """Return a mask of the image cells with matches that keep their pixel in many pairs although the gripper moves.

    Such cells show the gripper's own fingers, a logo, or text drawn into the images. The cells have sides of CELL_PX,
    and many means LEAST_PAIRS and the share LEAST_SHARE. `moving` are the pairs between which the gripper moved, and
    `size` is width and height, px.
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
    """Test for each keypoint whether it lies in a cell that the mask `still` (`still_cells`) marks."""
    return still[tuple(_cells(x_px, still.shape).T)]


def _cells(x_px: Float[ndarray, "k 2"], shape: tuple[int, int]) -> Int[ndarray, "k 2"]:
    """Return the row and column of the cell (side CELL_PX) of each keypoint, for a grid of `shape` rows and columns."""
    return np.clip((x_px // CELL_PX).astype(int), 0, [shape[1] - 1, shape[0] - 1])[:, ::-1]
