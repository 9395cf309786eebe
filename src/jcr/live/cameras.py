"""Cameras while a capture is taken: V4L2 devices, streams, RealSense cameras, and video files in their place."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from jcr.capture.camera_info import IntrinsicsEntry
from jcr.errors import InputError

TIMEOUT_S = 10.0
"""Time without an image after which a camera counts as lost."""
V4L2_MANUAL_EXPOSURE = 1


@dataclass(frozen=True)
class CameraOptions:
    """Camera settings that stay fixed during the capture."""

    camera_size: tuple[int, int] | None = None
    """Resolution in pixels, WIDTH HEIGHT; unset: the camera's default (RealSense: 1280 720)."""
    exposure: float | None = None
    """Fix the exposure, in the camera's own unit (V4L2: 0.1 ms, RealSense: µs); unset: automatic."""
    focus: float | None = None
    """Fix the focus, in the camera's own unit; unset: autofocus is switched off and the current focus kept."""


@dataclass(frozen=True)
class Frame:
    """Image of a camera with the time at which it was taken."""

    image: UInt8[ndarray, "h w 3"]
    """RGB."""
    time_s: float
    """Time on the camera's own clock."""
    depth_mm: UInt16[ndarray, "h w"] | None = None
    """Depth aligned with the image, 0 where there is none; None where the camera measures no depth."""


@dataclass(frozen=True)
class Camera:
    """Camera that is open."""

    frames: Iterable[Frame]
    """Frames of a device or stream taken after they are requested, never from a buffer; InputError when it is lost."""
    latest: Callable[[], Frame | None]
    """Function that returns the newest frame."""
    intrinsics: IntrinsicsEntry | None = None
    """Intrinsics, where the camera's maker stored them in it."""


class NewestFrame:
    """Newest frame of a source, kept by a thread that empties the driver's buffer."""

    def __init__(self, read: Callable[[], Frame | None], name: str) -> None:
        """Start the thread; `read` waits for the next frame and returns None at the end."""
        self._read, self._name = read, name
        self._arrived, self._stop = threading.Condition(), threading.Event()
        self._frame: Frame | None = None
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        """Read frames until the source ends."""
        while not self._stop.is_set():
            frame = self._read()
            with self._arrived:
                if frame is not None:
                    self._frame = frame
                self._arrived.notify_all()
            if frame is None:
                return

    def latest(self) -> Frame | None:
        """Return the newest frame."""
        return self._frame

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames that were taken after they were requested; raise InputError when the camera falls silent."""
        while True:
            asked = time.monotonic()

            def is_fresh(asked: float = asked) -> bool:
                return self._frame is not None and self._frame.time_s >= asked

            with self._arrived:
                self._arrived.wait_for(lambda: is_fresh() or not self._thread.is_alive(), TIMEOUT_S)
                frame = self._frame
                if frame is None or not is_fresh():
                    raise InputError(
                        f"--camera {self._name}: gives no more images; check its cable and start again: the same "
                        "command resumes"
                    )
            yield frame

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self._thread.join(TIMEOUT_S)


class RecordedFrames:
    """Frames of a recording, one after the other."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        """Read from `frames` as they are requested."""
        self._frames = frames
        self._frame: Frame | None = None

    def latest(self) -> Frame | None:
        """Return the frame that was read last."""
        return self._frame

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames."""
        for frame in self._frames:
            self._frame = frame
            yield frame


@contextmanager
def open_camera(source: str, options: CameraOptions | None = None) -> Iterator[Camera]:
    """Open a camera: a V4L2 device (number), a stream (with ://), `realsense[:SERIAL]`, or else a video file.

    Raises InputError when it cannot be opened or does not follow the options.
    """
    options = options or CameraOptions()
    if source.partition(":")[0] == "realsense":
        from jcr.live.realsense import open_realsense

        with open_realsense(source.partition(":")[2], options) as camera:
            yield camera
        return
    # OpenCV and FFmpeg write warnings of their own to stderr; the error that we raise is all a user needs.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    device: int | str = int(source) if source.isdigit() else source
    is_file = not source.isdigit() and "://" not in source
    if is_file and not Path(source).is_file():
        raise InputError(f"--camera {source}: no such video file; name a file, a device number or a stream")
    try:
        video = _video(device)
        if not video.isOpened():
            raise InputError(
                f"--camera {source}: cannot be opened; look which devices there are (v4l2-ctl --list-devices), "
                "whether another program holds it, or whether the stream's address is right"
            )
        try:
            if isinstance(device, int):
                apply_options(video, options, source)
            elif options != CameraOptions():
                raise InputError(
                    f"--camera {source}: size, exposure and focus can be set for a device number or realsense; set "
                    "them in the camera, and leave the options out"
                )
            if is_file:
                recorded = RecordedFrames(_recorded_frames(video))
                yield Camera(recorded, recorded.latest)
            else:
                newest = NewestFrame(lambda: _read(video), source)
                try:
                    yield Camera(newest, newest.latest)
                finally:
                    newest.close()
        finally:
            video.release()
    finally:
        cv2.utils.logging.setLogLevel(before)


def apply_options(video: Any, options: CameraOptions, source: str) -> None:
    """Fix size, exposure and focus of a cv2.VideoCapture; raise InputError where the camera does not follow.

    A driver may take a value and not follow it, so each is read back (videoio's page on VideoCaptureProperties).
    """
    if options.camera_size is not None:
        wanted = options.camera_size
        video.set(cv2.CAP_PROP_FRAME_WIDTH, wanted[0])
        video.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted[1])
        size = round(video.get(cv2.CAP_PROP_FRAME_WIDTH)), round(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if size != wanted:
            raise InputError(
                f"--camera-size {wanted[0]} {wanted[1]}: camera {source} gives {size[0]}x{size[1]}; choose a size that "
                "v4l2-ctl --list-formats-ext lists"
            )
    # With the focus the intrinsics change. Not all cameras have a setting for it.
    video.set(cv2.CAP_PROP_AUTOFOCUS, 0)
    if options.exposure is not None:
        video.set(cv2.CAP_PROP_AUTO_EXPOSURE, V4L2_MANUAL_EXPOSURE)
        _fix(video, cv2.CAP_PROP_EXPOSURE, options.exposure, "--exposure", source)
    if options.focus is not None:
        _fix(video, cv2.CAP_PROP_FOCUS, options.focus, "--focus", source)


def _fix(video: Any, prop: int, value: float, option: str, source: str) -> None:
    """Set a property; raise InputError where its value differs after that."""
    if not video.set(prop, value) or abs(video.get(prop) - value) > 0.01 * abs(value) + 1.0:
        raise InputError(
            f"{option} {value:g}: camera {source} stays at {video.get(prop):g}; give a value that "
            "v4l2-ctl --list-ctrls allows, or leave the option out"
        )


def _video(device: int | str) -> cv2.VideoCapture:
    """Open a device, stream or file with OpenCV, with limits of time."""
    if isinstance(device, int):
        return cv2.VideoCapture(device)
    limit_ms = int(1e3 * TIMEOUT_S)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
    return cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)


def _read(video: cv2.VideoCapture) -> Frame | None:
    """Return the next frame of a device or stream, stamped when reading began; None at its end."""
    began = time.monotonic()
    good, pixels = video.read()
    return Frame(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), began) if good else None


def _recorded_frames(video: cv2.VideoCapture) -> Iterator[Frame]:
    """Yield the frames of a file, stamped by its frame rate."""
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    number = 0
    while (read := video.read())[0]:
        yield Frame(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), number / rate)
        number += 1
