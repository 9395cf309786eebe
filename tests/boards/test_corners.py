"""Corners of a board beside the features of a reconstruction."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr.boards import corners
from jcr.boards.detection import Board, Sighting, boards, is_of_unknown_size, side_of
from jcr.calibration.stage import calibrate_reconstruction
from jcr.camera import project
from jcr.findings import FindingKind, sentence
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Capture, Reconstruction
from jcr.records.npz import read_reconstruction, write_reconstruction
from simulation.faults import Faults, FaultyCapture, faulty_capture, reconstructed

pytestmark = pytest.mark.slow

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


def test_a_board_that_was_moved_is_used_where_most_images_show_it_and_the_others_are_named(
    monkeypatch: pytest.MonkeyPatch,
):
    capture, made, _ = with_board(monkeypatch, [0] * 6 + [1] * 3)
    boards = made.tracks.boards
    assert boards is not None and boards.elsewhere == (6, 7, 8)
    hand_eye = calibrate_reconstruction(capture, made)
    (named,) = (one for one in hand_eye.findings if one.kind is FindingKind.BOARD_MOVED)
    assert named.images == (
        "06.png",
        "07.png",
        "08.png",
    ) and "it was moved, the robot holds it, or there are two" in sentence(named)
    assert hand_eye.converged and hand_eye.board is not None
    assert hand_eye.board.images == 6


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


def test_a_board_of_unknown_side_has_its_side_as_unit():
    assert is_of_unknown_size("chessboard:9x6:SIDE") and not is_of_unknown_size(SPEC)
    assert side_of("chessboard:9x6:SIDE") == side_of("apriltag:SIDE:36h11") == 1.0
    assert (
        side_of("charuco:7x5:0.030:0.022:DICT_4X4_50") == 0.03 and side_of("aruco:0.05:DICT_4X4_50") == 0.05
    )
    readings = boards("charuco:7x5:SIDE:MARKER:DICT_4X4_50")
    assert all(isinstance(one, Board) for one in readings)
    assert {one.name.split(":")[3].split()[0] for one in readings} == {"0.75", "0.7", "0.8", "0.6", "0.5"}
