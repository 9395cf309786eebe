"""`benchmarks real DIR`: real captures against the references stored beside them."""

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

from benchmarks.page import apart, boards_of, folders_with, number, table
from benchmarks.peers import opencv
from jcr.boards.marker import reconstruct_marker
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.stage import calibrate as calibrate_stage
from jcr.camera import unproject
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.geometry import (
    Transforms,
    apply,
    inverse,
    nearest_rotation,
    step_between,
    transform,
)
from jcr.pipeline import RunOptions, calibrate
from jcr.reconstruct import ReconstructOptions
from jcr.records import Capture, HandEye, Intrinsics, LeaveOneOut, coefficients_of


@dataclass(frozen=True)
class Row:
    """One calibration held against its reference."""

    capture: str
    how: str
    images: str
    off_mm: float | None = None
    off_deg: float | None = None
    seen_mm: float | None = None
    """How far apart the two pairs of intrinsics and transform place a point at the centre of the image."""
    seen_95_mm: float | None = None
    """What 95 % of its errors are said to be below."""
    sigmas: float | None = None
    """Largest distance on any axis in reported standard deviations; the reference's own error is in it."""
    joint_sigmas: float | None = None
    """The same in standard deviations of both, where the reference states its own."""
    std_mm: float | None = None
    std_deg: float | None = None
    leave_one_out: LeaveOneOut | None = None
    accepted: bool = False
    seconds: float = 0.0
    message: str = ""
    alone: bool = False
    """From images, without a board."""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Markdown: every capture below `captures` that has a reference.json, without and with its board.

    A board is named as CAPTURE=BOARD, in the words of `--board`. Raises InputError where no capture has a
    reference, or a board is of a capture that is not there.
    """
    folders = folders_with(captures, "reference.json")
    board_of = boards_of(boards, folders, captures)
    rows = []
    for folder in folders:
        rows += _rows(folder, None)
        if folder.name in board_of:
            rows += _rows(folder, board_of[folder.name])
    lines = [
        *_claims(rows),
        "",
        "Distance of `gripper_from_camera` from the reference stored with each capture, which has an error of its "
        "own. σ: the largest reported standard deviation of an axis; joint: that of the reference, where it states "
        "one, counted as well (white noise of its board poses alone). References were made with the intrinsics stored "
        "with the capture, where there are any; a transform belongs to its intrinsics. Seen point: how far apart the "
        "two pairs place a point at the centre of the image and the median distance of the scene, and what 95 % of the "
        "errors of that are said to be below. Left out: each gripper pose predicted by the "
        "other images; where two calibrations predict alike, the images cannot tell which is the better one.",
        "",
        *table(
            "capture | from | images used | off: mm | ° | seen point: mm | 95 % below | in σ | joint | ±σ: mm | ° | "
            "leave-one-out error: mm / ° | accepted | s",
            map(_cells, rows),
        ),
        "",
        *(f"- {row.capture}, {row.how}: {row.message}" for row in rows if row.message),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _claims(rows: Sequence[Row]) -> list[str]:
    tried = [row for row in rows if row.seconds]
    alone = [row for row in tried if row.alone]
    by_boards = [row for row in tried if not row.alone]
    of = [
        f"{len([row for row in some if row.accepted])} of {len(some)} accepted from {what}, {_off_from_references(some)}"
        for what, some in (("images alone", alone), ("a board", by_boards))
        if any(row.accepted for row in some)
    ]
    seen = [row.seen_mm for row in tried if row.accepted and row.seen_mm is not None]
    placed = (
        f" A seen point is {np.median(seen):.1f} mm (median) from where the references put it."
        if seen
        else ""
    )
    joint = [row.joint_sigmas for row in tried if row.accepted and row.joint_sigmas is not None]
    beyond = f" Beyond 3 joint σ: {sum(sigmas > 3 for sigmas in joint)} of {len(joint)}." if joint else ""
    refused = [f"{row.capture} ({row.how})" for row in tried if not row.accepted]
    rejected = f" Rejected: {', '.join(refused)}." if refused else ""
    return [f"> Real captures: {'; '.join(of) or 'none is accepted'}.{rejected}{beyond}{placed}"]


def _off_from_references(rows: Sequence[Row]) -> str:
    """Median and worst distance of accepted rows."""
    off = [
        (row.off_mm, row.off_deg, row.capture)
        for row in rows
        if row.accepted and row.off_mm is not None and row.off_deg is not None
    ]
    if not off:
        return "none with a reference"
    worst_mm, _, worst = max(off)
    mm, deg = np.median([mm for mm, _, _ in off]), np.median([deg for _, deg, _ in off])
    return f"{mm:.1f} mm and {deg:.2f}° from the references (median; worst {worst_mm:.1f} mm, {worst})"


def _rows(folder: Path, board: str | None) -> list[Row]:
    capture = read_capture(folder)
    how = "images alone" if board is None else f"`{board}`"
    known = read_hand_eye(folder / "reference.json")
    reference = known.gripper_from_camera
    options = RunOptions(
        reconstruct=ReconstructOptions(backend="auto" if board is None else "marker", board=board)
    )
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as out:
            result = calibrate(capture, out, options)
    except RejectedError as refusal:
        seconds = time.perf_counter() - begun
        return [
            Row(
                folder.name,
                how,
                f"0 of {len(capture)}",
                seconds=seconds,
                message=str(refusal),
                alone=board is None,
            )
        ]
    seconds = time.perf_counter() - begun
    x, uncertainty = result.hand_eye.gripper_from_camera, result.calibration.uncertainty
    assert uncertainty is not None
    off_mm, off_deg = apart(x, reference)
    std = np.sqrt(np.diag(result.hand_eye.covariance)[:6])
    error = step_between(x, reference) / std
    joint = std if known.covariance is None else np.hypot(std, np.sqrt(np.diag(known.covariance)))
    row = Row(
        folder.name,
        how if board else f"{how} ({result.calibration.backend})",
        f"{sum(image.used for image in result.calibration.images)} of {len(capture)}",
        off_mm,
        off_deg,
        *_seen(folder, capture, result.hand_eye, reference),
        float(np.abs(error).max()),
        None if known.covariance is None else float(np.abs(error * std / joint).max()),
        max(uncertainty.translation_std_mm),
        max(uncertainty.rotation_std_deg),
        result.calibration.held_out,
        result.converged,
        seconds,
        "" if result.converged else result.calibration.warnings[0],
        board is None,
    )
    if board is None:
        return [row]
    rows = result.reconstruction.image_index
    gripper, camera = capture.base_from_gripper[rows], result.reconstruction.recon_from_camera
    off_mm, off_deg = apart(_park(gripper, camera), reference)
    park = Row(folder.name, f"{how}, OpenCV's Park", f"{len(rows)} of {len(capture)}", off_mm, off_deg)
    return [
        row,
        replace(park, leave_one_out=_park_leave_one_out(gripper, camera)),
        *_intrinsics_row(capture, board, reference),
    ]


def _intrinsics_row(capture: Capture, board: str, reference: Float[ndarray, "4 4"]) -> list[Row]:
    """The same with the intrinsics found from the board: how much of the distance the stored intrinsics may explain."""
    if capture.intrinsics is None:
        return []
    blind = replace(capture, intrinsics=None)
    try:
        found = reconstruct_marker(blind, board)
        hand_eye = calibrate_stage(blind, found)
    except RejectedError:
        return []
    off_mm, off_deg = apart(hand_eye.gripper_from_camera, reference)
    how = f"`{board}`, its intrinsics ({found.intrinsics.fx:.1f} px, stored {capture.intrinsics.fx:.1f})"
    fixed = hand_eye.leave_one_out
    error = (
        None
        if fixed is None
        else LeaveOneOut(
            translation_mm=fixed.translation_mm,
            rotation_deg=fixed.rotation_deg,
            reprojection_px=None,
            how=fixed.how,
        )
    )
    images = f"{hand_eye.inliers.sum()} of {len(capture)}"
    return [Row(capture.folder.name, how, images, off_mm, off_deg, leave_one_out=error)]


def _park(gripper: Transforms, camera: Transforms) -> Float[ndarray, "4 4"]:
    """What the references were made with, on the board's poses that we found."""
    return opencv("Park", gripper, camera, 1.0)[0]


def _park_leave_one_out(gripper: Transforms, camera: Transforms) -> LeaveOneOut:
    """Each gripper pose predicted by Park's method from the others, as `held_out` of a calibration has it."""
    errors = []
    for k in range(len(gripper)):
        others = np.arange(len(gripper)) != k
        x = _park(gripper[others], camera[others])
        base_from_board = gripper[others] @ x @ inverse(camera[others])
        middle = transform(
            nearest_rotation(base_from_board[:, :3, :3].mean(0)), base_from_board[:, :3, 3].mean(0)
        )
        errors.append(apart(middle @ camera[k] @ inverse(x), gripper[k]))
    mm, deg = np.mean(errors, axis=0)
    return LeaveOneOut(translation_mm=mm, rotation_deg=deg, reprojection_px=None, how="each by the others")


def _seen(
    folder: Path, capture: Capture, hand_eye: HandEye, reference: Float[ndarray, "4 4"]
) -> tuple[float | None, float | None]:
    """mm: from where the reference, with the intrinsics that it was made with, places a point at the image's centre at
    the working distance, and what 95 % of its errors are said to be below; None where nobody says with which."""
    intrinsics, used = hand_eye.intrinsics, _intrinsics_of_reference(folder, capture)
    if intrinsics is None or used is None or hand_eye.in_use is None:
        return None, None
    seen = hand_eye.in_use.seen
    x_px = np.array([intrinsics.width - 1.0, intrinsics.height - 1.0]) / 2
    ours, theirs = (
        apply(x, 1e-3 * seen.distance_mm * (ray := unproject(camera, x_px)) / np.linalg.norm(ray))
        for x, camera in ((hand_eye.gripper_from_camera, intrinsics), (reference, used))
    )
    return 1e3 * float(np.linalg.norm(ours - theirs)), seen.within_95_mm


def _intrinsics_of_reference(folder: Path, capture: Capture) -> Intrinsics | None:
    """Those that reference.json names, else those of the capture, which the others used."""
    camera = json.loads((folder / "reference.json").read_text()).get("camera")
    if camera is None:
        return capture.intrinsics
    (fx, _, cx), (_, fy, cy), _ = camera["K"]
    with Image.open(capture.folder / capture.images[0]) as image:
        return Intrinsics(fx, fy, cx, cy, *image.size, coefficients_of(camera["d"]))


def _cells(row: Row) -> list[str]:
    error = row.leave_one_out
    return [
        row.capture,
        row.how,
        row.images,
        number(row.off_mm, 2),
        number(row.off_deg, 3),
        number(row.seen_mm, 2),
        number(row.seen_95_mm, 2),
        number(row.sigmas, 1),
        number(row.joint_sigmas, 1),
        number(row.std_mm, 2),
        number(row.std_deg, 3),
        "" if error is None else f"{error.translation_mm:.2f} / {error.rotation_deg:.2f}",
        "" if row.seconds == 0 else "yes" if row.accepted else "**no**",
        number(row.seconds or None, 1),
    ]
