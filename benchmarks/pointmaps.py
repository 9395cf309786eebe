"""The whole job from pairwise pointmaps with a network's errors, against the truth."""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.page import mm_deg, squared_distance, table
from jcr.capture.read import read_capture
from jcr.geometry import fit_similarity, step_between
from jcr.pipeline.run import RunOptions
from jcr.pipeline.run import run as run_all
from jcr.reconstruct import ReconstructOptions
from simulation.capture import SimulateOptions, simulate
from simulation.pairs import pairs_of_capture, write_pairs
from simulation.truth import read_truth, surface_in_workspace

IMAGES, NOISES = (3, 5, 10), ((0.0, 0.0), (0.5, 0.1))
"""Numbers of images, and robot pose noise in mm and degrees per axis."""


class EndToEnd(NamedTuple):
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
                text.format(value)
                for text, value in zip(
                    ("{:.2f} mm", "{:.3f}°", "{:.2f} %", "{:.1f} mm", "{:.1f}", "{:.0f} s"),
                    found,
                    strict=True,
                )
            ]
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
        simulated = SimulateOptions(images=images, seed=seed, robot_noise=noise)
        made, pairs = simulate(Path(folder) / "capture", simulated), Path(folder) / "pairs.npz"
        write_pairs(pairs, pairs_of_capture(made, seed=seed)[0])
        options = RunOptions(reconstruct=ReconstructOptions(predictions=pairs))
        result = run_all(read_capture(made), Path(folder) / "out", options)
        truth = read_truth(made)
        x = surface_in_workspace(truth).x_in_base
    assert result.scene is not None
    distance = np.abs(np.asarray(result.scene.query(x[:: max(1, len(x) // 20_000)]).distance))
    centers = result.reconstruction.recon_from_camera[:, :3, 3]
    true_scale, found = fit_similarity(truth.base_from_camera[:, :3, 3], centers)[1], result.found
    step = step_between(found.gripper_from_camera, truth.gripper_from_camera)
    off = np.r_[step, np.log(true_scale / found.scale)]
    return EndToEnd(
        *mm_deg(off),
        100 * abs(float(off[6])),
        1e3 * float(np.nanmedian(distance)),
        float(np.sqrt(squared_distance(off, found.covariance) / 7)),
        sum(result.calibration.timings_s.values()),
    )
