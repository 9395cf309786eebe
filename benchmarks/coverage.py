"""`benchmarks coverage`: shares of errors inside the stated 95 % and 3 σ, and the uncertainty predicted by `jcr check`.

Three simulated tables against the effective transform: poses of arms with systematic errors, points that the camera
sees, and predicted over reported uncertainty.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import table
from benchmarks.peers import opencv
from jcr.calibration.adjust import adjust_images
from jcr.calibration.case import of_images
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.requirement import assumptions_of, reached
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate, fit_poses
from jcr.camera import parameters, unproject, with_parameters
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.estimation.intrinsics_prior import ESTIMATED, Camera, camera_with_prior
from jcr.estimation.point_uncertainty import point_covariance, within_95
from jcr.estimation.prediction import predict
from jcr.estimation.wrist import adjust_wrist, estimate_of
from jcr.geometry import apply, step_between
from jcr.pipeline.check import spread_rows
from jcr.records import Capture, Estimate, HandEye, Intrinsics, Reconstruction
from simulation.arms import PresetName
from simulation.problems import INTRINSICS, BentProblem, bent_problem, error, observed

COUNTS = (8, 12, 30)
DRAWS, PREDICTED_DRAWS = 10, 20
"""Captures per row of seen points, and captures of predicted uncertainty."""
POINTS, PIXEL_STD, DISTANCE_M = 400, 0.3, 0.45
OFF = 0.005
"""Relative error of a focal length that is given wrong; its principal point is 3 px off."""
BENT = Intrinsics(450.0, 449.0, 322.0, 236.0, 640, 480, (0.1, -0.3, 0.5, -0.4), "fisheye")
"""Camera whose distortion five coefficients of a pinhole leave by 0.2 px rms, 2 px in the corners."""
FACTOR = 2.0
"""Ratio of predicted and reported uncertainty that counts as agreement."""
WHITE, PEER = "white noise alone", "OpenCV Park, scale given"
SOLVERS: dict[str, Callable[[BentProblem], HandEye]] = {
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


def run() -> str:
    """Return the page in Markdown: claims, then the three tables."""
    robots, seen, ahead = measure_robots(), measure_seen(), predicted()
    return "\n".join([*_claims(robots, seen, ahead), *_tables(robots, seen, ahead)]) + "\n"


# Poses of arms with systematic errors.


@dataclass(frozen=True)
class RobotRow:
    """Results of one solver for arms with errors of one size, against the effective transform."""

    preset: PresetName
    count: int
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


def measure_robots(
    arms: Sequence[str] = ROBOT_NAMES,
    presets: Sequence[PresetName] = get_args(PresetName),
    counts: Sequence[int] = COUNTS,
    draws: int = 1,
) -> list[RobotRow]:
    """Return a row per size of errors, number of images and solver; `draws` of each arm."""
    rows = []
    for preset in presets:
        for count in counts:
            problems = [bent_problem(arm_named(arm), preset, count, k) for arm in arms for k in range(draws)]
            for known, solve in SOLVERS.items():
                rows.append(_robot_row(preset, count, known, [(p, solve(p)) for p in problems]))
            park = [opencv("Park", p.base_from_gripper, p.recon_from_camera, p.scale) for p in problems]
            off = np.array([error(p, *found)[:6] for p, found in zip(problems, park, strict=True)])
            rows.append(RobotRow(preset, count, PEER, *_median_error(off), 1.0))
    return rows


def _robot_row(
    preset: PresetName, count: int, known: str, answers: list[tuple[BentProblem, HandEye]]
) -> RobotRow:
    off = np.array([error(problem, one.gripper_from_camera, one.scale)[:6] for problem, one in answers])
    covariance = np.array([one.covariance[:6, :6] for _, one in answers])
    accepted = np.array([one.converged for _, one in answers])
    head = preset, count, known, *_median_error(off), float(accepted.mean())
    if not accepted.any():
        return RobotRow(*head)
    off, covariance = off[accepted], covariance[accepted]
    worst = np.abs(off / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).max(1)
    squared = np.einsum("ki,ki->k", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return RobotRow(*head, float((worst > 3).mean()), float((worst > 5).mean()), float(squared.mean() / 6))


def _median_error(off: Float[ndarray, "k 6"]) -> tuple[float, float]:
    """Return median translation (mm) and rotation (degrees)."""
    metres, radians = np.median(np.linalg.norm(off.reshape(-1, 2, 3), axis=2), axis=0)
    return 1e3 * float(metres), float(np.degrees(radians))


# Points that the camera sees.


@dataclass(frozen=True)
class Knowledge:
    """Knowledge of the intrinsics, and the camera that took the images."""

    name: str
    start: Callable[[np.random.Generator], Intrinsics]
    prior: Callable[[Intrinsics], Camera]
    camera: Intrinsics = INTRINSICS


def _off(rng: np.random.Generator) -> Intrinsics:
    values = parameters(INTRINSICS)
    values[:2] *= 1 + OFF * rng.choice([-1.0, 1.0])
    values[2:4] += 3.0 * rng.choice([-1.0, 1.0], size=2)
    return with_parameters(INTRINSICS, values)


def _guessed(camera: Intrinsics) -> Callable[[np.random.Generator], Intrinsics]:
    """Return what draws the initial intrinsics of a reconstruction without given ones."""

    def draw(rng: np.random.Generator) -> Intrinsics:
        focal = camera.fx * (1 + 0.01 * rng.normal())
        return Intrinsics(focal, focal, 319.5, 239.5, 640, 480)

    return draw


def _estimated(found: Intrinsics) -> Camera:
    return camera_with_prior(found, ESTIMATED)


WAYS = (
    Knowledge("given", lambda rng: INTRINSICS, camera_with_prior),
    Knowledge("given, 0.5 % and 3 px off", _off, camera_with_prior),
    Knowledge("not given", _guessed(INTRINSICS), _estimated),
    Knowledge("not given, more distortion than the model", _guessed(BENT), _estimated, BENT),
)


@dataclass(frozen=True)
class SeenRow:
    """Errors of seen points over all captures of a row."""

    preset: PresetName
    count: int
    known: str
    within_95: float
    """Share of seen points whose error is below what 95 % are stated to be below."""
    within_3: float
    """Share of those within 3 σ on every axis."""
    seen_mm: float
    """Median error of a seen point."""
    stated_mm: float
    """Median of the stated 95 % bound."""
    camera_mm: float
    """Median error of the camera on the gripper."""


def measure_seen(
    presets: Sequence[PresetName] = ("white", "typical"),
    counts: Sequence[int] = COUNTS,
    ways: Sequence[Knowledge] = WAYS,
    draws: int = DRAWS,
) -> list[SeenRow]:
    """Return a row per robot, number of images and knowledge of the intrinsics."""
    return [
        _seen_row(preset, count, known, draws) for preset in presets for count in counts for known in ways
    ]


def _seen_row(preset: PresetName, count: int, known: Knowledge, draws: int) -> SeenRow:
    within, three, errors, stated, camera = [], [], [], [], []
    for seed in range(draws):
        problem = bent_problem(arm_named(ROBOT_NAMES[seed % len(ROBOT_NAMES)]), preset, count, seed)
        rng = np.random.default_rng([seed, 9])
        tracks = observed(problem, rng, POINTS, PIXEL_STD, known.camera)
        if len(tracks.image) < 100 * count:
            continue
        start, solved = known.start(rng), solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        fit = solved.gripper_from_camera, solved.scale, solved.base_from_recon
        found = adjust_wrist(
            problem.base_from_gripper, fit, problem.recon_from_camera, known.prior(start), tracks
        )
        estimate = estimate_of(found, tracks)
        off, covariance = _point_errors(problem, known.camera, estimate)
        below = np.array([within_95(one) for one in covariance])
        within.append(np.linalg.norm(off, axis=1) < below)
        three.append((np.abs(off) < 3 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))).all(1))
        errors.append(np.linalg.norm(off, axis=1))
        stated.append(below)
        camera.append(
            np.linalg.norm(step_between(estimate.gripper_from_camera, problem.gripper_from_camera)[:3])
        )
    medians = (1e3 * float(np.median(values)) for values in (errors, stated, camera))
    return SeenRow(preset, count, known.name, float(np.mean(within)), float(np.mean(three)), *medians)


def _point_errors(
    problem: BentProblem, camera: Intrinsics, estimate: Estimate
) -> tuple[Float[ndarray, "k 3"], Float[ndarray, "k 3 3"]]:
    """Return errors of seen points in axes of the estimated camera, and the stated covariance of each."""
    share = np.array([0.1, 0.5, 0.9])
    x_px = np.stack(np.meshgrid(share * camera.width, share * camera.height), -1).reshape(-1, 2)
    assert estimate.intrinsics is not None

    def placed(x: Float[ndarray, "4 4"], own: Intrinsics, distance: float) -> Float[ndarray, "k 3"]:
        ray = unproject(own, x_px)
        return apply(x, distance * ray / np.linalg.norm(ray, axis=1, keepdims=True))

    found = placed(
        estimate.gripper_from_camera, estimate.intrinsics, DISTANCE_M * estimate.scale / problem.scale
    )
    off = placed(problem.gripper_from_camera, camera, DISTANCE_M) - found
    stated = point_covariance(estimate, estimate.intrinsics, x_px, DISTANCE_M)
    return off @ estimate.gripper_from_camera[:3, :3], stated


# Predicted uncertainty.


def predicted(draws: int = PREDICTED_DRAWS) -> Float[ndarray, "k 3"]:
    """Return predicted over reported uncertainty of seen point, camera and rotation for accepted captures.

    Captures differ in arm, its errors, number of images, intrinsics and noise.
    """
    return np.array(list(_ratios(draws))).reshape(-1, 3)


def _ratios(draws: int) -> Iterator[list[float]]:
    for seed in range(draws):
        capture, reconstruction = _made(seed)
        options = CalibrateOptions()
        robot, rows = robot_errors(capture, options), spread_rows(len(capture))
        case = fit_poses(capture, _only(reconstruction, rows), options, robot.of(rows))
        case = adjust_images(case)
        hand_eye = calibrate(capture, reconstruction, options)
        if not (hand_eye.converged and case.hand_eye.converged) or hand_eye.in_use is None:
            continue
        prediction = predict(assumptions_of(case), capture.base_from_gripper, robot.systematic)
        foretold, reported = (
            (reached(one, use, "seen")[0], *reached(one, use, "camera"))
            for one, use in ((prediction.estimate, prediction.in_use), (hand_eye, hand_eye.in_use))
        )
        yield np.divide(foretold, reported).tolist()


def _made(seed: int) -> tuple[Capture, Reconstruction]:
    """Return a capture without images and its reconstruction; every other one has the joints of a named arm."""
    name, known = ROBOT_NAMES[seed % len(ROBOT_NAMES)], WAYS[seed % 3]
    preset: PresetName = "white" if seed % 5 in (1, 4) else "typical"
    count, rng = (6, 8, 12, 20)[seed % 4], np.random.default_rng([seed, 7])
    problem, start = bent_problem(arm_named(name), preset, count, seed), known.start(rng)
    capture = Capture(
        folder=Path(),
        images=tuple(f"{k}.png" for k in range(count)),
        base_from_gripper=problem.base_from_gripper,
        image_size=(start.width, start.height),
        intrinsics=None if known.name.startswith("not") else start,
        joints=problem.joints if seed % 2 else None,
        robot=name if seed % 2 else None,
    )
    return capture, Reconstruction(
        image_index=np.arange(count),
        recon_from_camera=problem.recon_from_camera,
        intrinsics=start,
        tracks=observed(problem, rng, POINTS, (0.1, 0.3)[seed // 2 % 2], known.camera),
        backend="simulated",
    )


def _only(made: Reconstruction, rows: np.ndarray) -> Reconstruction:
    among = np.isin(np.arange(len(made.image_index)), rows)
    return Reconstruction(
        image_index=rows,
        recon_from_camera=made.recon_from_camera[rows],
        intrinsics=made.intrinsics,
        tracks=of_images(made.tracks, among),
        backend=made.backend,
    )


# The page.


def _claims(
    robots: Sequence[RobotRow], seen: Sequence[SeenRow], ahead: Float[ndarray, "k 3"]
) -> Iterator[str]:
    ours = [row for row in robots if row.known in SOLVERS and row.known != WHITE and row.accepted > 0]
    white = [row for row in robots if row.known == WHITE and row.preset != "white" and row.accepted > 0]
    yield (
        f"> Arms with systematic errors: {_pooled(ours):.1f} % of the accepted results are beyond 3 of their own σ on "
        f"an axis, {100 * max(row.beyond_3 for row in ours):.0f} % in the worst row; with white noise alone "
        f"{_pooled(white):.0f} %."
    )
    shares = [100 * row.within_95 for row in seen]
    yield (
        f"> Points seen at {DISTANCE_M} m: {np.mean(shares):.0f} % of the errors are within the stated 95 %, "
        f"{min(shares):.0f} to {max(shares):.0f} % in the rows; median error "
        f"{np.median([row.seen_mm for row in seen]):.2f} mm, of the camera on the gripper "
        f"{np.median([row.camera_mm for row in seen]):.2f} mm."
    )
    agree = (np.abs(np.log(ahead)) < np.log(FACTOR)).sum(0)
    worst = np.exp(np.abs(np.log(ahead)).max(0))
    parts = [f"{what} {n} of {len(ahead)}, at most {most:.2f} times"
             for what, n, most in zip(("seen point", "camera", "rotation"), agree, worst, strict=True)]  # fmt: skip
    yield f"> Predicted and reported uncertainty agree within a factor of {FACTOR:g}: {'; '.join(parts)}."


def _pooled(rows: Sequence[RobotRow]) -> float:
    """Return per cent of all accepted results beyond three σ; all rows have as many draws."""
    accepted = sum(row.accepted for row in rows)
    return 100 * sum(row.accepted * row.beyond_3 for row in rows) / accepted if accepted else np.nan


def _tables(
    robots: Sequence[RobotRow], seen: Sequence[SeenRow], ahead: Float[ndarray, "k 3"]
) -> Iterator[str]:
    yield from ("", "## Arms with systematic errors", "")
    head = "errors | images | solver | median error | accepted | > 3 σ | > 5 σ | squared distance / 6"
    yield from table(head, map(_robot_cells, robots))
    yield from ("", "## Points that the camera sees", "")
    yield from (f"Nine pixels of the image, {POINTS} points with {PIXEL_STD} px, {DRAWS} captures a row.", "")
    head = "robot | images | intrinsics | within their 95 % | within 3 σ | median error | 95 % stated below | camera"
    yield from table(head, map(_seen_cells, seen))
    yield from ("", "## Predicted over reported uncertainty", "")
    quantiles = np.quantile(ahead, (0.0, 0.25, 0.5, 0.75, 1.0), axis=0).T
    names = ("seen point", "camera on the gripper", "rotation")
    yield from table(
        "95 % of errors of | least | 25 % | median | 75 % | most",
        ([name, *(f"{q:.2f}" for q in row)] for name, row in zip(names, quantiles, strict=True)),
    )


def _robot_cells(row: RobotRow) -> list[str]:
    shares = (row.accepted, row.beyond_3, row.beyond_5)
    cells = [f"{100 * share:.0f} %" if np.isfinite(share) else "–" for share in shares]
    squared = f"{row.squared:.2f}" if np.isfinite(row.squared) else "–"
    return [row.preset, f"{row.count}", row.known, f"{row.mm:.2f} mm {row.deg:.3f}°", *cells, squared]


def _seen_cells(row: SeenRow) -> list[str]:
    shares = (f"{100 * row.within_95:.0f} %", f"{100 * row.within_3:.1f} %")
    lengths = (f"{mm:.2f} mm" for mm in (row.seen_mm, row.stated_mm, row.camera_mm))
    return [row.preset, f"{row.count}", row.known, *shares, *lengths]
