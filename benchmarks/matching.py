"""`jcr bench matching DIR`: SIFT, XFeat and ALIKED on real captures, with the robot's gate and without."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.calibration_json import read_hand_eye
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import rotation_between_deg, rotation_log
from jcr.match.matchers import FeatureName
from jcr.reconstruct.colmap import ColmapOptions, reconstruct
from jcr.records import HandEye

WAYS: tuple[tuple[FeatureName, bool], ...] = (
    ("sift", True),
    ("sift", False),
    ("xfeat", True),
    ("xfeat", False),
    ("aliked", True),
)
"""Features, and whether the robot checks them."""


@dataclass(frozen=True)
class Row:
    """One way of matching one capture."""

    capture: str
    features: str
    gate: bool
    images: str
    seconds: float
    off_mm: float | None = None
    off_deg: float | None = None
    std_mm: float | None = None
    std_deg: float | None = None
    sigmas: float | None = None
    trusted: bool = False
    says: str = ""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Markdown: every capture below `captures` that has a reference.json, matched in every way; boards are not used.

    Raises InputError where no capture has a reference.
    """
    folders = sorted(path.parent for path in captures.glob("*/reference.json"))
    if not folders:
        raise InputError(f"{captures}: no folder below it holds a reference.json beside its capture.json")
    return table([row_of(folder, features, gate) for folder in folders for features, gate in WAYS])


def table(rows: Sequence[Row]) -> str:
    """Markdown of the rows."""
    told = []
    for features, gate in WAYS:
        some = [row for row in rows if (row.features, row.gate) == (features, gate)]
        how = features + ("" if gate else " and no gate")
        told += [f"{sum(row.trusted for row in some)} of {len(some)} with {how}"] if some else []
    lines = [
        f"> Real captures, {len({row.capture for row in rows})}: trusted calibrations from images alone: "
        f"{', '.join(told)}.",
        "",
        "Distance from the reference stored with each capture, which has an error of its own; in σ: the largest on any "
        "axis in reported standard deviations. ±σ: the largest reported one. Seconds: reconstruction without dense "
        "depth and calibration.",
        "",
        "| capture | features | gate | images registered | off: mm | ° | in σ | ±σ: mm | ° | trusted | s |",
        "|---" * 11 + "|",
        *map(line, rows),
        "",
        *(
            f"- {row.capture}, {row.features}{'' if row.gate else ', no gate'}: {row.says}"
            for row in rows
            if row.says
        ),
    ]
    return "\n".join(lines).rstrip() + "\n"


def row_of(folder: Path, features: FeatureName, gate: bool) -> Row:
    """One capture reconstructed and calibrated."""
    capture = read_capture(folder)
    reference = read_hand_eye(folder / "reference.json").gripper_from_camera
    begun = time.perf_counter()
    made = None
    try:
        made = reconstruct(capture, ColmapOptions(dense=False, features=features, robot_checks=gate))
        hand_eye = calibrate(capture, made)
    except NotTrustedError as refusal:
        count = 0 if made is None else len(made.image_index)
        seconds = time.perf_counter() - begun
        return Row(folder.name, features, gate, f"{count} of {len(capture)}", seconds, says=str(refusal))
    seconds = time.perf_counter() - begun
    mm, deg = off(hand_eye.gripper_from_camera, reference)
    std = np.sqrt(np.diag(hand_eye.covariance))
    return Row(
        folder.name,
        features,
        gate,
        f"{len(made.image_index)} of {len(capture)}",
        seconds,
        mm,
        deg,
        1e3 * float(std[:3].max()),
        float(np.degrees(std[3:6].max())),
        sigmas(hand_eye, reference),
        hand_eye.converged,
        "; ".join(made.notes),
    )


def off(x: Float[ndarray, "4 4"], reference: Float[ndarray, "4 4"]) -> tuple[float, float]:
    """Distance of two hand-eye transforms in mm and degrees."""
    mm = 1e3 * float(np.linalg.norm(x[:3, 3] - reference[:3, 3]))
    return mm, float(rotation_between_deg(x[:3, :3], reference[:3, :3]))


def sigmas(hand_eye: HandEye, reference: Float[ndarray, "4 4"]) -> float:
    """Largest distance on any axis in reported standard deviations."""
    x = hand_eye.gripper_from_camera
    gap = np.concatenate([reference[:3, 3] - x[:3, 3], rotation_log(reference[:3, :3] @ x[:3, :3].T)])
    return float(np.abs(gap / np.sqrt(np.diag(hand_eye.covariance)[:6])).max())


def line(row: Row) -> str:
    """A row of the table."""
    numbers = (
        ["–"] * 5
        if row.off_mm is None
        else [
            f"{row.off_mm:.1f}",
            f"{row.off_deg:.2f}",
            f"{row.sigmas:.1f}",
            f"{row.std_mm:.1f}",
            f"{row.std_deg:.2f}",
        ]
    )
    gate, trusted = ("on" if row.gate else "off"), ("yes" if row.trusted else "no")
    cells = [row.capture, row.features, gate, row.images, *numbers, trusted, f"{row.seconds:.0f}"]
    return f"| {' | '.join(cells)} |"
