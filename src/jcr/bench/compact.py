"""`jcr bench compact`: a small network on captures that it was not trained on, beside COLMAP.

Four ways to calibrate: its pointmaps aligned as DUSt3R's are; its matches alone; the back end `compact`, which is
direct alignment started by these; and direct alignment without a network.
"""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from jcr.calibrate.file import read_hand_eye
from jcr.capture.read import read_capture
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import apply, inverse, rotation_between_deg, rotation_log
from jcr.pipeline import RunOptions, RunResult, calibrate
from jcr.reconstruct.backends import BackendName, ReconstructOptions
from jcr.reconstruct.checkpoints import CHECKPOINTS
from jcr.reconstruct.compact import CompactOptions, rough_hand_eye
from jcr.reconstruct.dust3r.weights import load_weights
from jcr.simulate.capture import SimulateOptions, simulate
from jcr.simulate.truth import read_truth, true_depth, true_labels
from jcr.train.validate import PairErrors, capture_views, pair_errors, summary

SEEDS = range(200, 203)
"""Of the scenes; validation while training looks at others."""
IMAGES = 10
WAYS: dict[str, BackendName | None] = {
    "pointmaps": "dust3r",
    "matches alone": None,
    "compact": "compact",
    "direct": "direct",
    "colmap": "colmap",
}
"""Ways to calibrate, and the back end of each; None: no back end, the rough start of one."""


@dataclass(frozen=True)
class Calibrated:
    """One calibration held against the truth; infinite where it gave nothing, NaN where no truth is known."""

    mm: float = np.inf
    deg: float = np.inf
    scale_percent: float = np.inf
    """Of the median depth of the pointmaps in metres."""
    height_percent: float = np.inf
    """Median over the objects of the error of the height above the table."""
    sigmas: float = np.inf
    """Error of the camera's pose in reported standard deviations: root of the mean square of its six parameters. The
    scale does not count here, for it is that of pointmaps, whose errors no calibration reports."""
    trusted: bool = False
    seconds: float = 0.0


def run(captures: Path | None = None, weights: str | None = None) -> str:
    """Markdown: pairs, then calibrations, on simulated captures, and on the real ones below `captures`.

    Raises InputError where there are no weights, or they do not say their one size of images.
    """
    if weights is None and not CHECKPOINTS["compact"].is_cached():
        raise InputError("bench compact: this package has no weights; name yours with --weights FOLDER")
    weights = weights or CHECKPOINTS["compact"].hub_id
    loaded = load_weights(weights)
    if loaded.size is None:
        raise InputError(f"{weights}: its config.json has no only_size, as python -m jcr.train writes")
    pair_rows, rows, said = [], [], []
    with tempfile.TemporaryDirectory() as name:
        for texture in (True, False):
            surface = "textured" if texture else "untextured"
            errors: list[PairErrors] = []
            found: dict[str, list[Calibrated]] = {way: [] for way in WAYS}
            for seed in SEEDS:
                folder = Path(name) / f"{surface}{seed}"
                simulate(folder, SimulateOptions(images=IMAGES, seed=seed, texture=texture))
                views = capture_views(folder, loaded.size)
                first, second = (~torch.eye(IMAGES, dtype=torch.bool)).nonzero().T
                errors.append(pair_errors(loaded.network, views, first, second))
                for way, of_way in found.items():
                    of_way.append(calibrated(folder, way, weights))
                    rows.append(_line(f"{surface} {seed}", way, of_way[-1]))
            pairs = PairErrors(*(np.concatenate(values) for values in zip(*errors, strict=True)))
            pair_rows.append(f"| {surface} | " + " | ".join(str(v) for v in summary(pairs).values()) + " |")
            for way, of_way in found.items():
                middle = _median(of_way)
                rows.append(_line(f"**{surface}, median**", way, middle))
                off = f"{middle.mm:.2g} mm and {middle.deg:.2g}° off" if np.isfinite(middle.mm) else "nothing"
                if way in ("matches alone", "compact", "colmap"):
                    said.append(f"{way} on {surface} scenes {off}")
    real = _real(captures, weights) if captures is not None else []
    return "\n".join(
        [
            f"> {IMAGES} simulated images (medians of {len(SEEDS)} scenes): {'; '.join(said)}.",
            "",
            f"`jcr simulate --images {IMAGES}`, scenes of seeds {SEEDS[0]} to {SEEDS[-1]}, every ordered pair.",
            "",
            "| captures | points % | rotation ° | direction ° | AUC@5° | AUC@15° |",
            "|---|---|---|---|---|---|",
            *pair_rows,
            "",
            "Points: median relative error. AUC: of the larger of both angles.",
            "",
            "| capture | way | offset mm | orientation ° | scale % | heights % | error in σ | trusted | s |",
            "|---|---|---|---|---|---|---|---|---|",
            *rows,
            *real,
            "",
        ]
    )


def calibrated(folder: Path, way: str, weights: str) -> Calibrated:
    """A simulated capture calibrated in one of the ways."""
    if way == "matches alone":
        return _by_matches(folder, weights, read_truth(folder).gripper_from_camera)
    result, seconds = _run(folder, way, weights)
    return Calibrated(seconds=seconds) if result is None else scored(result, folder, seconds)


def _by_matches(folder: Path, weights: str, true: Float[ndarray, "4 4"]) -> Calibrated:
    """What the network's matches and the robot's motion say, before any colour is compared."""
    begun = time.perf_counter()
    found, _ = rough_hand_eye(read_capture(folder), CompactOptions(weights))
    seconds = time.perf_counter() - begun
    if isinstance(found, NotTrustedError):
        return Calibrated(seconds=seconds)
    x = found.gripper_from_camera
    millimetres = 1e3 * float(np.linalg.norm(true[:3, 3] - x[:3, 3]))
    degrees = float(rotation_between_deg(x[:3, :3], true[:3, :3]))
    return Calibrated(millimetres, degrees, np.nan, np.nan, np.nan, False, seconds)


def scored(result: RunResult, folder: Path, seconds: float = 0.0) -> Calibrated:
    """A calibration of the simulated capture in `folder`, held against its truth."""
    truth, hand_eye = read_truth(folder), result.hand_eye
    log_scale, height = _depth_errors(result, folder)
    x, true = hand_eye.gripper_from_camera, truth.gripper_from_camera
    off = np.concatenate([true[:3, 3] - x[:3, 3], rotation_log(true[:3, :3] @ x[:3, :3].T)])
    return Calibrated(
        1e3 * float(np.linalg.norm(off[:3])),
        float(rotation_between_deg(x[:3, :3], true[:3, :3])),
        100 * abs(float(np.expm1(-log_scale))),
        height,
        float(np.sqrt(off @ np.linalg.solve(hand_eye.covariance[:6, :6], off) / 6)),
        result.converged,
        seconds,
    )


def _run(folder: Path, way: str, weights: str) -> tuple[RunResult | None, float]:
    backend = WAYS[way]
    assert backend is not None
    options = RunOptions(
        ReconstructOptions(backend, weights=weights if backend in ("dust3r", "compact") else None)
    )
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as out:
            return calibrate(read_capture(folder), out, options), time.perf_counter() - begun
    except NotTrustedError:
        return None, time.perf_counter() - begun


def _depth_errors(result: RunResult, folder: Path) -> tuple[float, float]:
    """Log of true over found depth, and the median error of the objects' heights in percent."""
    truth, made, hand_eye = read_truth(folder), result.reconstruction, result.hand_eye
    base_from_camera = read_capture(folder).base_from_gripper @ hand_eye.gripper_from_camera
    ratios, points, true_points, labels = [], [], [], []
    for row, image in enumerate(made.image_index):
        pinhole = made.pointmap_intrinsics
        depth, label = (read(truth, int(image)) for read in (true_depth, true_labels))
        y, x = np.mgrid[: pinhole.height, : pinhole.width]
        ray = np.stack([(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy, np.ones(x.shape)], -1)
        k = truth.intrinsics
        column, line = (ray[..., :2] * [k.fx, k.fy] + [k.cx, k.cy]).round().astype(int).transpose(2, 0, 1)
        inside = (column >= 0) & (column < k.width) & (line >= 0) & (line < k.height)
        inside &= made.confidence[row] > 0
        depth, label = (array[line[inside], column[inside]] for array in (depth, label))
        x_in_camera = apply(inverse(made.recon_from_camera[row]), made.points_in_recon[row][inside])
        shown = (label > 0) & (depth > 0)
        ratios.append(np.log(depth[shown] / np.maximum(hand_eye.scale * x_in_camera[shown, 2], 1e-6)))
        points.append(apply(base_from_camera[image], hand_eye.scale * x_in_camera[shown])[:, 2])
        true_camera = depth[shown, None] * ray[inside][shown]
        true_points.append(apply(truth.base_from_camera[image], true_camera)[:, 2])
        labels.append(label[shown])
    z, true_z, label = (np.concatenate(parts) for parts in (points, true_points, labels))
    heights = [
        (_height(z, label, thing), _height(true_z, label, thing))
        for thing in np.unique(label).tolist()
        if thing > 1
    ]
    return (
        float(np.median(np.concatenate(ratios))),
        100 * float(np.median([abs(found / true - 1) for found, true in heights])),
    )


def _height(z: Float[ndarray, "n"], label: ndarray, thing: int) -> float:
    """Of the upper end of an object over the table, by quantiles that survive wrong pixels."""
    return float(np.quantile(z[label == thing], 0.95) - np.median(z[label == 1]))


def _median(rows: list[Calibrated]) -> Calibrated:
    numbers = np.array([list(vars(row).values()) for row in rows], dtype=float)
    return replace(Calibrated(*np.median(numbers, axis=0).tolist()), trusted=bool(numbers[:, 5].all()))


def _line(capture: str, way: str, row: Calibrated) -> str:
    numbers = (row.mm, row.deg, row.scale_percent, row.height_percent, row.sigmas)
    shown = ("" if np.isnan(x) else f"{x:.3g}" if np.isfinite(x) else "nothing" for x in numbers)
    trusted = "yes" if row.trusted else "no"
    return f"| {capture} | {way} | {' | '.join(shown)} | {trusted} | {row.seconds:.1f} |"


def _real(captures: Path, weights: str) -> list[str]:
    """The real captures, by the reference stored with each, which has an error of its own."""
    rows = []
    for folder in sorted(path.parent for path in captures.glob("*/reference.json")):
        reference, _ = read_hand_eye(folder / "reference.json")
        for way in ("matches alone", "compact", "colmap"):
            if way == "matches alone":
                rows.append(_line(folder.name, way, _by_matches(folder, weights, reference)))
                continue
            result, seconds = _run(folder, way, weights)
            if result is None:
                rows.append(_line(folder.name, way, Calibrated(seconds=seconds)))
                continue
            x = result.hand_eye.gripper_from_camera
            off = np.concatenate([reference[:3, 3] - x[:3, 3], rotation_log(reference[:3, :3] @ x[:3, :3].T)])
            covariance = result.hand_eye.covariance[:6, :6]
            row = Calibrated(
                1e3 * float(np.linalg.norm(off[:3])),
                float(rotation_between_deg(x[:3, :3], reference[:3, :3])),
                np.nan,
                np.nan,
                float(np.sqrt(off @ np.linalg.solve(covariance, off) / 6)),
                result.converged,
                seconds,
            )
            rows.append(_line(folder.name, way, row))
    return rows
