"""Pictures from a camera while it runs: a V4L2 index, a stream, or a video file in its place."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
from jaxtyping import UInt8
from numpy import ndarray

from jcr.errors import InputError

TIMEOUT_S = 10.0
"""Without a picture for so long, a camera is gone."""


@dataclass(frozen=True)
class Frame:
    """One picture and when it was taken, on a clock of the camera's own."""

    image: UInt8[ndarray, "h w 3"]
    """RGB."""
    time_s: float


@contextmanager
def opened(source: str) -> Iterator[Iterator[Frame]]:
    """The frames of a camera: a number is a V4L2 device, anything with :// a stream, else a video file.

    A device or stream gives what it sees when it is asked, never what waited in a buffer; a file gives frame
    after frame. Raises InputError when it cannot be opened, and later when it falls silent.
    """
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
            yield _of_file(video) if is_file else _newest(video, source)
        finally:
            video.release()
    finally:
        cv2.utils.logging.setLogLevel(before)


def _video(device: int | str) -> cv2.VideoCapture:
    if isinstance(device, int):
        return cv2.VideoCapture(device)
    limit_ms = int(1e3 * TIMEOUT_S)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
    return cv2.VideoCapture(device, cv2.CAP_FFMPEG, limits)


def _of_file(video: cv2.VideoCapture) -> Iterator[Frame]:
    rate = video.get(cv2.CAP_PROP_FPS) or 30.0
    number = 0
    while (read := video.read())[0]:
        yield Frame(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB), number / rate)
        number += 1


def _newest(video: cv2.VideoCapture, source: str) -> Iterator[Frame]:
    """Frames whose taking began after they were asked for; a thread empties the driver's buffer meanwhile."""
    arrived, stop = threading.Condition(), threading.Event()
    newest: list[Frame] = []

    def watch() -> None:
        while not stop.is_set():
            began = time.monotonic()
            good, pixels = video.read()
            with arrived:
                if good:
                    newest[:] = [Frame(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), began)]
                arrived.notify_all()
            if not good:
                return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        while True:
            asked = time.monotonic()

            def fresh(asked: float = asked) -> bool:
                return bool(newest and newest[0].time_s >= asked) or not thread.is_alive()

            with arrived:
                came = arrived.wait_for(fresh, TIMEOUT_S)
                if not came or not (newest and newest[0].time_s >= asked):
                    raise InputError(
                        f"--camera {source}: gives no more pictures; check its cable and start again: the same "
                        "command goes on where it was"
                    )
                frame = newest[0]
            yield frame
    finally:
        stop.set()
        thread.join(TIMEOUT_S)
