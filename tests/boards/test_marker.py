"""Boards drawn where the truth is known: their points to parts of a pixel, and the calibration from their images."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

import jcr
import scenes
from jcr.backends import ReconstructOptions, reconstruct
from jcr.boards.corners import with_boards
from jcr.boards.detection import PRINTED_STD, Sighting, boards
from jcr.boards.marker import reconstruct_marker
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.difference import compare
from jcr.camera import project, unproject
from jcr.capture.formats import capture_json
from jcr.capture.images import encode_png
from jcr.capture.read import read_capture
from jcr.files import write_bytes
from jcr.findings import FindingKind
from jcr.geometry import apply, inverse, rotation_between_deg, rotation_exp, step_between, transform
from jcr.pipeline.backend_selection import select_reconstruction
from jcr.records import CellCamera, Intrinsics
from jcr.result import RunOptions
from places import SHARED
from scenes import png_names
from simulation.problems import TARGET_IN_BASE, hand_eye_problem

pytestmark = pytest.mark.slow

INTRINSICS = Intrinsics(620.0, 620.0, 322.0, 236.0, 640, 480, (-0.08, 0.03, 0.0, 0.0, 0.0))
PX_PER_M = 2000
"""Of the printed sheets."""
MARGIN_M = 0.02


def charuco(px_per_m: int = PX_PER_M, legacy: bool = False) -> np.ndarray:
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, 6), 0.03, 0.022, tags)
    board.setLegacyPattern(legacy)
    return board.generateImage((round(0.21 * px_per_m), round(0.18 * px_per_m)), marginSize=0)


def legacy_charuco() -> np.ndarray:
    return charuco(legacy=True)


def chessboard(px_per_m: int = PX_PER_M) -> np.ndarray:
    side = px_per_m // 40
    row, column = np.indices((6 * side, 9 * side)) // side
    return (255 * ((row + column) % 2)).astype(np.uint8)


def tag(px_per_m: int = PX_PER_M, number: int = 3) -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.generateImageMarker(dictionary, number, px_per_m // 20)


def tags() -> np.ndarray:
    """Five 5 cm tags here and there on one sheet."""
    sheet = np.full((500, 600), 255, np.uint8)
    for number, (x, y) in enumerate([(40, 40), (420, 30), (230, 190), (50, 360), (440, 370)]):
        sheet[y : y + 100, x : x + 100] = tag(number=number)
    return sheet


FINE = 2
"""Samples a side of a pixel: the sheet's edges keep their place to a small part of it."""


@cache
def directions() -> np.ndarray:
    """Viewing rays of the fine samples, z = 1."""
    v, u = np.indices((FINE * INTRINSICS.height, FINE * INTRINSICS.width))
    return unproject(INTRINSICS, (np.stack([u, v], -1).reshape(-1, 2) + 0.5) / FINE - 0.5)


def photographed(sheet: np.ndarray, base_from_camera: np.ndarray, seed: int) -> np.ndarray:
    """What the camera sees of a sheet printed at PX_PER_M that lies flat about TARGET_IN_BASE."""
    pad = round(MARGIN_M * PX_PER_M)
    sheet = cv2.copyMakeBorder(sheet, pad, pad, pad, pad, cv2.BORDER_CONSTANT, value=255)
    direction = directions() @ base_from_camera[:3, :3].T
    origin = base_from_camera[:3, 3]
    x_in_base = origin + direction * ((TARGET_IN_BASE[2] - origin[2]) / direction[:, 2])[:, None]
    on_sheet = (x_in_base - TARGET_IN_BASE)[:, :2] * [1, -1] * PX_PER_M
    on_sheet += np.array(sheet.shape[::-1]) / 2 - 0.5
    u, v = on_sheet.astype(np.float32).T.reshape(2, FINE * INTRINSICS.height, FINE * INTRINSICS.width)
    image = cv2.remap(sheet, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    small = cv2.resize(image, (INTRINSICS.width, INTRINSICS.height), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(seed).normal(0, 2, small.shape)
    grey = np.clip(25 + 0.8 * small + noise, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


PROBLEM = hand_eye_problem(np.random.default_rng(3), 8)


@cache
def photograph(sheet: Callable[[], np.ndarray], k: int) -> np.ndarray:
    """One of eight views of a sheet, drawn once for all tests."""
    return photographed(sheet(), PROBLEM.base_from_gripper[k] @ PROBLEM.gripper_from_camera, k)


def capture_of(folder: Path, sheet: Callable[[], np.ndarray], count: int = 8, known_intrinsics: bool = True):
    """A capture of the sheet's first views, and the true gripper_from_camera."""
    for k, name in enumerate(png_names(count)):
        write_bytes(folder / name, encode_png(photograph(sheet, k)))
    camera = INTRINSICS if known_intrinsics else None
    capture = scenes.capture_of(PROBLEM.base_from_gripper[:count], folder=folder, intrinsics=camera)
    return capture, PROBLEM.gripper_from_camera


def test_calibrates_from_tags(tmp_path):
    capture, gripper_from_camera = capture_of(tmp_path / "capture", tags)
    reconstruction = reconstruct_marker(capture, "apriltag:0.050:36h11")
    assert len(reconstruction.image_index) == len(capture)
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    found = hand_eye.gripper_from_camera
    mm = 1e3 * np.linalg.norm(found[:3, 3] - gripper_from_camera[:3, 3])
    deg = rotation_between_deg(found[:3, :3], gripper_from_camera[:3, :3])
    assert hand_eye.converged and mm < 1.0 and deg < 0.2, f"{mm} mm, {deg}°"
    assert abs(hand_eye.scale - 1) < 0.005
    # The size of the tags is a prior of the scale, and no length that a network predicted.
    assert reconstruction.metric_std == PRINTED_STD
    assert "network" not in {one.name for one in hand_eye.lengths}


@pytest.mark.parametrize(("spec", "legacy", "read_as"), [
    ("charuco:6x7:0.030:0.022:DICT_4X4_50", False, "charuco:7x6:0.030:0.022:DICT_4X4_50"),
    ("charuco:7x6:0.030:0.022:DICT_4X4_50", True, "before OpenCV 4.6"),
])  # fmt: skip
def test_other_readings_of_a_charuco_board_are_tried_and_named(tmp_path, spec, legacy, read_as):
    capture, gripper_from_camera = capture_of(
        tmp_path / "capture", legacy_charuco if legacy else charuco, count=5
    )
    reconstruction = reconstruct_marker(capture, spec)
    assert any(read_as in note for note in reconstruction.notes)
    found = calibrate_reconstruction(capture, reconstruction).gripper_from_camera
    assert np.linalg.norm(found - gripper_from_camera) < 0.01


DATA = SHARED / "data"


@pytest.mark.skipif(not DATA.is_dir(), reason="the real captures are not beside this checkout")
@pytest.mark.long
@pytest.mark.parametrize(("name", "spec"), [
    ("doosan_bench", "charuco:7x5:0.030:0.022:DICT_4X4_50"),
    ("franka_wood_table", "charuco:5x7:0.034:0.0255:DICT_6X6_250"),
])  # fmt: skip
def test_a_real_board_alone_agrees_with_the_features_of_the_scene(name: str, spec: str):
    capture = read_capture(DATA / name)
    by_board = calibrate_reconstruction(capture, reconstruct_marker(capture, spec))
    by_features = calibrate_reconstruction(
        capture, reconstruct(capture, ReconstructOptions(backend="colmap"))
    )
    difference = compare(by_board, by_features)
    assert by_board.converged and by_board.source == "images"
    assert difference.p_value is not None and difference.p_value > 0.01


@pytest.mark.skipif(not DATA.is_dir(), reason="the real captures are not beside this checkout")
def test_a_real_board_of_another_size_than_stated_is_named():
    """The robot's motion excludes the size of the squares with which the reference was made."""
    capture = read_capture(DATA / "franka_plain_background")
    found = calibrate_reconstruction(capture, reconstruct_marker(capture, "chessboard:9x6:0.0236"))
    assert found.verdict == "rejected" and found.findings[0].kind is FindingKind.BOARD_SIZE


def test_a_board_that_the_gripper_carries_before_a_fixed_camera_comes_before_features(tmp_path: Path):
    seen, base_from_camera = capture_of(tmp_path / "capture", charuco, count=6)
    capture = replace(seen, base_from_gripper=inverse(seen.base_from_gripper), mount="base")
    options = RunOptions(reconstruct=ReconstructOptions(board="charuco:7x6:0.030:0.022:DICT_4X4_50"))
    made, found = select_reconstruction(capture, options)
    assert made.backend == "marker" and found.converged and len(found.attempts) == 1
    assert np.linalg.norm(found.parent_from_camera - base_from_camera) < 0.01


def test_cameras_that_watch_the_gripper_are_located_together_by_its_board(tmp_path: Path):
    """The second camera has its images of two poses at which the first does not see the board."""
    spec, step = (
        "charuco:7x6:0.030:0.022:DICT_4X4_50",
        transform(rotation_exp(np.array([0.05, 0.1, 0.2])), np.array([0.03, 0.02, 0.0])),
    )
    seen, base_from_camera = capture_of(tmp_path / "capture", charuco)
    for grey, name in enumerate(seen.images[6:], start=90):
        write_bytes(seen.folder / name, encode_png(np.full((480, 640, 3), grey, np.uint8)))
    there = seen.base_from_gripper @ base_from_camera @ step
    names = [f"second/{k}.png" for k in range(1, 8)]
    for k, name in enumerate(names, start=1):
        write_bytes(seen.folder / name, encode_png(photographed(charuco(), there[k], 20 + k)))
    second = CellCamera(
        name="second", mount="base", images=tuple(names), image_size=(640, 480), intrinsics=INTRINSICS,
        frame=np.arange(1, 8),
    )  # fmt: skip
    own = replace(seen, base_from_gripper=inverse(seen.base_from_gripper), mount="base")
    capture_json.write(seen.folder, replace(own, others=(second,)))
    result = jcr.calibrate(
        read_capture(seen.folder), tmp_path / "out", RunOptions(reconstruct=ReconstructOptions(board=spec))
    )
    (placed,) = result.cameras.cameras
    assert placed.verdict == "accepted" and [one.used for one in placed.images] == [True] * 7
    assert placed.parent_from_camera is not None and placed.covariance is not None
    off = step_between(placed.parent_from_camera, base_from_camera @ step)
    assert np.linalg.norm(off[:3]) < 0.004 and off @ np.linalg.solve(placed.covariance, off) < 22.5


def test_a_chessboard_with_a_narrow_border_before_a_dark_background_is_found_where_it_is():
    """OpenCV's sector-based detector returns points beside the board."""
    row, column = np.indices((4 * 50, 5 * 50)) // 50
    sheet, border = (255 * ((row + column) % 2)).astype(np.uint8), 12
    sheet = cv2.copyMakeBorder(sheet, border, border, border, border, cv2.BORDER_CONSTANT, value=255)
    height, width = sheet.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    turned = cv2.getPerspectiveTransform(
        corners, np.array([[200, 100], [315, 166], [290, 290], [173, 215]], np.float32)
    )
    image = cv2.warpPerspective(sheet, turned, (480, 400), flags=cv2.INTER_AREA, borderValue=60)
    (sighting,) = boards("chessboard:4x3:0.050")[0].detect(cv2.GaussianBlur(image, (0, 0), 0.7))
    inner = np.indices((3, 4))[::-1].reshape(2, -1).T * 50.0 + 50 + border - 0.5
    expected = cv2.perspectiveTransform(inner[None], turned)[0]
    apart = np.linalg.norm(sighting.x_px[:, None] - expected, axis=2)
    assert max(apart.min(0).max(), apart.min(1).max()) < 0.5


def test_a_corner_that_only_one_image_shows_takes_the_place_of_no_other(tmp_path: Path, monkeypatch):
    capture, gripper_from_camera = capture_of(tmp_path / "capture", charuco, count=3)
    cameras, corners = (
        capture.base_from_gripper @ gripper_from_camera,
        np.indices((3, 2, 1)).reshape(3, -1).T * 0.03,
    )
    seen = list[list[Sighting]]()
    for camera, first in zip(cameras, (0, 1, 1), strict=True):
        x = corners[first:]
        x_px = project(INTRINSICS, apply(inverse(camera), TARGET_IN_BASE + x))
        seen.append([Sighting(0, tuple(range(first, len(corners))), x, x_px)])
    monkeypatch.setattr("jcr.boards.corners.most_seen", lambda readings, _: (readings[0], seen))
    made = scenes.reconstruction_of(cameras, intrinsics=INTRINSICS)
    tracks = with_boards(capture, made, "charuco:7x6:0.030:0.022:DICT_4X4_50").tracks
    assert tracks.boards is not None
    (body,) = tracks.boards.bodies
    assert len(body.point) == len(corners) - 1
    np.testing.assert_allclose(tracks.points_in_recon[body.point], TARGET_IN_BASE + body.x_in_body, atol=1e-5)


def test_an_unknown_intrinsics_comes_from_the_board(tmp_path):
    capture, gripper_from_camera = capture_of(tmp_path / "capture", charuco, known_intrinsics=False)
    reconstruction = reconstruct_marker(capture, "charuco:7x6:0.030:0.022:DICT_4X4_50")
    assert abs(reconstruction.intrinsics.fx / INTRINSICS.fx - 1) < 0.01
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    assert np.linalg.norm(hand_eye.gripper_from_camera - gripper_from_camera) < 0.01


@pytest.mark.parametrize(
    ("spec", "draw", "origin_px", "flip", "limit_px"),
    [
        ("charuco:7x6:0.030:0.022:DICT_4X4_50", charuco, 0, 1, 0.03),
        ("chessboard:8x5:0.025", chessboard, 100, 1, 0.03),
        # Its axis of the body points up; AprilTag's fit of lines leaves 0.05 px.
        ("apriltag:0.050:36h11", tag, 100, -1, 0.1),
    ],
)
def test_a_detector_s_points_are_at_the_truth_on_average(spec, draw, origin_px, flip, limit_px):
    """In pixels whose first has its centre at (0, 0), eight samples a side of a pixel."""
    px_per_m = 2 * PX_PER_M
    sheet = cv2.copyMakeBorder(draw(px_per_m), 100, 100, 100, 100, cv2.BORDER_CONSTANT, value=255)
    errors = []
    for degrees, shift in ((20, (0.1, 0.3)), (110, (0.4, -0.2)), (200, (-0.3, 0.1)), (290, (0.2, 0.4))):
        angle = np.radians(degrees)
        rotation = 0.25 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        # Pixels of the image from those of the sheet, both counted from their images' corners.
        middle = np.array([160.0, 160.0]) + shift - rotation @ (np.array(sheet.shape[::-1]) / 2)
        from_centres = np.column_stack([8 * rotation, 8 * (middle + rotation @ [0.5, 0.5]) - 0.5])
        fine = cv2.warpAffine(sheet, from_centres, (320 * 8, 320 * 8), borderValue=255)
        image = cv2.GaussianBlur(cv2.resize(fine, (320, 320), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
        (sighting,) = boards(spec)[0].detect(image)
        on_sheet = sighting.x_in_body[:, :2] * [1, flip] * px_per_m + origin_px + 100
        errors.append(sighting.x_px - (on_sheet @ rotation.T + middle - 0.5))
    assert np.abs(np.concatenate(errors).mean(0)).max() < limit_px
