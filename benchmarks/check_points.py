"""`benchmarks check_points DIR`: corners of boards that took no part, where a calibration puts them in the base."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from benchmarks.page import boards_of, folders_with, number, table
from jcr.boards.detection import Sighting, boards, most_seen
from jcr.boards.marker import WORST_PX
from jcr.boards.proposal import board_in_view
from jcr.calibration.seen import joint_covariance
from jcr.camera import by_point, parameters, project, unproject, with_parameters
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.geometry import inverse, nearest_to_lines, retract, skew
from jcr.pipeline import calibrate
from jcr.records import Capture, HandEye, Intrinsics
from jcr.results import RunResult

FEWEST_IMAGES = 3
"""Of a corner."""
FEWEST_CORNERS = 4
"""Of an image."""
STEPS = 5
"""Of Gauss-Newton: from the robot's poses the third changes nothing that is printed."""
NEIGHBOURS = 1.01
"""Corners this much farther apart than the nearest are no neighbours."""
DRAWS = 200
"""Of the errors that a calibration states."""
SIDE = "SIDE"
"""In place of a length that nobody states."""
LENGTHS_M = {SIDE: "0.1", "MARKER": "0.07"}
"""Of a board whose size nobody states; the ratio of its sides is what counts."""
Parts = dict[str, Float[ndarray, " d"]]


@dataclass(frozen=True)
class Corners:
    """Observations of the corners of one board, an element each."""

    image: Int[ndarray, " k"]
    corner: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    x_in_board: Float[ndarray, "c 3"]
    """Metres as stated, z = 0."""

    def of(self, chosen: Bool[ndarray, " k"]) -> "Corners":
        """Some of the observations."""
        return replace(self, image=self.image[chosen], corner=self.corner[chosen], x_px=self.x_px[chosen])


@dataclass(frozen=True)
class WristCamera:
    """What a calibration and the robot say together of where a camera was."""

    intrinsics: Intrinsics
    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "n 4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """Of every image."""
        return self.base_from_gripper @ self.gripper_from_camera


@dataclass(frozen=True)
class Measured:
    """What the corners came to, in metres."""

    side: float
    """Mean distance of neighbouring corners over the stated one."""
    flat: float
    """rms distance of the triangulated corners from their plane; NaN of fewer than four."""
    unbent: float
    """From a surface of second order; NaN of fewer than seven."""
    scatter: float
    """rms over images and corners of the distance of a corner seen in one image from its mean over the images."""
    lateral: float
    """The part of it across the ray, both axes together."""
    along: float
    """The part along the ray."""
    halves: float
    """rms distance of the corners triangulated from every other image from those of the others; NaN where too few."""


def corners_of(sightings: Sequence[Sequence[Sighting]]) -> Corners:
    """Observations of the body seen most often; `sightings` of each image."""
    bodies = [s.body for shown in sightings for s in shown]
    body = max(sorted(set(bodies)), key=bodies.count, default=0)
    seen = [(k, s) for k, shown in enumerate(sightings) for s in shown if s.body == body]
    x_in_board = {index: x for _, s in seen for index, x in zip(s.index, s.x_in_body, strict=True)}
    place = {index: c for c, index in enumerate(sorted(x_in_board))}
    return enough(
        Corners(
            np.array([k for k, s in seen for _ in s.index], dtype=int),
            np.array([place[index] for _, s in seen for index in s.index], dtype=int),
            np.concatenate([s.x_px for _, s in seen] or [np.zeros((0, 2))]),
            np.reshape([x_in_board[index] for index in place], (-1, 3)),
        )
    )


def enough(corners: Corners) -> Corners:
    """Without corners that too few images see, and images that see too few of these."""
    while True:
        images, shown = np.unique(corners.image, return_counts=True)
        own, seen = np.unique(corners.corner, return_counts=True)
        good = np.isin(corners.image, images[shown >= FEWEST_CORNERS])
        good &= np.isin(corners.corner, own[seen >= FEWEST_IMAGES])
        if good.all():
            number = np.searchsorted(own, corners.corner)
            return replace(corners, corner=number, x_in_board=corners.x_in_board[own])
        corners = corners.of(good)


def measure(camera: WristCamera, corners: Corners) -> Measured:
    """The corners as a user would measure them with this calibration."""
    points = triangulated(camera, corners)
    seen, ray = seen_in_base(camera, corners, points)
    counts = np.bincount(corners.corner, minlength=len(points))
    mean = _sums(corners.corner, seen, len(points)) / counts[:, None]
    # A mean of n takes a part of 1/n of the scatter with it.
    off = (seen - mean[corners.corner]) * np.sqrt(counts / (counts - 1))[corners.corner, None]
    along = (off * ray).sum(1)
    flat, unbent = _flatness(points)
    return Measured(
        side=_side(points, corners.x_in_board),
        flat=flat,
        unbent=unbent,
        scatter=_rms_length(off),
        lateral=_rms_length(off - along[:, None] * ray),
        along=_rms_length(along[:, None]),
        halves=_halves(camera, corners),
    )


def triangulated(camera: WristCamera, corners: Corners) -> Float[ndarray, "c 3"]:
    """Each corner by least squares of its reprojection errors, the cameras where robot and calibration put them."""
    base_from_camera = camera.base_from_camera[corners.image]
    ray = np.einsum("kij,kj->ki", base_from_camera[:, :3, :3], unproject(camera.intrinsics, corners.x_px))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    points = np.stack(
        [
            nearest_to_lines(base_from_camera[own, :3, 3], ray[own])
            for own in (corners.corner == c for c in range(len(corners.x_in_board)))
        ]
    )
    for _ in range(STEPS):
        error, by_x = _linearised(camera.intrinsics, base_from_camera, points[corners.corner], corners.x_px)
        normal = _sums(corners.corner, by_x.transpose(0, 2, 1) @ by_x, len(points))
        gradient = _sums(corners.corner, (by_x.transpose(0, 2, 1) @ error[..., None])[..., 0], len(points))
        points = points - np.linalg.solve(normal, gradient[..., None])[..., 0]
    return points


def camera_poses(
    camera: WristCamera, corners: Corners, points: Float[ndarray, "c 3"]
) -> tuple[Float[ndarray, "n 4 4"], float]:
    """base_from_camera of each image by its pixels alone, of corners known in the base, and the rms per axis (px)."""
    poses, count = camera.base_from_camera, len(camera.base_from_gripper)
    for _ in range(STEPS):
        own = poses[corners.image]
        error, by_x = _linearised(camera.intrinsics, own, points[corners.corner], corners.x_px)
        arm = points[corners.corner] - own[:, :3, 3]
        by_step = np.concatenate([-by_x, by_x @ skew(arm)], axis=2)
        normal = _sums(corners.image, by_step.transpose(0, 2, 1) @ by_step, count)
        gradient = _sums(corners.image, (by_step.transpose(0, 2, 1) @ error[..., None])[..., 0], count)
        shows = np.bincount(corners.image, minlength=count) > 0
        normal[~shows] = np.eye(6)
        poses = retract(poses, -np.linalg.solve(normal, gradient[..., None])[..., 0])
    error, _ = _linearised(camera.intrinsics, poses[corners.image], points[corners.corner], corners.x_px)
    free = 2 * len(error) - 6 * len(np.unique(corners.image))
    return poses, float(np.sqrt((error**2).sum() / max(free, 1)))


def seen_in_base(
    camera: WristCamera, corners: Corners, points: Float[ndarray, "c 3"]
) -> tuple[Float[ndarray, "k 3"], Float[ndarray, "k 3"]]:
    """Every observation as a point of the base frame, and its ray's direction there.

    The pixel gives the ray, the board's size and shape as triangulated (in the robot's metre) give how far along it,
    and the pose that the robot reports with this image takes both to the base.
    """
    poses, _ = camera_poses(camera, corners, points)
    depth = _in_camera(poses[corners.image], points[corners.corner])[:, 2:]
    x_in_camera = unproject(camera.intrinsics, corners.x_px) * depth
    base_from_camera = camera.base_from_camera[corners.image]
    arm = np.einsum("kij,kj->ki", base_from_camera[:, :3, :3], x_in_camera)
    return base_from_camera[:, :3, 3] + arm, arm / np.linalg.norm(arm, axis=1, keepdims=True)


def pixels_of(camera: WristCamera, corners: Corners, points: Float[ndarray, "c 3"]) -> Float[ndarray, "k 2"]:
    """Where the camera sees the corners."""
    return project(
        camera.intrinsics, _in_camera(camera.base_from_camera[corners.image], points[corners.corner])
    )


def _linearised(
    intrinsics: Intrinsics,
    base_from_camera: Float[ndarray, "k 4 4"],
    x_in_base: Float[ndarray, "k 3"],
    x_px: Float[ndarray, "k 2"],
) -> tuple[Float[ndarray, "k 2"], Float[ndarray, "k 2 3"]]:
    """Reprojection errors, and their derivatives by the points."""
    x_in_camera = _in_camera(base_from_camera, x_in_base)
    by_x = by_point(intrinsics, x_in_camera) @ base_from_camera[:, :3, :3].transpose(0, 2, 1)
    return project(intrinsics, x_in_camera) - x_px, by_x


def _in_camera(
    base_from_camera: Float[ndarray, "k 4 4"], x_in_base: Float[ndarray, "k 3"]
) -> Float[ndarray, "k 3"]:
    camera_from_base = inverse(base_from_camera)
    return np.einsum("kij,kj->ki", camera_from_base[:, :3, :3], x_in_base) + camera_from_base[:, :3, 3]


def _sums(
    group: Int[ndarray, " k"], values: Float[ndarray, "k *any"], count: int
) -> Float[ndarray, "g *any"]:
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, group, values)
    return out


def _rms_length(values: Float[ndarray, "k d"]) -> float:
    return float(np.sqrt((values**2).sum(1).mean()))


def neighbours(x_in_board: Float[ndarray, "c 3"]) -> Bool[ndarray, "c c"]:
    """Pairs of corners with a side between them, each once."""
    apart = np.linalg.norm(x_in_board[:, None] - x_in_board, axis=2)
    apart[np.tril_indices(len(apart))] = np.inf
    return apart < NEIGHBOURS * apart.min()


def _side(points: Float[ndarray, "c 3"], x_in_board: Float[ndarray, "c 3"]) -> float:
    i, j = np.nonzero(neighbours(x_in_board))
    found, stated = (np.linalg.norm(x[i] - x[j], axis=1) for x in (points, x_in_board))
    return float((found / stated).mean())


def _flatness(points: Float[ndarray, "c 3"]) -> tuple[float, float]:
    centred = points - points.mean(0)
    _, _, axes = np.linalg.svd(centred)
    u, v, height = (centred @ axes.T / np.abs(centred).max()).T
    found = []
    for columns in ([1 + 0 * u, u, v], [1 + 0 * u, u, v, u * u, u * v, v * v]):
        surface = np.stack(columns, axis=1)
        if len(points) <= len(columns):
            found.append(np.nan)
            continue
        left = height - surface @ np.linalg.lstsq(surface, height, rcond=None)[0]
        free = len(points) - len(columns)
        found.append(float(np.abs(centred).max() * np.sqrt((left**2).sum() / free)))
    return found[0], found[1]


def _halves(camera: WristCamera, corners: Corners) -> float:
    """Of corners that two images or more of each half see."""
    place = np.unique(corners.image, return_inverse=True)[1]
    halves = [corners.of(place % 2 == half) for half in (0, 1)]
    counts = [np.bincount(half.corner, minlength=len(corners.x_in_board)) for half in halves]
    both = (np.minimum(*counts) >= 2).nonzero()[0]
    if not len(both):
        return float("nan")
    numbers = np.full(len(corners.x_in_board), -1)
    numbers[both] = np.arange(len(both))
    found = []
    for half in halves:
        own = half.of(numbers[half.corner] >= 0)
        found.append(
            triangulated(
                camera, replace(own, corner=numbers[own.corner], x_in_board=corners.x_in_board[both])
            )
        )
    return _rms_length(found[0] - found[1])


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
