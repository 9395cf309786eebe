"""Two-view geometry of matched keypoints, by COLMAP's robust estimation, with all its readings."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import HALF_PIXEL, unproject
from jcr.features.gate import Key, Pair
from jcr.features.two_view import readings
from jcr.records import Intrinsics

Geometries = dict[Key, pycolmap.TwoViewGeometry]

MIN_INLIERS = 25
"""Least number of inliers; with COLMAP's 15 a view of a board was registered 30 cm off, by the wrong squares."""
STATIONARY_PX = 4.0
"""Matches that keep their pixel while the gripper moves: fingers, or text drawn into the images."""


def _verification(seed: int, known: bool, matches: int) -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's options for a pair of that number of matches; `known`: the intrinsics are no guess."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    # With COLMAP's own (0.25, 3, 0.999, 10000) it takes four times as long and finds 1 % more inliers.
    options.ransac.min_inlier_ratio = max(0.25, MIN_INLIERS / matches)
    options.ransac.dyn_num_trials_multiplier = 1.0
    options.ransac.confidence, options.ransac.max_num_trials = 0.99, 2000
    options.min_num_inliers = MIN_INLIERS
    # The gripper's fingers, or text drawn into the images, keep their pixels while the scene moves.
    options.filter_stationary_matches = True
    options.stationary_matches_max_error = STATIONARY_PX
    if known:  # a fundamental matrix bends itself to wrong matches, which an essential matrix cannot explain
        options.min_E_F_inlier_ratio = 0.0
    return options


@dataclass(frozen=True)
class View:
    """Keypoints, rays and intrinsics of the images at the working size."""

    x_px: Sequence[Float[ndarray, "_ 2"]]
    """Keypoints of every image; pixel centres are whole numbers."""
    intrinsics: Intrinsics
    """Given, or a guess."""
    rays: Sequence[Float[ndarray, "_ 2"]]
    """x/z, y/z of the keypoints through those intrinsics."""

    @staticmethod
    def of(x_px: Sequence[Float[ndarray, "_ 2"]], intrinsics: Intrinsics) -> "View":
        """Return the keypoints with their rays."""
        return View(x_px, intrinsics, [unproject(intrinsics, x)[:, :2] for x in x_px])

    def pair(
        self,
        i: int,
        j: int,
        rows: Int[ndarray, "m 2"],
        essential: Float[ndarray, "3 3"] | None,
        homography: Float[ndarray, "3 3"] | None,
    ) -> Pair:
        """Return a pair with all readings of its geometry; matrices of normalised coordinates, j from i."""
        ray_i, ray_j = self.rays[i][rows[:, 0]], self.rays[j][rows[:, 1]]
        return Pair(i, j, rows, tuple(readings(ray_i, ray_j, self.intrinsics.fx, essential, homography)))


def matched(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    camera: pycolmap.Camera,
    i: int,
    j: int,
    rows: Int[ndarray, "m 2"],
    seed: int,
    known: bool,
) -> pycolmap.TwoViewGeometry | None:
    """Return the geometry on which most matches agree; None where too few do."""
    way = np.linalg.norm(x_px[i][rows[:, 0]] - x_px[j][rows[:, 1]], axis=1)
    rows = rows[way > STATIONARY_PX]
    if len(rows) < MIN_INLIERS:
        return None
    found = pycolmap.estimate_two_view_geometry(
        camera,
        x_px[i] + HALF_PIXEL,
        camera,
        x_px[j] + HALF_PIXEL,
        rows.astype(np.uint32),
        _verification(seed, known, len(rows)),
    )
    return found if len(found.inlier_matches) >= MIN_INLIERS else None


def pair_of(view: View, i: int, j: int, found: pycolmap.TwoViewGeometry) -> Pair:
    """COLMAP's two-view geometry with its readings through the view's intrinsics."""
    rows = np.asarray(found.inlier_matches, dtype=int).reshape(-1, 2)
    return view.pair(i, j, rows, *matrices(found, view.intrinsics))


def matrices(
    found: pycolmap.TwoViewGeometry, intrinsics: Intrinsics
) -> tuple[Float[ndarray, "3 3"] | None, Float[ndarray, "3 3"] | None]:
    """Essential matrix and homography of normalised coordinates, j from i, where COLMAP found one."""
    k = intrinsics.matrix
    essential, homography = found.E, found.H
    if essential is None and found.F is not None:
        essential = k.T @ _between_centres(found.F) @ k
    if homography is not None:
        centre = np.eye(3)
        centre[:2, 2] = HALF_PIXEL
        homography = np.linalg.inv(centre @ k) @ homography @ centre @ k
    return essential, homography


def _between_centres(fundamental: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """Return COLMAP's fundamental matrix for pixels whose centres are whole numbers."""
    move = np.eye(3)
    move[:2, 2] = HALF_PIXEL
    return move.T @ fundamental @ move


def write_keypoints(database: Path, x_px: Sequence[Float[ndarray, "_ 2"]]) -> None:
    """Write keypoints into a database that has the images already."""
    with closing(pycolmap.Database.open(database)) as db:
        for row, x in enumerate(x_px):
            db.write_keypoints(row + 1, (x + HALF_PIXEL).astype(np.float32))


def write_geometries(database: Path, geometries: Geometries) -> None:
    """Replace all geometries of a database by these."""
    with closing(pycolmap.Database.open(database)) as db:
        db.clear_two_view_geometries()
        for (i, j), geometry in geometries.items():
            db.write_two_view_geometry(i + 1, j + 1, geometry)
