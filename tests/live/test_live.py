"""Taking a capture live: a video file for the camera, a client or a simulated robot for the poses."""

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from jcr.capture.images import read_image
from jcr.live import line_server, ur
from jcr.live.asks import Ask, pose_of_numbers
from jcr.live.camera import Frame
from jcr.live.collect import CollectOptions, LiveCapture
from jcr.live.devices import opened
from jcr.live.folder import LiveFolder
from jcr.live.line_server import MAX_LINE, MOST_REFUSED, Listen, bound, served_poses
from jcr.live.look import Look, frame_at_rest
from jcr.live.rest import asks_at_rest
from jcr.live.typed import typed_poses
from places import ROOT
from scripted_capture import Scripted
from simulation.ur import SimulatedUr
from waiting import until

RATE = 10
CLIENT = ROOT / "examples" / "pose_client.py"


def still(tabletop: Path, k: int) -> ndarray:
    return read_image(tabletop / "images" / f"{k:02d}.jpg")


def poses(tabletop: Path) -> list[ndarray]:
    frames = json.loads((tabletop / "capture.json").read_text())["frames"]
    return [np.array(frame["base_from_gripper"]) for frame in frames]


def video(path: Path, tabletop: Path, images: range, rest_s: int = 1) -> Path:
    """The arm rests for a while before each image and swings for half a second in between."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (640, 480))
    for k in images:
        rgb = still(tabletop, k)
        for step in range(5):
            shift = np.array([[1, 0, 40.0 * (5 - step)], [0, 1, 0]])
            writer.write(cv2.warpAffine(rgb, shift, (640, 480), borderMode=cv2.BORDER_WRAP)[..., ::-1])
        for _ in range(RATE * rest_s):
            writer.write(np.ascontiguousarray(rgb[..., ::-1]))
    writer.release()
    return path


def taken(folder: Path, camera: Path, asks: Iterator[Ask], **options) -> list[dict]:
    """The answers to requests."""
    answers: list[dict] = []
    scripted: Any = Scripted(LiveFolder(folder))
    with opened(str(camera)) as opened_camera:
        capture = LiveCapture(
            scripted, opened_camera, CollectOptions(**options), lambda answer, lines: answers.append(answer)
        )
        capture.run(asks)
    return [answer for answer in answers if "accepted" in answer]


def close_to(image: ndarray, other: ndarray) -> bool:
    return bool(np.abs(image.astype(float) - other).mean() < 4)


def test_each_pose_gets_the_image_that_was_still_there_and_a_stopped_capture_is_resumed(
    tmp_path: Path, tabletop: Path
):
    pose = poses(tabletop)
    first = taken(tmp_path / "c", video(tmp_path / "a.avi", tabletop, range(3)), map(Ask, pose[:3]))
    assert [answer["image"] for answer in first] == [f"images/00{k}.png" for k in range(3)]
    file = tmp_path / "c" / "capture.json"
    content = json.loads(file.read_text()) | {
        "remark": "mine",
        "intrinsics": {"fx": 600, "fy": 600, "cx": 320, "cy": 240},
    }
    file.write_text(json.dumps(content))
    more = taken(
        tmp_path / "c", video(tmp_path / "b.avi", tabletop, range(3, 6)), map(Ask, pose[3:6]), images=5
    )
    assert [answer["done"] for answer in more] == [False, True]
    assert json.loads(file.read_text())["remark"] == "mine"
    capture = jcr.read_capture(tmp_path / "c")
    assert len(capture) == 5 and capture.intrinsics is not None
    for k, name in enumerate(capture.images):
        assert close_to(read_image(capture.folder / name), still(tabletop, k))
        assert np.allclose(capture.base_from_gripper[k], pose[k])


def test_a_frozen_stream_the_same_place_and_the_end_of_the_video_are_named(tmp_path: Path, tabletop: Path):
    pose = poses(tabletop)
    file = video(tmp_path / "a.avi", tabletop, range(1), rest_s=2)
    answers = taken(tmp_path / "c", file, map(Ask, [pose[0], pose[0], pose[1], pose[2]]), patience=0.8)
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
    assert words in str(frame_at_rest(spoiled, [Look.of(sharp.image)], 2.0))


def test_noise_of_a_cheap_sensor_is_no_motion(tabletop: Path):
    rng = np.random.default_rng(0)
    image = still(tabletop, 0)
    noisy = (
        Frame(np.clip(image + rng.normal(0, 10, image.shape), 0, 255).astype(np.uint8), k / RATE)
        for k in range(10)
    )
    assert not isinstance(frame_at_rest(noisy, [], 1.0), str)


class Client:
    """What a user's program would send."""

    def __init__(self, port: int):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        self.lines = self.socket.makefile("rw")

    def ask(self, line: object) -> dict:
        self.lines.write((line if isinstance(line, str) else json.dumps(line)) + "\n")
        self.lines.flush()
        return json.loads(self.lines.readline())

    def close(self) -> None:
        self.lines.close()
        self.socket.close()


@contextmanager
def serving(listen: Listen) -> Iterator[tuple[int, list[Ask]]]:
    """A server whose requests are all granted."""
    server, heard = bound(listen), []

    def serve() -> None:
        for ask in served_poses(server, listen):
            heard.append(ask)
            ask.answer({"accepted": True})

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield server.getsockname()[1], heard
    finally:
        with socket.create_connection(server.getsockname()) as last:
            token = json.dumps({"token": listen.token}) + "\n" if listen.token else ""
            last.sendall((token + '{"done": true}\n').encode())
            thread.join(20)
        server.close()
        assert not thread.is_alive()


def test_bad_lines_are_answered_and_bad_clients_dropped(tabletop: Path):
    pose = poses(tabletop)[0]
    with serving(Listen(port=0, timeout_s=20.0)) as (port, heard):
        client = Client(port)
        for line, words in (
            ("hello", "not JSON"),
            ([1, 2], "not a JSON object"),
            ({"pose": 1}, 'no "base_from_gripper"'),
            ({"base_from_gripper": "here"}, "not numbers"),
            ({"base_from_gripper": (pose * 2).tolist()}, "last row"),
            ({"base_from_gripper": [400, 0, 500, 0, 0, 0]}, "millimetres"),
            ({"base_from_gripper": [0.4, 0, 0.5, 0, 0, float("nan")]}, "NaN"),
            ("[" * 50_000, "not JSON"),
        ):
            answer = client.ask(line)
            assert answer["accepted"] is False and words in answer["reason"], line
        assert client.ask({"base_from_gripper": pose.tolist()}) == {"accepted": True}
        assert "more than" in client.ask("x" * (MAX_LINE + 10))["reason"]
        client.close()
        again = Client(port)
        assert again.ask({"base_from_gripper": [0.4, 0, 0.5, 0, np.pi, 0]}) == {"accepted": True}
        again.close()
    assert len(heard) == 2 and np.allclose(heard[0].base_from_gripper, pose)
    assert np.allclose(heard[1].base_from_gripper[:3, :3], np.diag([-1, 1, -1]))


def test_others_need_the_token(tabletop: Path):
    with pytest.raises(jcr.InputError, match="token"):
        bound(Listen("0.0.0.0", 0))
    with serving(Listen(port=0, token="sesame", timeout_s=20.0)) as (port, heard):
        wrong = {"token": "wrong"}, {"token": "\ud800"}
        for line in (*wrong, {"base_from_gripper": poses(tabletop)[0].tolist()}, {"done": True}):
            stranger = Client(port)
            assert stranger.ask(line)["accepted"] is False
            assert stranger.lines.readline() == ""
            stranger.close()
        friend = Client(port)
        assert friend.ask({"token": "sesame"}) == {"accepted": True}
        assert friend.ask({"base_from_gripper": poses(tabletop)[0].tolist()}) == {"accepted": True}
        friend.close()
    assert len(heard) == 1


def test_a_client_that_drips_or_floods_is_dropped_and_others_are_served(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("jcr.live.line_server.LINE_S", 0.4)
    received = [bytearray()]

    def watched(client: socket.socket, buffer: bytearray, patience_s: float) -> bytes:
        received.append(buffer)
        return line(client, buffer, patience_s)

    line = line_server._line
    monkeypatch.setattr(line_server, "_line", watched)
    with serving(Listen(port=0, timeout_s=20.0)) as (port, heard):
        with socket.create_connection(("127.0.0.1", port), timeout=20) as dripping:
            begun = time.monotonic()
            with pytest.raises(OSError):
                while time.monotonic() - begun < 10:
                    dripping.sendall(b" ")
                    time.sleep(0.1)
            assert time.monotonic() - begun < 5
        flooding = Client(port)
        answers = [flooding.ask({"pose": k}) for k in range(MOST_REFUSED)]
        assert not any(answer["accepted"] for answer in answers)
        assert "in a row were refused" in flooding.ask({"pose": 0})["reason"]
        assert flooding.lines.readline() == ""
        flooding.close()
        friend = Client(port)
        half = json.dumps({"base_from_gripper": [0.4, 0, 0.5, 0, np.pi, 0]})
        friend.socket.sendall(half[:20].encode())
        until(lambda: received[-1] == half[:20].encode())
        assert friend.ask(half[20:]) == {"accepted": True}
        friend.close()
    assert len(heard) == 1


def test_a_silent_client_gives_way_to_one_that_waits_and_alone_it_may_wait(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("jcr.live.line_server.LINE_S", 0.2)
    with serving(Listen(port=0, timeout_s=20.0)) as (port, heard):
        slow = Client(port)
        time.sleep(0.5)
        pose = {"base_from_gripper": [0.4, 0, 0.5, 0, np.pi, 0]}
        assert slow.ask(pose) == {"accepted": True}
        slow.close()
        silent = Client(port)
        friend = Client(port)
        begun = time.monotonic()
        assert friend.ask(pose) == {"accepted": True} and time.monotonic() - begun < 5
        assert "another client waits" in json.loads(silent.lines.readline())["reason"]
        silent.close()
        friend.close()
    assert len(heard) == 2


def test_silence_ends_the_wait():
    listen = Listen(port=0, timeout_s=0.1)
    with bound(listen) as server, pytest.raises(jcr.InputError, match="nobody sent a pose"):
        next(served_poses(server, listen))


@pytest.mark.parametrize("length", [812, 1060, 1220])
def test_a_ur_arm_is_asked_for_wherever_it_rests(tabletop: Path, length: int):
    goals = np.array(poses(tabletop)[:3])
    angles = np.linspace(-1, 1, 18).reshape(3, 6)
    with SimulatedUr(goals, length, angles) as robot:
        asks = asks_at_rest(lambda: ur.states("127.0.0.1", robot.port))
        for goal, joints in zip(goals, angles, strict=True):
            ask = next(asks)
            assert np.allclose(ask.base_from_gripper, goal, atol=1e-9)
            assert ask.joints is not None and np.allclose(ask.joints, joints)
            ask.answer({"accepted": True})
        assert ask.current is not None and np.allclose(ask.current(), goals[2], atol=1e-9)


def test_an_arm_that_moves_while_the_image_is_taken_is_named(tmp_path: Path, tabletop: Path):
    pose = poses(tabletop)
    moved = pose[0].copy()
    moved[0, 3] += 1e-3
    ask = Ask(pose[0], current=lambda: moved)
    (answer,) = taken(tmp_path / "c", video(tmp_path / "a.avi", tabletop, range(1)), iter([ask]))
    assert "moved" in answer["reason"] and not (tmp_path / "c" / "capture.json").exists()


def test_what_is_no_ur_robot_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ur, "TIMEOUT_S", 0.2)
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]
    with pytest.raises(jcr.InputError, match="silent"):
        next(ur.states("127.0.0.1", port))

    def greet() -> None:
        for _ in range(2):  # the first connection is the one that gave up
            connection, _ = server.accept()
            connection.sendall(b"HTTP/1.1 400 Bad Request")
            connection.close()

    thread = threading.Thread(target=greet)
    thread.start()
    with pytest.raises(jcr.InputError, match="not come from a UR"):
        next(ur.states("127.0.0.1", port))
    thread.join(5)
    server.close()
    with pytest.raises(jcr.InputError, match="check the address"):
        next(ur.states("127.0.0.1", port))


def test_poses_are_typed_in_three_ways_and_mistakes_asked_again():
    said: list[str] = []
    lines = ["0.4 0 0.5 0 3.14159265 0", "p[0.4, 0, 0.5, 0]", "abc", "0.4 0 0.5 0 1 0 0", "", "1 2 3"]
    found = [ask.base_from_gripper for ask in typed_poses(iter(lines), said.append)]
    assert len(found) == 2  # nothing after the empty line
    assert np.allclose(found[0], found[1], atol=1e-6)
    assert sum("refused" in text for text in said) == 2
    matrix = pose_of_numbers(found[0].ravel().tolist(), "typed")
    assert np.allclose(matrix, found[0])


def start(out: Path, camera: Path) -> tuple[subprocess.Popen[str], str]:
    """`jcr capture` running, and the port on which it waits for poses."""
    command = [sys.executable, "-m", "jcr", "capture", out, "--camera", camera, "--listen", "127.0.0.1:0"]
    running = subprocess.Popen([str(word) for word in command], stderr=subprocess.PIPE, text=True)
    assert running.stderr is not None
    line = next(line for line in running.stderr if "waiting for poses" in line)
    return running, line.split(":")[-1].strip()


@pytest.mark.slow
def test_an_interrupted_command_goes_on_and_the_example_client_talks_to_it(tmp_path: Path, tabletop: Path):
    out = tmp_path / "c"
    running, port = start(out, video(tmp_path / "a.avi", tabletop, range(1)))
    client = Client(int(port))
    assert client.ask({"base_from_gripper": poses(tabletop)[0].tolist()})["image"] == "images/000.png"
    second = [sys.executable, "-m", "jcr", "capture", str(out), "--camera", str(tmp_path / "a.avi")]
    refused = subprocess.run(second, capture_output=True, text=True, timeout=60)
    assert refused.returncode == 2 and "another jcr is writing there" in refused.stderr.splitlines()[-1]
    running.send_signal(signal.SIGINT)
    printed = running.communicate(timeout=20)[1]
    client.close()
    assert running.returncode == 130
    assert printed.splitlines()[-1].startswith("error: interrupted") and "Traceback" not in printed

    running, port = start(out, video(tmp_path / "b.avi", tabletop, range(1, 4)))
    talked = subprocess.run([sys.executable, CLIENT, port], capture_output=True, text=True, timeout=60)
    printed = running.communicate(timeout=20)[1]
    assert running.returncode == 0, printed
    assert talked.returncode == 0 and talked.stdout.count("images/00") == 3, talked.stdout + talked.stderr
    # From the second image on there is a pose to go to.
    assert "next: [[" in talked.stdout.splitlines()[-1]
    assert jcr.read_capture(out).images == tuple(f"images/00{k}.png" for k in range(4))
