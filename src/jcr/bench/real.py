"""`jcr bench real DIR`: real captures against the references stored beside them."""

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.bench.peers import opencv
from jcr.calibrate.file import HeldOutError, read_hand_eye
from jcr.capture.read import read_capture
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import rotation_between_deg, rotation_log
from jcr.pipeline import RunOptions, calibrate
from jcr.reconstruct.backends import ReconstructOptions
from jcr.records import Capture


@dataclass(frozen=True)
class Row:
    """One calibration held against its reference."""

    capture: str
    how: str
    images: str
    off_mm: float | None = None
    off_deg: float | None = None
    sigmas: float | None = None
    """Largest distance on any axis in reported standard deviations; the reference's own error is in it."""
    std_mm: float | None = None
    std_deg: float | None = None
    held_out: HeldOutError | None = None
    trusted: bool = False
    seconds: float = 0.0
    says: str = ""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Markdown: every capture below `captures` that has a reference.json, without and with its board.

    A board is named as CAPTURE=BOARD, in the words of `--board`. Raises InputError where no capture has a
    reference, or a board is of a capture that is not there.
    """
    folders = sorted(path.parent for path in captures.glob("*/reference.json"))
    if not folders:
        raise InputError(f"{captures}: no folder below it holds a reference.json beside its capture.json")
    board_of = {name: board for name, _, board in (text.partition("=") for text in boards)}
    if unknown := board_of.keys() - {folder.name for folder in folders}:
        raise InputError(f"--boards {', '.join(sorted(unknown))}: no such capture in {captures}")
    rows = []
    for folder in folders:
        rows += _rows(folder, None)
        if folder.name in board_of:
            rows += _rows(folder, board_of[folder.name])
    lines = [
        "Distance of `gripper_from_camera` from the reference stored with each capture, which has an error of its "
        "own. σ: the largest reported standard deviation of an axis.",
        "",
        "| capture | from | images used | off: mm | ° | in σ | ±σ: mm | ° | held out: mm / ° | trusted | s |",
        "|---" * 11 + "|",
        *map(_line, rows),
        "",
        *(f"- {row.capture}, {row.how}: {row.says}" for row in rows if row.says),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _rows(folder: Path, board: str | None) -> list[Row]:
    capture = read_capture(folder)
    how = "pictures alone" if board is None else f"`{board}`"
    reference, _ = read_hand_eye(folder / "reference.json")
    options = RunOptions(ReconstructOptions(board=board))
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as out:
            result = calibrate(capture, out, options)
    except NotTrustedError as refusal:
        seconds = time.perf_counter() - begun
        return [Row(folder.name, how, f"0 of {len(capture)}", seconds=seconds, says=str(refusal))]
    seconds = time.perf_counter() - begun
    x, uncertainty = result.hand_eye.gripper_from_camera, result.calibration.uncertainty
    assert uncertainty is not None
    off_mm, off_deg = _off(x, reference)
    error = np.concatenate(
        [reference[:3, 3] - x[:3, 3], rotation_log(reference[:3, :3] @ x[:3, :3].T)]
    ) / np.sqrt(np.diag(result.hand_eye.covariance)[:6])
    row = Row(
        folder.name,
        how if board else f"{how} ({result.calibration.backend})",
        f"{sum(image.used for image in result.calibration.images)} of {len(capture)}",
        off_mm,
        off_deg,
        float(np.abs(error).max()),
        max(uncertainty.translation_std_mm),
        max(uncertainty.rotation_std_deg),
        result.calibration.held_out,
        result.converged,
        seconds,
        "" if result.converged else result.calibration.warnings[0],
    )
    if board is None:
        return [row]
    rows = result.reconstruction.image_index
    park = _park(capture, rows, result.reconstruction.recon_from_camera)
    off_mm, off_deg = _off(park, reference)
    return [row, Row(folder.name, f"{how}, OpenCV's Park", f"{len(rows)} of {len(capture)}", off_mm, off_deg)]


def _park(capture: Capture, rows: ndarray, recon_from_camera: Float[ndarray, "m 4 4"]) -> ndarray:
    """What the references were made with, on the board's poses that we found."""
    return opencv("Park", capture.base_from_gripper[rows], recon_from_camera, 1.0)[0]


def _off(x: Float[ndarray, "4 4"], reference: Float[ndarray, "4 4"]) -> tuple[float, float]:
    metres = float(np.linalg.norm(x[:3, 3] - reference[:3, 3]))
    return 1e3 * metres, float(rotation_between_deg(x[:3, :3], reference[:3, :3]))


def _line(row: Row) -> str:
    def shown(value: float | None, digits: int) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    held = (
        "" if row.held_out is None else f"{row.held_out.translation_mm:.2f} / {row.held_out.rotation_deg:.2f}"
    )
    judged = "" if row.seconds == 0 else ("yes" if row.trusted else "**no**")
    cells = (
        row.capture,
        row.how,
        row.images,
        shown(row.off_mm, 2),
        shown(row.off_deg, 3),
        shown(row.sigmas, 1),
        shown(row.std_mm, 2),
        shown(row.std_deg, 3),
        held,
        judged,
        shown(row.seconds or None, 1),
    )
    return "| " + " | ".join(cells) + " |"
