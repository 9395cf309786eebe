"""Real captures against references, their halves, and boards that took no part.

A transform belongs to its intrinsics, so pairs are compared: the places of points seen over the image at the working
distance. References come from the board in the images (benchmarks.references). Halves of a capture, calibrated apart,
need no reference. Corners of a board that took no part show whether points seen in single images are where the
calibration says, as exactly as it says.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import folders_with_captures, largest_std, number, of_rows, squared_distance, table
from benchmarks.real_captures.fetch import recipes
from benchmarks.references import (
    Corners,
    Reference,
    find_corners,
    nine_pixels,
    placed,
    placed_covariance,
    reference,
)
from jcr.backends import ReconstructOptions
from jcr.calibration.record import Calibration
from jcr.camera import parameters, project, unproject, with_parameters
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.estimation.point_uncertainty import point_covariance, within_95
from jcr.geometry import inverse, nearest_to_lines, retract, rotation_exp, rotation_log, transform
from jcr.pipeline.run import RunOptions, calibrate
from jcr.records import Capture, Intrinsics
from jcr.result import RunResult

WORST_PX = 2.0
"""rms misfit above which an image shows another thing than the board."""
UNKNOWN_MM = 1000.0
"""95 % bound of a reference from which it is said not to determine a place; the scenes are 0.3 to 0.8 m away."""
DRAWS = 100
"""Draws of the errors that a calibration states."""


class Apart(NamedTuple):
    """Places of points by two pairs of transform and intrinsics, at nine pixels and the working distance."""

    mm: float
    """rms distance over the image."""
    sigmas: float
    """rms distance over the image in standard deviations of both, per axis; 1 is expected."""
    stated_mm: float
    """Distance that 95 % of both errors are stated to stay below, rms over the image."""
    other_mm: float
    """Distance that 95 % of the other's errors are stated to stay below, rms over the image."""


SIDE_CELL = 3
"""Column of the side of a board over the stated one, in the table of boards that took no part."""


class Row(NamedTuple):
    """One calibration beside its reference."""

    alone: bool
    """Whether it is from images alone, without a board."""
    verdict: str
    apart: Apart | None
    cells: list[str]


class CheckPoints(NamedTuple):
    """Corners of a board in the base frame, m."""

    side: float
    """Mean distance of neighbouring corners over the stated one."""
    flat: float
    """rms distance of the triangulated corners from their plane."""
    scatter: float
    """rms distance of a corner seen in one image from its mean over the images."""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Return the page in Markdown: every capture below `captures`, from its images alone and with its board.

    Boards are those of the recipes, or named as CAPTURE=BOARD. Raises InputError where there is no capture, or a board
    is of a capture that is not there.
    """
    folders = folders_with_captures(captures)
    given = {name: board for name, _, board in (text.partition("=") for text in boards)}
    if unknown := given.keys() - {folder.name for folder in folders}:
        raise InputError(f"--boards {', '.join(sorted(unknown))}: no such capture in {captures}")
    named = {name: recipe.board for name, recipe in recipes().items() if recipe.board} | given
    references, rows, halves, corners, absent = [], [], [], [], []
    for folder in folders:
        capture, board, known = read_capture(folder), named.get(folder.name), None
        if board is not None:
            try:
                seen = find_corners(capture, board)
                known = reference(capture.base_from_gripper, seen, capture.image_size, capture.intrinsics)
                cells = _reference_cells(folder.name, known)
                references.append([*cells[:-1], cells[-1] if "SIDE" not in board else ""])
            except (RejectedError, cv2.error) as refusal:
                absent.append(f"- {folder.name}, reference: {str(refusal).splitlines()[0]}")
        rows.append(_row(capture, None, alone := _calibrated(capture), known))
        if board is not None and "SIDE" not in board:
            rows.append(_row(capture, board, _calibrated(capture, board), known))
        halves += _halves(capture)
        if isinstance(alone[0], RunResult) and board is not None:
            try:
                scatter, expected, cells = _checked(folder.name, alone[0], board)
                side = cells[SIDE_CELL] if "SIDE" not in board else ""
                corners.append((scatter, expected, [*cells[:SIDE_CELL], side, *cells[SIDE_CELL + 1 :]]))
            except (InputError, RejectedError) as refusal:
                absent.append(f"- {folder.name}, check points: {refusal}")
    ratios = [scatter / expected for scatter, expected, _ in corners]
    scatters = [1e3 * scatter for scatter, _, _ in corners]
    lines = [
        *_claims(rows, [one for _, one in halves]),
        f"> Corners of boards that took no part scatter by {np.median(scatters):.1f} mm (median of {len(corners)} "
        f"captures), {min(ratios):.1f} to {max(ratios):.1f} times what is predicted."
        if corners
        else "",
        "",
        "## References",
        "",
        "From the corners of the board in the images (benchmarks/references.py): intrinsics, pose errors, size and "
        "shape of the sheet are estimated with the transform.",
        "",
        *table(
            "capture | images | corners | rms, px | ±σ: mm | ° | noise: mm | ° | size over stated", references
        ),
        "",
        "## Captures",
        "",
        "Point: rms distance of the places that both pairs of transform and intrinsics give nine points over the "
        "image, at the working distance; in σ of what both state, per axis. Reference: rms of its own 95 % bounds at "
        "these points, within which it cannot confirm a calibration; it is large where the board was in no corner of "
        "the images.",
        "",
        *table(
            "capture | from | images | verdict | point: mm | reference, 95 %: mm | σ | "
            "centre: 95 % stated below | ±σ: mm | ° | leave-one-out, mm | s",
            (row.cells for row in rows),
        ),
        "",
        "## Halves, calibrated apart",
        "",
        *table(
            "capture | point apart: mm | σ | 95 % stated below: mm",
            ([name, *map(number, one[:3])] for name, one in halves),
        ),
        "",
        "## Boards that took no part",
        "",
        *table(
            "capture | images | corners | side over stated | flat: mm | scatter: mm | predicted | ratio",
            (cells for _, _, cells in corners),
        ),
        "",
        *absent,
    ]
    return "\n".join(lines).rstrip() + "\n"


def _claims(rows: Sequence[Row], halves: Sequence[Apart]) -> Iterator[str]:
    """Yield the results of the page in sentences."""
    for what, some in (
        ("images alone", [row for row in rows if row.alone]),
        ("a board", [row for row in rows if not row.alone]),
    ):
        exact = sum(row.verdict == "accepted" for row in some)
        sound = [row for row in some if row.verdict.startswith("accepted")]
        if apart := [row.apart for row in sound if row.apart is not None]:
            mm, worst = [one.mm for one in apart], max(apart)
            yield (
                f"> From {what}: {exact} of {len(some)} real captures are accepted, {len(sound) - exact} more are sound "
                f"but miss 5 mm and 1°; a point is {np.median(mm):.1f} mm from its place by the reference (median "
                f"of {len(mm)}; worst {worst.mm:.1f} mm, {_of_reference(worst.other_mm)}), within 2 σ of "
                f"both in {sum(one.sigmas < 2 for one in apart)}."
            )
    if halves:
        yield (
            f"> Of {len(halves)} captures cut in halves {sum(one.sigmas < 2 for one in halves)} agree within 2 σ, a "
            f"point within what both state for 95 % in {sum(one.mm < one.stated_mm for one in halves)}."
        )


def _of_reference(mm: float) -> str:
    """Return what a reference with this 95 % bound (mm) can tell about a place, in words."""
    return (
        f"known to {mm:.1f} mm by the reference"
        if mm < UNKNOWN_MM
        else "which the reference does not determine"
    )


def _calibrated(capture: Capture, board: str | None = None) -> tuple[RunResult | None, float]:
    """Calibrate as a user would, from images alone or by the marker back end; return the seconds too."""
    backend = "auto" if board is None else "marker"
    options = RunOptions(reconstruct=ReconstructOptions(backend=backend, board=board))
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as out:
            result = calibrate(capture, out, options)
    except RejectedError:
        result = None
    return result, time.perf_counter() - begun


def _reference_cells(name: str, one: Reference) -> list[object]:
    """Return the row of a reference."""
    noise = 1e3 * one.noise[0], np.degrees(one.noise[1])
    numbers = map(number, (one.rms_px, *largest_std(one.covariance), *noise))
    return [name, one.images, one.corners, *numbers, f"{100 * (one.size - 1):+.2f} %"]


def _row(
    capture: Capture, board: str | None, made: tuple[RunResult | None, float], known: Reference | None
) -> Row:
    """Compare a calibration with the reference of its capture, if any."""
    (result, seconds), how = made, "images alone" if board is None else f"`{board}`"
    head = [capture.folder.name, how]
    if result is None:
        return Row(
            board is None,
            "rejected",
            None,
            [*head, f"0 of {len(capture)}", "rejected", *[""] * 7, number(seconds)],
        )
    found, held_out, verdict = result.found, result.calibration.held_out, result.calibration.verdict or ""
    apart = None if known is None else _apart(found, known)
    if board is None:
        head[1] += f" ({result.calibration.backend})"
    values = (
        *((None, None, None) if apart is None else (apart.mm, apart.other_mm, apart.sigmas)),
        None if found.uncertainty.seen is None else found.uncertainty.seen.within_95_mm,
        *largest_std(found.covariance),
        None if held_out is None else held_out.translation_mm,
        seconds,
    )
    images = f"{sum(image.used for image in result.calibration.images)} of {len(capture)}"
    cells = [*head, images, verdict, *map(number, values)]
    if apart is not None and apart.other_mm >= UNKNOWN_MM:
        cells[-7] = "over 1 m"
    return Row(board is None, verdict, apart, cells)


def _halves(capture: Capture) -> Iterator[tuple[str, Apart]]:
    """Calibrate the even and the odd images apart; nothing where a half is rejected."""
    results = []
    for first in (0, 1):
        result, _ = _calibrated(of_rows(capture, range(first, len(capture), 2)))
        if result is None or not result.converged:
            return
        results.append(result.found)
    if (apart := _apart(*results)) is not None:
        yield capture.folder.name, apart


def _apart(found: Calibration, other: Calibration | Reference) -> Apart | None:
    """Compare a calibration with another one or a reference; None where one has no intrinsics."""
    if found.uncertainty.seen is None or found.intrinsics is None or other.intrinsics is None:
        return None
    camera, distance = found.intrinsics, 1e-3 * found.uncertainty.seen.distance_mm
    x_px = nine_pixels(camera)
    off = placed(found.gripper_from_camera, camera, x_px, distance)
    off = off - placed(other.gripper_from_camera, other.intrinsics, x_px, distance)

    def stated(one: Calibration | Reference) -> Float[ndarray, "9 3 3"]:
        """Return covariances of the points in gripper axes."""
        if isinstance(one, Reference):
            return placed_covariance(one, x_px, distance)
        turn, own = one.gripper_from_camera[:3, :3], one.intrinsics or camera
        return turn @ point_covariance(one.gripper_from_camera, one.uncertainty, own, x_px, distance) @ turn.T

    of_other = stated(other)
    covariance = stated(found) + of_other
    sigmas = float(np.sqrt(squared_distance(off, covariance).mean() / 3))
    bounds = ([within_95(one) for one in each] for each in (covariance, of_other))
    sizes = np.linalg.norm(off, axis=1), *bounds
    mm, stated_mm, other_mm = (1e3 * float(np.sqrt(np.mean(np.square(one)))) for one in sizes)
    return Apart(mm, sigmas, stated_mm, other_mm)


# Boards that took no part.


@dataclass(frozen=True)
class WristCamera:
    """Intrinsics, hand-eye transform and reported gripper poses."""

    intrinsics: Intrinsics
    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """Places of the camera."""
        return self.base_from_gripper @ self.gripper_from_camera


def _checked(name: str, result: RunResult, board: str) -> tuple[float, float, list[object]]:
    """Return scatter and predicted scatter (m) of a board that took no part in a calibration, and its row."""
    rows = result.reconstruction.image_index[result.found.inliers].tolist()
    camera = WristCamera(
        result.found.intrinsics or result.reconstruction.intrinsics,
        result.found.gripper_from_camera,
        result.capture.base_from_gripper[rows],
    )
    corners = find_corners(result.capture, board, rows)
    while len(corners.x_in_board):  # Leave out images in which something else was taken for the board.
        off = (_misfit(camera, corners) ** 2).sum(1)
        rms_px = {k: float(np.sqrt(off[corners.image == k].mean())) for k in np.unique(corners.image)}
        worst = max(rms_px, key=lambda k: rms_px[k])
        if rms_px[worst] < WORST_PX:
            break
        corners = corners.of(corners.image != worst)
    else:
        raise RejectedError("too few images share the corners of a board", "name it with --boards")
    found = measure(camera, corners)
    draws = predicted(camera, result.found, corners, float(np.sqrt(off.mean() / 2)))
    expected = float(np.sqrt((np.array(draws) ** 2).mean()))
    lengths = [number(1e3 * value) for value in (found.flat, found.scatter, expected)]
    counts = [len(np.unique(corners.image)), len(corners.x_in_board)]
    side, ratio = f"{100 * (found.side - 1):+.2f} %", number(found.scatter / expected, 1)
    return found.scatter, expected, [name, *counts, side, *lengths, ratio]


def _rays(camera: WristCamera, corners: Corners) -> Float[ndarray, "k 3"]:
    """Return the unit direction of each observation in its camera."""
    ray = unproject(camera.intrinsics, corners.x_px)
    return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def _triangulated(camera: WristCamera, corners: Corners) -> Float[ndarray, "c 3"]:
    """Return the corners in the base frame, nearest to their rays from all images."""
    pose = camera.base_from_camera[corners.image]
    ray = np.einsum("kij,kj->ki", pose[:, :3, :3], _rays(camera, corners))
    rows = [np.flatnonzero(corners.corner == c) for c in range(len(corners.x_in_board))]
    return np.stack([nearest_to_lines(pose[own, :3, 3], ray[own]) for own in rows])


def _apply_each(a_from_b: Float[ndarray, "k 4 4"], x_in_b: Float[ndarray, "k 3"]) -> Float[ndarray, "k 3"]:
    """Transform each point by its own transform."""
    return np.einsum("kij,kj->ki", a_from_b[:, :3, :3], x_in_b) + a_from_b[:, :3, 3]


def pixels_of(
    camera: WristCamera, corners: Corners, x_in_base: Float[ndarray, "c 3"]
) -> Float[ndarray, "k 2"]:
    """Return where each observation's corner projects to."""
    x = _apply_each(inverse(camera.base_from_camera)[corners.image], x_in_base[corners.corner])
    return project(camera.intrinsics, x)


def _board_poses(
    camera: WristCamera, corners: Corners, x_in_base: Float[ndarray, "c 3"]
) -> Float[ndarray, "n 4 4"]:
    """Return base_from_camera of each image, refined so that the triangulated corners fit it (OpenCV's PnP)."""
    poses = camera.base_from_camera.copy()
    for k in np.unique(corners.image):
        rows = corners.image == k
        ray = unproject(camera.intrinsics, corners.x_px[rows])
        start, x_px = inverse(poses[k]), ray[:, :2] / ray[:, 2:]
        guess = rotation_log(start[:3, :3]), start[:3, 3].copy()
        _, rotation, translation = cv2.solvePnP(
            x_in_base[corners.corner[rows]], x_px, np.eye(3), None, *guess, useExtrinsicGuess=True
        )
        poses[k] = inverse(transform(rotation_exp(np.ravel(rotation)), np.ravel(translation)))
    return poses


def _misfit(camera: WristCamera, corners: Corners) -> Float[ndarray, "k 2"]:
    """Return the residuals (px) of the corners in images whose poses are refined to fit them."""
    points = _triangulated(camera, corners)
    own = WristCamera(camera.intrinsics, np.eye(4), _board_poses(camera, corners, points))
    return corners.x_px - pixels_of(own, corners, points)


def measure(camera: WristCamera, corners: Corners) -> CheckPoints:
    """Measure the corners as a user would with this calibration.

    The pixel gives the ray; the board's size and shape, as triangulated, give the distance along it; the reported pose
    of that image takes it to the base.
    """
    points = _triangulated(camera, corners)
    poses = _board_poses(camera, corners, points)
    in_camera = _apply_each(inverse(poses)[corners.image], points[corners.corner])
    along = _rays(camera, corners) * np.linalg.norm(in_camera, axis=1, keepdims=True)
    seen = _apply_each(camera.base_from_camera[corners.image], along)
    mean = np.stack([seen[corners.corner == c].mean(0) for c in range(len(points))])
    stated = np.linalg.norm(corners.x_in_board[:, None] - corners.x_in_board, axis=2)
    near = (stated > 0) & (stated < 1.01 * stated[stated > 0].min())
    found = np.linalg.norm(points[:, None] - points, axis=2)
    flat = np.linalg.svd(points - points.mean(0), compute_uv=False)[2] / np.sqrt(len(points))
    scatter = float(np.sqrt(((seen - mean[corners.corner]) ** 2).sum(1).mean()))
    return CheckPoints(float((found[near] / stated[near]).mean()), float(flat), scatter)


def predicted(camera: WristCamera, hand_eye: Calibration, corners: Corners, noise_px: float) -> list[float]:
    """Return the scatter in draws of the errors that the calibration states, of gripper poses and of pixels."""
    rng = np.random.default_rng(0)
    points = _triangulated(camera, corners)
    values, vectors = np.linalg.eigh(hand_eye.uncertainty.whole)
    spread, of_pose = vectors * np.sqrt(values.clip(0)), np.repeat(hand_eye.robot_noise.together, 3)
    found = []
    for _ in range(DRAWS):
        step = spread @ rng.normal(size=len(spread))
        intrinsics = camera.intrinsics
        if hand_eye.uncertainty.joint is not None:
            intrinsics = with_parameters(intrinsics, parameters(intrinsics) + step[7:])
        noise = of_pose * rng.normal(size=(len(camera.base_from_gripper), 6))
        poses = retract(camera.base_from_gripper, noise)
        true = WristCamera(intrinsics, retract(camera.gripper_from_camera, step[:6]), poses)
        x_px = pixels_of(true, corners, points) + rng.normal(scale=noise_px, size=corners.x_px.shape)
        found.append(measure(camera, replace(corners, x_px=x_px)).scatter)
    return found
