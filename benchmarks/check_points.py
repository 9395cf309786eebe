"""`benchmarks check_points DIR`: corners of boards that took no part, where a calibration puts them in the base."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.corners import (
    FEWEST_IMAGES,
    Corners,
    Measured,
    WristCamera,
    camera_poses,
    corners_of,
    enough,
    measure,
    pixels_of,
    triangulated,
)
from benchmarks.page import boards_of, folders_with, number, table
from jcr.calibration.seen import joint_covariance
from jcr.camera import parameters, with_parameters
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.geometry import retract
from jcr.pipeline import calibrate
from jcr.reconstruct.board import Sighting, boards, most_seen
from jcr.reconstruct.board_in_view import board_in_view
from jcr.reconstruct.marker import WORST_PX
from jcr.records import Capture, HandEye
from jcr.results import RunResult

DRAWS = 200
"""Of the errors that a calibration states."""
SIDE = "SIDE"
"""In place of a length that nobody states."""
LENGTHS_M = {SIDE: "0.1", "MARKER": "0.07"}
"""Of a board whose size nobody states; the ratio of its sides is what counts."""
Parts = dict[str, Float[ndarray, " d"]]


@dataclass(frozen=True)
class Row:
    """One capture."""

    capture: str
    images: str
    corners: int
    stated: float | None
    """Side in metres; None: nobody states it."""
    side: float
    """Of one square as the detector was given it."""
    found: Measured
    predicted: Parts
    """Each number of `found` in the draws."""


def run(captures: Path, boards: Sequence[str] = (), runs: Path | None = None) -> str:
    """Markdown: every capture below `captures` with a board in view, calibrated without it, and its corners.

    A board is named as CAPTURE=BOARD, in the words of `--board`, its side SIDE where nobody states it; of other
    captures it is looked for. Run folders are kept in `runs` and used again. Raises InputError where no capture shows a
    board, or one is named of a capture that is not there.
    """
    folders = folders_with(captures, "capture.json")
    named = boards_of(boards, folders, captures)
    rows, absent = [], []
    for folder in folders:
        try:
            rows.append(_row(read_capture(folder), named.get(folder.name), runs))
        except RejectedError as refusal:
            absent.append(f"{folder.name}: {refusal.what}")
        except InputError as refusal:
            absent.append(f"{folder.name}: {refusal}")
    if not rows:
        raise InputError(f"{captures}: no capture below it shows a board that {FEWEST_IMAGES} images share")
    return "\n".join([_claim(rows), "", *_corner_table(rows), "", *_list(absent)])


def _row(capture: Capture, named: str | None, runs: Path | None) -> Row:
    with _folder(runs, capture.folder.name) as out:
        result = calibrate(capture, out)
    camera, used = _camera_of(result)
    spec, seen = _sightings(replace(capture, images=tuple(capture.images[k] for k in used)), named)
    corners = _plausible(camera, corners_of(seen))
    side = _side_of(corners)
    shows = np.unique(corners.image)
    points = triangulated(camera, corners)
    noise_px = camera_poses(camera, corners, points)[1]
    return Row(
        capture=capture.folder.name,
        images=f"{len(shows)} of {len(capture)}",
        corners=len(points),
        stated=side if named and SIDE not in named else None,
        side=side,
        found=measure(camera, corners),
        predicted=predicted(camera, result.hand_eye, corners, noise_px),
    )


@contextmanager
def _folder(runs: Path | None, name: str) -> Iterator[Path]:
    if runs is not None:
        yield runs / name
        return
    with tempfile.TemporaryDirectory() as out:
        yield Path(out)


def _camera_of(result: RunResult) -> tuple[WristCamera, list[int]]:
    """The camera of the images that the calibration used, and their rows in the capture."""
    rows = result.reconstruction.image_index[result.hand_eye.inliers]
    return (
        WristCamera(
            result.hand_eye.intrinsics or result.reconstruction.intrinsics,
            result.hand_eye.gripper_from_camera,
            result.capture.base_from_gripper[rows],
        ),
        rows.tolist(),
    )


def _sightings(capture: Capture, named: str | None) -> tuple[str, list[list[Sighting]]]:
    """The board's name, with lengths of our own where nobody states them, and where each image shows it."""
    images = [read_image(capture.folder / name) for name in capture.images]
    spec = named or board_in_view(images)
    if spec is None:
        raise RejectedError("no board or tag is found in its images", "name it with --boards")
    for word, length in LENGTHS_M.items():
        spec = spec.replace(word, length)
    board, seen = most_seen(boards(spec), images)
    return board.name, seen


def _side_of(corners: Corners) -> float:
    apart = np.linalg.norm(corners.x_in_board[:, None] - corners.x_in_board, axis=2)
    return float(apart[apart > 0].min())


def _plausible(camera: WristCamera, corners: Corners) -> Corners:
    """Without the images whose corners do not fit the others': another thing was taken for the board."""
    for _ in range(len(camera.base_from_gripper)):
        if not len(corners.x_in_board):
            raise RejectedError("too few images share the corners of a board", "name it with --boards")
        points = triangulated(camera, corners)
        poses, _ = camera_poses(camera, corners, points)
        own = replace(camera, gripper_from_camera=np.eye(4), base_from_gripper=poses)
        off = ((pixels_of(own, corners, points) - corners.x_px) ** 2).sum(1)
        rms_px = {k: float(np.sqrt(off[corners.image == k].mean())) for k in np.unique(corners.image)}
        worst = max(rms_px, key=lambda k: rms_px[k])
        if rms_px[worst] < WORST_PX:
            return corners
        corners = enough(corners.of(corners.image != worst))
    return corners


def predicted(camera: WristCamera, hand_eye: HandEye, corners: Corners, noise_px: float) -> Parts:
    """The same measures in draws of the errors that the calibration states, and of pixels.

    The calibration is off by one draw in all images; each gripper pose by one of its own.
    """
    rng = np.random.default_rng(0)
    points = triangulated(camera, corners)
    of_pose = np.repeat(hand_eye.robot_noise.together, 3)
    found = []
    for true in _true_cameras(camera, hand_eye, rng):
        poses = retract(true.base_from_gripper, rng.normal(size=(len(true.base_from_gripper), 6)) * of_pose)
        x_px = pixels_of(replace(true, base_from_gripper=poses), corners, points)
        x_px = x_px + rng.normal(scale=noise_px, size=x_px.shape)
        found.append(measure(camera, replace(corners, x_px=x_px)))
    return {name: np.array([getattr(one, name) for one in found]) for name in vars(found[0])}


def _true_cameras(camera: WristCamera, hand_eye: HandEye, rng: np.random.Generator) -> Iterator[WristCamera]:
    """Cameras that may be the true one, drawn from what the calibration states of X and intrinsics together."""
    estimate = hand_eye.estimate
    values, vectors = np.linalg.eigh(joint_covariance(estimate))
    spread = vectors * np.sqrt(values.clip(0))
    for _ in range(DRAWS):
        step = spread @ rng.normal(size=len(spread))
        intrinsics = camera.intrinsics
        if estimate.intrinsics_cross is not None:
            intrinsics = with_parameters(intrinsics, parameters(intrinsics) + step[7:])
        x = retract(camera.gripper_from_camera, step[:6])
        yield replace(camera, gripper_from_camera=x, intrinsics=intrinsics)


def _claim(rows: Sequence[Row]) -> str:
    ratios = [row.found.scatter / _rms(row.predicted["scatter"]) for row in rows]
    seen = [1e3 * row.found.scatter for row in rows]
    return (
        f"> Corners of boards that took no part, seen from single images of {len(rows)} real captures: they scatter "
        f"about their means by {min(seen):.1f} to {max(seen):.1f} mm (median {np.median(seen):.1f}), {min(ratios):.1f} "
        f"to {max(ratios):.1f} times (median {np.median(ratios):.1f}) what the calibrations predict."
    )


def _rms(values: Float[ndarray, " d"]) -> float:
    return float(np.sqrt((values**2).mean()))


def _corner_table(rows: Sequence[Row]) -> list[str]:
    return [
        "The features of a calibration come from the whole image, the board's texture included; no board was "
        "searched for. Single: each corner from one image. Its pixel gives the ray; the board's size and shape, as "
        "triangulated in the robot's metre, give how far along it; the pose that the robot reports with that image "
        "takes it to the base. The scatter is about the corner's mean over the images, across the ray (both axes) and "
        "along it. Halves: corners triangulated from every other image, rms distance from those of the others. "
        f"Predicted: the same measures of {DRAWS} draws of the errors that the calibration states, one draw for all "
        "images, of the robot's random and systematic errors, one draw an image, and of pixels. "
        "Side: mean distance of neighbouring "
        "corners, ± predicted. Flat: rms distance of the triangulated corners from their plane, and from a surface of "
        "second order.",
        "",
        *table(
            "capture | images | corners | side: stated mm | triangulated | flat: mm | bend removed | single: mm "
            "| across | along | predicted | across | along | ratio | halves: mm | predicted",
            map(_cells, rows),
        ),
    ]


def _cells(row: Row) -> list[str]:
    found, draws = row.found, row.predicted

    def mm(value: float, digits: int = 2) -> str:
        return number(1e3 * value, digits)

    return [
        row.capture,
        row.images,
        str(row.corners),
        "" if row.stated is None else mm(row.stated),
        f"{mm(row.side * found.side, 3)} ± {mm(row.side * float(draws['side'].std()), 3)}",
        mm(found.flat),
        mm(found.unbent),
        *(mm(value) for value in (found.scatter, found.lateral, found.along)),
        *(mm(_rms(draws[name])) for name in ("scatter", "lateral", "along")),
        f"{found.scatter / _rms(draws['scatter']):.1f}",
        mm(found.halves),
        mm(_rms(draws["halves"])),
    ]


def _list(lines: Sequence[str]) -> list[str]:
    return ["Not measured:", "", *(f"- {line}" for line in lines), ""] if lines else []
