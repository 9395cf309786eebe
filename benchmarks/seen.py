"""`benchmarks seen`: are points that the camera sees where the calibration says, as exactly as it says?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import table
from jcr.calibration.adjust import estimate_of
from jcr.calibration.seen import seen_uncertainty, within_95
from jcr.camera import parameters, unproject, with_parameters
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.estimation.intrinsics_prior import ESTIMATED, Camera, camera_with_prior
from jcr.estimation.wrist import adjust_wrist
from jcr.geometry import apply, step_between
from jcr.records import Estimate, Intrinsics
from simulation.arms import PresetName
from simulation.problems import INTRINSICS, BentProblem, bent_problem, observed

PRESETS: tuple[PresetName, ...] = ("white", "typical")
COUNTS = (8, 12, 30)
DRAWS = 10
"""Of each row."""
POINTS, PIXEL_STD = 400, 0.3
DISTANCE_M = 0.45
OFF = 0.005
"""Of a given focal length, relative; its principal point is 3 px off."""
BENT = Intrinsics(450.0, 449.0, 322.0, 236.0, 640, 480, (0.1, -0.3, 0.5, -0.4), "fisheye")
"""A camera whose distortion the five coefficients of a pinhole leave by 0.2 px rms, 2 px in the corners."""


@dataclass(frozen=True)
class Knowledge:
    """What is known of the intrinsics, and which camera took the images."""

    name: str
    start: Callable[[np.random.Generator], Intrinsics]
    prior: Callable[[Intrinsics], Camera]
    camera: Intrinsics = INTRINSICS


def _off(rng: np.random.Generator) -> Intrinsics:
    values = parameters(INTRINSICS)
    values[:2] *= 1 + OFF * rng.choice([-1.0, 1.0])
    values[2:4] += 3.0 * rng.choice([-1.0, 1.0], size=2)
    return with_parameters(INTRINSICS, values)


def _found(rng: np.random.Generator) -> Intrinsics:
    """As a reconstruction without given intrinsics begins with them: no tangential distortion, the centre the
    image's."""
    return _guessed(INTRINSICS, rng)


def _found_of_bent(rng: np.random.Generator) -> Intrinsics:
    return _guessed(BENT, rng)


def _guessed(camera: Intrinsics, rng: np.random.Generator) -> Intrinsics:
    focal = camera.fx * (1 + 0.01 * rng.normal())
    return Intrinsics(focal, focal, 319.5, 239.5, 640, 480)


WAYS = (
    Knowledge("given", lambda rng: INTRINSICS, camera_with_prior),
    Knowledge("given, 0.5 % and 3 px off", _off, camera_with_prior),
    Knowledge("not given", _found, lambda found: camera_with_prior(found, ESTIMATED)),
    Knowledge(
        "not given, more distortion than the model",
        _found_of_bent,
        lambda found: camera_with_prior(found, ESTIMATED),
        BENT,
    ),
)


@dataclass(frozen=True)
class Row:
    """What came of all draws of one cell, against the effective hand-eye transform."""

    preset: PresetName
    count: int
    known: str
    draws: int
    within_95: float
    """Share of seen points whose error is within what 95 % are said to be below."""
    within_3: float
    """Share of those within 3 σ on every axis."""
    seen_mm: float
    """Median error of a seen point."""
    said_mm: float
    """Median of what 95 % are said to be below."""
    camera_mm: float
    """Median error of the camera on the gripper."""


def measure(
    presets: Sequence[PresetName] = PRESETS,
    counts: Sequence[int] = COUNTS,
    ways: Sequence[Knowledge] = WAYS,
    draws: int = DRAWS,
) -> list[Row]:
    """A row per robot, number of images and knowledge of the intrinsics."""
    return [_row(preset, count, known, draws) for preset in presets for count in counts for known in ways]


def run() -> str:
    """Markdown: the claim, then the table."""
    return page(measure())


def page(rows: Sequence[Row]) -> str:
    """Markdown of measured rows."""
    shares = [100 * row.within_95 for row in rows]
    lines = [
        f"> Points seen at {DISTANCE_M} m, in simulation: {np.mean(shares):.0f} % of their errors are within the "
        f"95 % that are reported, {min(shares):.0f} to {max(shares):.0f} % in the rows; the median error is "
        f"{np.median([row.seen_mm for row in rows]):.2f} mm, that of the camera on the gripper "
        f"{np.median([row.camera_mm for row in rows]):.2f} mm.",
        "",
        f"Of each row {rows[0].draws} draws, the arms in turn; {POINTS} points seen with {PIXEL_STD} px; nine pixels "
        "of the image, placed on the gripper with intrinsics, transform and scale as estimated, against the true ones "
        "(effective transform).",
        "",
        *table(
            "robot | images | intrinsics | errors within their 95 % | within 3 σ on every axis | seen point: median "
            "error | 95 % reported below | camera: median error",
            (
                (
                    row.preset,
                    row.count,
                    row.known,
                    f"{100 * row.within_95:.0f} %",
                    f"{100 * row.within_3:.1f} %",
                )
                + tuple(f"{mm:.2f} mm" for mm in (row.seen_mm, row.said_mm, row.camera_mm))
                for row in rows
            ),
        ),
    ]
    return "\n".join(lines) + "\n"


def _row(preset: PresetName, count: int, known: Knowledge, draws: int) -> Row:
    within, three, errors, said, camera = [], [], [], [], []
    for seed in range(draws):
        problem = bent_problem(arm_named(ROBOT_NAMES[seed % len(ROBOT_NAMES)]), preset, count, seed)
        estimate = _adjusted(problem, known, np.random.default_rng([seed, 9]))
        if estimate is None:
            continue
        off, covariance = _placed(problem, known.camera, estimate)
        length = np.linalg.norm(off, axis=1)
        below = np.array([within_95(one) for one in covariance])
        within.append(length < below)
        std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        three.append((np.abs(off) < 3 * std).all(1))
        errors.append(length)
        said.append(below)
        step = step_between(estimate.gripper_from_camera, problem.gripper_from_camera)
        camera.append(np.linalg.norm(step[:3]))
    return Row(
        preset,
        count,
        known.name,
        len(camera),
        float(np.mean(within)),
        float(np.mean(three)),
        1e3 * float(np.median(errors)),
        1e3 * float(np.median(said)),
        1e3 * float(np.median(camera)),
    )


def _adjusted(problem: BentProblem, known: Knowledge, rng: np.random.Generator) -> Estimate | None:
    tracks = observed(problem, rng, POINTS, PIXEL_STD, known.camera)
    if len(tracks.image) < 100 * len(problem.base_from_gripper):
        return None
    start = known.start(rng)
    solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    found = adjust_wrist(
        problem.base_from_gripper,
        (solved.gripper_from_camera, solved.scale, solved.base_from_recon),
        problem.recon_from_camera,
        known.prior(start),
        tracks,
    )
    return estimate_of(found, tracks)


def _placed(
    problem: BentProblem, camera: Intrinsics, estimate: Estimate
) -> tuple[Float[ndarray, "k 3"], Float[ndarray, "k 3 3"]]:
    """Errors of seen points in axes of the estimated camera, and the covariance that is said of each."""
    u, v = np.meshgrid(np.array([0.1, 0.5, 0.9]) * camera.width, np.array([0.1, 0.5, 0.9]) * camera.height)
    x_px = np.stack([u.ravel(), v.ravel()], axis=1)
    assert estimate.intrinsics is not None
    placed, true = (
        apply(x, distance * (ray := unproject(own, x_px)) / np.linalg.norm(ray, axis=1, keepdims=True))
        for x, own, distance in (
            (estimate.gripper_from_camera, estimate.intrinsics, DISTANCE_M * estimate.scale / problem.scale),
            (problem.gripper_from_camera, camera, DISTANCE_M),
        )
    )
    off = (true - placed) @ estimate.gripper_from_camera[:3, :3]
    return off, seen_uncertainty(estimate, estimate.intrinsics, x_px, DISTANCE_M)
