"""Photometric alignment of cameras and depths at one image size: depth search along rays, then Gauss-Newton."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import null_space

from jcr.geometry import nearest_to_lines, retract, step_axes
from jcr.least_squares import damped_gauss_newton
from jcr.photometric.residuals import (
    Cameras,
    Level,
    PhotometricEquations,
    Points,
    energy,
    equations,
    search_depths,
    strong_edges,
)

DEPTHS = 40
"""Number of depths tried along a ray, evenly spaced in inverse depth."""
DEPTH_RANGE = (0.55, 1.8)
"""Nearest and farthest depth tried, as factors of a camera's depth of the point where the optical axes meet."""
MEET_WITHIN = (0.1, 2.0)
"""Limits, m, to which the depth of the point where the optical axes meet is clipped."""
AGREED = 0.5
"""Largest cost (0 to 1) of a point whose depth and colour are used."""
IMAGES_AT_FULL = 10
"""Largest number of images that each get all points; more images see each point more often and get fewer."""
STEPS, ENOUGH = 8, 3e-4
"""Largest number of damped steps in a round, and the relative change of the cost below which the round ends."""
SETTLED_COST_RATIO = 0.995
"""Ratio of the costs of successive rounds above which the rounds end."""


@dataclass(frozen=True)
class PyramidLevel:
    """Settings of the alignment at one image height: points per image, number of rounds, scale of the robust cost."""

    height: int
    per_image: int
    """Number of points per image."""
    rounds: int
    """Largest number of rounds; a round is a depth search along all rays followed by Gauss-Newton."""
    sigma: float
    """Colour difference (RGB, each 0 to 1) at which the robust cost reaches half of its maximum."""


def axes_intersection(base_from_camera: Float[ndarray, "*batch n 4 4"]) -> Float[ndarray, "*batch 3"]:
    """Return the point in the base frame with the least sum of squared distances from the n optical axes."""
    return nearest_to_lines(base_from_camera[..., :3, 3], base_from_camera[..., :3, 2])


def cost_of(level: Level, cameras: Cameras, stage: PyramidLevel) -> float:
    """Return the mean robust cost (0 to 1) of the colour differences between images, each point at its best depth.

    `stage` sets the number of points and the scale of the cost (`search_depths`).
    """
    host, x_px = strong_edges(level, _per_image(level, stage))
    return search_depths(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)[1]


def _per_image(level: Level, stage: PyramidLevel) -> int:
    return max(10, stage.per_image * IMAGES_AT_FULL // max(level.count, IMAGES_AT_FULL))


def _depths(cameras: Cameras) -> Float[ndarray, "d n"]:
    """Return the depths (z in the camera frame, m) to try in each of n images (columns), evenly spaced in inverse depth.

    They are DEPTH_RANGE times the depth of the point where the optical axes meet.
    """
    pose = cameras.base_from_camera
    middle = np.clip(((axes_intersection(pose) - pose[:, :3, 3]) * pose[:, :3, 2]).sum(1), *MEET_WITHIN)
    return middle / np.linspace(1 / DEPTH_RANGE[0], 1 / DEPTH_RANGE[1], DEPTHS)[:, None]


def tied_directions(intrinsics_known: bool) -> Float[ndarray, "7 q"]:
    """Return the free steps when all cameras move as one, one per column.

    The rows are translation (3) and rotation (3) in camera axes, and the log focal length. The column of the focal
    length is left out where the intrinsics are known.
    """
    return np.eye(7)[:, : 6 if intrinsics_known else 7]


def free_directions(cameras: Cameras, intrinsics_known: bool) -> Float[ndarray, "p q"]:
    """Return an orthonormal basis (columns) of the free steps when each camera moves by itself.

    The p rows are translation (3) and rotation (3) in camera axes of each camera, then the log focal length. The first
    camera and the common scale are fixed, and so is the focal length where the intrinsics are known.
    """
    pose = cameras.base_from_camera
    grown = np.zeros((len(pose), 6))
    grown[:, :3] = np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3] - pose[0, :3, 3])
    fixed = np.zeros((8, 6 * len(pose) + 1))
    fixed[:6, :6] = np.eye(6)
    fixed[6, :-1] = grown.ravel()
    fixed[7, -1] = intrinsics_known
    return null_space(fixed)


def align_photometrically(
    level: Level, cameras: Cameras, stage: PyramidLevel, directions: Float[ndarray, "p q"]
) -> tuple[Cameras, Points]:
    """Align cameras at one pyramid level by rounds of depth search and Gauss-Newton; return cameras and points.

    `stage` has the settings. The columns of `directions` are the free steps of the cameras (`tied_directions`,
    `free_directions`); with p = 7 rows, all cameras move as one. The points are pixels at edges.
    """

    def step(
        at: tuple[Cameras, Points], system: PhotometricEquations, damping: float
    ) -> tuple[Cameras, Points]:
        normal = directions.T @ system.normal @ directions
        normal += np.diag(damping * np.diag(normal) + 1e-9)
        along = -directions @ np.linalg.solve(normal, directions.T @ system.gradient.sum(0))
        depth = at[1].depth * np.exp(np.clip(system.depth_step(along), -0.05, 0.05))
        return after_step(at[0], along), replace(at[1], depth=depth)

    host, x_px = strong_edges(level, _per_image(level, stage))
    before, points = np.inf, None
    for _ in range(stage.rounds):
        points, cost = search_depths(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)
        if cost > SETTLED_COST_RATIO * before:
            break
        before = cost
        (cameras, points), _, _ = damped_gauss_newton(
            lambda at: equations(level, *at, stage.sigma, tied=len(directions) == 7),
            step,
            lambda at: energy(level, *at, stage.sigma),
            (cameras, points),
            enough=lambda best: ENOUGH * best,
            damping=1e-3,
            iterations=STEPS,
        )
    assert points is not None
    return cameras, points


def after_step(cameras: Cameras, step: Float[ndarray, " p"]) -> Cameras:
    """Return the cameras moved by a step: translation (m) and rotation (rad) in camera axes, then log focal length.

    `step` has p = 7 numbers if all cameras make one motion (6), else p = 6n + 1, a motion of each camera. The last
    number is the change of the log focal length, limited to ±0.1.
    """
    pose, twist = cameras.base_from_camera, step[:-1].reshape(-1, 6, 1)
    return Cameras(
        retract(pose, (step_axes(pose[:, :3, :3]) @ twist)[..., 0]),
        cameras.zoom * float(np.exp(np.clip(step[-1], -0.1, 0.1))),
    )
