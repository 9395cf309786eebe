"""A camera while it runs, whatever it is: its settings, its frames, and the newest of them."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from jaxtyping import UInt8, UInt16
from numpy import ndarray

from jcr.errors import InputError

TIMEOUT_S = 10.0
"""Without an image for so long, a camera is gone."""


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
    """One image and when it was taken, on a clock of the camera's own."""

    image: UInt8[ndarray, "h w 3"]
    """RGB."""
    time_s: float
    depth_mm: UInt16[ndarray, "h w"] | None = None
    """Aligned with the image, 0 where there is none; None where the camera measures no depth."""


class Newest:
    """The newest frame of a source that `read` waits on, kept by a thread that empties the driver's buffer."""

    def __init__(self, read: Callable[[], Frame | None], name: str) -> None:
        self._read, self._name = read, name
        self._arrived, self._stop = threading.Condition(), threading.Event()
        self._frame: Frame | None = None
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._stop.is_set():
            frame = self._read()
            with self._arrived:
                if frame is not None:
                    self._frame = frame
                self._arrived.notify_all()
            if frame is None:
                return

    def latest(self) -> Frame | None:
        """What the camera saw last."""
        return self._frame

    def __iter__(self) -> Iterator[Frame]:
        """Frames whose taking began after they were asked for; InputError when the camera falls silent."""
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
        """Stop watching."""
        self._stop.set()
        self._thread.join(TIMEOUT_S)


class Recorded:
    """The frames of a recording, one after the other."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._frames = frames
        self._frame: Frame | None = None

    def latest(self) -> Frame | None:
        """What was read last."""
        return self._frame

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._frames:
            self._frame = frame
            yield frame


@dataclass(frozen=True)
class Camera:
    """A camera that is open."""

    frames: Iterable[Frame]
    """Of a device or stream what it sees when it is asked, never what waited in a buffer."""
    latest: Callable[[], Frame | None]
    """The newest frame that is there."""
    intrinsics: dict[str, Any] | None = None
    """As capture.json has them, where the camera's maker stored them in it."""
