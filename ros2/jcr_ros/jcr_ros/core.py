"""What the node does, without ROS: images and gripper poses come in, samples, advice and a calibration go out.

The node (node.py) translates topics, tf and services to the calls below and holds no logic of its own.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

import jcr
from jcr.capture.camera_info import intrinsics_of_ros
from jcr.capture.camera_json import intrinsics_as_json
from jcr.capture.ros_image import image_of
from jcr.errors import InputError
from jcr.export.ros import CameraMount, camera_mount
from jcr.handeye.arms import ROBOT_NAMES, arm_named
from jcr.live.arm_words import ArmWords
from jcr.live.asks import Answer, Ask
from jcr.live.camera import TIMEOUT_S, Camera, Frame
from jcr.live.collect import CollectOptions, collect
from jcr.live.folder import LiveFolder
from jcr.live.rest import State, asks_at_rest

POLL_S = 0.02
ANSWER_S = 30.0


@dataclass(frozen=True)
class Settings:
    """What the node's parameters say."""

    folder: Path
    """Of the capture; the result lies in its folder `result`."""
    images: int = 12
    at_rest: bool = True
    """Take a sample whenever the arm comes to rest in a new place; else by service alone."""
    robot: str = ""
    """Name of the arm, for joint angles of the next pose; empty: unknown."""
    parent: str = "tool0"
    child: str = "camera_color_optical_frame"
    base: str = "base_link"


class Pushed:
    """Frames that a subscription pushes; whoever asks gets one that arrived later."""

    def __init__(self) -> None:
        self._arrived = threading.Condition()
        self._frame: Frame | None = None
        self._closed = False

    def push(self, frame: Frame) -> None:
        """A new frame."""
        with self._arrived:
            self._frame = frame
            self._arrived.notify_all()

    def close(self) -> None:
        """No more will come."""
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()

    def latest(self) -> Frame | None:
        """The newest frame."""
        return self._frame

    def __iter__(self) -> Iterator[Frame]:
        while not self._closed:
            before = self._frame
            with self._arrived:
                self._arrived.wait_for(lambda b=before: self._closed or self._frame is not b, TIMEOUT_S)
                frame = self._frame
            if frame is None or frame is before:
                raise InputError("no images arrive; check image_topic and that the camera's driver runs")
            yield frame


@dataclass
class Session:
    """One capture at the robot, from the first sample to the calibration."""

    settings: Settings
    gripper: Callable[[], State | None]
    """base_from_gripper now; None while tf does not know it."""
    say: Callable[[str], None]
    """Hears each answer in words."""
    propose: Callable[[ndarray | None, Answer], None]
    """Hears each answer, and the next base_from_gripper (4,4) where one is proposed."""
    frames: Pushed = field(default_factory=Pushed)
    lens: dict[str, Any] | None = None
    _asked: "queue.Queue[Ask | None]" = field(default_factory=queue.Queue)
    _thread: threading.Thread | None = None

    def image(self, message: Any, time_s: float, depth_mm: ndarray | None = None) -> None:
        """A sensor_msgs/Image or CompressedImage."""
        import cv2

        pixels, _ = image_of(message, "image")
        if isinstance(pixels, bytes):
            pixels = cv2.cvtColor(
                cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB
            )
        self.frames.push(Frame(np.asarray(pixels, np.uint8), time_s, depth_mm))

    def camera_info(self, message: Any) -> None:
        """A sensor_msgs/CameraInfo; refused in words where jcr does not know its intrinsics."""
        size = (message.width, message.height)
        lens = intrinsics_of_ros(
            list(message.k), message.distortion_model, list(message.d), size, size, "camera_info"
        )
        if lens is not None:
            self.lens = intrinsics_as_json(lens)

    def start(self) -> None:
        """Begin to take samples, in a thread of its own."""
        name = self.settings.robot
        live = LiveFolder(self.settings.folder, self.lens, name or None)
        words = ArmWords(arm=arm_named(name) if name in ROBOT_NAMES else None)
        options = CollectOptions(images=self.settings.images)

        def work() -> None:
            try:
                collect(
                    live, Camera(self.frames, self.frames.latest), self._asks(), options, self._tell, words
                )
                self.say("enough images: call ~/solve")
            except InputError as error:
                self.say(f"error: {error}")

        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def take(self) -> tuple[bool, str]:
        """A sample here and now; whether it was kept, and why not."""
        state = self.gripper()
        if state is None:
            return False, "tf does not know the gripper in the base: check base_frame and gripper_frame"
        if self._thread is None or not self._thread.is_alive():
            return False, "not started, or there are enough images: call ~/solve"
        answered: queue.Queue[Answer] = queue.Queue()
        self._asked.put(Ask(state.base_from_gripper, answered.put, self._now, state.joints))
        try:
            answer = answered.get(timeout=ANSWER_S)
        except queue.Empty:
            return False, "no answer: do images arrive?"
        if answer["accepted"]:
            return True, f"kept {answer['image']}"
        return False, str(answer["reason"])

    def stop(self) -> None:
        """Take no more samples; those taken are kept."""
        self._asked.put(None)
        self.frames.close()
        if self._thread is not None:
            self._thread.join(ANSWER_S)

    def solve(self) -> tuple[CameraMount, bool, str]:
        """The camera's frame under the gripper, whether it is accepted, and a line for people.

        Raises InputError and NotTrustedError as jcr.calibrate does.
        """
        result = jcr.calibrate(jcr.read_capture(self.settings.folder), self.settings.folder / "result")
        hand_eye = result.hand_eye
        mount = camera_mount(
            hand_eye.gripper_from_camera,
            hand_eye.covariance,
            self.settings.parent,
            self.settings.child,
            self.settings.base,
            None if result.converged else "; ".join(hand_eye.warnings),
        )
        std = np.sqrt(np.diag(hand_eye.covariance))
        offset = " ".join(f"{1e3 * value:.1f}" for value in hand_eye.gripper_from_camera[:3, 3])
        line = (
            f"camera at {offset} mm on {self.settings.parent}, sigma {1e3 * std[:3].max():.2g} mm and "
            f"{np.degrees(std[3:6].max()):.2g} deg; {hand_eye.verdict}"
        )
        return mount, result.converged, line

    def _now(self) -> ndarray:
        state = self.gripper()
        if state is None:
            raise InputError("tf no longer knows the gripper in the base")
        return state.base_from_gripper

    def _states(self) -> Iterator[State]:
        while True:
            state = self.gripper()
            if state is not None:
                yield state
            time.sleep(POLL_S)

    def _asks(self) -> Iterator[Ask]:
        """What services asked for, and rest where that counts."""
        if self.settings.at_rest:
            threading.Thread(target=self._watch, daemon=True).start()
        while (ask := self._asked.get()) is not None:
            yield ask

    def _watch(self) -> None:
        """Ask at rest, one at a time: the next is thought of when the last is answered."""
        for ask in asks_at_rest(self._states):
            done = threading.Event()

            def heard(answer: Answer, ask: Ask = ask, done: threading.Event = done) -> None:
                ask.answer(answer)
                done.set()

            self._asked.put(Ask(ask.base_from_gripper, heard, ask.current, ask.joints))
            done.wait()

    def _tell(self, answer: Answer, lines: list[str]) -> None:
        self.say("\n".join(lines))
        proposed = answer.get("next_base_from_gripper")
        self.propose(None if proposed is None else np.array(proposed), answer)
