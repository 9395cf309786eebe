"""`benchmarks cameras DIR`: further cameras and arms, simulated against the truth and real images against the robot."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import chi2

from benchmarks.page import folders_with, mm_deg, table
from jcr.calibration.stage import calibrate
from jcr.camera import parameters, with_parameters
from jcr.capture.read import read_capture
from jcr.cell.stage import place_cameras
from jcr.errors import RejectedError
from jcr.estimation.intrinsics_prior import camera_with_prior
from jcr.estimation.problem import Problem, State, with_observations
from jcr.estimation.solve import Solution, solve
from jcr.geometry import inverse, scale_translation, skew, step_between
from jcr.reconstruct import ReconstructOptions, reconstruct
from jcr.records import Capture, CellCamera
from simulation.arms import PresetName
from simulation.cells import BOX, CellProblem, Kind, cell_problem

DRAWS = 10
"""Of each kind of cell."""
COUNT = 10
"""Poses of each arm."""
PRESET_NAMES: tuple[PresetName, ...] = ("white", "typical")
BOX_MM = "x".join(f"{1e3 * side:.0f}" for side in BOX)
WITHHELD = 4
"""Every this many of a real capture's images are declared images of fixed cameras, one each."""
Of = Callable[[State], Float[ndarray, "4 4"]]


def wanted(problem: CellProblem) -> dict[str, Of]:
    """What is asked of a cell, by the name that its truth has."""
    if problem.kind == "carried":
        return {"base_from_camera": lambda p: p.x[0]}
    if problem.kind == "wrists":
        return {
            "gripper_from_camera": lambda p: p.x[0],
            "gripper_from_second": lambda p: p.x[0] @ scale_translation(p.rig_from_camera[1], p.scale),
        }
    if problem.kind == "arms":
        return {
            "gripper_from_camera": lambda p: p.x[0],
            "gripper_from_second": lambda p: p.x[1],
            "base1_from_base2": lambda p: p.z[0] @ inverse(p.z[1]),
        }
    return {"base_from_camera": lambda p: p.z[0] @ scale_translation(p.world_from_rig[COUNT], p.scale)}


WORDS: dict[Kind, str] = {
    "fixed": "a fixed camera",
    "wrists": "two cameras on a wrist",
    "arms": "two arms",
    "carried": "eye-to-hand",
}


@dataclass(frozen=True)
class Draw:
    """One answer against its truth."""

    error: Float[ndarray, "6"]
    covariance: Float[ndarray, "6 6"]

    @property
    def squared(self) -> float:
        """Mahalanobis' distance."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))

    @property
    def sigmas(self) -> float:
        """Of the worst axis."""
        return float((np.abs(self.error) / np.sqrt(np.diag(self.covariance))).max())


def run(captures: Path) -> str:
    """Markdown: simulated draws of each kind, and withheld images of every capture below `captures`.

    Raises InputError where there is no capture.
    """
    folders = folders_with(captures, "capture.json")
    drawn: dict[tuple[Kind, PresetName], dict[str, list[Draw]]] = {
        (kind, preset): _drawn(kind, preset) for kind in get_args(Kind) for preset in PRESET_NAMES
    }
    real = [line for folder in folders for line in _withheld(folder)]
    return _page(drawn, real, DRAWS)


def answered(problem: CellProblem, seed: int) -> Solution:
    """The cell from its images and poses; intrinsics are off by what is usual of given ones."""
    rng = np.random.default_rng([seed, 17])
    cameras = []
    for k, camera in enumerate(problem.cameras):
        free = camera_with_prior(camera)
        off = free.directions @ (free.std * rng.normal(size=len(free.std)))
        free = camera_with_prior(with_parameters(camera, parameters(camera) + off))
        cameras.append(replace(free, mount_free=problem.kind == "wrists" and k > 0))
    state = State(
        x=np.stack([x for x, _ in problem.starts]),
        scale=1.0,
        z=np.stack([z for _, z in problem.starts]),
        world_from_rig=problem.world_from_rig,
        rig_from_camera=problem.rig_from_camera,
        points_in_world=problem.points_in_world,
    )
    cell = Problem(arms=tuple(problem.arms), n_rigs=len(problem.world_from_rig), cameras=tuple(cameras))
    return solve(*with_observations(cell, state, problem.observations))


def _drawn(kind: Kind, preset: PresetName) -> dict[str, list[Draw]]:
    out: dict[str, list[Draw]] = {}
    for seed in range(DRAWS):
        problem = cell_problem(kind, preset, COUNT, seed)
        answer = answered(problem, seed)
        for name, of in wanted(problem).items():
            found, covariance = answer.transform(of)
            out.setdefault(name, []).append(Draw(step_between(found, problem.truth[name]), covariance))
    return out


@dataclass(frozen=True)
class Row:
    """One withheld image."""

    capture: str
    image: str
    intrinsics: str
    points: int
    draw: Draw | None
    """Of base_from_camera against the robot's pose and X; None where it was not placed."""
    std_mm: float = 0.0
    std_deg: float = 0.0
    scene_mm: float = 0.0
    message: str = ""


def _withheld(folder: Path) -> list[Row]:
    capture = read_capture(folder)
    apart = list(range(2, len(capture), WITHHELD))
    kept = [row for row in range(len(capture)) if row not in apart]
    rest = _of_rows(capture, kept)
    try:
        reconstruction = reconstruct(rest, ReconstructOptions(backend="colmap"))
        hand_eye = calibrate(rest, reconstruction)
    except RejectedError as refusal:
        return [Row(folder.name, "–", "", 0, None, message=str(refusal))]
    if not hand_eye.converged:
        return [Row(folder.name, "–", "", 0, None, message=hand_eye.warnings[0])]
    cameras = [
        CellCamera(
            name=f"fixed{row}",
            mount="base",
            images=(capture.images[row],),
            image_size=capture.image_size,
            intrinsics=capture.intrinsics,
        )
        for row in apart
    ]
    found = place_cameras(rest, cameras, reconstruction, hand_eye)
    intrinsics, rows = "estimated" if capture.intrinsics is None else "given", []
    rig = int(hand_eye.inliers.sum())
    for row, camera in zip(apart, found.cameras, strict=True):
        points = camera.images[0].points
        if camera.parent_from_camera is None or camera.covariance is None:
            rows.append(
                Row(folder.name, capture.images[row], intrinsics, points, None, message=camera.warnings[0])
            )
            continue
        assert found.answer is not None
        draw = _against_robot(found.answer, rig, capture.base_from_gripper[row])
        rig += 1
        std = np.sqrt(np.diag(camera.covariance))
        rows.append(
            Row(
                folder.name,
                capture.images[row],
                intrinsics,
                points,
                draw,
                1e3 * float(std[:3].max()),
                float(np.degrees(std[3:].max())),
                1e3 * (camera.std_at_scene or 0.0),
                "" if camera.converged else camera.warnings[0],
            )
        )
    return rows


def _of_rows(capture: Capture, rows: list[int]) -> Capture:
    return replace(
        capture,
        images=tuple(capture.images[row] for row in rows),
        base_from_gripper=capture.base_from_gripper[rows],
        joints=None if capture.joints is None else capture.joints[rows],
    )


def _against_robot(answer: Solution, rig: int, gripper: Float[ndarray, "4 4"]) -> Draw:
    """base_from_camera of a rig that no arm moved, against the pose that its arm reported and X, with errors of both."""

    def placed(p: State) -> Float[ndarray, "4 4"]:
        return p.z[0] @ scale_translation(p.world_from_rig[rig], p.scale)

    def carried(p: State) -> Float[ndarray, "4 4"]:
        return gripper @ p.x[0]

    j = answer.derivative(placed) - answer.derivative(carried)
    moves = np.eye(6)
    moves[:3, 3:] = -skew(gripper[:3, :3] @ answer.state.x[0][:3, 3])
    sizes = answer.noise.together
    robot = moves @ np.diag(np.repeat(sizes, 3) ** 2) @ moves.T
    error = step_between(placed(answer.state), carried(answer.state))
    return Draw(error, j @ answer.covariance @ j.T + robot)


def _page(
    drawn: dict[tuple[Kind, PresetName], dict[str, list[Draw]]], real: Sequence[Row], of_each: int
) -> str:
    every = [draw for names in drawn.values() for draws in names.values() for draw in draws]
    beyond = 100 * np.mean([draw.sigmas > 3 for draw in every])
    placed = [row for row in real if row.draw is not None]
    lines = [
        f"> Simulated cells of {COUNT} poses an arm, {of_each} draws of each kind: {100 * _inside(every, 0.95):.0f} % "
        f"of {len(every)} results lie within their own 95 % ellipsoid, {100 * _inside(every, 0.99):.0f} % within that "
        f"of 99 %, {beyond:.1f} % are beyond 3 σ on an axis.",
    ]
    if placed:
        errors = np.array([mm_deg(row.draw.error) for row in placed if row.draw is not None])
        named = sorted({row.capture for row in placed})
        median = np.median(errors, axis=0)
        lines.append(
            f"> Real images declared to be of fixed cameras, {len(placed)} of {len([r for r in real if r.intrinsics])} "
            f"placed, of {', '.join(named)}: base_from_camera {median[0]:.1f} mm and {median[1]:.2f}° from the robot's "
            f"pose times X (median), at most {errors[:, 0].max():.1f} mm; "
            f"{sum(row.draw.sigmas > 3 for row in placed if row.draw is not None)} beyond 3 σ of both on an axis."
        )
    lines += [
        "",
        "Simulated: arms of UR5e kinematics, white: random errors of 0.5 mm and 0.1°; typical: joint offsets of 0.1° "
        "and link errors of 0.3 mm, the truth then the effective transform. Points of a table (of a box of "
        f"{BOX_MM} mm in the gripper), 0.5 px of noise; intrinsics off by what is usual of given ones (0.5 % of focal "
        "length, 0.5 % of the width). No images: what bundle adjustment and the robots make of them. σ also counts "
        "what features of real images leave wrong in the intrinsics, and systematic errors of any arm: why squared "
        "distance / 6 is below 1 here is in docs/how-to/cameras.md.",
        "",
        *table(
            "cell | errors | transform | median error | 95 % of errors below | σ per axis | inside 95 % | 99 % | > 3 σ "
            "| squared distance / 6",
            (_simulated(*cell, *named) for cell, names in drawn.items() for named in names.items()),
        ),
        "",
        f"Real: every {WITHHELD}th image of a capture is declared the image of a fixed camera of its own, its gripper "
        "pose withheld; base_from_camera then against the pose that the robot reported there, times the X of the other "
        "images. In σ: largest on an axis, of the camera's place, X and the robot's pose together.",
        "",
        *table(
            "capture | image | intrinsics | points | off: mm | ° | in σ | ±σ: mm | ° | at the scene: mm",
            map(_real, real),
        ),
    ]
    lines += ["", *(f"- {row.capture}, {row.image}: {row.message}" for row in real if row.message)]
    return "\n".join(lines).rstrip() + "\n"


def _simulated(kind: Kind, preset: PresetName, name: str, draws: list[Draw]) -> list[str]:
    sizes = np.array([mm_deg(draw.error) for draw in draws])
    spread = (
        np.median(sizes, axis=0),
        np.quantile(sizes, 0.95, axis=0),
        np.median([*map(_std, draws)], axis=0),
    )
    return [
        WORDS[kind],
        preset,
        name,
        *(f"{mm:.2f} mm {deg:.3f}°" for mm, deg in spread),
        *(f"{100 * _inside(draws, share):.0f} %" for share in (0.95, 0.99)),
        f"{100 * np.mean([draw.sigmas > 3 for draw in draws]):.0f} %",
        f"{np.mean([draw.squared for draw in draws]) / 6:.2f}",
    ]


def _real(row: Row) -> list[str]:
    cells = [row.capture, row.image, row.intrinsics, str(row.points)]
    if row.draw is None:
        return cells + ["–"] * 6
    mm, deg = mm_deg(row.draw.error)
    cells += [f"{mm:.2f}", f"{deg:.3f}", f"{row.draw.sigmas:.1f}"]
    return [*cells, f"{row.std_mm:.2f}", f"{row.std_deg:.3f}", f"{row.scene_mm:.1f}"]


def _inside(draws: Sequence[Draw], share: float) -> float:
    return float(np.mean([draw.squared < chi2.ppf(share, 6) for draw in draws]))


def _std(draw: Draw) -> tuple[float, float]:
    """mm and degrees per axis, root mean square."""
    metres, radians = np.sqrt(np.diag(draw.covariance).reshape(2, 3).mean(1))
    return 1e3 * float(metres), float(np.degrees(radians))
