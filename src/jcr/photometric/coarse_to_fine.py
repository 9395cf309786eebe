"""Cameras and depths brought to agree in colour at one size of the images: search along rays, and Gauss-Newton."""

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
    on_rays,
    strongest,
)

DEPTHS = 40
"""Tried along a ray, evenly spaced in inverse depth."""
DEPTH_RANGE = (0.55, 1.8)
"""Nearest and farthest depth, as shares of the distance at which the cameras' axes meet."""
MEET_WITHIN = (0.1, 2.0)
"""m. Distance at which they may."""
AGREED = 0.5
"""Cost of a point beyond which its depth is not used."""
IMAGES_AT_FULL = 10
"""Most images that each get all points; with more each has fewer, as each point is seen more often."""
STEPS, ENOUGH = 8, 3e-4
"""Most damped steps of a round, and the relative change of the cost that ends them: a step costs more than it gains."""
SETTLED = 0.995
"""A round that leaves more of the cost than this was the last."""


@dataclass(frozen=True)
class PyramidLevel:
    """One level of the pyramid."""

    height: int
    """Height of the images in pixels."""
    per_image: int
    """Points."""
    rounds: int
    """Largest number of rounds of search along all rays and Gauss-Newton."""
    sigma: float
    """Difference of colours (0 to 1) that counts half."""


def axes_meet(base_from_camera: Float[ndarray, "*batch n 4 4"]) -> Float[ndarray, "*batch 3"]:
    """Return the point nearest to all optical axes."""
    return nearest_to_lines(base_from_camera[..., :3, 3], base_from_camera[..., :3, 2])


def cost_of(level: Level, cameras: Cameras, stage: PyramidLevel) -> float:
    """Return the cost of the cameras' colour differences, at the best depth of each point."""
    host, x_px = strongest(level, _per_image(level, stage))
    return on_rays(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)[1]


def _per_image(level: Level, stage: PyramidLevel) -> int:
    return max(10, stage.per_image * IMAGES_AT_FULL // max(level.count, IMAGES_AT_FULL))


def _depths(cameras: Cameras) -> Float[ndarray, "d n"]:
    """Depths to try in every image."""
    pose = cameras.base_from_camera
    depth = ((axes_meet(pose) - pose[:, :3, 3]) * pose[:, :3, 2]).sum(1)
    middle = np.clip(depth, *MEET_WITHIN)
    return middle / np.linspace(1 / DEPTH_RANGE[0], 1 / DEPTH_RANGE[1], DEPTHS)[:, None]


def tied_directions(intrinsics_known: bool) -> Float[ndarray, "7 q"]:
    """Directions in which cameras on a robot's gripper, all alike, and their intrinsics may move."""
    return np.eye(7)[:, : 6 if intrinsics_known else 7]


def free_directions(cameras: Cameras, intrinsics_known: bool) -> Float[ndarray, "p q"]:
    """Directions in which cameras may move one by one: the first stays, and so does their common scale."""
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
    """Search along the rays and Gauss-Newton, alternately."""
    host, x_px = strongest(level, _per_image(level, stage))
    before, points = np.inf, None
    for _ in range(stage.rounds):
        points, cost = on_rays(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)
        if cost > SETTLED * before:
            break
        cameras, points = _after_descent(level, cameras, points, stage.sigma, directions)
        before = cost
    assert points is not None
    return cameras, points


def _after_descent(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"]
) -> tuple[Cameras, Points]:
    """Take a few damped steps of cameras and depths; the cameras move together where there are 7 parameters."""

    def step(
        at: tuple[Cameras, Points], system: PhotometricEquations, damping: float
    ) -> tuple[Cameras, Points]:
        normal = directions.T @ system.normal @ directions
        normal += np.diag(damping * np.diag(normal) + 1e-9)
        along = -directions @ np.linalg.solve(normal, directions.T @ system.gradient.sum(0))
        depth = at[1].depth * np.exp(np.clip(system.depth_step(along), -0.05, 0.05))
        return after_step(at[0], along), replace(at[1], depth=depth)

    return damped_gauss_newton(
        lambda at: equations(level, *at, sigma, tied=len(directions) == 7),
        step,
        lambda at: energy(level, *at, sigma),
        (cameras, points),
        enough=lambda best: ENOUGH * best,
        damping=1e-3,
        iterations=STEPS,
    )[0]


def after_step(cameras: Cameras, step: Float[ndarray, " p"]) -> Cameras:
    """Cameras after twists (v, ω) in camera axes, one for all or one for each, and a step of the log focal length."""
    pose, twist = cameras.base_from_camera, step[:-1].reshape(-1, 6, 1)
    return Cameras(
        retract(pose, (step_axes(pose[:, :3, :3]) @ twist)[..., 0]),
        cameras.zoom * float(np.exp(np.clip(step[-1], -0.1, 0.1))),
    )
