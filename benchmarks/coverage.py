"""Shares of errors inside the stated uncertainty.

Two simulated tables against the effective transform: poses of arms with systematic errors, and points that the camera
sees.
"""

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares

from benchmarks.page import number, squared_distance, table
from benchmarks.peers import opencv
from benchmarks.references import nine_pixels, placed
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.camera import parameters, project, unproject, with_parameters
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.intrinsics_prior import ESTIMATED, camera_with_prior
from jcr.estimation.point_uncertainty import point_covariance, within_95
from jcr.estimation.problem import wrist_arm, wrist_problem
from jcr.estimation.solve import solve, uncertainty_of
from jcr.geometry import step_between
from jcr.records import Intrinsics
from simulation.arms import PresetName
from simulation.problems import INTRINSICS, BentProblem, bent_problem, error, observed

COUNTS = (8, 12, 30)
DRAWS = 20
"""Captures per row of points."""
POINTS, PIXEL_STD, DISTANCE_M = 400, 0.3, 0.45
OFF = 0.005
"""Relative error of a focal length that is given wrong; its principal point is 3 px off."""
BENT = Intrinsics(450.0, 449.0, 322.0, 236.0, 640, 480, (-0.2, 0.8, -1.6, 1.0), "fisheye")
"""Camera whose distortion five coefficients of a pinhole leave by 0.3 px rms, 0.8 px at most."""
WHITE, PEER = "white noise alone", "OpenCV Park, scale given"
SOLVERS: dict[str, Callable[[BentProblem], Calibration]] = {
    "joints known": lambda p: solve_hand_eye(
        p.base_from_gripper, p.recon_from_camera, joints=p.joints, robot=p.bent.arm
    ),
    "robot given": lambda p: solve_hand_eye(p.base_from_gripper, p.recon_from_camera, robot=p.bent.arm),
    "nothing known": lambda p: solve_hand_eye(p.base_from_gripper, p.recon_from_camera),
    WHITE: lambda p: solve_hand_eye(
        p.base_from_gripper, p.recon_from_camera, systematic=np.zeros((6 * len(p.joints), 6 * len(p.joints)))
    ),
}
"""Three states of knowledge about the robot, and independent errors alone, HALCON's published model."""


def run(every: int = 1) -> str:
    """Return the page in Markdown, of one arm and one draw in `every`: claims, then the two tables."""
    draws = max(DRAWS // every, 1)
    robots, seen = measure_robots(ROBOT_NAMES[::every]), measure_seen(draws)
    return "\n".join([*_claims(robots, seen), *_tables(robots, seen, draws)]) + "\n"


class RobotRow(NamedTuple):
    """Results of one solver for arms with errors of one size, against the effective transform."""

    preset: PresetName
    images: int
    known: str
    mm: float
    """Median error."""
    deg: float
    accepted: float
    """Share of accepted results; the next three are of these, NaN where there is none."""
    beyond_3: float = np.nan
    """Share of results with more than three σ on an axis."""
    beyond_5: float = np.nan
    squared: float = np.nan
    """Mean squared Mahalanobis distance over its 6 degrees of freedom."""


def measure_robots(arms: Sequence[str]) -> list[RobotRow]:
    """Return a row per size of errors, number of images and solver, over one draw of each arm."""
    rows: list[RobotRow] = []
    for preset, count in product(get_args(PresetName), COUNTS):
        problems = [bent_problem(arm_named(arm), preset, count, 0) for arm in arms]
        for known, method in SOLVERS.items():
            answers = [method(p) for p in problems]
            off = _errors(problems, [(one.gripper_from_camera, one.scale) for one in answers])
            accepted = np.array([one.converged for one in answers])
            shares = []
            if accepted.any():
                covariance = np.array([one.covariance[:6, :6] for one in answers if one.converged])
                std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
                worst = np.abs(off[accepted] / std).max(1)
                squared = squared_distance(off[accepted], covariance).mean() / 6
                shares = [float((worst > 3).mean()), float((worst > 5).mean()), float(squared)]
            rows.append(RobotRow(preset, count, known, *_median_error(off), float(accepted.mean()), *shares))
        park = [opencv("Park", p.base_from_gripper, p.recon_from_camera, p.scale) for p in problems]
        rows.append(RobotRow(preset, count, PEER, *_median_error(_errors(problems, park)), 1.0))
    return rows


def _errors(
    problems: Sequence[BentProblem], found: Sequence[tuple[Float[ndarray, "4 4"], float]]
) -> Float[ndarray, "k 6"]:
    """Return the errors of found transforms and scales."""
    return np.array([error(p, *one)[:6] for p, one in zip(problems, found, strict=True)])


def _median_error(off: Float[ndarray, "k 6"]) -> tuple[float, float]:
    """Return median translation (mm) and rotation (degrees)."""
    metres, radians = np.median(np.linalg.norm(off.reshape(-1, 2, 3), axis=2), axis=0)
    return 1e3 * float(metres), float(np.degrees(radians))


class Knowledge(NamedTuple):
    """Knowledge of the intrinsics, and the camera that took the images."""

    name: str
    start: Callable[[np.random.Generator], Intrinsics]
    """Draws the initial intrinsics."""
    is_given: bool = False
    camera: Intrinsics = INTRINSICS


def _off(rng: np.random.Generator) -> Intrinsics:
    values = parameters(INTRINSICS)
    values[:2] *= 1 + OFF * rng.choice([-1.0, 1.0])
    values[2:4] += 3.0 * rng.choice([-1.0, 1.0], size=2)
    return with_parameters(INTRINSICS, values)


def _reconstructed(camera: Intrinsics) -> Callable[[np.random.Generator], Intrinsics]:
    """Return what draws the intrinsics of a reconstruction without given ones, at which the adjustment starts.

    The reconstruction has adjusted them: they are the pinhole with five coefficients that fits the camera best, with
    errors of 1 % of the focal length and 10 % of each coefficient. From zero distortion, the adjustment ends in a local
    minimum for some captures of a lens that displaces the corner by 30 %.
    """
    across = [np.linspace(0, size - 1, 25) for size in (camera.width, camera.height)]
    x_px = np.stack(np.meshgrid(*across), -1).reshape(-1, 2)
    ray, middle = unproject(camera, x_px), Intrinsics(450.0, 450.0, 319.5, 239.5, 640, 480)
    best = least_squares(
        lambda values: (project(with_parameters(middle, values), ray) - x_px).ravel(), parameters(middle)
    ).x

    def draw(rng: np.random.Generator) -> Intrinsics:
        values = best.copy()
        values[:2] *= 1 + 0.01 * rng.normal()
        values[2:4] = 319.5, 239.5
        values[4:] *= 1 + 0.1 * rng.normal(size=5)
        return with_parameters(middle, values)

    return draw


WAYS = (
    Knowledge("given", lambda rng: INTRINSICS, True),
    Knowledge("given, 0.5 % and 3 px off", _off, True),
    Knowledge("not given", _reconstructed(INTRINSICS)),
    Knowledge("not given, more distortion than the model", _reconstructed(BENT), camera=BENT),
)


class SeenRow(NamedTuple):
    """Errors of points over all captures of a robot, a number of images and a knowledge of the intrinsics."""

    preset: PresetName
    images: int
    known: str
    within_95: float
    """Share of points whose error is below what 95 % are stated to be below; their distances are exact."""
    within_3: float
    """Share of those within 3 σ on every axis."""
    seen_mm: float
    """Median error of a point."""
    stated_mm: float
    """Median of the stated 95 % bound."""
    camera_mm: float
    """Median error of the camera on the gripper."""


def measure_seen(draws: int) -> list[SeenRow]:
    """Return a row per robot, number of images and knowledge of the intrinsics."""
    presets: tuple[PresetName, ...] = ("white", "typical")
    return [_seen_row(*row, draws) for row in product(presets, COUNTS, WAYS)]


def _seen_row(preset: PresetName, count: int, known: Knowledge, draws: int) -> SeenRow:
    three, lengths, stated, moved = [], [], [], []
    for seed in range(draws):
        problem = bent_problem(arm_named(ROBOT_NAMES[seed % len(ROBOT_NAMES)]), preset, count, seed)
        rng = np.random.default_rng([seed, 9])
        tracks = observed(problem, rng, POINTS, PIXEL_STD, known.camera)
        if len(tracks.image) < 100 * count:
            continue
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        fit = solved.gripper_from_camera, solved.scale, solved.base_from_recon.rigid
        start = known.start(rng)
        free = camera_with_prior(start) if known.is_given else camera_with_prior(start, ESTIMATED)
        arm = wrist_arm(problem.base_from_gripper)
        found = solve(*wrist_problem(arm, fit, problem.recon_from_camera, free, tracks))
        camera = found.problem.intrinsics(found.state)[0]
        # Errors of points in axes of the estimated camera, and their stated covariance.
        x, x_px = found.state.x[0], nine_pixels(known.camera)
        uncertainty = uncertainty_of(found)
        true = placed(problem.gripper_from_camera, known.camera, x_px, DISTANCE_M)
        off = (true - placed(x, camera, x_px, DISTANCE_M)) @ x[:3, :3]
        covariance = point_covariance(x, uncertainty, camera, x_px, DISTANCE_M)
        three.append((np.abs(off) < 3 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).all(1))
        lengths.append(np.linalg.norm(off, axis=1))
        stated.append([within_95(one) for one in covariance])
        moved.append(np.linalg.norm(step_between(x, problem.gripper_from_camera)[:3]))
    within = float((np.array(lengths) < stated).mean())
    medians = (1e3 * float(np.median(values)) for values in (lengths, stated, moved))
    return SeenRow(preset, count, known.name, within, float(np.mean(three)), *medians)


def _claims(robots: Sequence[RobotRow], seen: Sequence[SeenRow]) -> Iterator[str]:
    ours = [row for row in robots if row.known in SOLVERS and row.known != WHITE and row.accepted > 0]
    white = [row for row in robots if row.known == WHITE and row.preset != "white" and row.accepted > 0]
    # Per cent of all accepted results; all rows have as many draws.
    pooled, alone = (
        100 * np.average([row.beyond_3 for row in rows], weights=[row.accepted for row in rows])
        for rows in (ours, white)
    )
    yield (
        f"> Arms with systematic errors: {pooled:.1f} % of the accepted results are beyond 3 of their own σ on "
        f"an axis, {100 * max(row.beyond_3 for row in ours):.0f} % in the worst row; with white noise alone "
        f"{alone:.0f} %."
    )
    shares = [100 * row.within_95 for row in seen]
    yield (
        f"> Points seen at {DISTANCE_M} m: {np.mean(shares):.0f} % of the errors are within the stated 95 %, "
        f"{min(shares):.0f} to {max(shares):.0f} % in the rows; median error "
        f"{np.median([row.seen_mm for row in seen]):.2f} mm, of the camera on the gripper "
        f"{np.median([row.camera_mm for row in seen]):.2f} mm."
    )


def _tables(robots: Sequence[RobotRow], seen: Sequence[SeenRow], draws: int) -> Iterator[str]:
    yield from ("", "## Arms with systematic errors", "")
    head = "errors | images | solver | median error | accepted | > 3 σ | > 5 σ | squared distance / 6"
    yield from table(
        head,
        (
            [
                *row[:3],
                f"{row.mm:.2f} mm {row.deg:.3f}°",
                *map(_percent, row[5:8]),
                number(row.squared) or "–",
            ]
            for row in robots
        ),
    )
    yield from ("", "## Points that the camera sees", "")
    yield from (f"Nine pixels of the image, {POINTS} points with {PIXEL_STD} px, {draws} captures a row.", "")
    head = "robot | images | intrinsics | within their 95 % | within 3 σ | median error"
    head += " | 95 % stated below | camera"
    yield from table(
        head,
        (
            [
                *row[:3],
                _percent(row.within_95),
                f"{100 * row.within_3:.1f} %",
                *(f"{mm:.2f} mm" for mm in row[5:]),
            ]
            for row in seen
        ),
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "–"
