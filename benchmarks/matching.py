"""`benchmarks matching DIR`: SIFT and XFeat on real captures, with the robot's gate and without."""

import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import apart, boards_of, folders_with, number, table
from jcr.boards import marker
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.features.matchers import FeatureName, Matcher
from jcr.features.pairs import all_pairs
from jcr.features.stage import Matched
from jcr.geometry import rotation_log
from jcr.records import HandEye, Intrinsics
from jcr.sfm import mapping
from jcr.sfm.colmap import reconstruct_colmap
from jcr.sfm.options import ColmapOptions

WAYS: tuple[tuple[FeatureName, bool], ...] = (("xfeat", True),)
"""SIFT with the gate is what `real` measures."""
EVERY = 4
"""One capture in this many."""


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
    joint: float | None = None
    accepted: bool = False
    message: str = ""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Markdown: every capture below `captures` that has a reference.json, matched in a few ways.

    `boards` are CAPTURE=BOARD for those whose reference is the marker back end's with that board, where it accepts it,
    for one that is stored may be of a wrong size. Raises InputError where no capture has a reference, and for a board
    of none.
    """
    folders = folders_with(captures, "reference.json")
    board_of = boards_of(boards, folders, captures)
    rows, remade = [], {}
    for folder in folders[::EVERY]:
        reference = stored = reference_of(folder)
        if (board := board_of.get(folder.name)) is not None and (made := by_board(folder, board)) is not None:
            reference, remade[folder.name] = (
                made,
                f"`{board}`, {_apart_in_words(made, stored)} from that stored",
            )
        rows += [row_of(folder, features, gate, reference) for features, gate in WAYS]
    return page(rows, remade)


@dataclass(frozen=True)
class Reference:
    """The hand-eye transform of a capture by other means."""

    gripper_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"] | None
    """None: not stated."""


def reference_of(folder: Path) -> Reference:
    """That stored with a capture."""
    stored = read_hand_eye(folder / "reference.json")
    covariance = stored.covariance
    return Reference(stored.gripper_from_camera, None if covariance is None else covariance[:6, :6])


def by_board(folder: Path, board: str) -> Reference | None:
    """The marker back end's from a board in the images; None where it rejects it."""
    capture = read_capture(folder)
    hand_eye = calibrate(capture, marker.reconstruct_marker(capture, board))
    return (
        Reference(hand_eye.gripper_from_camera, hand_eye.covariance[:6, :6]) if hand_eye.converged else None
    )


def _apart_in_words(one: Reference, other: Reference) -> str:
    mm, deg = apart(one.gripper_from_camera, other.gripper_from_camera)
    return f"{mm:.1f} mm and {deg:.2f}°"


def page(rows: Sequence[Row], remade: Mapping[str, str]) -> str:
    """Markdown of the rows; `remade` says of captures with which board their references were made."""
    counts = []
    for features, gate in WAYS:
        some = [row for row in rows if (row.features, row.gate) == (features, gate)]
        how = features + ("" if gate else " and no gate")
        counts += [f"{sum(row.accepted for row in some)} of {len(some)} with {how}"] if some else []
    lines = [
        f"> Real captures, {len({row.capture for row in rows})}: accepted calibrations from images alone: "
        f"{', '.join(counts)}.",
        "",
        "Distance from the reference stored with each capture, which has an error of its own; in σ: the largest on any "
        "axis in reported standard deviations; joint: in those and the reference's, where it states them. ±σ: the "
        "largest reported one. Seconds: reconstruction without dense depth and calibration.",
        *(
            f"The reference of {name} is the marker back end's with {board}."
            for name, board in remade.items()
        ),
        "",
        *table(
            "capture | features | gate | images registered | off: mm | ° | in σ | joint | ±σ: mm | ° | accepted | s",
            map(_cells, rows),
        ),
        "",
        *(
            f"- {row.capture}, {row.features}{'' if row.gate else ', no gate'}: {row.message}"
            for row in rows
            if row.message
        ),
    ]
    return "\n".join(lines).rstrip() + "\n"


def row_of(folder: Path, features: FeatureName, gate: bool, reference: Reference) -> Row:
    """One capture reconstructed and calibrated."""
    capture = read_capture(folder)
    begun = time.perf_counter()
    made = None
    try:
        with nullcontext() if gate else images_alone():
            made = reconstruct_colmap(capture, ColmapOptions(features=features))
        hand_eye = calibrate(capture, made)
    except RejectedError as refusal:
        count = 0 if made is None else len(made.image_index)
        seconds = time.perf_counter() - begun
        return Row(folder.name, features, gate, f"{count} of {len(capture)}", seconds, message=str(refusal))
    seconds = time.perf_counter() - begun
    mm, deg = apart(hand_eye.gripper_from_camera, reference.gripper_from_camera)
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
        sigmas(hand_eye, reference.gripper_from_camera),
        None
        if reference.covariance is None
        else sigmas(hand_eye, reference.gripper_from_camera, reference.covariance),
        hand_eye.converged,
        "; ".join((*hand_eye.warnings, *made.warnings, *made.notes)),
    )


def images_alone() -> AbstractContextManager[object]:
    """Structure from motion without gripper poses: all pairs are matched, none is judged, and no image is placed."""

    def match_all(
        matcher: Matcher, gripper: Float[ndarray, "n 4 4"], working: Intrinsics, *_: object
    ) -> Matched:
        pairs = all_pairs(len(matcher.x_px))
        geometries = matcher.geometries(pairs, np.zeros((len(pairs), 2)))
        return Matched(geometries=geometries, gate=None, intrinsics=working)

    def place_none(database: Path, model: object, matcher: Matcher, matched: Matched, *_: object) -> object:
        return model, matched

    return patch.multiple(mapping, match_with_robot=match_all, _with_predicted_images=place_none)


def sigmas(
    hand_eye: HandEye, reference: Float[ndarray, "4 4"], its_covariance: Float[ndarray, "6 6"] | None = None
) -> float:
    """Largest distance on any axis in reported standard deviations, with the reference's where these are given."""
    variance = np.diag(hand_eye.covariance)[:6] + (0 if its_covariance is None else np.diag(its_covariance))
    x = hand_eye.gripper_from_camera
    gap = np.concatenate([reference[:3, 3] - x[:3, 3], rotation_log(reference[:3, :3] @ x[:3, :3].T)])
    return float(np.abs(gap / np.sqrt(variance)).max())


def _cells(row: Row) -> list[str]:
    off = (
        (row.off_mm, 1),
        (row.off_deg, 2),
        (row.sigmas, 1),
        (row.joint, 1),
        (row.std_mm, 1),
        (row.std_deg, 2),
    )
    numbers = ["–"] * 6 if row.off_mm is None else [number(value, digits) for value, digits in off]
    gate, accepted = ("on" if row.gate else "off"), ("yes" if row.accepted else "no")
    return [row.capture, row.features, gate, row.images, *numbers, accepted, f"{row.seconds:.0f}"]
