"""Capture while it is taken: a video or scripted frames, a simulated arm; commands, faults of the world, the end."""

import errno
import json
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from in_process import run_jcr
from jcr.capture.images import read_image
from jcr.live import robot
from jcr.live.cameras import Frame, open_camera
from jcr.live.folder import LiveFolder
from jcr.live.kept_frames import ImageSummary, frame_at_rest
from jcr.live.robot import MOVED_ON, RobotState, next_rest
from jcr.live.session import Answer, LiveSession, SessionOptions
from refusal import refused
from scripted_capture import RATE, Scripted, a_capture, poses, still, still_frames, take_all, video
from simulation.ur import SimulatedUr

Step = int | tuple
"""An image to take, or a command with its arguments."""


class Stepped:
    """A capture that is driven from a test, an image or a command at a time; each is calibrated before the next."""

    def __init__(self, folder: Path, tabletop: Path, has_gripper: bool = True, **options) -> None:
        self.poses = list(jcr.read_capture(tabletop).base_from_gripper)
        self.at = 0
        self.heard: list[tuple[Answer, list[str]]] = []
        self.session, self.scripted = a_capture(
            folder, still_frames(lambda: still(tabletop, self.at)),
            lambda answer, lines: self.heard.append((answer, lines)),
            (lambda: RobotState(0.0, self.poses[self.at])) if has_gripper else None, **options,
        )  # fmt: skip
        self.folder = self.session.folder

    def run(self, steps: list[Step]) -> list[tuple[Answer, list[str]]]:
        """Go to images and give commands, then end the session; return all that was told."""

        def source() -> None:
            for step in steps:
                if isinstance(step, tuple):
                    self.session.press(*step)
                else:
                    self.at = step
                    self.session.take(RobotState(0.0, self.poses[step]), waits=True)

        self.session.run(source)
        return self.heard


def frames_in(folder: Path) -> list[str]:
    return [frame["image"] for frame in json.loads((folder / "capture.json").read_text())["frames"]]


def test_a_capture_ends_by_itself_when_it_is_accurate(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop, accurate_from=8, until_accurate=True)
    heard = taken.run([*range(10)])
    done = taken.session.state.result
    assert done is not None and taken.session.finish() is done
    assert len(taken.folder.names) == 8
    met = [answer["calibration"]["requirement_met"] for answer, _ in heard if "calibration" in answer]
    assert met[-8:] == 7 * [False] + [True]


def test_commands_take_retake_remove_and_undo(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop, has_gripper=False)
    retake, removed, undo = ("retake", 2), ("remove", 1), ("undo",)
    heard = taken.run([0, 1, 2, retake, undo, retake, 3, ("remove", 9), removed, undo, undo])
    said = [line for _, lines in heard for line in lines]
    # Nothing is removed before its replacement is there.
    waits, kept = "the next image replaces images/002.png", "images/002.png is kept"
    assert [line for line in said if "002" in line and line != "kept images/002.png"] == [
        waits, kept, waits, "kept images/004.png in place of images/002.png",
    ]  # fmt: skip
    assert any(answer.get("reason") == "there is no image 9" for answer, _ in heard)
    assert ({"images": ["images/003.png", "images/004.png"]}, ["removed images/001.png"]) in heard
    assert frames_in(tmp_path / "c") == ["images/001.png", "images/002.png", "images/003.png"]
    taken.scripted.close()
    left = sorted(file.name for file in (tmp_path / "c" / "images").iterdir())
    assert left == ["001.png", "002.png", "003.png"]


def test_the_changes_of_a_closed_capture_cannot_be_undone(tmp_path: Path, tabletop: Path):
    """Their images are deleted: an undone removal would name a file that is not there."""
    folder = LiveFolder(tmp_path / "c")
    name = folder.add(still(tabletop, 0), poses(tabletop)[0])
    folder.remove(name)
    folder.close()
    assert not folder.can_undo and not folder.undo() and frames_in(tmp_path / "c") == []


def test_joints_that_some_images_lack_are_not_written(tmp_path: Path, tabletop: Path):
    folder = LiveFolder(tmp_path / "c")
    for k, joints in enumerate(([0.1] * 6, None)):
        folder.add(still(tabletop, k), poses(tabletop)[k], joints=joints)
        frames = json.loads((tmp_path / "c" / "capture.json").read_text())["frames"]
        assert ["joints" in frame for frame in frames] == [[True], [False, False]][k]


def test_a_connection_that_fails_during_retake_does_not_end_the_capture(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop)

    is_lost = iter(
        [False, True, True, False]
    )  # after the first image, at both commands, after the last image

    def read() -> RobotState:
        if next(is_lost):
            raise jcr.InputError("--poses ur:192.168.0.2:30003: silent for 5 s")
        return RobotState(0.0, taken.poses[taken.at])

    taken.session._gripper = read
    heard = taken.run([0, ("retake",), ("take",), 1])
    reasons = [answer["reason"] for answer, _ in heard if "reason" in answer]
    assert len(reasons) == 2 and all("silent for 5 s" in reason for reason in reasons)
    assert frames_in(tmp_path / "c") == ["images/002.png"]


def test_requests_and_commands_of_several_threads_come_one_after_the_other(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop)
    answers: list[Answer] = []

    def source() -> None:
        # All of them are at the same place: one image is kept, whoever comes first.
        state = RobotState(0.0, taken.poses[0])
        with ThreadPoolExecutor(8) as threads:
            for _ in range(4):
                threads.submit(lambda: answers.append(taken.session.take(state)))
                threads.submit(taken.session.press, "take")

    taken.session.run(source)
    assert frames_in(tmp_path / "c") == ["images/001.png"]
    assert all("where images/001.png" in one["reason"] for one in answers if not one["accepted"])


def test_an_arm_that_moves_while_the_image_is_taken_is_named(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop)
    moved = taken.poses[0].copy()
    moved[0, 3] += 1e-3
    taken.session._gripper = lambda: RobotState(0.0, moved)
    answer = taken.session.take(RobotState(0.0, taken.poses[0]))
    assert "moved" in answer["reason"] and not (tmp_path / "c" / "capture.json").exists()


def test_a_full_disk_refuses_the_image_alone(tmp_path: Path, tabletop: Path, monkeypatch: pytest.MonkeyPatch):
    taken = Stepped(tmp_path / "c", tabletop)
    full = OSError(errno.ENOSPC, "No space left on device")
    real, files = LiveFolder._write, []

    def write(self: LiveFolder, images) -> None:
        if len(images) == 2 and not files:
            files.append(sorted(file.name for file in (self.folder / "images").iterdir()))
            raise full
        real(self, images)

    monkeypatch.setattr(LiveFolder, "_write", write)
    heard = taken.run([0, 1, 1, 2])
    assert [answer["reason"] for answer, _ in heard if "reason" in answer] == [
        "the image cannot be written (No space left on device); free the disk and take it again"
    ]
    assert files == [["001.png", "002.png"]] and len(frames_in(tmp_path / "c")) == 3
    # Neither does a calibration that cannot write its files end the capture.
    again = Stepped(tmp_path / "d", tabletop)
    again.scripted.fault = full
    heard = again.run([0, 1])
    assert any("No space left" in lines[0] for answer, lines in heard) and len(again.folder.names) == 2


@pytest.mark.parametrize(("camera", "why"), [
    (lambda first, k: first, "stream frozen"),
    (lambda first, k: cv2.resize(np.roll(first, 9, 0), (320, 160)), "c of 640x480; set its old resolution"),
    (lambda first, k: np.roll(first, 9, 0)[: 480 - k % 2], "size of the camera's images changes"),
])  # fmt: skip
def test_a_camera_that_repeats_or_changes_its_size_is_named(tmp_path, tabletop, camera, why):
    first, poses = still(tabletop, 0), list(jcr.read_capture(tabletop).base_from_gripper)

    def frames() -> Iterator[Frame]:
        for k in range(100):
            image = camera(first, k) if (tmp_path / "c" / "capture.json").exists() else first
            yield Frame(image, 0.25 * k)

    session, _ = a_capture(tmp_path / "c", frames(), patience=1.0)
    kept, refused = take_all(session, poses[:2])
    assert kept["accepted"] and not refused["accepted"] and why in refused["reason"]
    assert frames_in(tmp_path / "c") == ["images/001.png"]


def test_poses_that_stop_end_the_capture_in_one_line_with_all_that_was_taken(tmp_path: Path, tabletop: Path):
    poses = list(jcr.read_capture(tabletop).base_from_gripper)
    session, scripted = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, 0)))

    def source() -> None:
        session.take(RobotState(0.0, poses[0]))
        raise jcr.InputError("--poses ur:192.168.0.2:30003: silent for 5 s")

    with refused("silent"):
        session.run(source)
    scripted.close()
    assert frames_in(tmp_path / "c") == ["images/001.png"]
    resumed, _ = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, 1)))
    take_all(resumed, poses[1:2])
    assert frames_in(tmp_path / "c") == ["images/001.png", "images/002.png"]


def taken(folder: Path, camera: Path, poses: list[ndarray], **options) -> list[dict]:
    """The answers to requests at these poses."""
    scripted: Any = Scripted(LiveFolder(folder))
    with open_camera(str(camera)) as opened:
        return take_all(LiveSession(scripted, opened, SessionOptions(**options)), poses)


def close_to(image: ndarray, other: ndarray) -> bool:
    return bool(np.abs(image.astype(float) - other).mean() < 4)


def test_each_pose_gets_the_image_still_there_and_a_stopped_capture_resumes(tmp_path: Path, tabletop: Path):
    pose = poses(tabletop)
    first = taken(tmp_path / "c", video(tmp_path / "a.avi", tabletop, range(3)), pose[:3])
    assert [answer["image"] for answer in first] == [f"images/00{k}.png" for k in range(1, 4)]
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


def test_a_capture_without_an_image_ends_with_the_reason(tmp_path, tabletop: Path, monkeypatch):
    swings = video(tmp_path / "a.avi", tabletop, range(5), rest_s=0)
    monkeypatch.setattr(LiveSession, "run", lambda self: self.take(RobotState(0.0, np.eye(4))))
    ended = run_jcr("capture", tmp_path / "c", "--camera", swings)
    assert ended.returncode == 2 and ended.stdout == ""
    assert "no image was kept: the video has ended; an image needs two" in ended.stderr.splitlines()[-1]


@pytest.mark.parametrize(("spoil", "words"), [
    (lambda image, k: np.roll(image, 3 * k, axis=1), "not still"),
    (lambda image, k: cv2.GaussianBlur(image, (0, 0), 8), "blurred"),
    (lambda image, k: image // 64, "nearly black"),
])  # fmt: skip
def test_an_image_that_moves_is_blurred_or_dark_is_refused(tabletop: Path, spoil, words: str):
    rng, image = np.random.default_rng(0), still(tabletop, 0)
    noisy = [np.clip(image + rng.normal(0, 10, image.shape), 0, 255).astype(np.uint8) for _ in range(10)]
    sharp = frame_at_rest(iter(Frame(one, k / RATE) for k, one in enumerate(noisy)), [], 5.0)
    assert not isinstance(sharp, str), "noise of a cheap sensor is no motion"
    spoiled = (Frame(spoil(still(tabletop, 1), k), k / RATE) for k in range(40))
    assert words in str(frame_at_rest(spoiled, [ImageSummary.of(sharp.image)], 2.0))


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


def test_an_arm_whose_clock_is_set_back_rests_again_half_a_second_later():
    times = [10.0, 10.2, *(0.1 * k for k in range(10))]
    found = next_rest(lambda: (RobotState(time_s, np.eye(4)) for time_s in times), None, MOVED_ON)
    assert found.time_s == 0.5


def test_what_is_no_ur_robot_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(robot, "UR_TIMEOUT_S", 0.2)
    server = socket.create_server(("127.0.0.1", 0))
    states = lambda: robot.ur_states("127.0.0.1", server.getsockname()[1])  # noqa: E731
    with refused("silent"):
        next(states())

    def greet() -> None:
        for _ in range(2):  # the first connection is the one that gave up
            connection, _ = server.accept()
            connection.sendall(b"HTTP/1.1 400 Bad Request")
            connection.close()

    thread, closed = threading.Thread(target=greet), states()
    thread.start()
    with refused("no packet of a UR"):
        next(states())
    thread.join(5)
    server.close()
    with refused("check the address"):
        next(closed)
