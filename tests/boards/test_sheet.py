"""Printed boards: found whole at their size, proposed where none is named, their corners beside the features."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray

from in_process import run_jcr
from jcr.boards import corners
from jcr.boards.detection import Sighting, boards
from jcr.boards.proposal import board_in_view
from jcr.boards.sheet import PAPERS_MM, as_pdf, board_sheet
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.camera import project
from jcr.findings import FindingKind, sentence
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Capture, Reconstruction
from jcr.records.reconstruction_npz import read_reconstruction, write_reconstruction
from refusal import refused
from simulation.faults import Faults, FaultyCapture, faulty_capture, reconstructed

pytestmark = pytest.mark.slow


def mm_of_page(data: bytes) -> tuple[ndarray, ndarray]:
    """Width and height (mm) of the page of a PDF, and of the image on it."""
    paper = re.search(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]", data)
    image = re.search(rb"q (\S+) 0 0 (\S+) 0 0 cm /image Do Q", data)
    assert paper and image
    return tuple(
        25.4 / 72 * np.array([float(number) for number in found.groups()]) for found in (paper, image)
    )


@pytest.mark.parametrize(
    "spec", ["charuco:8x5:0.030:0.022:DICT_4X4_50", "charuco:7x5:0.031:0.0233:DICT_5X5_50"]
)
def test_a_printed_board_is_found_whole_and_at_its_size(spec: str):
    pixels, px_per_mm = board_sheet(spec)
    paper, image = mm_of_page(as_pdf(pixels, px_per_mm))
    np.testing.assert_allclose(paper, (297, 210), atol=0.03)
    np.testing.assert_allclose(image, np.array(pixels.size) / px_per_mm, atol=1e-3)
    grey = cv2.resize(
        255 * np.asarray(pixels, np.uint8), None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA
    )
    (sighting,) = boards(spec)[0].detect(grey)
    x_mm = 3 * (sighting.x_px + 0.5) / px_per_mm
    expected = 1e3 * sighting.x_in_body[:, :2]
    across, down = (int(text) for text in spec.split(":")[1].split("x"))
    assert len(x_mm) == (across - 1) * (down - 1)
    # The board's own frame and the paper's have the same axes, up to where they begin.
    assert np.allclose(x_mm - x_mm.mean(0), expected - expected.mean(0), atol=0.05)


@pytest.mark.parametrize(("spec", "words"), [
    ("charuco:12x8:0.030:0.022:DICT_4X4_50", "360 x 240 mm, but a4 has room for"),
    ("charuco:12x9:0.020:0.015:DICT_4X4_50", "need 54 markers, but DICT_4X4_50 has 50; choose DICT_4X4_100"),
    ("apriltag:0.050:36h11", "prints charuco"),
    ("charuco:7x5:30:22:DICT_4X4_50", "30 mm is 0.030"),
])  # fmt: skip
def test_what_cannot_be_printed_is_one_line(spec: str, words: str):
    with refused(words):
        board_sheet(spec)


def test_the_command_writes_the_file_and_names_the_option(tmp_path: Path):
    done = run_jcr("board", tmp_path / "b.pdf")
    assert done.returncode == 0 and "--board charuco:8x5:0.030:0.022:DICT_4X4_50" in done.stdout
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")


PX_PER_MM = 5


def seen(spec: str, views: int = 3) -> list[ndarray]:
    """Photographs of the printed sheet, each from another direction."""
    printed, _ = board_sheet(spec)
    width, height = (round(PX_PER_MM * side) for side in PAPERS_MM["a4"])
    paper = np.where(np.asarray(printed.convert("L").resize((width, height))) > 127, 245, 15).astype(np.uint8)
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    photographs = []
    for _ in range(views):
        moved = corners * 0.5 + np.array([60.0, 60.0]) + rng.uniform(-40, 40, (4, 2))
        warp = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
        image = cv2.warpPerspective(paper, warp, (900, 700), flags=cv2.INTER_AREA, borderValue=120)
        photographs.append(cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.COLOR_GRAY2RGB))
    return photographs


@pytest.mark.parametrize(("printed", "found"), [
    ("charuco:8x5:0.030:0.022:DICT_4X4_50", "aruco:SIDE:DICT_4X4_50"),
    ("chessboard:8x5:0.027", "chessboard:8x5:SIDE"),
])  # fmt: skip
def test_a_board_is_recognised(printed: str, found: str):
    assert board_in_view(seen(printed)) == found


def test_single_tags_are_recognised():
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    scene = np.full((700, 900), 200, np.uint8)
    for k in range(3):
        scene[250:410, 100 + 250 * k : 260 + 250 * k] = cv2.aruco.generateImageMarker(tags, 5 + k, 160)
    images = [np.roll(cv2.cvtColor(scene, cv2.COLOR_GRAY2RGB), shift, axis=1) for shift in (0, 20, -30)]
    assert board_in_view(images) == "apriltag:SIDE:36h11"


def test_a_table_without_a_board_is_none(tabletop):
    images = [
        cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in sorted(tabletop.glob("images/*"))
    ]
    assert board_in_view(images) is None


SPEC = "chessboard:9x6:0.025"
GRID = np.column_stack(
    [0.025 * np.stack(np.meshgrid(np.arange(9.0), np.arange(6.0)), -1).reshape(-1, 2), np.zeros(54)]
)
PLACES = (
    transform(rotation_exp(np.array([0.0, 0.0, 0.3])), np.array([0.42, -0.06, 0.005])),
    transform(rotation_exp(np.array([0.0, 0.0, 0.5])), np.array([0.36, 0.02, 0.005])),
)


def seen_at(found: FaultyCapture, place_of_image: list[int]) -> list[list[Sighting]]:
    """The corners in each image, of a board at one of the places; -1: it is not in view."""
    rng, sightings = np.random.default_rng(0), list[list[Sighting]]()
    for camera, place in zip(found.base_from_camera, place_of_image, strict=True):
        x_px = project(found.intrinsics, apply(inverse(camera) @ PLACES[place], GRID))
        x_px += 0.1 * rng.normal(size=x_px.shape)
        sightings.append([] if place < 0 else [Sighting(0, tuple(range(54)), GRID, x_px)])
    return sightings


def with_board(
    monkeypatch: pytest.MonkeyPatch, place_of_image: list[int]
) -> tuple[Capture, Reconstruction, FaultyCapture]:
    found = faulty_capture(np.random.default_rng(4), len(place_of_image), Faults())
    capture, reconstruction = reconstructed(found, estimated=False)
    sightings = seen_at(found, place_of_image)
    monkeypatch.setattr(corners, "read_image", lambda path: np.zeros((480, 640, 3), np.uint8))
    monkeypatch.setattr(corners, "most_seen", lambda readings, images: (readings[0], sightings))
    return capture, corners.with_boards(capture, reconstruction, SPEC), found


def test_corners_are_tracks_of_a_board_and_survive_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    _, made, found = with_board(monkeypatch, [0] * 7 + [-1])
    boards = made.tracks.boards
    assert boards is not None and boards.side == 0.025 and boards.elsewhere == ()
    (body,) = boards.bodies
    assert np.bincount(made.tracks.point)[body.point].tolist() == [7] * 54
    assert np.abs(made.tracks.points_in_recon[body.point] - apply(PLACES[0], GRID)).max() < 5e-3
    write_reconstruction(tmp_path / "r.npz", made)
    again = read_reconstruction(tmp_path / "r.npz").tracks
    assert again.boards is not None and again.boards.spec == SPEC and again.boards.size_std == 0.002
    assert np.array_equal(again.boards.bodies[0].point, body.point)
    assert np.array_equal(again.boards.bodies[0].x_in_body, body.x_in_body)
    assert np.array_equal(again.on_board, made.tracks.on_board) and found.tracks.boards is None


def test_a_moved_board_is_used_where_most_images_show_it_the_others_named(monkeypatch: pytest.MonkeyPatch):
    capture, made, _ = with_board(monkeypatch, [0] * 6 + [1] * 3)
    boards = made.tracks.boards
    assert boards is not None and boards.elsewhere == (6, 7, 8)
    hand_eye = calibrate_reconstruction(capture, made)
    (named,) = (one for one in hand_eye.findings if one.kind is FindingKind.BOARD_MOVED)
    assert named.images == ("06.png", "07.png", "08.png")
    assert "it was moved, the robot holds it, or there are two" in sentence(named)
    assert hand_eye.converged and [one.name for one in hand_eye.lengths] == ["board"]


def test_a_board_that_no_image_shows_is_named_and_features_alone_are_used(monkeypatch: pytest.MonkeyPatch):
    capture, made, found = with_board(monkeypatch, [-1] * 8)
    hand_eye = calibrate_reconstruction(capture, made)
    alone = calibrate_reconstruction(*reconstructed(found, estimated=False))
    assert np.array_equal(hand_eye.gripper_from_camera, alone.gripper_from_camera)
    (named,) = (one for one in hand_eye.findings if one.kind is FindingKind.BOARD_NOT_FOUND)
    assert named.severity == "warns" and SPEC in sentence(named)
    boards = made.tracks.boards
    assert boards is not None
    proposed = replace(made.tracks, boards=replace(boards, proposed="aruco:SIDE:X"))
    warnings = calibrate_reconstruction(capture, replace(made, tracks=proposed)).warnings
    assert any("seem to show aruco:SIDE:X" in text for text in warnings)
