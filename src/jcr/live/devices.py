"""Cameras by what a user names them: a V4L2 index, a stream, a RealSense, or a video file in the place of one."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2

from jcr.errors import InputError
from jcr.live.camera import TIMEOUT_S, Camera, CameraOptions, Frame, Newest, Recorded
from jcr.live.realsense import REALSENSE, opened_realsense

V4L2_MANUAL_EXPOSURE = 1


@contextmanager
def opened(source: str, options: CameraOptions | None = None) -> Iterator[Camera]:
    """A camera: a number is a V4L2 device, anything with :// a stream, `realsense[:SERIAL]`, else a video file.

    Raises InputError when it cannot be opened or does not keep to the options, and later when it falls silent.
    """
    options = options or CameraOptions()
    if source == REALSENSE or source.startswith(REALSENSE + ":"):
        with opened_realsense(source.partition(":")[2], options) as camera:
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
                keep_to(video, options, source)
            elif options != CameraOptions():
                raise InputError(
                    f"--camera {source}: size, exposure and focus can be set for a device number or realsense; set "
                    "them in the camera, and leave the options out"
                )
            if is_file:
                recorded = Recorded(_of_file(video))
                yield Camera(recorded, recorded.latest)
            else:
                newest = Newest(lambda: _read(video), source)
                try:
                    yield Camera(newest, newest.latest)
                finally:
                    newest.close()
        finally:
            video.release()
    finally:
        cv2.utils.logging.setLogLevel(before)


@runtime_checkable
class Device(Protocol):
    """What of cv2.VideoCapture sets a camera up."""

    def set(self, propid: int, value: float, /) -> bool: ...

    def get(self, propid: int, /) -> float: ...


def keep_to(video: Device, options: CameraOptions, source: str) -> None:
    """Fix size, exposure and focus; InputError where the camera does otherwise.

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


def _fix(video: Device, prop: int, value: float, option: str, source: str) -> None:
    if not video.set(prop, value) or abs(video.get(prop) - value) > 0.01 * abs(value) + 1.0:
        raise InputError(
            f"{option} {value:g}: camera {source} stays at {video.get(prop):g}; give a value that "
            "v4l2-ctl --list-ctrls allows, or leave the option out"
        )


def _video(device: int | str) -> cv2.VideoCapture:
    if isinstance(device, int):
        return cv2.VideoCapture(device)
    limit_ms = int(1e3 * TIMEOUT_S)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
    return cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)


def _read(video: cv2.VideoCapture) -> Frame | None:
    began = time.monotonic()
    good, pixels = video.read()
    return Frame(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), began) if good else None


def _of_file(video: cv2.VideoCapture) -> Iterator[Frame]:
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    number = 0
    while (read := video.read())[0]:
        yield Frame(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), number / rate)
        number += 1
