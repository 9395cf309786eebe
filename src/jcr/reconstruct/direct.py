"""Direct alignment: wrist cameras found by colour alone, on plain tables too, where features find nothing to match.

The robot's poses leave one unknown for all cameras, the hand-eye transform (and the focal length, if the lens is
not known). That is little enough to find it from nothing: the cameras look at a common place, which tells their
viewing direction in the gripper's frame, and turns about it and tilts are tried all around, on images 15 pixels high.
From there coarse to fine, with a depth for each of a few thousand pixels; in the end every camera moves by itself, so
that what disagrees with the robot's motion shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.linalg import null_space

from jcr.capture.images import read_image
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import adjoint, apply, inverse, rotation_between_deg, rotation_exp, transform
from jcr.progress import Progress, silent
from jcr.reconstruct.dense import DenseOptions, SparseModel, plan_memory, with_pointmaps
from jcr.reconstruct.lens import distort, pinhole_inside, undistort_image, usable_lens
from jcr.reconstruct.photometric import (
    Cameras,
    Level,
    Points,
    energy,
    equations,
    in_base,
    make_level,
    on_rays,
    project,
    squared_misfit,
    strongest,
)
from jcr.records import CameraEvidence, Capture, Intrinsics, Reconstruction, Tracks

GUESSED_FOCAL = 0.8
"""In long sides, where nothing is known of the lens."""
DEPTHS = 40
"""Tried along a ray, evenly spaced in inverse depth."""
DEPTH_RANGE = (0.55, 1.8)
"""Of the distance at which the cameras' axes meet."""
MEET_WITHIN = (0.1, 2.0)
"""m. Distance at which they may."""
TURNS, TILTS, TILT_DEG = 24, 6, 15.0
"""Starts about the viewing direction that the robot's poses suggest, which was off by 4 to 22° in 13 captures."""
SCREENED_POINTS = 40
"""Per image, by which starts are ranked before any is improved."""
KEPT, KEPT_BASINS = 24, 6
"""Of the starts, after screening; and of the different places to which they led."""
SAME_M, SAME_DEG = 0.03, 5.0
"""Starts that ended closer than this found the same."""
CLEARLY_BETTER = 0.9
"""Largest cost of a found hand-eye transform, relative to the next different one. Right ones have 0.5 to 0.75, wrong
ones, of which there are many alike, 0.97 to 1."""
AGREED = 0.5
"""Cost of a point beyond which its depth is not believed."""
LEAST_AGREED = 0.25
"""Share of the points that the views must agree on in the end."""
REGION = 0.05
"""m. Points within it share their errors: they are pixels of one edge, seen from many sides."""
IMAGES_AT_FULL = 10
"""With more images each has fewer points, as each point is seen more often."""


@dataclass(frozen=True)
class Stage:
    """One level of the pyramid."""

    height: int
    """Of the images, in pixels."""
    per_image: int
    """Points."""
    rounds: int
    """At most, of a search along all rays and Gauss-Newton, until the search finds nothing better."""
    sigma: float
    """Difference of colours (0 to 1) that counts half."""


COARSEST = Stage(15, 150, 3, 0.2)
COARSE = Stage(30, 100, 8, 0.15)
JUDGE = Stage(60, 100, 1, 0.12)
FINE = (Stage(60, 300, 3, 0.12), Stage(120, 300, 3, 0.1), Stage(240, 300, 3, 0.1))
SETTLED = 0.995
"""A round that leaves more of the cost than this was the last."""


@dataclass(frozen=True, kw_only=True)
class DirectOptions(DenseOptions):
    """Alignment by colour."""


@dataclass(frozen=True)
class Found:
    """Cameras on the robot's poses, and how badly the colours fit."""

    cameras: Cameras
    cost: float


def refine_directly(
    capture: Capture,
    gripper_from_camera: Float[ndarray, "4 4"] | None = None,
    options: DirectOptions | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Camera poses by the colours of a capture's images, with the robot's poses to start from.

    A rough `gripper_from_camera` (tens of degrees and centimetres) is one start among others, none is needed. Known
    intrinsics are held, else a focal length is estimated. The unit is the robot's metre only roughly, the frame is the
    first camera's; `evidence` has the covariance. Raises InputError with fewer than three images, and NotTrustedError
    where another place of the camera fits as well, or too few pixels are explained.
    """
    if len(capture) < 3:
        raise InputError(f"direct alignment needs 3 images or more, there are {len(capture)}; take more")
    options, report = options or DirectOptions(), progress or silent
    plan_memory(len(capture), capture.image_size, options)
    images = [read_image(capture.folder / name) for name in capture.images]
    given, notes = usable_lens(capture.intrinsics)
    lens = given or _guessed_lens(capture.image_size)
    levels = pyramid(images, lens)
    held = given is not None
    found = search(levels, capture.base_from_gripper, gripper_from_camera, held, report)
    cameras, _ = aligned(levels[FINE[0].height], found.cameras, FINE[0], tied_directions(held))
    points = None
    for k, stage in enumerate(FINE):
        report("direct alignment", 0.7 + 0.1 * k)
        level = levels[stage.height]
        cameras, points = aligned(level, cameras, stage, free_directions(cameras, held))
    assert points is not None
    report("direct alignment", 1.0)
    if (agreed := points.agreed.mean()) < LEAST_AGREED:
        raise NotTrustedError(
            f"direct alignment: the views agree on {100 * agreed:.0f} % of the pixels at edges, too few; "
            "take pictures that overlap more, of a scene that does not move or shine"
        )
    covariance = twist_covariance(level, cameras, points, stage.sigma, free_directions(cameras, held))
    points = points.where(points.agreed)
    lens = replace(lens, fx=lens.fx * cameras.zoom, fy=lens.fy * cameras.zoom)
    tracks = _tracks(level, cameras, points, stage.sigma, lens)
    recon_from_camera = inverse(cameras.base_from_camera[0]) @ cameras.base_from_camera
    sparse = SparseModel(np.arange(len(capture)), recon_from_camera, lens, tracks, notes)
    reconstruction = with_pointmaps(sparse, images, options, report, backend="direct")
    return replace(reconstruction, evidence=CameraEvidence(recon_from_camera, covariance))


def _guessed_lens(size: tuple[int, int]) -> Intrinsics:
    focal = GUESSED_FOCAL * max(size)
    return Intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, *size)


def pyramid(images: Sequence[UInt8[ndarray, "h w 3"]], lens: Intrinsics) -> dict[int, Level]:
    """Undistorted images by height in pixels."""
    finest = FINE[-1].height
    grid = pinhole_inside(lens, round(finest * max(lens.width, lens.height) / min(lens.width, lens.height)))
    stack = np.stack([undistort_image(image, lens, grid) for image in images]).astype(np.float32) / 255
    return {stage.height: make_level(stack, grid, stage.height) for stage in (COARSEST, COARSE, *FINE)}


def search(
    levels: dict[int, Level],
    base_from_gripper: Float[ndarray, "n 4 4"],
    gripper_from_camera: Float[ndarray, "4 4"] | None,
    lens_held: bool,
    report: Progress,
) -> Found:
    """The hand-eye transform under which colours agree best; NotTrustedError where a different one is as good."""
    starts = starts_from_nothing(base_from_gripper)
    if gripper_from_camera is not None:
        starts = np.concatenate([gripper_from_camera[None], starts])
    directions = tied_directions(lens_held)
    screen = replace(COARSEST, per_image=SCREENED_POINTS)
    ranked = _best_first([judged(levels, Cameras(base_from_gripper @ x), screen) for x in starts])[:KEPT]
    coarse = []
    for k, start in enumerate(ranked):
        report("direct alignment", 0.1 + 0.4 * k / len(ranked))
        cameras, _ = aligned(levels[COARSEST.height], start.cameras, COARSEST, directions)
        coarse.append(judged(levels, cameras, COARSE))
    fine = []
    for k, start in enumerate(different(coarse)[:KEPT_BASINS]):
        report("direct alignment", 0.5 + 0.2 * k / KEPT_BASINS)
        cameras, _ = aligned(levels[COARSE.height], start.cameras, COARSE, directions)
        fine.append(judged(levels, cameras, JUDGE))
    best, *rivals = different(fine)
    if rivals and best.cost > CLEARLY_BETTER * rivals[0].cost:
        raise NotTrustedError(
            "direct alignment: cameras at different places explain the pictures alike (cost "
            f"{best.cost:.3f} and {rivals[0].cost:.3f}); take more pictures, from more sides, of more and different objects"
        )
    return best


def starts_from_nothing(base_from_gripper: Float[ndarray, "n 4 4"]) -> Float[ndarray, "t 4 4"]:
    """Hand-eye transforms by which the cameras look at a common place, turned and tilted all around."""
    # Directions evenly over the sphere (Fibonacci's spiral).
    k = np.arange(600) + 0.5
    height, around = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - height**2)
    z = np.column_stack([flat * np.cos(around), flat * np.sin(around), height])
    x = np.cross(z, np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    facing = np.stack([x, np.cross(z, x), z], -1)
    cameras = base_from_gripper @ transform(facing, np.zeros(3))[:, None]
    towards = axes_meet(cameras)[:, None] - cameras[..., :3, 3]
    cosine = (towards * cameras[..., :3, 2]).sum(-1) / np.maximum(np.linalg.norm(towards, axis=-1), 1e-9)
    best = facing[cosine.mean(1).argmax()]
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    toward = 2 * np.pi * np.arange(TILTS) / TILTS
    tilt = np.radians(TILT_DEG) * np.column_stack([np.cos(toward), np.sin(toward), 0 * toward])
    tilts = rotation_exp(np.concatenate([np.zeros((1, 3)), tilt]))
    rotations = best @ tilts[:, None] @ rotation_exp(turn[:, None] * [0.0, 0.0, 1.0])
    return transform(rotations.reshape(-1, 3, 3), np.zeros(3))


def axes_meet(base_from_camera: Float[ndarray, "*batch n 4 4"]) -> Float[ndarray, "*batch 3"]:
    """The point nearest to all optical axes."""
    center, axis = base_from_camera[..., :3, 3], base_from_camera[..., :3, 2]
    across = np.eye(3) - axis[..., :, None] * axis[..., None, :]
    # Parallel axes meet anywhere along them.
    normal = across.sum(-3) + 1e-6 * np.eye(3)
    return np.linalg.solve(normal, (across @ center[..., None]).sum(-3))[..., 0]


def judged(levels: dict[int, Level], cameras: Cameras, stage: Stage) -> Found:
    """What the colours say of cameras as they are."""
    level = levels[stage.height]
    host, x_px = strongest(level, _per_image(level, stage))
    return Found(cameras, on_rays(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)[1])


def _best_first(found: Sequence[Found]) -> list[Found]:
    return sorted(found, key=lambda each: each.cost)


def different(found: Sequence[Found]) -> list[Found]:
    """The best of each place to which several led, best first."""
    kept: list[Found] = []
    for each in _best_first(found):
        if all(not _same(each.cameras, other.cameras) for other in kept):
            kept.append(each)
    return kept


def _same(one: Cameras, other: Cameras) -> bool:
    gap = inverse(one.base_from_camera[0]) @ other.base_from_camera[0]
    return bool(
        np.linalg.norm(gap[:3, 3]) < SAME_M and rotation_between_deg(np.eye(3), gap[:3, :3]) < SAME_DEG
    )


def _per_image(level: Level, stage: Stage) -> int:
    return max(10, stage.per_image * IMAGES_AT_FULL // max(level.count, IMAGES_AT_FULL))


def _depths(cameras: Cameras) -> Float[ndarray, "d n"]:
    """Depths to try in every image."""
    pose = cameras.base_from_camera
    depth = ((axes_meet(pose) - pose[:, :3, 3]) * pose[:, :3, 2]).sum(1)
    middle = np.clip(depth, *MEET_WITHIN)
    return middle / np.linspace(1 / DEPTH_RANGE[0], 1 / DEPTH_RANGE[1], DEPTHS)[:, None]


def tied_directions(lens_held: bool) -> Float[ndarray, "7 q"]:
    """Directions in which cameras on a robot's gripper, all alike, and their lens may move."""
    return np.eye(7)[:, : 6 if lens_held else 7]


def free_directions(cameras: Cameras, lens_held: bool) -> Float[ndarray, "p q"]:
    """Directions in which cameras may move one by one: the first stays, and so does their common scale."""
    pose = cameras.base_from_camera
    grown = np.zeros((len(pose), 6))
    grown[:, :3] = np.einsum("nji,nj->ni", pose[:, :3, :3], pose[:, :3, 3] - pose[0, :3, 3])
    fixed = np.zeros((8, 6 * len(pose) + 1))
    fixed[:6, :6] = np.eye(6)
    fixed[6, :-1] = grown.ravel()
    fixed[7, -1] = lens_held
    return null_space(fixed)


def aligned(
    level: Level, cameras: Cameras, stage: Stage, directions: Float[ndarray, "p q"]
) -> tuple[Cameras, Points]:
    """Search along the rays, and Gauss-Newton, in turn."""
    host, x_px = strongest(level, _per_image(level, stage))
    before, points = np.inf, None
    for _ in range(stage.rounds):
        points, cost = on_rays(level, cameras, host, x_px, _depths(cameras), stage.sigma, AGREED)
        if cost > SETTLED * before:
            break
        cameras, points = descended(level, cameras, points, stage.sigma, directions)
        before = cost
    assert points is not None
    return cameras, points


def descended(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"]
) -> tuple[Cameras, Points]:
    """A few steps of Levenberg and Marquardt; the cameras move together where there are 7 parameters."""
    damping, best = 1e-3, energy(level, cameras, points, sigma)
    for _ in range(6):
        system = equations(level, cameras, points, sigma, tied=len(directions) == 7)
        normal = directions.T @ system.normal @ directions
        gradient = directions.T @ system.gradient.sum(0)
        for _ in range(5):
            damped = normal + np.diag(damping * np.diag(normal) + 1e-9)
            step = -directions @ np.linalg.solve(damped, gradient)
            depth = points.depth * np.exp(np.clip(system.depth_step(step), -0.05, 0.05))
            tried = moved(cameras, step), replace(points, depth=depth)
            cost = energy(level, *tried, sigma)
            if cost < best:
                break
            damping *= 6
        else:
            return cameras, points
        settled = best - cost < 3e-4 * best
        (cameras, points), best, damping = tried, cost, damping / 6
        if settled:
            break
    return cameras, points


def moved(cameras: Cameras, step: Float[ndarray, " p"]) -> Cameras:
    """Cameras after twists (v, ω) in camera axes, one for all or one for each, and a step of the log focal length."""
    twist = step[:-1].reshape(-1, 6)
    motion = transform(rotation_exp(twist[:, 3:]), twist[:, :3])
    return Cameras(cameras.base_from_camera @ motion, cameras.zoom * float(np.exp(np.clip(step[-1], -0.1, 0.1))))


def twist_covariance(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"]
) -> Float[ndarray, "r r"]:
    """Covariance (6n,6n) of the cameras' twists in the first camera's axes, as records.CameraEvidence has it.

    Residuals of one region of the scene err together, in all images that look there. How far the gradients of regions
    scatter about zero is measured, and the inverse normal matrix scaled to it on average (a sandwich estimate that has
    one number to estimate instead of a full matrix, for which there are too few regions).
    """
    system = equations(level, cameras, points, sigma, tied=False)
    inverse_normal = np.linalg.inv(directions.T @ system.normal @ directions)
    cell = np.floor(in_base(level, cameras, points) / REGION).astype(np.int64)
    region = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    score = np.zeros((region.max() + 1, directions.shape[1]))
    np.add.at(score, region, system.gradient @ directions)
    spread = np.einsum("bp,pq,bq->", score, inverse_normal, score) / directions.shape[1]
    first_from_camera = inverse(cameras.base_from_camera[0]) @ cameras.base_from_camera
    n = len(first_from_camera)
    to_first = np.zeros((6 * n, 6 * n))
    for k, block in enumerate(adjoint(first_from_camera)):
        to_first[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    twists = to_first @ directions[:-1]
    return spread * twists @ inverse_normal @ twists.T


def _tracks(level: Level, cameras: Cameras, points: Points, sigma: float, lens: Intrinsics) -> Tracks:
    """The points, where their host sees them and where the others do that show their colour."""
    _, u, v, seen = project(level, cameras, points)
    shown = seen & (squared_misfit(level, points, u, v) < sigma**2)
    image, point = np.nonzero(shown)
    host = np.arange(len(points.host))
    x_grid = np.concatenate([points.x_px, np.column_stack([u[shown], v[shown]])])
    focal = np.array([level.grid.fx, level.grid.fy]) * cameras.zoom
    return Tracks(
        image=np.concatenate([points.host, image]),
        x_px=distort(lens, (x_grid - [level.grid.cx, level.grid.cy]) / focal),
        point=np.concatenate([host, point]),
        points_in_recon=apply(inverse(cameras.base_from_camera[0]), in_base(level, cameras, points)),
        from_pointmaps=True,
    )
