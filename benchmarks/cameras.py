"""`benchmarks cameras DIR`: further cameras and arms, simulated against the truth and real images against the robot."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
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
from jcr.geometry import inverse, scale_translation, step_between
from jcr.reconstruct import ReconstructOptions, reconstruct
from jcr.records import Capture, CellCamera
from simulation.arms import PresetName
from simulation.cells import CellProblem, Kind, cell_problem

DRAWS, COUNT = 10, 10
"""Cells of each kind, and poses of each arm."""
PRESET_NAMES: tuple[PresetName, ...] = ("white", "typical")
WITHHELD = 4
"""Every this many of a real capture's images are declared images of fixed cameras, one each."""
Of = Callable[[State], Float[ndarray, "4 4"]]


def wanted(problem: CellProblem) -> dict[str, Of]:
    """Return the transforms to compare of a cell, by the names of their truth."""
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


@dataclass(frozen=True)
class Draw:
    """Error of one estimated transform and its stated covariance."""

    error: Float[ndarray, "6"]
    covariance: Float[ndarray, "6 6"]

    @property
    def squared(self) -> float:
        """Squared Mahalanobis distance."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))

    @property
    def sigmas(self) -> float:
        """Largest error on an axis in standard deviations."""
        return float((np.abs(self.error) / np.sqrt(np.diag(self.covariance))).max())


def run(captures: Path) -> str:
    """Return the page in Markdown: simulated cells of each kind, and withheld images of the captures."""
    folders = folders_with(captures, "capture.json")
    cells: list[tuple[Kind, PresetName]] = [*product(get_args(Kind), PRESET_NAMES)]
    simulated = {cell: _draws(*cell) for cell in cells}
    real = [row for folder in folders for row in _withheld(folder)]
    every = [draw for names in simulated.values() for draws in names.values() for draw in draws]
    head = "cell | errors | transform | median error | 95 % of errors below | inside 95 % | > 3 σ | squared distance / 6"
    rows = (_cells(*cell, *named) for cell, names in simulated.items() for named in names.items())
    lines = [
        f"> Simulated cells of {COUNT} poses an arm: {100 * _inside(every):.0f} % of {len(every)} results lie within "
        f"their own 95 % ellipsoid, {100 * np.mean([draw.sigmas > 3 for draw in every]):.1f} % are beyond 3 σ.",
        *_claim(real),
        "",
        "Simulated: UR5e kinematics, white: 0.5 mm and 0.1°; typical: joint offsets of 0.1° and link errors of 0.3 mm, "
        "the truth then the effective transform; 0.5 px of noise; given intrinsics 0.5 % off.",
        "",
        *table(head, rows),
        "",
        f"Real: every {WITHHELD}th image of a capture is declared the image of a fixed camera, its gripper pose "
        "withheld. Its base_from_camera is compared with the reported pose times the X of the other images.",
        "",
        *table("capture | image | points | off: mm | ° | ±σ: mm | °", (row.cells() for row in real)),
    ]
    return "\n".join(lines) + "\n"


def answered(problem: CellProblem, seed: int) -> Solution:
    """Adjust a cell by its images and poses; intrinsics are off by the usual error of given ones."""
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


def _draws(kind: Kind, preset: PresetName) -> dict[str, list[Draw]]:
    """Return the errors of every transform of a kind of cell."""
    out: dict[str, list[Draw]] = {}
    for seed in range(DRAWS):
        problem = cell_problem(kind, preset, COUNT, seed)
        answer = answered(problem, seed)
        for name, of in wanted(problem).items():
            found, covariance = answer.transform(of)
            out.setdefault(name, []).append(Draw(step_between(found, problem.truth[name]), covariance))
    return out


def _cells(kind: Kind, preset: PresetName, name: str, draws: list[Draw]) -> list[str]:
    sizes = np.array([mm_deg(draw.error) for draw in draws])
    return [
        kind,
        preset,
        name,
        *(
            f"{mm:.2f} mm {deg:.3f}°"
            for mm, deg in (np.median(sizes, axis=0), np.quantile(sizes, 0.95, axis=0))
        ),
        f"{100 * _inside(draws):.0f} %",
        f"{100 * np.mean([draw.sigmas > 3 for draw in draws]):.0f} %",
        f"{np.mean([draw.squared for draw in draws]) / 6:.2f}",
    ]


def _inside(draws: Sequence[Draw]) -> float:
    """Return the share of results within their 95 % ellipsoid."""
    return float(np.mean([draw.squared < chi2.ppf(0.95, 6) for draw in draws]))


@dataclass(frozen=True)
class Row:
    """One withheld image; without numbers where its camera was not located."""

    capture: str
    image: str
    points: int = 0
    off: tuple[float, float] | None = None
    """mm and degrees from the reported pose times X."""
    std: tuple[float, float] | None = None
    """Largest stated standard deviation, mm and degrees."""

    def cells(self) -> list[str]:
        """Return the row of the table."""
        numbers = [f"{value:.2f}" for pair in (self.off, self.std) if pair is not None for value in pair]
        return [self.capture, self.image, str(self.points), *(numbers or ["–"] * 4)]


def _withheld(folder: Path) -> Iterator[Row]:
    """Calibrate a capture without some of its images, and locate these as fixed cameras."""
    capture = read_capture(folder)
    apart = list(range(2, len(capture), WITHHELD))
    rest = _only(capture, [row for row in range(len(capture)) if row not in apart])
    try:
        reconstruction = reconstruct(rest, ReconstructOptions(backend="colmap"))
        hand_eye = calibrate(rest, reconstruction)
    except RejectedError:
        yield Row(folder.name, "rejected")
        return
    if not hand_eye.converged:
        yield Row(folder.name, "rejected")
        return
    size, intrinsics = capture.image_size, capture.intrinsics
    cameras = [
        CellCamera(
            name=f"fixed{row}",
            mount="base",
            images=(capture.images[row],),
            image_size=size,
            intrinsics=intrinsics,
        )
        for row in apart
    ]
    found = place_cameras(rest, cameras, reconstruction, hand_eye)
    for row, camera in zip(apart, found.cameras, strict=True):
        points = camera.images[0].points
        if camera.parent_from_camera is None or camera.covariance is None:
            yield Row(folder.name, capture.images[row], points)
            continue
        there = capture.base_from_gripper[row] @ hand_eye.gripper_from_camera
        std = np.sqrt(np.diag(camera.covariance))
        off = mm_deg(step_between(camera.parent_from_camera, there))
        largest = 1e3 * float(std[:3].max()), float(np.degrees(std[3:].max()))
        yield Row(folder.name, capture.images[row], points, off, largest)


def _only(capture: Capture, rows: list[int]) -> Capture:
    return replace(
        capture,
        images=tuple(capture.images[row] for row in rows),
        base_from_gripper=capture.base_from_gripper[rows],
        joints=None if capture.joints is None else capture.joints[rows],
    )


def _claim(real: Sequence[Row]) -> Iterator[str]:
    placed = np.array([row.off for row in real if row.off is not None])
    if len(placed):
        (mm, deg), most = np.median(placed, axis=0), placed[:, 0].max()
        tried = sum(row.image != "rejected" for row in real)
        yield (
            f"> Real images declared to be of fixed cameras, {len(placed)} of {tried} located: {mm:.1f} mm and "
            f"{deg:.2f}° from the reported pose times X (median), at most {most:.1f} mm."
        )
