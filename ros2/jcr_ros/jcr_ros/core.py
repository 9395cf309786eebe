"""Core of the node without ROS: images and gripper poses in, states of the calibration and its transform out.

The node (node.py) translates topics, tf and services to the calls below.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

import jcr

POLL_S = 0.02
SILENT_S = 10.0
"""Time without an image after which the camera counts as lost."""
FINISH_S = 300.0
"""Longest time of the calibration of all images."""
SAME_S = 0.02
"""Largest difference between the stamps of an image and its depth."""
WAITING = 10
"""Number of images that wait for their depth, and of depth images that wait for their image."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Parameters of the node."""

    folder: Path
    """Folder of the capture; the result lies in its folder `result`."""
    options: jcr.SessionOptions = field(default_factory=jcr.SessionOptions)
    """Options of taking images."""
    at_rest: bool = True
    """Take an image whenever the arm comes to rest in a new place; else by service alone."""
    robot: str = ""
    """Name of the arm, to model its joint offsets and link errors; empty: unknown."""
    frames: jcr.FrameNames = field(default_factory=jcr.FrameNames)
    """Names of the frames of base, gripper and camera."""
    has_depth: bool = False
    """Whether images wait for their depth."""


class FrameStream:
    """Frames that subscriptions push; images are joined with the depth of the same stamp."""

    def __init__(self, has_depth: bool) -> None:
        """Wait for images; `has_depth`: an image is passed on with its depth, without it only after WAITING others."""
        self._has_depth = has_depth
        self._arrived = threading.Condition()
        self._frame: jcr.Frame | None = None
        self._closed = False
        self._images: deque[jcr.Frame] = deque()
        self._depths: deque[tuple[float, ndarray]] = deque(maxlen=WAITING)

    def push_image(self, image: ndarray, time_s: float) -> None:
        """Take an image (h,w,3) RGB with its stamp."""
        with self._arrived:
            self._images.append(jcr.Frame(image, time_s))
            self._join()

    def push_depth(self, depth_mm: ndarray, time_s: float) -> None:
        """Take a depth image (h,w), mm, with its stamp."""
        with self._arrived:
            self._depths.append((time_s, depth_mm))
            self._join()

    def _join(self) -> None:
        """Pass on the newest image whose depth is here, and drop the images before it."""
        joined = None
        for frame in self._images:
            near = [depth for time_s, depth in self._depths if abs(time_s - frame.time_s) <= SAME_S]
            if near or not self._has_depth:
                joined = jcr.Frame(frame.image, frame.time_s, near[0] if near else None)
        if joined is None and len(self._images) > WAITING:
            joined = self._images[0]
        if joined is None:
            return
        while self._images and self._images[0].time_s <= joined.time_s:
            self._images.popleft()
        self._frame = joined
        self._arrived.notify_all()

    def close(self) -> None:
        """End the stream."""
        with self._arrived:
            self._closed = True
            self._arrived.notify_all()

    def latest(self) -> jcr.Frame | None:
        """Return the newest frame."""
        return self._frame

    def __iter__(self) -> Iterator[jcr.Frame]:
        """Yield frames that arrive after they are requested; raise InputError where none does."""
        while not self._closed:
            before = self._frame
            with self._arrived:
                self._arrived.wait_for(lambda b=before: self._closed or self._frame is not b, SILENT_S)
                frame = self._frame
            if frame is None or frame is before:
                raise jcr.InputError("no images arrive; check image_topic and that the camera's driver runs")
            yield frame


@dataclass
class Calibrator:
    """One capture at the robot, from the first image to the calibration."""

    settings: Settings
    gripper: Callable[[], jcr.RobotState | None]
    """Function that returns the present state of the gripper; None while tf does not know it."""
    show: Callable[[str], None]
    """Receives each event in words."""
    publish: Callable[[dict[str, Any]], None]
    """Receives the state of the calibration at each event: the fields of the answer to a sample, and `event`."""
    broadcast: Callable[[ndarray], None]
    """Receives gripper_from_camera (4,4) of an accepted calibration."""
    intrinsics: jcr.Intrinsics | None = None
    """Intrinsics from camera_info."""
    session: jcr.LiveSession | None = None
    """Session while images are taken."""
    outcome: tuple[bool, str] = (False, "not started")
    """Whether the calibration of all images is accepted, and a line on it."""
    _thread: threading.Thread | None = None
    _is_stopped: bool = False

    def __post_init__(self) -> None:
        """Begin to receive images."""
        self.frames = FrameStream(self.settings.has_depth)

    def start(self) -> str:
        """Begin to take images in a thread of its own; return the address of the live page."""
        if self.is_running:
            raise jcr.InputError("already started: call ~/finish")
        opened, settings = ExitStack(), self.settings
        with opened:
            calibration = jcr.LiveCalibration(
                settings.folder,
                intrinsics=self.intrinsics,
                robot=settings.robot or None,
                frame_names=settings.frames,
                options={"require": settings.options.require},
                exclusive=True,
            )
            opened.callback(calibration.close)
            camera = jcr.Camera(self.frames, self.frames.latest)
            self.session = jcr.LiveSession(
                calibration, camera, settings.options, self._tell, gripper=self.gripper_now
            )
            page = opened.enter_context(jcr.LiveServer(self.session))
            # The thread closes what is open, from here on.
            work = (self.session, opened.pop_all())
            self._thread = threading.Thread(target=self._work, args=work, daemon=True)
        self._thread.start()
        return page.address

    @property
    def is_running(self) -> bool:
        """Whether images are being taken or calibrated."""
        return self._thread is not None and self._thread.is_alive()

    def take(self) -> tuple[bool, str]:
        """Take an image now; return whether it is kept, and its name or the reason."""
        try:
            state = self.gripper_now()
        except jcr.InputError as error:
            return False, str(error)
        if self.session is None or not self.is_running:
            return False, "not started, or finished: call ~/start"
        answer = self.session.take(state)
        return (True, f"kept {answer['image']}") if answer["accepted"] else (False, str(answer["reason"]))

    def undo(self) -> tuple[bool, str]:
        """Take back the last change; return whether there was one."""
        if self.session is None or not self.is_running or not self.session.state.can_undo:
            return False, "nothing to undo"
        self.session.press("undo")
        return True, "the last change is taken back"

    def finish(self) -> tuple[bool, str]:
        """Calibrate all images; return whether the calibration is accepted, and a line on it."""
        if self.session is not None and self._thread is not None:
            self.session.press("finish")
            self._thread.join(FINISH_S)
        return self.outcome

    def stop(self) -> None:
        """Take no more images and calibrate none; the images taken are kept."""
        self._is_stopped = True
        if self.session is not None:
            self.session.end()
        self.frames.close()
        if self._thread is not None:
            self._thread.join(FINISH_S)

    def gripper_now(self) -> jcr.RobotState:
        """Return the present state of the gripper; raise InputError while tf does not know it."""
        state = self.gripper()
        if state is None:
            raise jcr.InputError(
                "tf does not know the gripper in the base: check base_frame and gripper_frame"
            )
        return state

    def _states(self) -> Iterator[jcr.RobotState]:
        """Yield the states of the gripper, while tf has it."""
        while not self._is_stopped:
            state = self.gripper()
            if state is not None:
                yield state
            time.sleep(POLL_S)

    def _work(self, session: jcr.LiveSession, opened: ExitStack) -> None:
        """Take images until the session ends, then calibrate all of them."""
        with opened:
            try:
                session.run((lambda: session.watch(self._states)) if self.settings.at_rest else None)
                if not self._is_stopped:
                    self._conclude(session)
            except jcr.InputError as error:
                self.outcome = False, str(error)
            self.show(self.outcome[1])

    def _conclude(self, session: jcr.LiveSession) -> None:
        """Calibrate all images, and broadcast the transform where it is accepted."""
        result = session.finish()
        if result is None:
            self.outcome = False, session.state.event or "no images"
            return
        x, std = result.gripper_from_camera, np.sqrt(np.diag(result.covariance))
        offset = " ".join(f"{1e3 * value:.1f}" for value in x[:3, 3])
        line = (
            f"camera at {offset} mm on {self.settings.frames.gripper}, sigma {1e3 * std[:3].max():.2g} mm and "
            f"{np.degrees(std[3:6].max()):.2g} deg; {result.verdict}"
        )
        is_accepted = result.verdict == "accepted"
        why = "" if is_accepted else f": {'; '.join(result.calibration.warnings)}"
        self.outcome = is_accepted, line + why
        if is_accepted:
            self.broadcast(x)

    def _tell(self, answer: dict[str, Any], lines: list[str]) -> None:
        """Show an event, and publish the state."""
        self.show("\n".join(lines))
        assert self.session is not None
        state = self.session.state
        self.publish(state.progress.as_json() | {"event": lines[0], "done": state.is_over} | answer)
