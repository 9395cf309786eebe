"""Taking a capture live: a video file for the camera, a simulated robot for the poses."""

import json
import socket
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from jcr.capture.images import read_image
from jcr.live import robot
from jcr.live.cameras import Frame, ImageSummary, frame_at_rest, open_camera
from jcr.live.folder import LiveFolder
from jcr.live.robot import MOVED_ON, next_rest, pose_of_numbers, typed_poses
from jcr.live.session import LiveSession, SessionOptions
from scripted_capture import RATE, Scripted, poses, still, take_all, video
from simulation.ur import SimulatedUr


def taken(folder: Path, camera: Path, poses: list[ndarray], **options) -> list[dict]:
    """The answers to requests at these poses."""
    scripted: Any = Scripted(LiveFolder(folder))
    with open_camera(str(camera)) as opened:
        return take_all(LiveSession(scripted, opened, SessionOptions(**options)), poses)


def close_to(image: ndarray, other: ndarray) -> bool:
    return bool(np.abs(image.astype(float) - other).mean() < 4)


def test_each_pose_gets_the_image_that_was_still_there_and_a_stopped_capture_is_resumed(
    tmp_path: Path, tabletop: Path
):
    pose = poses(tabletop)
    first = taken(tmp_path / "c", video(tmp_path / "a.avi", tabletop, range(3)), pose[:3])
    assert [answer["image"] for answer in first] == [f"images/00{k}.png" for k in range(3)]
    file = tmp_path / "c" / "capture.json"
    content = json.loads(file.read_text()) | {
        "remark": "mine",
        "intrinsics": {"fx": 600, "fy": 600, "cx": 320, "cy": 240},
    }
    file.write_text(json.dumps(content))
    more = taken(tmp_path / "c", video(tmp_path / "b.avi", tabletop, range(3, 6)), pose[3:6], images=5)
    assert [answer["done"] for answer in more[:2]] == [False, True]
    assert json.loads(file.read_text())["remark"] == "mine"
    capture = jcr.read_capture(tmp_path / "c")
    assert len(capture) == 5 and capture.intrinsics is not None
    for k, name in enumerate(capture.images):
        assert close_to(read_image(capture.folder / name), still(tabletop, k))
        assert np.allclose(capture.base_from_gripper[k], pose[k])


def test_a_frozen_stream_the_same_place_and_the_end_of_the_video_are_named(tmp_path: Path, tabletop: Path):
    pose = poses(tabletop)
    file = video(tmp_path / "a.avi", tabletop, range(1), rest_s=2)
    answers = taken(tmp_path / "c", file, [pose[0], pose[0], pose[1], pose[2]], patience=0.8)
    assert [answer["accepted"] for answer in answers] == [True, False, False, False]
    assert "where images/000.png was taken" in answers[1]["reason"]
    assert "did not change" in answers[2]["reason"] and "ended" in answers[3]["reason"]
    assert len(LiveFolder(tmp_path / "c").names) == 1


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda image, k: np.roll(image, 3 * k, axis=1), "not still"),
        (lambda image, k: cv2.GaussianBlur(image, (0, 0), 8), "blurred"),
        (lambda image, k: image // 64, "nearly black"),
    ],
)
def test_an_image_that_moves_is_blurred_or_dark_is_refused(tabletop: Path, spoil, words: str):
    sharp = frame_at_rest(iter(Frame(still(tabletop, 0), k / RATE) for k in range(10)), [], 5.0)
    assert not isinstance(sharp, str)
    spoiled = (Frame(spoil(still(tabletop, 1), k), k / RATE) for k in range(40))
    assert words in str(frame_at_rest(spoiled, [ImageSummary.of(sharp.image)], 2.0))


def test_noise_of_a_cheap_sensor_is_no_motion(tabletop: Path):
    rng = np.random.default_rng(0)
    image = still(tabletop, 0)
    noisy = (
        Frame(np.clip(image + rng.normal(0, 10, image.shape), 0, 255).astype(np.uint8), k / RATE)
        for k in range(10)
    )
    assert not isinstance(frame_at_rest(noisy, [], 1.0), str)


@pytest.mark.parametrize("length", [812, 1220])
def test_a_ur_arm_is_asked_for_wherever_it_rests(tabletop: Path, length: int):
    goals = np.array(poses(tabletop)[:3])
    angles = np.linspace(-1, 1, 18).reshape(3, 6)
    last = None
    with SimulatedUr(goals, length, angles) as simulated:
        for goal, joints in zip(goals, angles, strict=True):
            state = next_rest(lambda: robot.ur_states("127.0.0.1", simulated.port), last, MOVED_ON)
            last = state.base_from_gripper
            assert np.allclose(last, goal, atol=1e-9)
            assert state.joints is not None and np.allclose(state.joints, joints)


def test_what_is_no_ur_robot_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robot, "UR_TIMEOUT_S", 0.2)
    server = socket.create_server(("127.0.0.1", 0))
    states = lambda: robot.ur_states("127.0.0.1", server.getsockname()[1])  # noqa: E731
    with pytest.raises(jcr.InputError, match="silent"):
        next(states())

    def greet() -> None:
        for _ in range(2):  # the first connection is the one that gave up
            connection, _ = server.accept()
            connection.sendall(b"HTTP/1.1 400 Bad Request")
            connection.close()

    thread, closed = threading.Thread(target=greet), states()
    thread.start()
    with pytest.raises(jcr.InputError, match="not come from a UR"):
        next(states())
    thread.join(5)
    server.close()
    with pytest.raises(jcr.InputError, match="check the address"):
        next(closed)


def test_poses_are_typed_in_three_ways_and_mistakes_asked_again():
    said: list[str] = []
    lines = ["0.4 0 0.5 0 3.14159265 0", "p[0.4, 0, 0.5, 0]", "abc", "0.4 0 0.5 0 1 0 0", "", "1 2 3"]
    found = list(typed_poses(iter(lines), said.append))
    assert len(found) == 2  # nothing after the empty line
    assert np.allclose(found[0], found[1], atol=1e-6)
    assert sum("refused" in text for text in said) == 2
    matrix = pose_of_numbers(found[0].ravel().tolist(), "typed")
    assert np.allclose(matrix, found[0])
