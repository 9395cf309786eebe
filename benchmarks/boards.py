"""`benchmarks boards DIR`: features alone, a board alone, and both in one adjustment: real captures, and simulated."""

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from benchmarks import page
from benchmarks.attack import reconstructed
from jcr.boards.detection import PRINTED, Sighting
from jcr.boards.marker import pose_of_body
from jcr.calibration.known_transform import read_hand_eye
from jcr.calibration.stage import calibrate as calibrate_stage
from jcr.camera import project, unproject
from jcr.capture.read import read_capture
from jcr.errors import InputError, RejectedError
from jcr.geometry import apply, inverse, nearest_to_lines, rotation_between_deg, step_between
from jcr.pipeline import calibrate
from jcr.reconstruct import ReconstructOptions
from jcr.records import Capture, HandEye, Intrinsics, Kind, Reconstruction, Tracks
from jcr.results import RunOptions, RunResult
from simulation.boards import Sheet, with_sheet
from simulation.faults import Faults, FaultyCapture, faulty_capture

DRAWS = 2
POSE_SCALES = (1.0, 1.01, 1.02, 1.05)
BENDS_M = (0.0, 2e-3)
IMAGES = (8, 15)
USUAL = {"features": "colmap", "board": "marker", "both": "colmap"}
"""What each is calibrated from, and the back end that it usually comes to."""
HOWS = tuple(USUAL)
NAMED = frozenset({Kind.BOARD_SIZE, Kind.SCALES})


@dataclass(frozen=True)
class Outcome:
    """One simulated calibration, against the truth."""

    mm: float
    deg: float
    sigmas: float
    """Largest error on an axis of X in stated standard deviations."""
    named: bool
    """A finding states that board and robot contradict each other."""
    accepted: bool


@dataclass(frozen=True)
class Row:
    """One calibration of a real capture; None where there is none."""

    capture: str
    how: str
    message: str
    off_mm: float | None = None
    off_deg: float | None = None
    std_mm: float | None = None
    std_deg: float | None = None
    scale_percent: float | None = None
    feature_px: float | None = None
    corner_px: float | None = None
    seconds: float | None = None


def run(captures: Path, boards: Sequence[str] = (), runs: Path | None = None) -> str:
    """Markdown: the captures below `captures` that `boards` names as CAPTURE=BOARD, and the simulated table.

    Simulated draws are kept in the folder `runs` as they are made, and those that are there are used.
    Raises InputError where a capture that is named is not there.
    """
    named = {name: board for name, _, board in (text.partition("=") for text in boards)}
    folders = {path.parent.name: path.parent for path in sorted(captures.glob("*/capture.json"))}
    if unknown := named.keys() - folders.keys():
        raise InputError(f"--boards {', '.join(sorted(unknown))}: no such capture in {captures}")
    rows = [row for name, board in named.items() for row in _rows(read_capture(folders[name]), board)]
    table = _table(DRAWS, None if runs is None else runs / "draws.jsonl")
    return "\n".join([_claim(table), "", *_real_table(rows), "", *_simulated_table(table, DRAWS), ""])


# Real captures.


def _rows(capture: Capture, board: str) -> Iterator[Row]:
    reference = capture.folder / "reference.json"
    x = read_hand_eye(reference).gripper_from_camera if reference.is_file() else None
    timed = dict[str, tuple[RunResult | RejectedError, float]]()
    for how in HOWS:
        begun = time.perf_counter()
        result = _calibrated(capture, how, board)
        timed[how] = result, time.perf_counter() - begun
    shown, _ = timed["both"]
    for how, (result, seconds) in timed.items():
        if isinstance(result, RejectedError):
            yield Row(capture.folder.name, how, f"none: {result.what}", seconds=seconds)
            continue
        found, backend = result.hand_eye, result.calibration.backend
        std = np.sqrt(np.diag(found.covariance))
        halves = (None, None)
        if not isinstance(shown, RejectedError):
            halves = _left_out(capture, how, board, shown.reconstruction)
        yield Row(
            capture.folder.name,
            how if backend == USUAL[how] else f"{how} ({backend})",
            result.calibration.verdict or "",
            None if x is None else 1e3 * float(np.linalg.norm(found.gripper_from_camera[:3, 3] - x[:3, 3])),
            None if x is None else float(rotation_between_deg(found.gripper_from_camera[:3, :3], x[:3, :3])),
            1e3 * float(std[:3].max()),
            float(np.degrees(std[3:6].max())),
            100 * float(std[6]),
            *halves,
            seconds,
        )


def _calibrated(capture: Capture, how: str, board: str) -> RunResult | RejectedError:
    """As a user would: with and without --board, and with --backend marker."""
    options = RunOptions(
        reconstruct=ReconstructOptions(
            backend="marker" if how == "board" else "auto", board=None if how == "features" else board
        )
    )
    try:
        with tempfile.TemporaryDirectory() as out:
            return calibrate(capture, out, options)
    except RejectedError as refusal:
        return refusal


def _left_out(
    capture: Capture, how: str, board: str, shown: Reconstruction
) -> tuple[float | None, float | None]:
    """Median reprojection error of features and of corners in the odd images, by a calibration of the even ones; None
    where that is rejected."""
    even = np.arange(len(capture)) % 2 == 0
    half = _calibrated(_of(capture, even), how, board)
    if isinstance(half, RejectedError) or not half.converged:
        return None, None
    intrinsics = half.hand_eye.intrinsics or half.reconstruction.intrinsics
    cameras = capture.base_from_gripper[shown.image_index] @ half.hand_eye.gripper_from_camera
    odd = ~even[shown.image_index]
    tracks = shown.tracks
    corners = tracks.on_board | tracks.from_board
    own = tracks.only(odd[tracks.image])
    features, on_board = (own.only(corners[own.point] == kind) for kind in (False, True))
    return _reprojection_px(features, cameras, intrinsics), _reprojection_px(on_board, cameras, intrinsics)


def _of(capture: Capture, chosen: Bool[ndarray, " n"]) -> Capture:
    """Some of the images of a capture."""
    rows = np.flatnonzero(chosen)
    return replace(
        capture,
        images=tuple(capture.images[k] for k in rows),
        base_from_gripper=capture.base_from_gripper[rows],
        joints=None if capture.joints is None else capture.joints[rows],
        depths=None,
    )


def _reprojection_px(
    tracks: Tracks, cameras: Float[ndarray, "m 4 4"], intrinsics: Intrinsics
) -> float | None:
    """Median over observations of points that the same images triangulate, the cameras where robot and X put them."""
    order = np.argsort(tracks.point, kind="stable")
    image, x_px = tracks.image[order], tracks.x_px[order]
    ray = np.einsum("kij,kj->ki", cameras[image, :3, :3], unproject(intrinsics, x_px))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    errors = list[ndarray]()
    for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(tracks.point[order])) + 1):
        if len(rows) >= 2:
            point = nearest_to_lines(cameras[image[rows], :3, 3], ray[rows])
            seen = [project(intrinsics, apply(inverse(cameras[k]), point)) for k in image[rows]]
            errors.append(np.linalg.norm(np.array(seen) - x_px[rows], axis=1))
    return float(np.median(np.concatenate(errors))) if errors else None


def _real_table(rows: Sequence[Row]) -> list[str]:
    return [
        "As a user calls it: without and with `--board`, and with `--backend marker`. Distance of `gripper_from_camera` "
        "from the reference stored with the capture. That is a board's: Park's method "
        "on the poses of a flat board with the stored intrinsics, so that what bends the board, or is wrong with those "
        "intrinsics, is in the reference and not an error of ours. σ: the largest stated one of an axis. Left out: the "
        "calibration of the even images, and the odd images' points triangulated where robot and X put the cameras; "
        "median reprojection error of features and of corners; empty where the even images alone are rejected. Seconds "
        "include the matching.",
        "",
        *page.table(
            "capture | from | verdict | off: mm | ° | ±σ: mm | ° | scale: ±% | left out, features: px | corners: px | s",
            map(_cells, rows),
        ),
    ]


def _cells(row: Row) -> list[str]:
    return [
        row.capture,
        row.how,
        row.message,
        page.number(row.off_mm, 2),
        page.number(row.off_deg, 3),
        page.number(row.std_mm, 2),
        page.number(row.std_deg, 3),
        page.number(row.scale_percent, 3),
        page.number(row.feature_px, 2),
        page.number(row.corner_px, 2),
        page.number(row.seconds, 1),
    ]


# Simulated captures.


def _table(draws: int, file: Path | None) -> "Table":
    """That many draws of every row, the first of all rows before the second of any; a line of `file` each."""
    rows = list(product(IMAGES, BENDS_M, POSE_SCALES))
    made = dict[tuple[float, ...], dict[str, Outcome]]()
    if file is not None and file.is_file():
        for line in map(json.loads, file.read_text().splitlines()):
            made[tuple(line["draw"])] = {how: Outcome(**one) for how, one in line["outcomes"].items()}
    for seed, row in product(range(draws), rows):
        if (*row, seed) in made:
            continue
        made[(*row, seed)] = outcomes = _simulated(*row, seed)
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            line = {"draw": (*row, seed), "outcomes": {how: asdict(one) for how, one in outcomes.items()}}
            with file.open("a") as kept:
                kept.write(json.dumps(line) + "\n")
    return {row: [made[(*row, seed)] for seed in range(draws)] for row in rows}


def _simulated(images: int, bend_m: float, pose_scale: float, seed: int) -> dict[str, Outcome]:
    """One draw, calibrated in each way."""
    bare, capture, reconstruction, features = _without_sheet(images, pose_scale, seed)
    rng = np.random.default_rng([seed, images, 1])
    sheet = Sheet(bend_m=bend_m, size_error=float(rng.normal(scale=PRINTED)))
    found = with_sheet(bare, rng, sheet)
    ways = {"board": _board_alone(found), "both": replace(reconstruction, tracks=found.tracks)}
    outcomes = {how: _outcome(found, calibrate_stage(capture, one)) for how, one in ways.items()}
    return {"features": features, **outcomes}


@lru_cache(maxsize=len(IMAGES) * len(POSE_SCALES))
def _without_sheet(
    images: int, pose_scale: float, seed: int
) -> tuple[FaultyCapture, Capture, Reconstruction, Outcome]:
    """What sheets of every shape are put into, and what its features alone come to."""
    bare = faulty_capture(np.random.default_rng([seed, images]), images, Faults(pose_scale=pose_scale))
    capture, reconstruction = reconstructed(bare, estimated=False)
    return bare, capture, reconstruction, _outcome(bare, calibrate_stage(capture, reconstruction))


def _board_alone(found: FaultyCapture) -> Reconstruction:
    """What the marker back end makes of the corners."""
    tracks = found.tracks
    assert tracks.boards is not None
    (body,) = tracks.boards.bodies
    first, rows, cameras = int(body.point[0]), list[int](), list[ndarray]()
    for k in range(len(found.base_from_camera)):
        own = (tracks.image == k) & tracks.on_board[tracks.point]
        corner = tracks.point[own] - first
        seen = Sighting(0, tuple(corner.tolist()), body.x_in_body[corner], tracks.x_px[own])
        pose = pose_of_body(seen, found.intrinsics) if len(corner) else None
        if pose is not None:
            rows.append(k)
            cameras.append(inverse(pose.camera_from_body))
    own = np.isin(tracks.image, rows) & tracks.on_board[tracks.point]
    corners = Tracks(
        image=np.searchsorted(rows, tracks.image[own]),
        x_px=tracks.x_px[own],
        point=tracks.point[own] - first,
        points_in_recon=body.x_in_body,
        from_board=True,
    )
    return Reconstruction(
        image_index=np.array(rows),
        recon_from_camera=np.stack(cameras),
        intrinsics=found.intrinsics,
        tracks=corners,
        backend="marker",
        is_metric=True,
        metric_std=PRINTED,
    )


def _outcome(found: FaultyCapture, hand_eye: HandEye) -> Outcome:
    step = step_between(hand_eye.gripper_from_camera, found.gripper_from_camera)
    std = np.sqrt(np.diag(hand_eye.covariance))
    metres, radians = np.linalg.norm(step.reshape(2, 3), axis=1)
    return Outcome(
        1e3 * float(metres),
        float(np.degrees(radians)),
        float(np.abs(step / std[:6]).max()),
        any(one.kind in NAMED for one in hand_eye.findings),
        bool(hand_eye.converged),
    )


def _claim(table: "Table") -> str:
    behind = {
        row: _median(draws, "both") - min(_median(draws, how) for how in ("features", "board"))
        for row, draws in table.items()
    }
    right = [mm for (_, _, scale), mm in behind.items() if scale == 1.0]
    beyond = [one["both"].sigmas > 3 for draws in table.values() for one in draws if one["both"].accepted]
    long = [one["both"].named for (_, _, scale), draws in table.items() for one in draws if scale >= 1.02]
    clean = [one["both"] for (_, _, scale), draws in table.items() for one in draws if scale == 1.0]
    return (
        f"> Simulated: both are nearest in {sum(mm <= 0 for mm in right)} of {len(right)} rows of robots whose lengths "
        f"are right and in {sum(mm <= 0 for mm in behind.values())} of all {len(behind)}, elsewhere at most "
        f"{max(behind.values()):.2f} mm farther than the nearest. {sum(beyond)} of {len(beyond)} accepted results are "
        f"beyond 3 σ, {sum(one.named for one in clean)} of {len(clean)} are falsely said to contradict the board, and "
        f"positions 2 and 5 % too long are named in {sum(long)} of {len(long)} draws."
    )


Table = dict[tuple[int, float, float], list[dict[str, Outcome]]]


def _median(draws: Sequence[dict[str, Outcome]], how: str) -> float:
    return float(np.median([one[how].mm for one in draws]))


def _simulated_table(table: Table, draws: int) -> list[str]:
    lines = [
        f"Simulated, the truth known, {draws} draws a row: 500 features seen with 0.4 px of noise, a chessboard of 9x6 "
        "corners and 25 mm seen with 0.1 px, printed to 0.2 %, flat or with its edges 2 mm up; robot pose noise 0.3 mm "
        "and 0.06° per axis. *too long*: all positions of the robot. *off*: median distance from the true transform. "
        "Where a contradiction is named, the transform stays in the robot's metre, as that of features alone is: 2 or 5 "
        "% longer than the true one, and which of the two is nearer is chance. *> 3 σ*: accepted results with "
        "an axis of X more than three stated σ off. *named*: a finding says that board and robot contradict each other.",
        "",
        "| images | sheet | too long | features: mm | ° | > 3 σ | board: mm | ° | > 3 σ | both: mm | ° | > 3 σ | "
        "named | rejected |",
        "|---" * 14 + "|",
    ]
    for (images, bend, scale), row in table.items():
        cells = [str(images), "bent" if bend else "flat", f"{100 * (scale - 1):.0f} %"]
        for how in HOWS:
            some = [one[how] for one in row]
            accepted = [one for one in some if one.accepted]
            beyond = sum(one.sigmas > 3 for one in accepted)
            deg = float(np.median([one.deg for one in some]))
            cells += [f"{_median(row, how):.2f}", f"{deg:.3f}", f"{beyond} of {len(accepted)}"]
        cells += [f"{sum(one['both'].named for one in row)} of {len(row)}"]
        cells += [f"{sum(not one['both'].accepted for one in row)}"]
        lines.append("| " + " | ".join(cells) + " |")
    return lines
