"""`benchmarks live_real DIR`: captures fed image by image, against the same captures calibrated at once; latencies."""

import shutil
import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from benchmarks.live import cell_of
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.features.kept import FOLDER
from jcr.geometry import step_between
from jcr.live.calibration import LiveCalibration
from jcr.pipeline import calibrate
from jcr.records import Capture
from jcr.results import RunResult
from jcr.run_folder import LIVE
from simulation.render import render

MANY = 40
"""Images of the simulated capture."""
AT = 12
"""Image whose latency is stated, beside that of the last."""


@dataclass(frozen=True)
class Row:
    """One capture, image by image and at once."""

    capture: str
    images: int
    size: tuple[int, int]
    verdicts: tuple[str, str]
    """Of the live calibration's end, and of the calibration at once."""
    sigmas: float | None
    """Largest difference between the two in standard deviations of the latter, over translation and rotation; None
    where one has no calibration."""
    in_other_order: float | None
    """The same between two calibrations at once: under the names of a live capture, and under those that the capture
    has; None where both sort alike."""
    latency_s: tuple[float, ...]
    """Processor time from each image to the state with it."""
    finish_s: float
    """Processor time of the end, without its report."""
    at_once_s: float
    """The same of the calibration at once, which finds features and pairs itself."""


def run(captures: Path) -> str:
    """Markdown: captures below `captures` and a simulated one of 40 images; InputError where there is none."""
    folders = sorted(path.parent for path in captures.glob("*/capture.json"))
    if not folders:
        raise InputError(f"{captures}: no folder below it holds a capture.json")
    return page([row_of(folder) for folder in folders], simulated_latency())


def page(rows: Sequence[Row], simulated: Sequence[float]) -> str:
    """Markdown of measured rows, and of the seconds after each image of the simulated capture."""
    apart = [row.sigmas for row in rows if row.sigmas is not None]
    order = [row.in_other_order for row in rows if row.in_other_order is not None]
    same = sum(row.verdicts[0] == row.verdicts[1] for row in rows)
    lines = [
        f"> at most {max(apart, default=0.0):.2g} σ between the end of the live calibration and the calibration at once",
        f"> the same verdict in {same} of {len(rows)}",
        f"> at most {max(order, default=0.0):.2g} σ between calibrations at once of the same images under other names",
        f"> {simulated[AT - 1]:.1f} s of processor time after image {AT}, {simulated[-1]:.1f} s after image "
        f"{len(simulated)} (640×480)",
        "",
        "Each capture is given to `jcr.LiveCalibration` image by image; `finish()` is compared with `jcr.calibrate` of "
        "the same images and poses in a folder where nothing is kept: it finds features and pairs itself. Seconds are "
        "of the processor, on one core.",
        "",
        "Images are reconstructed in the order of their gripper poses. Where the names of a capture are in another "
        "order than its images (10.png before 2.png), `other order` is how far apart the calibrations at once under "
        "these names and under those of a live capture are.",
        "",
        f"| capture | images | verdict live | at once | apart, σ | other order, σ | image {AT}, s | last, s | "
        "slowest, s | end, s | at once, s |",
        "|---" * 11 + "|",
        *map(_line, rows),
        "",
        f"A simulated capture of {len(simulated)} images (640×480, UR5e), seconds after each image: "
        + " ".join(f"{value:.1f}" for value in simulated),
    ]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    name = f"{row.capture}, {row.size[0]}×{row.size[1]}"
    apart = ["" if value is None else f"{value:.2g}" for value in (row.sigmas, row.in_other_order)]
    cells = [name, str(row.images), *row.verdicts, *apart]
    cells.append(f"{row.latency_s[AT - 1]:.1f}" if row.images >= AT else "")
    cells += [
        f"{value:.1f}" for value in (row.latency_s[-1], max(row.latency_s), row.finish_s, row.at_once_s)
    ]
    return "| " + " | ".join(cells) + " |"


def row_of(folder: Path) -> Row:
    """A capture on disk."""
    capture = read_capture(folder)
    images = [read_image(folder / name) for name in capture.images]
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        latency, live, finish_s = _fed(capture, images, out / "live")
        shutil.copytree(
            out / "live", out / "bare", ignore=shutil.ignore_patterns(Path(FOLDER).parts[0], LIVE)
        )
        batch, at_once_s = _calibrated(lambda: calibrate(out / "bare", out / "batch"))
        by_name = None
        if list(capture.images) != sorted(capture.images):
            by_name, _ = _calibrated(lambda: calibrate(folder, out / "by_name"))
    verdicts = ["none" if one is None else one.verdict for one in (live, batch)]
    return Row(
        capture=folder.name,
        images=len(images),
        size=capture.image_size,
        verdicts=(verdicts[0], verdicts[1]),
        sigmas=_sigmas_apart(live, batch),
        in_other_order=_sigmas_apart(by_name, batch),
        latency_s=tuple(latency),
        finish_s=finish_s,
        at_once_s=at_once_s,
    )


def _sigmas_apart(one: RunResult | None, other: RunResult | None) -> float | None:
    """Largest difference of two calibrations in standard deviations of the second; None where there is none."""
    if one is None or other is None:
        return None
    std = np.sqrt(np.diag(other.hand_eye.covariance)[:6])
    away = step_between(one.hand_eye.gripper_from_camera, other.hand_eye.gripper_from_camera)
    return float(np.abs(away / std).max())


def _fed(
    capture: Capture, images: Sequence[UInt8[ndarray, "h w 3"]], folder: Path
) -> tuple[list[float], RunResult | None, float]:
    """Seconds after each image, the end, and its seconds."""
    with closing(LiveCalibration(folder, intrinsics=capture.intrinsics, robot=capture.robot)) as live:
        latency = []
        for image, pose in zip(images, capture.base_from_gripper, strict=True):
            begun = time.process_time()
            live.add(image, pose)
            latency.append(time.process_time() - begun)
        return latency, *_calibrated(live.finish)


def _calibrated(calibration) -> tuple[RunResult | None, float]:
    """A calibration, and its seconds without its report; None where there is none."""
    begun = time.process_time()
    try:
        result = calibration()
    except RejectedError:
        return None, time.process_time() - begun
    return result, time.process_time() - begun


def simulated_latency() -> list[float]:
    """Seconds after each image of a capture of 40 images, at the poses of the pattern `varied`."""
    cell = cell_of(0)
    joints = cell.varied[:MANY]
    cameras = iter([pose @ cell.physical for pose in cell.arm.true(joints)])
    poses = cell.arm.reported(joints)
    images = [seen.image for seen in render(cell.scene, cell.camera, cameras, with_truth=False)]
    latency = []
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(LiveCalibration(Path(folder) / "c", intrinsics=cell.camera)) as live,
    ):
        for image, pose in zip(images, poses, strict=True):
            begun = time.process_time()
            live.add(image, pose)
            latency.append(time.process_time() - begun)
    return latency
