"""What the node does, without ROS: images and gripper poses come in, states of the calibration and its transform go out.

The node (node.py) translates topics, tf and services to the calls below and holds no logic of its own.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.capture.camera_info import intrinsics_of_ros
from jcr.capture.camera_json import intrinsics_as_json
from jcr.capture.ros_image import image_of
from jcr.errors import InputError
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.export.ros import CameraMount
from jcr.live.arm_words import ArmWords
from jcr.live.asks import Answer, Ask
from jcr.live.calibration import LiveCalibration
from jcr.live.calibration_words import progress_answer
from jcr.live.camera import TIMEOUT_S, Camera, Frame
from jcr.live.collect import CollectOptions, LiveCapture
from jcr.live.commands import Command
from jcr.live.folder import LiveFolder
from jcr.live.rest import State, asks_at_rest
from jcr.live.server import Server
from jcr.results import RunResult
from jcr.run_folder import locked

POLL_S = 0.02
ANSWER_S = 30.0
FINISH_S = 300.0
"""For the calibration of all images."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The node's parameters."""

    folder: Path
    """Of the capture; the result lies in its folder `result`."""
    collect: CollectOptions = CollectOptions()
    at_rest: bool = True
    """Take an image whenever the arm comes to rest in a new place; else by service alone."""
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
    """One capture at the robot, from the first image to the calibration."""

    settings: Settings
    gripper: Callable[[], State | None]
    """base_from_gripper now; None while tf does not know it."""
    show: Callable[[str], None]
    """Gets each event in words."""
    publish: Callable[[Answer], None]
    """Gets the state of the calibration at each event: the fields of the answer to a sample, and `event`."""
    broadcast: Callable[[CameraMount], None]
    """Gets the camera's frame under the gripper, of an accepted calibration alone."""
    frames: Pushed = field(default_factory=Pushed)
    intrinsics: dict[str, Any] | None = None
    capture: LiveCapture | None = None
    outcome: tuple[bool, str] = (False, "not started")
    """Whether the calibration of all images is accepted, and a line on it."""
    _asked: "queue.Queue[Ask | None]" = field(default_factory=queue.Queue)
    _thread: threading.Thread | None = None
    _is_stopped: bool = False

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
        found = intrinsics_of_ros(
            list(message.k), message.distortion_model, list(message.d), size, size, "camera_info"
        )
        if found is not None:
            self.intrinsics = intrinsics_as_json(found)

    def start(self) -> str:
        """Begin to take images, in a thread of its own; the address of the live page."""
        if self._thread is not None and self._thread.is_alive():
            raise InputError("already started: call ~/finish")
        opened, name = ExitStack(), self.settings.robot
        with opened:
            opened.enter_context(locked(self.settings.folder))
            live = LiveFolder(self.settings.folder, self.intrinsics, name or None)
            options = self.settings.collect
            asked = CalibrateOptions(require=options.require)
            calibration = LiveCalibration(live, options=asked, reach=options.reach_m)
            opened.callback(calibration.close)
            camera = Camera(self.frames, self.frames.latest)
            words = ArmWords(arm=arm_named(name) if name in ROBOT_NAMES else None)
            self.capture = LiveCapture(calibration, camera, options, self._tell, words, self._state_now)
            page = opened.enter_context(Server(self.capture))
            # The thread closes what is open, from here on.
            self._thread = threading.Thread(
                target=self._work, args=(self.capture, opened.pop_all()), daemon=True
            )
        self._thread.start()
        return page.address

    def _work(self, capture: LiveCapture, opened: ExitStack) -> None:
        with opened:
            try:
                capture.run(self._asks())
                if not self._is_stopped:
                    self._conclude(capture.finish())
            except InputError as error:
                self.outcome = False, str(error)
            self.show(self.outcome[1])

    def _conclude(self, result: RunResult | None) -> None:
        """State what came of all images, and broadcast the transform where it is accepted."""
        if result is None:
            self.outcome = False, self.capture.shown.event if self.capture is not None else "no images"
            return
        hand_eye, settings = result.hand_eye, self.settings
        reason = None if result.converged else "; ".join(hand_eye.warnings)
        mount = CameraMount(
            parent=settings.parent,
            child=settings.child,
            parent_from_child=hand_eye.gripper_from_camera,
            base=settings.base,
        )
        std = np.sqrt(np.diag(hand_eye.covariance))
        offset = " ".join(f"{1e3 * value:.1f}" for value in hand_eye.gripper_from_camera[:3, 3])
        line = (
            f"camera at {offset} mm on {settings.parent}, sigma {1e3 * std[:3].max():.2g} mm and "
            f"{np.degrees(std[3:6].max()):.2g} deg; {hand_eye.verdict}"
        )
        self.outcome = result.converged, line if reason is None else f"{line}: {reason}"
        if result.converged:
            self.broadcast(mount)

    def take(self) -> tuple[bool, str]:
        """Take an image here and now; whether it was kept, and why not."""
        try:
            state = self._state_now()
        except InputError as error:
            return False, str(error)
        if self._thread is None or not self._thread.is_alive():
            return False, "not started, or finished: call ~/start"
        answered: queue.Queue[Answer] = queue.Queue()
        current = lambda: self._state_now().base_from_gripper  # noqa: E731
        self._asked.put(
            Ask(state.base_from_gripper, answer=answered.put, current=current, joints=state.joints)
        )
        try:
            answer = answered.get(timeout=ANSWER_S)
        except queue.Empty:
            return False, "no answer: do images arrive?"
        return (True, f"kept {answer['image']}") if answer["accepted"] else (False, str(answer["reason"]))

    def undo(self) -> tuple[bool, str]:
        """Take back the last change; whether there was one."""
        if self.capture is None or not self.capture.live.can_undo:
            return False, "nothing to undo"
        self.capture.press(Command("undo"))
        return True, "the last change is taken back"

    def finish(self) -> tuple[bool, str]:
        """Calibrate all images; whether the calibration is accepted, and a line on it."""
        if self.capture is not None and self._thread is not None:
            self.capture.press(Command("finish"))
            self._thread.join(FINISH_S)
        return self.outcome

    def stop(self) -> None:
        """Take no more images; those taken are kept."""
        self._is_stopped = True
        self._asked.put(None)
        self.frames.close()
        if self._thread is not None:
            self._thread.join(ANSWER_S)

    def _state_now(self) -> State:
        state = self.gripper()
        if state is None:
            raise InputError("tf does not know the gripper in the base: check base_frame and gripper_frame")
        return state

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
        """Ask at rest, one at a time, the next when the last is answered."""
        for ask in asks_at_rest(self._states):
            done = threading.Event()

            def answered(answer: Answer, ask: Ask = ask, done: threading.Event = done) -> None:
                ask.answer(answer)
                done.set()

            self._asked.put(
                Ask(ask.base_from_gripper, answer=answered, current=ask.current, joints=ask.joints)
            )
            done.wait()

    def _tell(self, answer: Answer, lines: list[str]) -> None:
        self.show("\n".join(lines))
        assert self.capture is not None
        shown = self.capture.shown
        self.publish(progress_answer(shown.progress) | {"event": lines[0], "done": shown.is_over} | answer)
