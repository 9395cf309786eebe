"""`benchmarks align`: global alignment by Gauss-Newton and by Adam on synthetic pairs."""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.adam import align_adam
from benchmarks.page import mm_deg, table
from benchmarks.synthetic_pairs import PairErrors, PairTruth, synthetic_pairs, write_pairs
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.geometry import (
    apply_similarity,
    fit_similarity,
    inverse,
    rotation_between_deg,
    rotation_exp,
    transform,
)
from jcr.pointmaps.dust3r.pair_graph import complete_pairs
from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.pairs import PairPredictions
from simulation.problems import HandEyeProblem, disturbed, error

SMALL, MIDDLE, LARGE = (64, 48), (128, 96), (512, 384)


@dataclass(frozen=True)
class Draws:
    """How many of each."""

    images: int
    kinds: int
    hand_eye: int


DRAWS = Draws(1, 1, 4)
FEW_STEPS = 3
"""Of adam at the large size, whose 300 take a quarter of an hour."""
ERRORS = {
    "white 0.3 %, smooth distance 1 %, 2 % outliers (below: these and)": PairErrors(),
    "pairs rotated by 1° per axis": PairErrors(pair_rotation_deg=1.0),
    "smooth direction 0.6°": PairErrors(bend=0.01),
    "20 % outliers": PairErrors(outliers=0.2),
    "10 % of the pairs wrong": PairErrors(wrong_pairs=6),
}
CHILD = """
import sys
from benchmarks.align_pairs import main
main(sys.argv[1:])
sys.stderr.write(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""
"""The command in a process of its own, which prints its peak memory (ru_maxrss includes the parent's)."""


@dataclass(frozen=True)
class Score:
    """Mean errors of the cameras after the best similarity, and the time of the alignment."""

    mm: float
    deg: float
    seconds: float


def run() -> str:
    """Markdown tables: time and memory, accuracy over images, kinds of error, hand-eye from few images."""
    return (
        "\n\n".join([_cost(), _images(DRAWS.images), _kinds(DRAWS.kinds), _hand_eye(DRAWS.hand_eye)]) + "\n"
    )


def camera_errors(
    base_from_camera: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"]
) -> tuple[float, float]:
    """Mean distance (mm) and angle (deg) of the cameras from the truth, after the best similarity."""
    base_from_recon, scale = fit_similarity(base_from_camera[:, :3, 3], recon_from_camera[:, :3, 3])
    centers = apply_similarity(base_from_recon, scale, recon_from_camera[:, :3, 3])
    rotation = rotation_between_deg(
        base_from_recon[:3, :3] @ recon_from_camera[:, :3, :3], base_from_camera[:, :3, :3]
    )
    return 1e3 * float(np.linalg.norm(centers - base_from_camera[:, :3, 3], axis=1).mean()), float(
        rotation.mean()
    )


def _cost() -> str:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        predictions, truth = synthetic_pairs(complete_pairs(10), MIDDLE)
        pairs = Path(folder) / "pairs.npz"
        write_pairs(pairs, predictions)
        fast, row = _command(pairs, "fast", 300, predictions, truth)
        rows.append([f"{_size(MIDDLE)}, 10 images", "fast", *row])
        adam, row = _command(pairs, "adam", 300, predictions, truth)
        rows.append([f"{_size(MIDDLE)}, 10 images", "adam, 300 steps", *row])
        predictions, truth = synthetic_pairs(complete_pairs(10), LARGE)
        write_pairs(pairs, predictions)
        large, row = _command(pairs, "fast", 300, predictions, truth)
        rows.append([f"{_size(LARGE)}, 10 images", "fast", *row])
        begin, _ = _command(pairs, "adam", 0, predictions, truth)
        few, row = _command(pairs, "adam", FEW_STEPS, predictions, truth)
        rows.append([f"{_size(LARGE)}, 10 images", f"adam, {FEW_STEPS} steps", *row])
    full = begin + (few - begin) * 300 / FEW_STEPS
    return "\n".join(
        [
            f"> Global alignment of 90 pairs at {_size(LARGE)} takes {large:.1f} s on the processor; 300 steps of Adam "
            f"would take {full / large:.0f} times as long.\n",
            *table("input | method | alignment | whole command | peak memory beside the input | error", rows),
            f"\nadam takes {adam / fast:.0f} times as long as fast at {_size(MIDDLE)}, and at {_size(LARGE)} "
            f"{full / large:.0f} times ({full:.0f} s, 300 steps extrapolated from {FEW_STEPS}).",
        ]
    )


def _command(
    pairs: Path, method: str, steps: int, predictions: PairPredictions, truth: PairTruth
) -> tuple[float, list[str]]:
    """Seconds of the alignment, and the rest of a table row, of the command in a process of its own."""
    result = pairs.with_name("aligned.npz")
    arguments = [
        str(pairs),
        str(result),
        "--method",
        method,
        "--adam.steps",
        str(steps),
    ]
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *arguments], capture_output=True, text=True, check=True
    )
    whole = time.perf_counter() - begin
    seconds = json.loads(done.stdout)["seconds"]
    peak_gb = int(done.stderr.split("VmHWM:")[1].split()[0]) * 1024 / 1e9
    input_gb = sum(array.nbytes for array in predictions.pointmaps) / 1e9
    with np.load(result) as file:
        mm, deg = camera_errors(truth.base_from_camera, file["poses"])
    row = [f"{seconds:.2f} s", f"{whole:.1f} s", f"{peak_gb - input_gb:.2f} GB", f"{mm:.2f} mm, {deg:.3f}°"]
    return seconds, row


def _score(predictions: PairPredictions, truth: PairTruth, method: str) -> Score:
    begin = time.perf_counter()
    found = align_adam(predictions) if method == "adam" else global_align(predictions)
    seconds = time.perf_counter() - begin
    return Score(*camera_errors(truth.base_from_camera, found.recon_from_camera), seconds)


def _mean_row(name: str, scores: dict[str, list[Score]]) -> list[str]:
    cells = [name]
    for method in ("fast", "adam"):
        mm = [score.mm for score in scores[method]]
        deg = [score.deg for score in scores[method]]
        seconds = np.mean([score.seconds for score in scores[method]])
        cells.append(
            f"{np.mean(mm):.2f} mm ({max(mm):.2f}), {np.mean(deg):.3f}° ({max(deg):.3f}), {seconds:.2f} s"
        )
    return cells


def _images(draws: int) -> str:
    rows = [_mean_row(str(images), _scores(images, draws)) for images in (6, 10, 15)]
    about = f"Mean over {draws} draws (worst in brackets), {_size(SMALL)}:\n"
    return "\n".join([about, *table("images | fast | adam", rows)])


def _kinds(draws: int) -> str:
    rows = [_mean_row(name, _scores(8, draws, errors)) for name, errors in ERRORS.items()]
    about = f"Mean over {draws} draws (worst in brackets), 8 images, {_size(SMALL)}:\n"
    return "\n".join([about, *table("errors of the predictions | fast | adam", rows)])


def _scores(images: int, draws: int, errors: PairErrors | None = None) -> dict[str, list[Score]]:
    scores: dict[str, list[Score]] = {"fast": [], "adam": []}
    for seed in range(draws):
        predictions, truth = synthetic_pairs(complete_pairs(images), SMALL, errors, seed)
        for method, list_of in scores.items():
            list_of.append(_score(predictions, truth, method))
    return scores


def _hand_eye(draws: int) -> str:
    rows = []
    for noise in ((0.0, 0.0), (5e-4, float(np.radians(0.1)))):
        for images in (3, 4, 5, 10):
            trials = [_hand_eye_trial(images, seed, noise) for seed in range(draws)]
            cameras_mm = np.mean([trial[0] for trial in trials])
            *_, mm, deg, percent, _ = np.median(trials, axis=0)
            sigmas = np.sqrt(np.mean([trial[-1] for trial in trials]) / 7)
            rows.append(
                [
                    f"{1e3 * noise[0]:g} mm, {np.degrees(noise[1]):g}°",
                    images,
                    f"{cameras_mm:.2f} mm",
                    f"{mm:.2f} mm, {deg:.3f}°, {percent:.3f} %",
                    f"{sigmas:.1f}",
                ]
            )
    about = (
        f"With the robot's poses, mean camera errors and median calibration errors over {draws} draws, "
        f"{_size(SMALL)}. The robot pose noise is estimated; "
        "error / sigma is the true error of the calibration over the reported one, 1 where honest.\n"
    )
    head = "robot pose noise | images | cameras | calibration | error / sigma"
    return "\n".join([about, *table(head, rows)])


def _hand_eye_trial(images: int, seed: int, noise: tuple[float, float]) -> Float[ndarray, "5"]:
    """Return the camera error (mm), the calibration errors (mm, deg, %) and the squared Mahalanobis distance."""
    predictions, truth = synthetic_pairs(complete_pairs(images), SMALL, seed=seed)
    rng = np.random.default_rng(1000 + seed)
    gripper_from_camera = transform(rotation_exp(rng.normal(0, 0.8, 3)), rng.uniform(-0.08, 0.08, 3))
    exact = truth.base_from_camera @ inverse(gripper_from_camera)
    base_from_gripper = disturbed(exact, noise, rng)
    aligned = global_align(predictions)
    found = solve_hand_eye(base_from_gripper, aligned.recon_from_camera, camera_covariance=aligned.covariance)
    scale = float(np.exp(-np.log(truth.pair_unit).mean()))
    problem = HandEyeProblem(base_from_gripper, aligned.recon_from_camera, gripper_from_camera, scale, exact)
    off = error(problem, found.gripper_from_camera, found.scale)
    return np.array(
        [
            camera_errors(truth.base_from_camera, aligned.recon_from_camera)[0],
            *mm_deg(off),
            100 * abs(off[6]),
            off @ np.linalg.solve(found.covariance, off),
        ]
    )


def _size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
