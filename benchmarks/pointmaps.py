"""`benchmarks pointmaps`: the whole job from pairwise pointmaps with a network's errors, against the truth."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.page import mm_deg, table
from jcr.capture.read import read_capture
from jcr.geometry import fit_similarity
from jcr.pipeline.run import RunOptions
from jcr.pipeline.run import run as run_all
from jcr.reconstruct import ReconstructOptions
from jcr.results import RunResult
from simulation.capture import SimulateOptions, simulate
from simulation.pairs import pairs_of_capture, write_pairs
from simulation.problems import HandEyeProblem, error
from simulation.surface import truth_points
from simulation.truth import read_truth

IMAGES, NOISES = (3, 5, 10), ((0.0, 0.0), (0.5, 0.1))
"""Numbers of images, and robot pose noise in mm and degrees per axis."""


@dataclass(frozen=True)
class EndToEnd:
    """Errors of one run from its truth."""

    translation_mm: float
    rotation_deg: float
    scale_percent: float
    surface_mm: float
    """Median distance of the map's surface from points of the true one, as far as the map reaches."""
    sigmas: float
    """Root mean square over the seven parts of the error in stated standard deviations."""
    seconds: float


def run() -> str:
    """Return the page in Markdown: errors and time by robot pose noise and number of images."""
    claim, rows = "", []
    for noise in NOISES:
        robot = f"{noise[0]:g} mm, {noise[1]:g}°"
        for images in IMAGES:
            found = end_to_end(images, 0, noise)
            cells = [
                f"{found.translation_mm:.2f} mm",
                f"{found.rotation_deg:.3f}°",
                f"{found.scale_percent:.2f} %",
            ]
            cells += [f"{found.surface_mm:.1f} mm", f"{found.sigmas:.1f}", f"{found.seconds:.0f} s"]
            rows.append([robot, images, *cells])
            claim = (
                f"> The whole job from simulated predictions of {images} images, robot pose noise {robot}: "
                f"{cells[0]} and {cells[1]} off, the map's surface {cells[3]}, in {cells[5]}.\n"
            )
    about = (
        "Simulated tabletop; true pointmaps at 128x96 with white errors of 0.3 %, smooth errors of distance of 1 %, "
        "2 % outliers and a unit per pair; `--backend predictions`.\n"
    )
    head = "robot pose noise | images | translation | rotation | scale | map surface | error / σ | time"
    return "\n".join([claim, about, *table(head, rows)]) + "\n"


def end_to_end(images: int, seed: int, noise: tuple[float, float]) -> EndToEnd:
    """Simulate a capture, predict pointmaps with errors, run everything; `noise` of the robot in mm and degrees."""
    with tempfile.TemporaryDirectory() as folder:
        made = simulate(
            Path(folder) / "capture", SimulateOptions(images=images, seed=seed, robot_noise=noise)
        )
        predictions, _ = pairs_of_capture(made, seed=seed)
        pairs = Path(folder) / "pairs.npz"
        write_pairs(pairs, predictions)
        options = RunOptions(reconstruct=ReconstructOptions(predictions=pairs))
        result = run_all(read_capture(made), Path(folder) / "out", options)
        return _scored(result, made)


def _scored(result: RunResult, capture: Path) -> EndToEnd:
    """Compare a run with the truth of its simulated capture."""
    truth, found = read_truth(capture), result.hand_eye
    surface, _ = truth_points(capture)
    assert result.scene is not None
    distance = np.abs(np.asarray(result.scene.query(surface[:: max(1, len(surface) // 20_000)]).distance))
    cameras = result.reconstruction.recon_from_camera
    true_scale = fit_similarity(truth.base_from_camera[:, :3, 3], cameras[:, :3, 3])[1]
    problem = HandEyeProblem(
        truth.base_from_gripper,
        cameras,
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
