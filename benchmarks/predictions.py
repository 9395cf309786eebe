"""`benchmarks predictions`: the whole job from pointmaps with a network's errors, against the truth."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.page import mm_deg, table
from benchmarks.synthetic_pairs import pairs_of_capture, write_pairs
from jcr.capture.read import read_capture
from jcr.pipeline import RunOptions
from jcr.pipeline import run as run_all
from jcr.reconstruct import ReconstructOptions
from jcr.results import RunResult
from simulation.capture import SimulateOptions, simulate
from simulation.problems import HandEyeProblem, error
from simulation.surface import truth_points
from simulation.truth import read_truth

SEEDS = 1
IMAGES = (3, 5, 10)
NOISES = ((0.0, 0.0), (0.5, 0.1))
"""Of the robot, mm and degrees per axis."""


@dataclass(frozen=True)
class EndToEnd:
    """Errors of one run from its truth."""

    translation_mm: float
    rotation_deg: float
    scale_percent: float
    surface_mm: float
    """Median distance of the map's surface from points of the true one, as far as the map reaches."""
    sigmas: float
    """The true error in units of the reported uncertainty: root of the mean square over its seven parts."""
    seconds: float


def run() -> str:
    """Markdown: median errors and times over seeds, by robot pose noise and number of images."""
    about = (
        f"Simulated tabletop; true pointmaps at 128x96 with a network's errors (white 0.3 %, smooth distance 1 %, "
        f"2 % outliers, a unit per pair); `--backend predictions`, median of {SEEDS} draws. The last but one "
        "column is the true error over the reported one sigma: about 1 where the uncertainty is honest.\n"
    )
    claim, rows = "", []
    for noise in NOISES:
        for images in IMAGES:
            runs = [end_to_end(images, seed, noise) for seed in range(SEEDS)]
            mm, deg, percent, surface, sigmas, seconds = np.median(
                [list(vars(r).values()) for r in runs], axis=0
            )
            cells = [
                f"{noise[0]:g} mm, {noise[1]:g}°",
                images,
                f"{mm:.2f} mm",
                f"{deg:.3f}°",
                f"{percent:.2f} %",
            ]
            rows.append([*cells, f"{surface:.1f} mm", f"{sigmas:.1f}", f"{seconds:.0f} s"])
            claim = (
                f"> The whole job from simulated predictions of {images} images, robot pose noise {noise[0]:g} mm and "
                f"{noise[1]:g}°: {mm:.2f} mm and {deg:.3f}° off, the map's surface {surface:.1f} mm, "
                f"in {seconds:.0f} s.\n"
            )
    head = "robot pose noise | images | translation | rotation | scale | map surface | error / sigma | time"
    return "\n".join([claim, about, *table(head, rows)]) + "\n"


def end_to_end(images: int, seed: int, noise: tuple[float, float]) -> EndToEnd:
    """Simulate, predict with errors, and run everything; `noise` of the robot in mm and degrees."""
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(
            Path(folder) / "capture", SimulateOptions(images=images, seed=seed, robot_noise=noise)
        )
        predictions, truth = pairs_of_capture(made, seed=seed)
        pairs = Path(folder) / "pairs.npz"
        write_pairs(pairs, predictions)
        options = RunOptions(reconstruct=ReconstructOptions(predictions=pairs))
        result = run_all(read_capture(made), Path(folder) / "out", options)
        # Metres per geometric mean of the pairs' units.
        return scored(result, made, float(np.exp(-np.log(truth.pair_unit).mean())))


def scored(result: RunResult, capture: Path, true_scale: float) -> EndToEnd:
    """Errors of a run on the simulated capture in a folder."""
    truth, found = read_truth(capture), result.hand_eye
    surface, _ = truth_points(capture)
    assert result.scene is not None
    every = max(1, len(surface) // 20_000)
    distance = np.abs(np.asarray(result.scene.query(surface[::every]).distance))
    problem = HandEyeProblem(
        truth.base_from_gripper,
        result.reconstruction.recon_from_camera,
        truth.gripper_from_camera,
        true_scale,
        truth.base_from_gripper,
    )
    off = error(problem, found.gripper_from_camera, found.scale)
    return EndToEnd(
        *mm_deg(off),
        100 * abs(float(off[6])),
        1e3 * float(np.nanmedian(distance)),
        float(np.sqrt(off @ np.linalg.solve(found.covariance, off) / 7)),
        sum(result.calibration.timings_s.values()),
    )
