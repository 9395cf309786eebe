"""`benchmarks real DIR`: real captures against references, their halves, and boards that took no part.

A transform belongs to its intrinsics, so pairs are compared: the places of points seen over the image at the working
distance. References come from the board in the images (benchmarks.references). Halves of a capture, calibrated apart,
need no reference. Corners of a board that took no part show whether points seen in single images are where the
calibration says, as exactly as it says.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import boards_of, folders_with, number, table
from benchmarks.real_captures.fetch import recipes
from benchmarks.references import (
    Corners,
    Reference,
    find_corners,
    placed,
    placed_covariance,
    reference,
)
from jcr.camera import parameters, project, unproject, with_parameters
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.estimation.point_uncertainty import joint_covariance, point_covariance, within_95
from jcr.geometry import (
    inverse,
    nearest_to_lines,
    retract,
    rotation_exp,
    rotation_log,
    transform,
)
from jcr.pipeline.run import RunOptions, calibrate
from jcr.reconstruct import ReconstructOptions
from jcr.records import Capture, HandEye, Intrinsics
from jcr.results import RunResult

WORST_PX = 2.0
"""rms misfit above which an image shows another thing than the board."""
DRAWS = 100
"""Draws of the errors that a calibration states."""
SHARES = np.array([0.1, 0.5, 0.9])
"""Shares of width and height at which points are placed."""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Return the page in Markdown: every capture below `captures`, from its images alone and with its board.

    Boards are those of the recipes, or named as CAPTURE=BOARD. Raises InputError where there is no capture, or a board
    is of a capture that is not there.
    """
    folders = folders_with(captures, "capture.json")
    known = {name: recipe.board for name, recipe in recipes().items() if recipe.board}
    named = known | boards_of(boards, folders, captures)
    references, rows, halves, corners, absent = {}, [], [], [], []
    for folder in folders:
        capture, board = read_capture(folder), named.get(folder.name)
        found = None
        if board is not None:
            try:
                seen = find_corners(capture, board)
                found = reference(capture.base_from_gripper, seen, capture.image_size, capture.intrinsics)
            except (RejectedError, cv2.error) as refusal:
                absent.append(f"- {folder.name}, reference: {str(refusal).splitlines()[0]}")
        alone = _calibrated(capture, None)
        rows.append(_row(capture, None, *alone, found))
        if board is not None and "SIDE" not in board:
            marker = _calibrated(capture, board)
            rows.append(_row(capture, board, *marker, found))
        if found is not None:
            references[folder.name] = found
        halves += _halves(capture)
        if isinstance(alone[0], RunResult) and board is not None:
            try:
                corners.append(check_points(folder.name, alone[0], board))
            except (InputError, RejectedError) as refusal:
                absent.append(f"- {folder.name}, check points: {refusal}")
    return page(references, rows, halves, corners, absent)


def _calibrated(capture: Capture, board: str | None) -> tuple[RunResult | RejectedError, float]:
    """Calibrate as a user would, from images alone or by the marker back end; return the seconds too."""
    backend = "auto" if board is None else "marker"
    options = RunOptions(reconstruct=ReconstructOptions(backend=backend, board=board))
    begun = time.perf_counter()
    try:
        with tempfile.TemporaryDirectory() as out:
            result = calibrate(capture, out, options)
    except RejectedError as refusal:
        return refusal, time.perf_counter() - begun
    return result, time.perf_counter() - begun


# References.


@dataclass(frozen=True)
class Apart:
    """Places of points by two pairs of transform and intrinsics, at nine pixels and the working distance."""

    mm: float
    """rms distance over the image."""
    sigmas: float
    """rms distance over the image in standard deviations of both, per axis; 1 is expected."""
    stated_mm: float
    """Distance that 95 % of both errors are stated to stay below, at the centre."""


def _pixels(camera: Intrinsics) -> Float[ndarray, "9 2"]:
    """Return the pixels at which points are placed, the centre in the middle."""
    return np.stack(np.meshgrid(SHARES * camera.width, SHARES * camera.height), -1).reshape(-1, 2)


def _stated(found: HandEye, camera: Intrinsics, distance_m: float) -> Float[ndarray, "9 3 3"]:
    """Return the stated covariances of the points in gripper axes."""
    turn = found.gripper_from_camera[:3, :3]
    return turn @ point_covariance(found, camera, _pixels(camera), distance_m) @ turn.T


def _apart(found: HandEye, other: HandEye | Reference) -> Apart | None:
    """Compare a calibration with another one or a reference; None where one has no intrinsics."""
    if found.in_use is None or found.intrinsics is None or other.intrinsics is None:
        return None
    camera, distance = found.intrinsics, 1e-3 * found.in_use.seen.distance_mm
    x_px = _pixels(camera)
    off = placed(found.gripper_from_camera, camera, x_px, distance)
    off = off - placed(other.gripper_from_camera, other.intrinsics, x_px, distance)
    covariance = _stated(found, camera, distance)
    if isinstance(other, Reference):
        covariance = covariance + placed_covariance(other, x_px, distance)
    else:
        covariance = covariance + _stated(other, other.intrinsics, distance)
    squared = np.einsum("ki,ki->k", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return Apart(
        mm=1e3 * float(np.sqrt((off**2).sum(1).mean())),
        sigmas=float(np.sqrt(squared.mean() / 3)),
        stated_mm=1e3 * within_95(covariance[4]),
    )


@dataclass(frozen=True, kw_only=True)
class Row:
    """One calibration beside its reference."""

    capture: str
    how: str
    alone: bool
    """Whether it is from images alone, without a board."""
    images: str
    verdict: str = ""
    apart: Apart | None = None
    stated_mm: float | None = None
    """Stated bound on 95 % of the errors of a seen point."""
    std: tuple[float, float] | None = None
    """Largest stated standard deviation, mm and degrees."""
    leave_one_out_mm: float | None = None
    seconds: float | None = None

    def cells(self) -> list[str]:
        """Return the row of the table."""
        std = self.std or (None, None)
        apart = (None, None) if self.apart is None else (self.apart.mm, self.apart.sigmas)
        values = (*apart, self.stated_mm, *std, self.leave_one_out_mm, self.seconds)
        return [self.capture, self.how, self.images, self.verdict, *(number(value, 2) for value in values)]


def _row(
    capture: Capture,
    board: str | None,
    result: RunResult | RejectedError,
    seconds: float,
    known: Reference | None,
) -> Row:
    """Compare a calibration with the reference of its capture, if any."""
    name, how, alone = capture.folder.name, "images alone" if board is None else f"`{board}`", board is None
    if isinstance(result, RejectedError):
        images = f"0 of {len(capture)}"
        return Row(capture=name, how=how, alone=alone, images=images, verdict="rejected", seconds=seconds)
    found, held_out = result.hand_eye, result.calibration.held_out
    std = np.sqrt(np.diag(found.covariance)[:6])
    return Row(
        capture=name,
        how=how if board else f"{how} ({result.calibration.backend})",
        alone=alone,
        images=f"{sum(image.used for image in result.calibration.images)} of {len(capture)}",
        verdict=result.calibration.verdict or "",
        apart=None if known is None else _apart(found, known),
        stated_mm=None if found.in_use is None else found.in_use.seen.within_95_mm,
        std=(1e3 * float(std[:3].max()), float(np.degrees(std[3:].max()))),
        leave_one_out_mm=None if held_out is None else held_out.translation_mm,
        seconds=seconds,
    )


def _halves(capture: Capture) -> Iterator[tuple[str, Apart]]:
    """Calibrate the even and the odd images apart; nothing where a half is rejected."""
    results = []
    for first in (0, 1):
        rows = np.arange(first, len(capture), 2)
        half = replace(
            capture,
            images=tuple(capture.images[k] for k in rows),
            base_from_gripper=capture.base_from_gripper[rows],
            joints=None if capture.joints is None else capture.joints[rows],
            depths=None,
        )
        result, _ = _calibrated(half, None)
        if isinstance(result, RejectedError) or not result.converged:
            return
        results.append(result.hand_eye)
    if (apart := _apart(*results)) is not None:
        yield capture.folder.name, apart


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


@dataclass(frozen=True, kw_only=True)
class CheckPoints:
    """Corners of a board in the base frame, m."""

    capture: str = ""
    images: int = 0
    corners: int = 0
    side: float
    """Mean distance of neighbouring corners over the stated one."""
    flat: float
    """rms distance of the triangulated corners from their plane."""
    scatter: float
    """rms distance of a corner seen in one image from its mean over the images."""
    predicted: list[float] = field(default_factory=list)
    """The scatter in draws of the errors that the calibration states."""

    def cells(self) -> list[str]:
        """Return the row of the table."""
        predicted = float(np.sqrt((np.array(self.predicted) ** 2).mean()))
        side = f"{100 * (self.side - 1):+.2f} %"
        lengths = [number(1e3 * value, 2) for value in (self.flat, self.scatter, predicted)]
        return [
            self.capture,
            f"{self.images}",
            f"{self.corners}",
            side,
            *lengths,
            f"{self.scatter / predicted:.1f}",
        ]


def check_points(name: str, result: RunResult, board: str) -> CheckPoints:
    """Measure the corners of a board by a calibration in which it took no part."""
    rows = result.reconstruction.image_index[result.hand_eye.inliers].tolist()
    camera = WristCamera(
        result.hand_eye.intrinsics or result.reconstruction.intrinsics,
        result.hand_eye.gripper_from_camera,
        result.capture.base_from_gripper[rows],
    )
    corners = _plausible(camera, find_corners(result.capture, board, rows))
    noise_px = float(np.sqrt((_misfit(camera, corners) ** 2).sum(1).mean() / 2))
    return replace(
        measure(camera, corners),
        capture=name,
        images=len(np.unique(corners.image)),
        corners=len(corners.x_in_board),
        predicted=predicted(camera, result.hand_eye, corners, noise_px),
    )


def _plausible(camera: WristCamera, corners: Corners) -> Corners:
    """Leave out the images in which something else was taken for the board."""
    while len(corners.x_in_board):
        off = (_misfit(camera, corners) ** 2).sum(1)
        rms_px = {k: float(np.sqrt(off[corners.image == k].mean())) for k in np.unique(corners.image)}
        worst = max(rms_px, key=lambda k: rms_px[k])
        if rms_px[worst] < WORST_PX:
            return corners
        corners = corners.of(corners.image != worst)
    raise RejectedError("too few images share the corners of a board", "name it with --boards")


def triangulated(camera: WristCamera, corners: Corners) -> Float[ndarray, "c 3"]:
    """Return the corners in the base frame, nearest to their rays from all images."""
    pose = camera.base_from_camera[corners.image]
    ray = np.einsum("kij,kj->ki", pose[:, :3, :3], unproject(camera.intrinsics, corners.x_px))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
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
        start = inverse(poses[k])
        _, rotation, translation = cv2.solvePnP(
            x_in_base[corners.corner[rows]],
            ray[:, :2] / ray[:, 2:],
            np.eye(3),
            None,
            rotation_log(start[:3, :3]),
            start[:3, 3].copy(),
            useExtrinsicGuess=True,
        )
        poses[k] = inverse(transform(rotation_exp(np.ravel(rotation)), np.ravel(translation)))
    return poses


def _misfit(camera: WristCamera, corners: Corners) -> Float[ndarray, "k 2"]:
    """Return the residuals (px) of the corners in images whose poses are refined to fit them."""
    points = triangulated(camera, corners)
    own = WristCamera(camera.intrinsics, np.eye(4), _board_poses(camera, corners, points))
    return corners.x_px - pixels_of(own, corners, points)


def measure(camera: WristCamera, corners: Corners) -> CheckPoints:
    """Measure the corners as a user would with this calibration."""
    points = triangulated(camera, corners)
    seen = seen_in_base(camera, corners, points)
    counts = np.bincount(corners.corner, minlength=len(points))
    mean = (
        np.stack([np.bincount(corners.corner, seen[:, k], len(points)) for k in range(3)], 1)
        / counts[:, None]
    )
    stated = np.linalg.norm(corners.x_in_board[:, None] - corners.x_in_board, axis=2)
    near = (stated > 0) & (stated < 1.01 * stated[stated > 0].min())
    found = np.linalg.norm(points[:, None] - points, axis=2)
    flat = np.linalg.svd(points - points.mean(0), compute_uv=False)[2] / np.sqrt(len(points))
    scatter = float(np.sqrt(((seen - mean[corners.corner]) ** 2).sum(1).mean()))
    return CheckPoints(side=float((found[near] / stated[near]).mean()), flat=float(flat), scatter=scatter)


def seen_in_base(
    camera: WristCamera, corners: Corners, points: Float[ndarray, "c 3"]
) -> Float[ndarray, "k 3"]:
    """Return each observation's corner in the base frame by its image alone.

    The pixel gives the ray; the board's size and shape, as triangulated, give the distance along it; the reported pose
    of that image takes it to the base.
    """
    poses = _board_poses(camera, corners, points)
    in_camera = _apply_each(inverse(poses)[corners.image], points[corners.corner])
    ray = unproject(camera.intrinsics, corners.x_px)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = ray * np.linalg.norm(in_camera, axis=1, keepdims=True)
    return _apply_each(camera.base_from_camera[corners.image], along)


def predicted(camera: WristCamera, hand_eye: HandEye, corners: Corners, noise_px: float) -> list[float]:
    """Return the scatter in draws of the errors that the calibration states, of gripper poses and of pixels."""
    rng, estimate = np.random.default_rng(0), hand_eye
    points = triangulated(camera, corners)
    values, vectors = np.linalg.eigh(joint_covariance(estimate))
    spread, of_pose = vectors * np.sqrt(values.clip(0)), np.repeat(hand_eye.robot_noise.together, 3)
    found = []
    for _ in range(DRAWS):
        step = spread @ rng.normal(size=len(spread))
        intrinsics = camera.intrinsics
        if estimate.intrinsics_cross is not None:
            intrinsics = with_parameters(intrinsics, parameters(intrinsics) + step[7:])
        poses = retract(
            camera.base_from_gripper, of_pose * rng.normal(size=(len(camera.base_from_gripper), 6))
        )
        true = WristCamera(intrinsics, retract(camera.gripper_from_camera, step[:6]), poses)
        x_px = pixels_of(true, corners, points) + rng.normal(scale=noise_px, size=corners.x_px.shape)
        found.append(measure(camera, replace(corners, x_px=x_px)).scatter)
    return found


# The page.


def page(
    references: dict[str, Reference],
    rows: Sequence[Row],
    halves: Sequence[tuple[str, Apart]],
    corners: Sequence[CheckPoints],
    absent: Sequence[str],
) -> str:
    """Return the page of measured captures in Markdown."""
    lines = [
        *_claims(rows, halves, corners),
        "",
        "## References",
        "",
        "From the corners of the board in the images (benchmarks/references.py): intrinsics, pose errors, size and "
        "shape of the sheet are estimated with the transform.",
        "",
        *table(
            "capture | images | corners | rms, px | ±σ: mm | ° | noise: mm | ° | size over stated",
            ([name, one.images, one.corners, *_numbers(one)] for name, one in references.items()),
        ),
        "",
        "## Captures",
        "",
        "Point: rms distance of the places that both pairs of transform and intrinsics give nine points over the "
        "image, at the working distance; in σ of what both state, per axis.",
        "",
        *table(
            "capture | from | images | verdict | point: mm | σ | 95 % stated below | ±σ: mm | ° | "
            "leave-one-out, mm | s",
            (row.cells() for row in rows),
        ),
        "",
        "## Halves, calibrated apart",
        "",
        *table(
            "capture | point apart: mm | σ | centre: 95 % stated below, mm",
            ([name, *(f"{x:.2f}" for x in (one.mm, one.sigmas, one.stated_mm))] for name, one in halves),
        ),
        "",
        "## Boards that took no part",
        "",
        *table(
            "capture | images | corners | side over stated | flat: mm | scatter: mm | predicted | ratio",
            (one.cells() for one in corners),
        ),
        "",
        *absent,
    ]
    return "\n".join(lines).rstrip() + "\n"


def _numbers(one: Reference) -> list[str]:
    """Return the cells of a reference."""
    noise = (1e3 * one.noise[0], float(np.degrees(one.noise[1])))
    return [*(f"{x:.2f}" for x in (one.rms_px, *one.std, *noise)), f"{100 * (one.size - 1):+.2f} %"]


def _claims(
    rows: Sequence[Row], halves: Sequence[tuple[str, Apart]], corners: Sequence[CheckPoints]
) -> Iterator[str]:
    """Yield the results of the page in sentences."""
    for what, some in (
        ("images alone", [row for row in rows if row.alone]),
        ("a board", [row for row in rows if not row.alone and row.verdict]),
    ):
        accepted = [row for row in some if row.verdict.startswith("accepted")]
        apart = [row.apart for row in accepted if row.apart is not None]
        if apart:
            mm = [one.mm for one in apart]
            yield (
                f"> From {what}: {len(accepted)} of {len(some)} real captures are accepted; a seen point is "
                f"{np.median(mm):.1f} mm from its place by the reference (median of {len(mm)}, worst {max(mm):.1f} mm), "
                f"within 2 σ of both in {sum(one.sigmas < 2 for one in apart)}."
            )
    if halves:
        agree = sum(one.sigmas < 2 for _, one in halves)
        within = sum(one.mm < one.stated_mm for _, one in halves)
        yield (
            f"> Of {len(halves)} captures cut in halves {agree} agree within 2 σ, a seen point within what both state "
            f"for 95 % in {within}."
        )
    if corners:
        ratios = [one.scatter / np.sqrt((np.array(one.predicted) ** 2).mean()) for one in corners]
        yield (
            f"> Corners of boards that took no part scatter by {1e3 * np.median([one.scatter for one in corners]):.1f} "
            f"mm (median of {len(corners)} captures), {min(ratios):.1f} to {max(ratios):.1f} times what is predicted."
        )
