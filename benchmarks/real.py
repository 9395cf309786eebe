"""`benchmarks real DIR`: real captures against references, their halves, and boards that took no part.

A transform belongs to its intrinsics, so pairs are compared: the places of a point seen at the centre of the image and
the working distance. Halves of a capture, calibrated apart, need no reference. Corners of a board that took no part
show whether points seen in single images are where the calibration says, as exactly as it says.
"""

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from PIL import Image

from benchmarks.page import apart, boards_of, folders_with, number, table
from benchmarks.peers import opencv
from jcr.boards.detection import Sighting, boards, most_seen
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.seen import joint_covariance
from jcr.camera import parameters, project, unproject, with_parameters
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.geometry import (
    apply,
    inverse,
    nearest_to_lines,
    retract,
    rotation_exp,
    rotation_log,
    step_between,
    transform,
)
from jcr.pipeline.run import RunOptions, calibrate
from jcr.reconstruct import ReconstructOptions
from jcr.records import Capture, HandEye, Intrinsics, coefficients_of
from jcr.results import RunResult

FEWEST_IMAGES, FEWEST_CORNERS, WORST_PX = 3, 4, 2.0
"""Fewest images of a corner and corners of an image; rms misfit above which an image shows another thing."""
DRAWS = 100
"""Draws of the errors that a calibration states."""
LENGTHS_M = {"SIDE": "0.1", "MARKER": "0.07"}
"""Lengths of a board whose size nobody states; the ratio of its sides is what counts."""


def run(captures: Path, boards: Sequence[str] = ()) -> str:
    """Return the page in Markdown: every capture below `captures`, from its images alone and with its board.

    A board is named as CAPTURE=BOARD, in the words of `--board`, its side SIDE where nobody states it. Raises
    InputError where there is no capture, or a board is of a capture that is not there.
    """
    folders = folders_with(captures, "capture.json")
    named = boards_of(boards, folders, captures)
    rows, halves, corners, absent = [], [], [], []
    for folder in folders:
        capture, board = read_capture(folder), named.get(folder.name)
        alone = _calibrated(capture, None)
        rows.append(_row(folder, capture, None, *alone))
        if board is not None and "SIDE" not in board:
            found = _calibrated(capture, board)
            rows.append(_row(folder, capture, board, *found))
            rows += _park(folder, board, found[0])
        halves += _halves(capture)
        if isinstance(alone[0], RunResult) and board is not None:
            try:
                corners.append(check_points(folder.name, alone[0], board))
            except (InputError, RejectedError) as refusal:
                absent.append(f"- {folder.name}: {refusal}")
    return page(rows, halves, corners, absent)


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


@dataclass(frozen=True, kw_only=True)
class Row:
    """One calibration beside its reference."""

    capture: str
    how: str
    alone: bool
    """Whether it is from images alone, without a board."""
    images: str
    verdict: str
    off: tuple[float, float] | None = None
    """mm and degrees from the reference."""
    point_mm: float | None = None
    """Distance of the places that the two pairs of intrinsics and transform give a point."""
    stated_mm: float | None = None
    """Stated bound on 95 % of the errors of that point."""
    sigmas: float | None = None
    """Largest distance on an axis in standard deviations of both, where the reference states its own."""
    std: tuple[float, float] | None = None
    """Largest stated standard deviation, mm and degrees."""
    leave_one_out_mm: float | None = None
    seconds: float | None = None

    def cells(self) -> list[str]:
        """Return the row of the table."""
        off, std = self.off or (None, None), self.std or (None, None)
        values = (*off, self.point_mm, self.stated_mm, self.sigmas, *std, self.leave_one_out_mm, self.seconds)
        return [self.capture, self.how, self.images, self.verdict, *(number(value, 2) for value in values)]


def _row(
    folder: Path, capture: Capture, board: str | None, result: RunResult | RejectedError, seconds: float
) -> Row:
    """Compare a calibration with the reference stored beside its capture, if any."""
    how, alone = ("images alone" if board is None else f"`{board}`"), board is None
    if isinstance(result, RejectedError):
        images = f"0 of {len(capture)}"
        return Row(
            capture=folder.name, how=how, alone=alone, images=images, verdict="rejected", seconds=seconds
        )
    found, known = result.hand_eye, None
    std = np.sqrt(np.diag(found.covariance)[:6])
    off, sigmas, point = None, None, None
    if (folder / "reference.json").is_file():
        known = read_hand_eye(folder / "reference.json")
        off, point = (
            apart(found.gripper_from_camera, known.gripper_from_camera),
            _point_off(folder, capture, found),
        )
        if known.covariance is not None:
            joint = np.hypot(std, np.sqrt(np.diag(known.covariance)[:6]))
            step = step_between(found.gripper_from_camera, known.gripper_from_camera)
            sigmas = float(np.abs(step / joint).max())
    held_out = result.calibration.held_out
    return Row(
        capture=folder.name,
        how=how if board else f"{how} ({result.calibration.backend})",
        alone=alone,
        images=f"{sum(image.used for image in result.calibration.images)} of {len(capture)}",
        verdict=result.calibration.verdict or "",
        off=off,
        point_mm=point,
        stated_mm=None if found.in_use is None else found.in_use.seen.within_95_mm,
        sigmas=sigmas,
        std=(1e3 * float(std[:3].max()), float(np.degrees(std[3:].max()))),
        leave_one_out_mm=None if held_out is None else held_out.translation_mm,
        seconds=seconds,
    )


def _park(folder: Path, board: str, result: RunResult | RejectedError) -> Iterator[Row]:
    """Compare OpenCV's Park method on the same poses of the board with the reference."""
    if isinstance(result, RejectedError) or not (folder / "reference.json").is_file():
        return
    rows = result.reconstruction.image_index
    x, _ = opencv(
        "Park", result.capture.base_from_gripper[rows], result.reconstruction.recon_from_camera, 1.0
    )
    off = apart(x, read_hand_eye(folder / "reference.json").gripper_from_camera)
    images = f"{len(rows)} of {len(result.capture)}"
    yield Row(
        capture=folder.name, how=f"`{board}`, OpenCV Park", alone=False, images=images, verdict="", off=off
    )


def _point_off(folder: Path, capture: Capture, found: HandEye) -> float | None:
    """Return the distance (mm) of a point's places by our pair and by that of the reference; None without intrinsics."""
    reference = read_hand_eye(folder / "reference.json").gripper_from_camera
    camera = json.loads((folder / "reference.json").read_text()).get("camera")
    theirs = capture.intrinsics
    if camera is not None:
        (fx, _, cx), (_, fy, cy), _ = camera["K"]
        with Image.open(folder / capture.images[0]) as image:
            theirs = Intrinsics(fx, fy, cx, cy, *image.size, coefficients_of(camera["d"]))
    return None if theirs is None else _pair_apart(found, reference, theirs)


def _pair_apart(found: HandEye, x: Float[ndarray, "4 4"], intrinsics: Intrinsics) -> float | None:
    """Return the distance (mm) of the places of a point at the image's centre and the working distance by two pairs."""
    own = found.intrinsics
    if own is None or found.in_use is None:
        return None
    x_px = np.array([own.width - 1.0, own.height - 1.0]) / 2
    distance = 1e-3 * found.in_use.seen.distance_mm
    first, second = (
        apply(x_of, distance * (ray := unproject(camera, x_px)) / np.linalg.norm(ray))
        for x_of, camera in ((found.gripper_from_camera, own), (x, intrinsics))
    )
    return 1e3 * float(np.linalg.norm(first - second))


# Halves.


@dataclass(frozen=True)
class Halves:
    """Two halves of one capture, calibrated apart."""

    capture: str
    point_mm: float
    """Distance of a seen point's places by the two pairs."""
    stated_mm: float
    """Bound on 95 % of that distance by what both state."""
    sigmas: float
    """Largest difference of the transforms on an axis in standard deviations of both."""


def _halves(capture: Capture) -> Iterator[Halves]:
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
    one, other = results
    if one.in_use is None or other.in_use is None or other.intrinsics is None:
        return
    point = _pair_apart(one, other.gripper_from_camera, other.intrinsics)
    std = np.sqrt(np.diag(one.covariance)[:6] + np.diag(other.covariance)[:6])
    step = step_between(one.gripper_from_camera, other.gripper_from_camera)
    stated = float(np.hypot(one.in_use.seen.within_95_mm, other.in_use.seen.within_95_mm))
    yield Halves(capture.folder.name, point or 0.0, stated, float(np.abs(step / std).max()))


# Boards that took no part.


@dataclass(frozen=True)
class Corners:
    """Observations of the corners of one board, an element each."""

    image: Int[ndarray, " k"]
    corner: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    x_in_board: Float[ndarray, "c 3"]
    """Metres as stated, z = 0."""

    def of(self, chosen: Bool[ndarray, " k"]) -> "Corners":
        """Return some of the observations, of corners and images that have enough of each other."""
        kept = replace(self, image=self.image[chosen], corner=self.corner[chosen], x_px=self.x_px[chosen])
        images, shown = np.unique(kept.image, return_counts=True)
        own, seen = np.unique(kept.corner, return_counts=True)
        good = np.isin(kept.image, images[shown >= FEWEST_CORNERS])
        good &= np.isin(kept.corner, own[seen >= FEWEST_IMAGES])
        if not good.all():
            return kept.of(good)
        return replace(kept, corner=np.searchsorted(own, kept.corner), x_in_board=self.x_in_board[own])


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
    rows = result.reconstruction.image_index[result.hand_eye.inliers]
    camera = WristCamera(
        result.hand_eye.intrinsics or result.reconstruction.intrinsics,
        result.hand_eye.gripper_from_camera,
        result.capture.base_from_gripper[rows],
    )
    images = [read_image(result.capture.folder / result.capture.images[row]) for row in rows]
    spec = board
    for word, length in LENGTHS_M.items():
        spec = spec.replace(word, length)
    corners = _plausible(camera, corners_of(most_seen(boards(spec), images)[1]))
    noise_px = float(np.sqrt((_misfit(camera, corners) ** 2).sum(1).mean() / 2))
    return replace(
        measure(camera, corners),
        capture=name,
        images=len(np.unique(corners.image)),
        corners=len(corners.x_in_board),
        predicted=predicted(camera, result.hand_eye, corners, noise_px),
    )


def corners_of(sightings: Sequence[Sequence[Sighting]]) -> Corners:
    """Return the observations of the body seen most often; `sightings` of each image."""
    bodies = [s.body for shown in sightings for s in shown]
    body = max(sorted(set(bodies)), key=bodies.count, default=0)
    seen = [(k, s) for k, shown in enumerate(sightings) for s in shown if s.body == body]
    x_in_board = {index: x for _, s in seen for index, x in zip(s.index, s.x_in_body, strict=True)}
    place = {index: c for c, index in enumerate(sorted(x_in_board))}
    corners = Corners(
        np.array([k for k, s in seen for _ in s.index], dtype=int),
        np.array([place[index] for _, s in seen for index in s.index], dtype=int),
        np.concatenate([s.x_px for _, s in seen] or [np.zeros((0, 2))]),
        np.reshape([x_in_board[index] for index in place], (-1, 3)),
    )
    return corners.of(np.ones(len(corners.image), bool))


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
    rng, estimate = np.random.default_rng(0), hand_eye.estimate
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
    rows: Sequence[Row], halves: Sequence[Halves], corners: Sequence[CheckPoints], absent: Sequence[str]
) -> str:
    """Return the page of measured captures in Markdown."""
    lines = [*_claims(rows, halves, corners), "", "## References", ""]
    lines += [
        "Distance from the reference stored with a capture, which has an error of its own and is made with the stored "
        "intrinsics. Point: distance of a point's places by the two pairs of intrinsics and transform.",
        "",
        *table(
            "capture | from | images | verdict | off: mm | ° | point: mm | 95 % stated below | σ of both | ±σ: mm | ° | "
            "leave-one-out, mm | s",
            (row.cells() for row in rows),
        ),
        "",
        "## Halves, calibrated apart",
        "",
        *table(
            "capture | point apart, mm | 95 % stated below | transform apart, σ of both",
            (
                [one.capture, f"{one.point_mm:.2f}", f"{one.stated_mm:.2f}", f"{one.sigmas:.1f}"]
                for one in halves
            ),
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


def _claims(rows: Sequence[Row], halves: Sequence[Halves], corners: Sequence[CheckPoints]) -> Iterator[str]:
    for what, some in (
        ("images alone", [row for row in rows if row.alone]),
        ("a board", [row for row in rows if not row.alone and row.verdict]),
    ):
        accepted = [row for row in some if row.verdict.startswith("accepted")]
        off = [row.off for row in accepted if row.off is not None]
        if off:
            mm, deg = np.median(off, axis=0)
            yield (
                f"> From {what}: {len(accepted)} of {len(some)} real captures are accepted, {mm:.1f} mm and {deg:.2f}° "
                f"from the references (median; worst {max(off)[0]:.1f} mm)."
            )
    if halves:
        agree, within = (
            sum(one.sigmas < 2 for one in halves),
            sum(one.point_mm < one.stated_mm for one in halves),
        )
        yield (
            f"> Of {len(halves)} captures cut in halves {agree} agree within 2 σ on every axis, a seen point within "
            f"what both state for 95 % in {within}."
        )
    if corners:
        ratios = [one.scatter / np.sqrt((np.array(one.predicted) ** 2).mean()) for one in corners]
        yield (
            f"> Corners of boards that took no part scatter by {1e3 * np.median([one.scatter for one in corners]):.1f} "
            f"mm (median of {len(corners)} captures), {min(ratios):.1f} to {max(ratios):.1f} times what is predicted."
        )
