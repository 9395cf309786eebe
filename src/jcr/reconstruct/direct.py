"""Direct alignment: a wrist camera found from the colours of plain objects, where features find nothing to match.

The robot's poses make all cameras one unknown, the hand-eye transform (and the focal length, if need be), so that a
handful of starts is enough to find it from nothing: all cameras look at a common place, which gives their viewing
direction, and the turn about it is tried all around. Coarse to fine, from images 15 pixels high.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.linalg import null_space

from jcr.capture.images import read_image
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import adjoint, inverse, rotation_exp, transform
from jcr.progress import Progress, silent
from jcr.reconstruct.dense import DenseOptions, SparseModel, with_pointmaps
from jcr.reconstruct.lens import pinhole_inside, undistort, undistort_image, usable_lens, distort
from jcr.reconstruct.photometric import (
    Cameras,
    Equations,
    Level,
    Points,
    along_ray,
    energy,
    equations,
    in_base,
    make_level,
    project,
    strongest,
)
from jcr.records import CameraEvidence, Capture, Intrinsics, Reconstruction, Tracks

GUESSED_FOCAL = 0.8
"""In long sides, where nothing is known of the lens."""
DEPTHS = 40
"""Tried along a ray."""
DEPTH_RANGE = (0.55, 1.8)
"""Of the distance at which the images' axes meet."""
REGION = 0.05
"""m. Points within it share their errors: they are pixels of one edge, seen from many sides."""


@dataclass(frozen=True)
class Stage:
    """One level of the pyramid."""

    height: int
    """Of the images, in pixels."""
    per_image: int
    """Points."""
    rounds: int
    """Of a search along all rays, and Gauss-Newton."""
    sigma: float
    """Difference of colours (0 to 1) that counts half."""


COARSEST = Stage(15, 150, 3, 0.2)
COARSE = Stage(30, 100, 3, 0.15)
JUDGE = Stage(60, 100, 1, 0.12)
FINE = (Stage(60, 300, 2, 0.12), Stage(120, 300, 2, 0.1), Stage(240, 300, 2, 0.1))
TRUSTED_COST = 0.5
"""Of a point, beyond which its depth is not believed."""


@dataclass(frozen=True, kw_only=True)
class DirectOptions(DenseOptions):
    """Alignment by colours."""

    turns: int = 24
    """Turns about the viewing direction that are tried."""
    around: int = 8
    """Further starts around a given one."""
    least_explained: float = 0.4
    """Share of the points that the views must agree on in the end."""


@dataclass(frozen=True)
class _Found:
    cameras: Cameras
    cost: float


def refine_directly(
    capture: Capture,
    gripper_from_camera: Float[ndarray, "4 4"] | None = None,
    options: DirectOptions | None = None,
    progress: Progress | None = None,
) -> tuple[Cameras, float]:
    """Wip."""
    options = options or DirectOptions()
    report = progress or silent
    images, grid, lens, held = _images(capture)
    gripper = capture.base_from_gripper
    levels = {s.height: make_level(images, grid, s.height) for s in (COARSEST, COARSE, *FINE)}
    found = _search(levels, gripper, gripper_from_camera, held, options, report)
    cameras = found.cameras
    for stage in FINE:
        cameras, points = aligned(levels[stage.height], cameras, stage, _tied(held))
    explained = float(points.trusted.mean())
    return cameras, points, levels, found, explained, lens


def _images(capture: Capture) -> tuple[Float32[ndarray, "n h w 3"], Intrinsics, Intrinsics, bool]:
    lens, _ = usable_lens(capture.intrinsics)
    held = lens is not None
    width, height = capture.image_size
    if lens is None:
        focal = GUESSED_FOCAL * max(width, height)
        lens = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    grid = pinhole_inside(lens, round(FINE[-1].height * max(width, height) / min(width, height)))
    images = [undistort_image(read_image(capture.folder / name), lens, grid) for name in capture.images]
    return np.stack(images).astype(np.float32) / 255, grid, lens, held


def _tied(held: bool) -> Float[ndarray, "7 q"]:
    """Directions in which cameras on a robot's gripper, all alike, and their lens may move."""
    return np.eye(7)[:, :6] if held else np.eye(7)


def aligned(
    level: Level, cameras: Cameras, stage: Stage, directions: Float[ndarray, "p q"]
) -> tuple[Cameras, Points]:
    """Search along the rays and Gauss-Newton in turn."""
    host, x_px = strongest(level, stage.per_image)
    points = None
    for _ in range(stage.rounds):
        points, _ = along_ray(level, cameras, host, x_px, _depths(cameras), stage.sigma, TRUSTED_COST)
        cameras, points = descended(level, cameras, points, stage.sigma, directions)
    return cameras, points


def descended(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"], iterations: int = 6
) -> tuple[Cameras, Points]:
    """Levenberg-Marquardt over cameras and depths; the cameras move together where there are 7 parameters."""
    tied = len(directions) == 7
    damping, best = 1e-3, energy(level, cameras, points, sigma)
    for _ in range(iterations):
        system = equations(level, cameras, points, sigma, tied)
        normal = directions.T @ system.normal @ directions
        gradient = directions.T @ system.gradient.sum(0)
        for _ in range(5):
            step = directions @ -np.linalg.solve(
                normal + np.diag(damping * np.diag(normal) + 1e-9), gradient
            )
            moved = _moved(cameras, step)
            depth = points.depth * np.exp(np.clip(system.depth_step(step), -0.05, 0.05))
            tried = replace(points, depth=depth)
            cost = energy(level, moved, tried, sigma)
            if cost < best:
                break
            damping *= 6
        else:
            break
        settled = best - cost < 3e-4 * best
        cameras, points, best, damping = moved, tried, cost, damping / 6
        if settled:
            break
    return cameras, points


def _moved(cameras: Cameras, step: Float[ndarray, " p"]) -> Cameras:
    twist = step[:-1].reshape(-1, 6)
    motion = transform(rotation_exp(twist[:, 3:]), twist[:, :3])
    return Cameras(cameras.base_from_camera @ motion, cameras.zoom * float(np.exp(np.clip(step[-1], -0.1, 0.1))))


def _depths(cameras: Cameras) -> Float[ndarray, "d n"]:
    """Depths to try in every image, evenly spaced in inverse depth about the place where the axes meet."""
    meet = axes_meet(cameras.base_from_camera)
    middle = np.clip((inverse(cameras.base_from_camera) @ np.append(meet, 1.0))[:, 2], 0.1, 2.0)
    return middle / np.linspace(1 / DEPTH_RANGE[0], 1 / DEPTH_RANGE[1], DEPTHS)[:, None]


def axes_meet(base_from_camera: Float[ndarray, "*batch n 4 4"]) -> Float[ndarray, "*batch 3"]:
    """The point nearest to all optical axes."""
    center, axis = base_from_camera[..., :3, 3], base_from_camera[..., :3, 2]
    across = np.eye(3) - axis[..., :, None] * axis[..., None, :]
    normal = across.sum(-3) + 1e-6 * np.eye(3)
    return np.linalg.solve(normal, (across @ center[..., None]).sum(-3))[..., 0]


def starts_from_nothing(base_from_gripper: Float[ndarray, "n 4 4"], turns: int) -> Float[ndarray, "t 4 4"]:
    """Hand-eye transforms by which all cameras look at a common place, in so many turns about their axis."""
    k = np.arange(600) + 0.5
    height, around = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    z = np.column_stack([flat * np.cos(around), flat * np.sin(around), height])
    x = np.cross(z, np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    facing = transform(np.stack([x, np.cross(z, x), z], -1), np.zeros(3))
    cameras = base_from_gripper @ facing[:, None]
    towards = axes_meet(cameras)[:, None] - cameras[..., :3, 3]
    distance = np.linalg.norm(towards, axis=-1)
    cosine = (towards * cameras[..., :3, 2]).sum(-1) / np.maximum(distance, 1e-9)
    best = facing[cosine.mean(1).argmax()]
    turn = 2 * np.pi * np.arange(turns) / turns
    return best @ transform(rotation_exp(turn[:, None] * [0.0, 0.0, 1.0]), np.zeros(3))


def _search(
    levels: dict[int, Level],
    gripper: Float[ndarray, "n 4 4"],
    given: Float[ndarray, "4 4"] | None,
    held: bool,
    options: DirectOptions,
    report: Progress,
) -> _Found:
    starts = starts_from_nothing(gripper, options.turns) if given is None else given[None]
    coarse = []
    for k, x in enumerate(starts):
        report("direct alignment", k / len(starts))
        cameras, _ = aligned(levels[COARSEST.height], Cameras(gripper @ x), COARSEST, _tied(held))
        coarse.append(_judged(levels[COARSE.height], cameras, COARSE))
    coarse.sort(key=lambda f: f.cost)
    finer = []
    for candidate in coarse[:6]:
        cameras, _ = aligned(levels[COARSE.height], candidate.cameras, COARSE, _tied(held))
        finer.append(_judged(levels[JUDGE.height], cameras, JUDGE))
    finer.sort(key=lambda f: f.cost)
    return finer[0], finer, coarse


def _judged(level: Level, cameras: Cameras, stage: Stage) -> _Found:
    host, x_px = strongest(level, stage.per_image)
    return _Found(cameras, along_ray(level, cameras, host, x_px, _depths(cameras), stage.sigma, TRUSTED_COST)[1])
