"""Fixed cameras, second wrist cameras, second arms and eye-to-hand: simulated cells, and real images of a capture."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import chi2

import jcr
from benchmarks.page import (
    farthest,
    folders_with_captures,
    largest_std,
    mm_deg,
    of_rows,
    squared_distance,
    table,
)
from jcr.backends import ReconstructOptions, reconstruct
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.camera import parameters, with_parameters
from jcr.capture.read import read_capture
from jcr.cell.place_cameras import place_cameras
from jcr.errors import RejectedError
from jcr.estimation.intrinsics_prior import camera_with_prior
from jcr.estimation.problem import State, with_observations
from jcr.estimation.solve import Solution, solve
from jcr.geometry import inverse, scale_translation, step_between
from jcr.records import CellCamera
from jcr.records.json_file import read_json
from jcr.result import RunOptions
from simulation.arms import PresetName
from simulation.cell_faults import CellKind, further_camera
from simulation.cells import CellProblem, Kind, cell_problem
from simulation.faults import Faults
from simulation.image_faults import IMAGES, ImageFault, draw, rendered, write

DRAWS, COUNT = 10, 10
"""Cells of each kind, and poses of each arm."""
PRESET_NAMES: tuple[PresetName, ...] = ("white", "typical")
WITHHELD = 4
"""Every this many of a real capture's images are declared images of fixed cameras, one each."""
Of = Callable[[State], Float[ndarray, "4 4"]]


CELL_SEEDS = (0, 2)
"""Seeds of rendered cells; their scenes have arms without systematic errors."""
CELL_FAULTS: tuple[tuple[str, CellKind, Faults], ...] = (
    ("none", "fixed", Faults()),
    ("bumped by 20 mm 1.5° between its two images", "fixed", Faults(slip=(0.02, np.radians(1.5)))),
    ("none", "wrist", Faults()),
    ("bumped by 5 mm midway", "wrist", Faults(slip=(0.005, 0.0))),
    ("none", "arm", Faults()),
    ("slips by 12 mm 4° midway", "arm", Faults(slip=(0.012, np.radians(4.0)))),
    ("poses late by 5 % of the time between images", "arm", Faults(delay_s=0.05, view_s=1.0)),
)
"""Fault, mount and size of each rendered further camera."""


class Draw(NamedTuple):
    """Error of one estimated transform against its stated covariance."""

    mm: float
    deg: float
    squared: float
    """Squared Mahalanobis distance."""
    sigmas: float
    """Largest error on an axis in standard deviations."""


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
    return {"base_from_camera": lambda p: p.z[0] @ scale_translation(p.world_from_rig[-1], p.scale)}


def answered(problem: CellProblem, seed: int) -> Solution:
    """Adjust a cell by its images and poses; intrinsics are off by the usual error of given ones."""
    rng = np.random.default_rng([seed, 17])
    cameras = []
    for k, camera in enumerate(problem.cameras):
        free = camera_with_prior(camera)
        off = free.directions @ (free.std * rng.normal(size=len(free.std)))
        free = camera_with_prior(with_parameters(camera, parameters(camera) + off))
        cameras.append(replace(free, mount_free=problem.kind == "wrists" and k > 0))
    return solve(*with_observations(*problem.unsolved(cameras)))


FIXED = "fixed"
"""Folder, below that of the captures, of those of cameras beside the robot."""


def run(captures: Path, every: int = 1) -> str:
    """Return the page in Markdown, of one draw, rendered cell and capture in `every`."""
    faults = [cells for seed in CELL_SEEDS[::every] for cells in _with_faults(seed)]
    real = [row for folder in folders_with_captures(captures, every) for row in _withheld(folder)]
    drawn, rows = [], []
    for kind, preset in product(get_args(Kind), PRESET_NAMES):
        for name, draws in _draws(kind, preset, max(DRAWS // every, 1)).items():
            drawn += draws
            middle, most = (np.quantile([draw[:2] for draw in draws], share, axis=0) for share in (0.5, 0.95))
            sizes = [f"{mm:.2f} mm {deg:.3f}°" for mm, deg in (middle, most)]
            beyond = f"{100 * np.mean([draw.sigmas > 3 for draw in draws]):.0f} %"
            squared = f"{np.mean([draw.squared for draw in draws]) / 6:.2f}"
            rows.append([kind, preset, name, *sizes, f"{100 * _inside(draws):.0f} %", beyond, squared])
    watching = [row for folder in sorted((captures / FIXED).glob("*")) for row in _watching(folder)]
    placed = np.array([off for _, off in real if off is not None])
    lines = [
        f"> Simulated cells of {COUNT} poses an arm: {100 * _inside(drawn):.0f} % of {len(drawn)} results lie within "
        f"their own 95 % ellipsoid, {100 * np.mean([draw.sigmas > 3 for draw in drawn]):.1f} % are beyond 3 σ."
    ]
    if len(placed):
        (mm, deg), tried = np.median(placed, axis=0), sum(cells[1] != "rejected" for cells, _ in real)
        lines.append(
            f"> Real images declared to be of fixed cameras, {len(placed)} of {tried} located: {mm:.1f} mm and "
            f"{deg:.2f}° from the reported pose times X (median), at most {placed[:, 0].max():.1f} mm."
        )
    head = "cell | errors | transform | median error | 95 % of errors below | inside 95 % | > 3 σ | squared distance / 6"
    lines += [
        "",
        "Simulated: UR5e kinematics, white: 0.5 mm and 0.1°; typical: joint offsets of 0.1° and link errors of 0.3 mm, "
        "the truth then the effective transform; 0.5 px of noise; given intrinsics 0.5 % off.",
        "",
        *table(head, rows),
        "",
        f"Real: every {WITHHELD}th image of a capture is declared the image of a fixed camera, its gripper pose "
        "withheld. Its base_from_camera is compared with the reported pose times the X of the other images.",
        "",
        *table("capture | image | points | off: mm | ° | ±σ: mm | °", (cells for cells, _ in real)),
        "",
        f"Rendered: a wrist camera with {IMAGES} images, and a further camera with one fault. A camera that moved is "
        "compared before and after, whichever is farther.",
        "",
        *table("mount | fault | verdict | findings | off: mm | ° | σ", faults),
        "",
        "Cameras that watch the gripper, each alone, with the board that it carries and without it (by features of what "
        "moves), and all together; `off` is from the pose that the repository states, σ the largest on an axis.",
        "",
        *table(
            "capture | camera | how | images | verdict | off: mm | ° | ±σ: mm | ° | σ | processor s", watching
        ),
    ]
    return "\n".join(lines) + "\n"


def _draws(kind: Kind, preset: PresetName, count: int) -> dict[str, list[Draw]]:
    """Return the errors of every transform of a kind of cell."""
    out: dict[str, list[Draw]] = {}
    for seed in range(count):
        problem = cell_problem(kind, preset, COUNT, seed)
        answer = answered(problem, seed)
        for name, of in wanted(problem).items():
            found, covariance = answer.transform(of)
            off = step_between(found, problem.truth[name])
            sigmas = float((np.abs(off) / np.sqrt(np.diag(covariance))).max())
            draw = Draw(*mm_deg(off), float(squared_distance(off, covariance)), sigmas)
            out.setdefault(name, []).append(draw)
    return out


def _inside(draws: Sequence[Draw]) -> float:
    """Return the share of results within their 95 % ellipsoid."""
    return float(np.mean([draw.squared < chi2.ppf(0.95, 6) for draw in draws]))


def _withheld(folder: Path) -> Iterator[tuple[list[str], tuple[float, float] | None]]:
    """Calibrate a capture without some of its images, and locate these as fixed cameras.

    Yields the row of each withheld image, and its distance (mm, degrees) from the reported pose times X where located.
    """
    capture = read_capture(folder)
    apart = list(range(2, len(capture), WITHHELD))
    rest = of_rows(capture, [row for row in range(len(capture)) if row not in apart])
    hand_eye = reconstruction = None
    try:
        reconstruction = reconstruct(rest, ReconstructOptions(backend="colmap"))
        hand_eye = calibrate_reconstruction(rest, reconstruction)
    except RejectedError:
        pass
    if reconstruction is None or hand_eye is None or not hand_eye.converged:
        yield [folder.name, "rejected", "0", *["–"] * 4], None
        return
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
    found, _, _ = place_cameras(rest, cameras, reconstruction, hand_eye)
    for row, camera in zip(apart, found.cameras, strict=True):
        off, numbers = None, ["–"] * 4
        if camera.parent_from_camera is not None and camera.covariance is not None:
            there = capture.base_from_gripper[row] @ hand_eye.gripper_from_camera
            off = mm_deg(step_between(camera.parent_from_camera, there))
            numbers = [f"{value:.2f}" for value in (*off, *largest_std(camera.covariance))]
        yield [folder.name, capture.images[row], str(camera.images[0].points), *numbers], off


def _watching(folder: Path) -> Iterator[list[object]]:
    """Calibrate cameras that watch the gripper, each alone and all together, and yield a row for each."""
    cell, source = read_capture(folder), read_json(folder / "capture.json")["source"]
    board = ReconstructOptions(board=source["board"])
    captures = {cell.camera_name: replace(cell, others=())}
    for camera in cell.others:
        assert camera.frame is not None
        poses = cell.base_from_gripper[camera.frame]
        captures[camera.name] = replace(
            captures[cell.camera_name], images=camera.images, base_from_gripper=poses, camera_name=camera.name
        )

    def row(
        name: str, how: str, images: str, verdict: str, found: Any, covariance: Any, begun: float
    ) -> list[object]:
        """Return the row of one placed camera; `found` is its base_from_camera, None if it has none."""
        off, seconds = ["–"] * 5, f"{time.process_time() - begun:.0f}"
        if found is not None:
            step, sigmas = farthest(found, covariance, [np.array(source["truth"][name])])
            off = [f"{value:.2f}" for value in (*mm_deg(step), *largest_std(covariance), sigmas)]
        return [folder.name, name, how, images, verdict, *off, seconds]

    with tempfile.TemporaryDirectory() as out:
        for (name, capture), (how, options) in product(
            captures.items(), {"board": board, "features": ReconstructOptions()}.items()
        ):
            begun = time.process_time()
            try:
                result = jcr.calibrate(capture, Path(out) / name / how, RunOptions(reconstruct=options))
            except RejectedError as error:
                yield row(name, how, f"0 of {len(capture)}", error.what, None, None, begun)
                continue
            made = result.found
            used = f"{sum(one.used for one in made.images)} of {len(capture)}"
            yield row(name, how, used, made.verdict, made.base_from_camera, made.covariance[:6, :6], begun)
        begun = time.process_time()
        result = jcr.calibrate(cell, Path(out) / "together", RunOptions(reconstruct=board))
        made = result.found
        used = f"{sum(one.used for one in made.images)} of {len(cell)}"
        together = made.base_from_camera, made.covariance[:6, :6]
        yield row(cell.camera_name, "together", used, made.verdict, *together, begun)
        for one in [] if result.cameras is None else result.cameras.cameras:
            used = f"{sum(image.used for image in one.images)} of {len(one.images)}"
            yield row(one.name, "together", used, one.verdict, one.parent_from_camera, one.covariance, begun)


def _with_faults(seed: int) -> Iterator[list[object]]:
    """Calibrate a rendered wrist camera, and yield a row for the placement of each further camera of CELL_FAULTS."""
    scene = rendered(seed)
    with tempfile.TemporaryDirectory() as folder:
        made = write(draw(scene, seed, ImageFault()), Path(folder) / "capture")
        result = jcr.calibrate(made, Path(folder) / "out")
        for fault, kind, faults in CELL_FAULTS:
            camera, truths = further_camera(kind, faults, scene, seed, Path(folder) / kind)
            file, _, _ = place_cameras(result.capture, [camera], result.reconstruction, result.found)
            (placed,) = file.cameras
            names = ", ".join(dict.fromkeys(one.kind for one in placed.findings)) or "–"
            off = ["–"] * 3
            if placed.parent_from_camera is not None and placed.covariance is not None:
                step, sigmas = farthest(placed.parent_from_camera, placed.covariance, truths)
                off = [f"{value:.2f}" for value in (*mm_deg(step), sigmas)]
            yield [kind, fault, placed.verdict, names, *off]
