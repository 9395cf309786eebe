"""The whole job from pairwise pointmaps with a network's errors, against the truth."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.stats import chi2

import jcr
from benchmarks.page import farthest, mm_deg, squared_distance, table
from jcr.backends import ReconstructOptions
from jcr.camera import unproject
from jcr.capture.formats import capture_json
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.estimation.point_uncertainty import point_covariance
from jcr.geometry import apply, fit_similarity, inverse, step_between
from jcr.pipeline.run import RunOptions
from jcr.pipeline.run import run as run_all
from jcr.pointmaps.pair_predictions import complete_pairs
from jcr.records import Capture
from simulation.capture import SimulateOptions, simulate
from simulation.faults import Faults, moved_parts, reported_poses
from simulation.pairs import PairErrors, pairs_of_capture, synthetic_pairs, write_pairs
from simulation.poses import random_hand_eye
from simulation.problems import disturbed
from simulation.truth import read_truth, surface_in_workspace

IMAGES, NOISES = (3, 5, 10), ((0.0, 0.0), (0.5, 0.1))
"""Numbers of images, and robot pose noise in mm and degrees per axis."""


GRID, PREDICTED = (96, 72), 10
"""Width and height (px) of images without features, and their number."""
FAULTS: tuple[tuple[str, float, bool, Faults, bool], ...] = (
    ("none", 0.0, True, Faults(), False),
    ("none", 0.0, False, Faults(), False),
    ("pointmaps have a focal length 3 % too long", 0.03, True, Faults(), False),
    ("pointmaps have a focal length 3 % too long", 0.03, False, Faults(), False),
    ("pointmaps have a focal length 10 % too long", 0.10, True, Faults(), False),
    ("pointmaps have a focal length 10 % too long", 0.10, False, Faults(), False),
    ("mount slips by 6 mm 2° midway", 0.0, True, Faults(slip=(0.006, np.radians(2.0))), False),
    ("poses late by 10 % of the time between images", 0.0, True, Faults(delay_s=0.1, view_s=1.0), False),
    ("poses in another order", 0.0, True, Faults(), True),
)
"""Fault, relative error of the focal length, whether intrinsics are given, size, whether poses are shuffled."""


def run() -> str:
    """Return the page in Markdown: errors and time by robot pose noise and number of images."""
    claim, rows = "", []
    for noise in NOISES:
        robot = f"{noise[0]:g} mm, {noise[1]:g}°"
        for images in IMAGES:
            cells = end_to_end(images, noise)
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
    faults = [
        "",
        f"{PREDICTED} images without features, of {GRID[0]}x{GRID[1]}; robot pose noise 0.5 mm, 0.1°. The corner is a "
        "point at 0.6 m in the corner of the image: its error and the stated 95 % of it.",
        "",
        *table(
            "fault | intrinsics | verdict | findings | off: mm | ° | σ | corner: mm | 95 %, mm",
            (with_fault(*one) for one in FAULTS),
        ),
    ]
    return "\n".join([claim, about, *table(head, rows), *faults]) + "\n"


def end_to_end(images: int, noise: tuple[float, float]) -> list[str]:
    """Simulate a capture, predict pointmaps with errors, run everything, and return the errors and the time.

    `noise` is that of the robot in mm and degrees. The distance of the map's surface is the median over points of the
    true one, as far as the map reaches; σ is the root mean square over the seven parts of the error.
    """
    with tempfile.TemporaryDirectory() as folder:
        simulated = SimulateOptions(images=images, robot_noise=noise)
        made, pairs = simulate(Path(folder) / "capture", simulated), Path(folder) / "pairs.npz"
        write_pairs(pairs, pairs_of_capture(made)[0])
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
    mm, deg = mm_deg(off)
    sigmas, seconds = (
        np.sqrt(squared_distance(off, found.covariance) / 7),
        result.calibration.timings_s.values(),
    )
    return [
        *(f"{mm:.2f} mm", f"{deg:.3f}°", f"{100 * abs(off[6]):.2f} %"),
        *(f"{1e3 * np.nanmedian(distance):.1f} mm", f"{sigmas:.1f}", f"{sum(seconds):.0f} s"),
    ]


def with_fault(what: str, focal: float, given: bool, faults: Faults, is_shuffled: bool) -> list[object]:
    """Calibrate from simulated predictions of images that show no features; return the row of the table.

    `focal` is the relative error of the focal length in the pointmaps, and `given` whether the capture has intrinsics.
    """
    rng, size = np.random.default_rng(7), GRID
    pairs, truth = synthetic_pairs(complete_pairs(PREDICTED), size, PairErrors(focal=focal), 7)
    x, camera = random_hand_eye(rng), truth.intrinsics
    mounts, _ = moved_parts(x, PREDICTED, faults, rng)
    poses = reported_poses(truth.base_from_camera @ inverse(mounts), faults)
    poses = disturbed(
        poses[rng.permutation(PREDICTED)] if is_shuffled else poses, (5e-4, np.radians(0.1)), rng
    )
    names = tuple(f"{k:02d}.png" for k in range(PREDICTED))
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "capture"
        made.mkdir()
        for k, name in enumerate(names):
            Image.new("RGB", size, (100 + k,) * 3).save(made / name)
        capture = Capture(
            folder=made,
            images=names,
            base_from_gripper=poses,
            image_size=size,
            intrinsics=camera if given else None,
        )
        capture_json.write(made, capture)
        # The network has no intrinsics but those that the capture states.
        write_pairs(Path(folder) / "pairs.npz", replace(pairs, images=names, intrinsics=capture.intrinsics))
        try:
            options = {"reconstruct": {"predictions": Path(folder) / "pairs.npz"}}
            found = jcr.calibrate(made, Path(folder) / "out", options)
        except RejectedError as error:
            return [what, "given" if given else "none", "rejected", str(error), *["–"] * 5]
    step, sigmas = farthest(found.gripper_from_camera, found.covariance[:6, :6], (mounts[0], mounts[-1]))
    seen, true = (unproject(one, np.zeros(2)) for one in (found.reconstruction.intrinsics, camera))
    points = [
        apply(a, 0.6 * ray / np.linalg.norm(ray))
        for a, ray in ((found.gripper_from_camera, seen), (mounts[0], true))
    ]
    covariance = point_covariance(
        found.gripper_from_camera, found.found.uncertainty, found.reconstruction.intrinsics, np.zeros(2), 0.6
    )
    within = 1e3 * np.sqrt(chi2.ppf(0.95, 3) * np.linalg.eigvalsh(covariance)[-1])
    names_found = (
        ", ".join(dict.fromkeys(one.kind for one in found.findings if one.severity != "informs")) or "–"
    )
    sizes = [f"{one:.2f}" for one in (*mm_deg(step), sigmas)]
    corner = [f"{one:.1f}" for one in (1e3 * np.linalg.norm(points[0] - points[1]), within)]
    return [what, "given" if given else "none", found.verdict, names_found, *sizes, *corner]
