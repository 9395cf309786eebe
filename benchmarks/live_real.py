"""`benchmarks live_real DIR`: captures fed image by image, against the same captures calibrated at once; latencies."""

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
from jcr.geometry import step_between
from jcr.live.calibration import LiveCalibration
from jcr.pipeline import calibrate
from jcr.records import Capture
from jcr.results import RunResult
from jcr.simulate.render import render

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
    same = sum(row.verdicts[0] == row.verdicts[1] for row in rows)
    lines = [
        f"> at most {max(apart, default=0.0):.2g} σ between the end of the live calibration and the calibration at once",
        f"> the same verdict in {same} of {len(rows)}",
        f"> {simulated[AT - 1]:.1f} s of processor time after image {AT}, {simulated[-1]:.1f} s after image "
        f"{len(simulated)} (640×480)",
        "",
        "Each capture is given to `jcr.LiveCalibration` image by image; `finish()` is compared with `jcr.calibrate` of "
        "the same folder, which finds features and pairs itself. Seconds are of the processor, on one core.",
        "",
        f"| capture | images | verdict live | at once | apart, σ | image {AT}, s | last, s | slowest, s | end, s | "
        "at once, s |",
        "|---" * 10 + "|",
        *map(_line, rows),
        "",
        f"A simulated capture of {len(simulated)} images (640×480, UR5e), seconds after each image: "
        + " ".join(f"{value:.1f}" for value in simulated),
    ]
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    name = f"{row.capture}, {row.size[0]}×{row.size[1]}"
    cells = [name, str(row.images), *row.verdicts, "" if row.sigmas is None else f"{row.sigmas:.2g}"]
    cells.append(f"{row.latency_s[AT - 1]:.1f}" if row.images >= AT else "")
    cells += [
        f"{value:.1f}" for value in (row.latency_s[-1], max(row.latency_s), row.finish_s, row.at_once_s)
    ]
    return "| " + " | ".join(cells) + " |"


def row_of(folder: Path) -> Row:
    """A capture on disk."""
    capture = read_capture(folder)
    images = [read_image(folder / name) for name in capture.images]
    with tempfile.TemporaryDirectory() as out:
        latency, live, finish_s = _fed(capture, images, Path(out) / "live")
        batch, at_once_s = _calibrated(lambda: calibrate(folder, Path(out) / "batch"))
    sigmas = None
    if live is not None and batch is not None:
        std = np.sqrt(np.diag(batch.hand_eye.covariance)[:6])
        away = step_between(live.hand_eye.gripper_from_camera, batch.hand_eye.gripper_from_camera)
        sigmas = float(np.abs(away / std).max())
    verdicts = ["none" if one is None else one.verdict for one in (live, batch)]
    return Row(
        capture=folder.name,
        images=len(images),
        size=capture.image_size,
        verdicts=(verdicts[0], verdicts[1]),
        sigmas=sigmas,
        latency_s=tuple(latency),
        finish_s=finish_s,
        at_once_s=at_once_s,
    )


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
