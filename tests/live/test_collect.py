"""A capture while it is taken: when it ends, what commands do to it, and what it does with faults of the world."""

import errno
import json
import queue
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from jcr.capture.images import read_image
from jcr.live.asks import Answer, Ask
from jcr.live.camera import Frame
from jcr.live.commands import Command, command_of, without_commands
from jcr.live.folder import LiveFolder
from jcr.live.rest import State, asks_at_rest
from scripted_capture import a_capture, asked, still_frames
from waiting import until


def still(tabletop: Path, k: int) -> ndarray:
    return read_image(tabletop / "images" / f"{k:02d}.jpg")


class Stepped:
    """A capture that is driven from a test, an image or a command at a time; each is waited for."""

    def __init__(self, folder: Path, tabletop: Path, has_gripper: bool = True, **options) -> None:
        self.poses = list(jcr.read_capture(tabletop).base_from_gripper)
        self.tabletop, self.at = tabletop, 0
        self.printed: queue.SimpleQueue[tuple[Answer, list[str]]] = queue.SimpleQueue()
        self.capture, self.scripted = a_capture(
            folder,
            still_frames(lambda: still(tabletop, self.at)),
            lambda answer, lines: self.printed.put((answer, lines)),
            (lambda: State(0.0, self.poses[self.at])) if has_gripper else None,
            **options,
        )
        self.live = self.capture.live

    def run(self, steps: list[int | Command]) -> list[tuple[Answer, list[str]]]:
        """Go to images and give commands, each when what came before it is calibrated; then finish."""
        heard: list[tuple[Answer, list[str]]] = []

        def asks() -> Iterator[Ask]:
            for step in steps:
                if isinstance(step, Command):
                    self.capture.press(step)
                else:
                    self.at = step
                    yield Ask(self.poses[step])
                while True:
                    heard.append(self.printed.get(timeout=20))
                    answer = heard[-1][0]
                    if "calibration" in answer or answer.get("accepted") is False or "retake" in answer:
                        break

        self.capture.run(asks())
        return heard


def frames_in(folder: Path) -> list[str]:
    return [frame["image"] for frame in json.loads((folder / "capture.json").read_text())["frames"]]


def test_a_capture_ends_by_itself_when_it_is_accurate(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop, accurate_from=4, until_accurate=True)
    heard = taken.run([0, 1, 2, 3, 4])
    done = taken.capture.shown.result
    assert done is not None and taken.capture.finish() is done
    # The next image may come before the end is known.
    assert len(taken.live.names) in (4, 5)
    accurate = [answer["calibration"]["requirement_met"] for answer, _ in heard if "calibration" in answer]
    assert accurate[:4] == 3 * [False] + [True]


def test_commands_are_distinguished_from_poses():
    assert command_of("retake") == Command("retake") and command_of("rem 3") == Command("remove", 3)
    assert command_of("FINISH\n") == Command("finish") and command_of("undo") == Command("undo")
    lines = ("", "0.4 0 0.5 0 0 0", "re", "remove it", "finish 1", "undo 2", "take 1", "retake ²")
    assert all(command_of(line) is None for line in lines)
    pressed: list[Command] = []
    assert list(without_commands(["1 2", "remove 2", "3 4"], pressed.append)) == ["1 2", "3 4"]
    assert pressed == [Command("remove", 2)]


def test_commands_take_retake_remove_and_undo(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop, has_gripper=False)
    heard = taken.run([0, 1, 2, Command("retake", 2), 3, Command("remove", 9), Command("remove", 1)])
    assert ({"retake": "images/001.png"}, ["the next image replaces images/001.png"]) in heard
    assert any(answer.get("reason") == "there is no image 9" for answer, _ in heard)
    # The image that replaces comes last, as all are in the order of taking.
    assert frames_in(tmp_path / "c") == taken.live.names == ["images/002.png", "images/003.png"]
    taken.capture.press(Command("undo"))
    taken.capture.press(Command("undo"))
    for _ in range(2):
        taken.capture._handle(taken.capture._events.get())
    assert frames_in(tmp_path / "c") == ["images/000.png", "images/001.png", "images/002.png"]
    taken.scripted.close()
    assert sorted(file.name for file in (tmp_path / "c" / "images").iterdir()) == [
        "000.png",
        "001.png",
        "002.png",
    ]


def test_take_and_retake_read_where_the_gripper_is(tmp_path: Path, tabletop: Path):
    taken = Stepped(tmp_path / "c", tabletop)
    heard = taken.run([0, Command("retake")])
    assert taken.capture.shown.images == ("images/001.png",) and taken.capture.shown.replaces is None
    assert heard[-1][0]["retake"] == "images/000.png"
    assert np.allclose(taken.live.poses[0], taken.poses[0])
    typed = Stepped(tmp_path / "d", tabletop, has_gripper=False)
    assert "give the pose" in typed.run([Command("take")])[-1][1][0]


def test_a_program_whose_pose_is_refused_is_answered_with_another_next_pose(tmp_path: Path, tabletop: Path):
    """Else it would be sent to the same place for ever."""
    poses, answers = list(jcr.read_capture(tabletop).base_from_gripper), []

    def asks() -> Iterator[Ask]:
        for ask in asked(poses[:2], answers, waits=True):
            yield ask
            until(lambda: len(answers) > 0)

    capture, _ = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, 0)), patience=0.5)
    capture.run(asks())
    kept, refused = answers
    assert kept["accepted"] and not refused["accepted"] and "did not change" in refused["reason"]
    # The scripted calibration proposes joints by which the refused pose is known.
    assert kept["next_joints"] is None and np.allclose(refused["next_joints"], poses[1][:3, 3])


@pytest.mark.slow
def test_a_program_that_sends_poses_is_answered_with_the_calibration(tmp_path: Path, tabletop: Path):
    poses, at, answers = list(jcr.read_capture(tabletop).base_from_gripper), [-1], []

    def asks() -> Iterator[Ask]:
        for ask in asked(poses[:4], answers, waits=True):
            at[0] += 1
            yield ask
            until(lambda: len(answers) > at[0])

    capture, _ = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, at[0])), images=4)
    capture.run(asks())
    assert [answer["done"] for answer in answers] == [False, False, False, True]
    assert [answer["image"] for answer in answers] == [f"images/00{k}.png" for k in range(4)]
    assert [len(answer["images"]) for answer in answers] == [1, 2, 3, 4]
    assert answers[3]["translation_95_mm"] == 2.5 and answers[0]["translation_95_mm"] is None


def test_a_full_disk_refuses_the_image_and_the_capture_goes_on(
    tmp_path: Path, tabletop: Path, monkeypatch: pytest.MonkeyPatch
):
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
    assert files == [["000.png", "001.png"]] and len(frames_in(tmp_path / "c")) == 3
    # Neither does a calibration that cannot write its files end the capture.
    again = Stepped(tmp_path / "d", tabletop)
    again.scripted.fault = full
    heard = again.run([0, 1])
    assert any("No space left" in lines[0] for answer, lines in heard) and len(again.live.names) == 2


@pytest.mark.parametrize(
    ("camera", "why"),
    [
        (lambda first, k: first, "stream frozen"),
        (lambda first, k: cv2.resize(np.roll(first, 9, 0), (320, 160)), "holds images of 640x480"),
        (lambda first, k: np.roll(first, 9, 0)[: 480 - k % 2], "size of the camera's images changes"),
    ],
)
def test_a_camera_that_repeats_or_changes_its_size_is_named_and_nothing_is_kept(
    tmp_path: Path, tabletop: Path, camera, why: str
):
    first, poses = still(tabletop, 0), list(jcr.read_capture(tabletop).base_from_gripper)
    answers: list[Answer] = []

    def frames() -> Iterator[Frame]:
        for k in range(100):
            image = first if not answers else camera(first, k)
            yield Frame(image, 0.25 * k)

    capture, _ = a_capture(tmp_path / "c", frames(), patience=1.0)
    capture.run(asked(poses[:2], answers))
    assert answers[0]["accepted"] and not answers[1]["accepted"] and why in answers[1]["reason"]
    assert frames_in(tmp_path / "c") == ["images/000.png"]


def test_a_clock_that_is_set_back_stops_neither_camera_nor_arm(tmp_path: Path, tabletop: Path):
    image, poses = still(tabletop, 0), list(jcr.read_capture(tabletop).base_from_gripper)
    times = [1e6, *(0.25 * k for k in range(20))]
    capture, _ = a_capture(tmp_path / "c", (Frame(image, time_s) for time_s in times))
    answers: list[Answer] = []
    capture.run(asked(poses[:1], answers))
    assert answers[0]["accepted"]

    def states() -> Iterator[State]:
        for k in range(200):
            yield State(1e6 + 0.1 * k if k < 3 else 0.1 * k, poses[0])

    assert np.allclose(next(asks_at_rest(states)).base_from_gripper, poses[0])


def test_poses_that_stop_end_the_capture_in_one_line_with_all_that_was_taken(tmp_path: Path, tabletop: Path):
    poses = list(jcr.read_capture(tabletop).base_from_gripper)

    def asks() -> Iterator[Ask]:
        yield Ask(poses[0])
        raise jcr.InputError("--poses ur:192.168.0.2:30003: silent for 5 s")

    capture, scripted = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, 0)))
    with pytest.raises(jcr.InputError, match="silent"):
        capture.run(asks())
    scripted.close()
    assert frames_in(tmp_path / "c") == ["images/000.png"]
    resumed, _ = a_capture(tmp_path / "c", still_frames(lambda: still(tabletop, 1)))
    resumed.run(asked(poses[1:2], []))
    assert frames_in(tmp_path / "c") == ["images/000.png", "images/001.png"]
