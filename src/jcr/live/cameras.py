"""Cameras of a live capture: V4L2 devices, network streams, RealSense cameras, and video files as a substitute."""

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from jcr.errors import InputError
from jcr.extras import extra
from jcr.records.capture_schema import IntrinsicsEntry

LOST_S = 10.0
"""Time without an image (s) after which a camera counts as lost."""
REALSENSE = "realsense"
"""Prefix of a RealSense camera in `--camera`; `:SERIAL` or the file of a recording, `:FILE`, may follow."""


@dataclass(frozen=True)
class Frame:
    """Image of a camera with its time and, from a depth camera, its depth."""

    image: UInt8[ndarray, "h w 3"]
    """RGB image."""
    time_s: float
    """Time (s) by this machine's monotonic clock; in a recording, by its frame rate or its time stamps."""
    depth_mm: UInt16[ndarray, "h w"] | None = None
    """Depth (mm) at each pixel of the image, 0 where it is unknown; None if the camera measures no depth."""


@dataclass(frozen=True)
class Camera:
    """Open camera: its frames, a function for the newest frame, and the intrinsics that the camera stores."""

    frames: Iterable[Frame]
    """Frames; a device or stream takes each one after the request for it. Raises InputError if the camera is lost."""
    latest: Callable[[], Frame | None]
    """Function that returns the newest frame, without waiting; None before the first one."""
    intrinsics: IntrinsicsEntry | None = None
    """Intrinsics that the maker stored in the camera; None if it stores none, or a distortion."""


@contextmanager
def _read_by(
    read: Callable[[], Frame | None], name: str | None, intrinsics: IntrinsicsEntry | None = None
) -> Iterator[Camera]:
    """Yield the camera whose next frame the function `read` waits for and returns; `read` returns None at the end.

    A thread reads the device or stream called `name`, so that no old frames are buffered. If `name` is None, the source
    is a recording, which is read without a thread.
    """
    newest, arrived, is_closed = deque[Frame](maxlen=1), threading.Condition(), threading.Event()

    def watch() -> None:
        """Read frames until the source ends or the camera is closed; keep only the newest frame."""
        while not is_closed.is_set() and (frame := read()) is not None:
            with arrived:
                newest.append(frame)
                arrived.notify_all()
        with arrived:
            is_closed.set()
            arrived.notify_all()

    def frames() -> Iterator[Frame]:
        """Yield, for each request, a frame taken after it; of a recording, the next frame."""
        while name is None:
            if (frame := read()) is None:
                return
            newest.append(frame)
            yield frame
        while True:
            asked = time.monotonic()
            with arrived:
                arrived.wait_for(
                    lambda asked=asked: is_closed.is_set() or (newest and newest[0].time_s >= asked),
                    LOST_S,
                )
                if not newest or newest[0].time_s < asked:
                    raise InputError(
                        f"--camera {name}: no more images; check its cable; the same command resumes"
                    )
                frame = newest[0]
            yield frame

    thread = threading.Thread(target=watch, daemon=True)
    if name is not None:
        thread.start()
    try:
        yield Camera(frames(), lambda: newest[0] if newest else None, intrinsics)
    finally:
        is_closed.set()
        if name is not None:
            thread.join(LOST_S)


@contextmanager
def open_camera(source: str, size: tuple[int, int] | None = None) -> Iterator[Camera]:
    """Open a camera: a V4L2 device (number), a stream (address with ://), `realsense[:SERIAL]`, or else a video file.

    `size` is the width and height (px) of the images; None: the default of the device (RealSense: 1280x720). Raises
    InputError if the camera cannot be opened or does not accept the size.
    """
    if source.partition(":")[0] == REALSENSE:
        with _open_realsense(source.partition(":")[2], size) as camera:
            yield camera
        return
    is_device = source.isdecimal()
    is_file = not is_device and "://" not in source
    if Path(source).is_dir():
        raise InputError(f"--camera {source}: is a folder; jcr run calibrates a folder of images and poses")
    if is_file and not Path(source).is_file():
        raise InputError(f"--camera {source}: no such video file; name a file, a device number or a stream")
    # OpenCV and FFmpeg would also write warnings to stderr, which add nothing to the InputError.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with ExitStack() as stack:
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        stack.callback(cv2.utils.logging.setLogLevel, before)
        limit_ms = int(1e3 * LOST_S)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, limit_ms]
        video = (
            cv2.VideoCapture(int(source)) if is_device else cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        )
        stack.callback(video.release)
        if not video.isOpened():
            raise InputError(
                f"--camera {source}: cannot be opened; look which devices there are (v4l2-ctl --list-devices), "
                "whether another program holds it, or whether the stream's address is right"
            )
        if is_device:
            set_up(video, size, source)
        elif size is not None:
            raise InputError(
                f"--camera {source}: the size can be set for a device number or realsense; set it in the camera, and "
                "leave --camera-size out"
            )
        rate, numbers = video.get(cv2.CAP_PROP_FPS) or 30.0, count()

        def read() -> Frame | None:
            """Return the next frame; None at the end.

            Its time is the moment when reading began; in a file it is the frame's number divided by the frame rate.
            """
            time_s = next(numbers) / rate if is_file else time.monotonic()
            good, pixels = video.read()
            return Frame(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), time_s) if good else None

        yield stack.enter_context(_read_by(read, None if is_file else source))


def set_up(video: Any, size: tuple[int, int] | None, source: str) -> None:
    """Set the size of a cv2.VideoCapture and switch autofocus off; raise InputError if the camera keeps another size.

    The size is read back, because a driver may accept a value without applying it (OpenCV, VideoCaptureProperties).
    """
    if size is not None:
        video.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        video.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        found = round(video.get(cv2.CAP_PROP_FRAME_WIDTH)), round(video.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if found != size:
            raise InputError(
                f"--camera-size {size[0]} {size[1]}: camera {source} gives {found[0]}x{found[1]}; choose a size that "
                "v4l2-ctl --list-formats-ext lists"
            )
    # Autofocus is switched off because the focus changes the intrinsics. Some cameras have no such setting.
    video.set(cv2.CAP_PROP_AUTOFOCUS, 0)


# Intel RealSense cameras are read with pyrealsense2: images, aligned depth, and the intrinsics that the maker stored.


@contextmanager
def _open_realsense(serial: str, size: tuple[int, int] | None) -> Iterator[Camera]:
    """Open a RealSense: `serial` is a serial number, empty for the first camera, or a recording (.bag, .db3)."""
    name = REALSENSE + (f":{serial}" if serial else "")
    rs = extra("pyrealsense2", "realsense", f"--camera {name}")
    pipeline, config, is_file = rs.pipeline(), rs.config(), serial.endswith((".bag", ".db3"))
    if is_file:
        if not Path(serial).is_file():
            raise InputError(f"--camera {name}: no such recording; name a .bag, or a serial number")
        rs.config.enable_device_from_file(config, serial, repeat_playback=False)
    else:
        if serial:
            config.enable_device(serial)
        width, height = size or (1280, 720)  # every D400 has this size
        config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, 0)  # 0: any frame rate
        config.enable_stream(rs.stream.depth)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise InputError(
            f"--camera {name}: {' '.join(str(error).split())}; see what rs-enumerate-devices lists, and whether another "
            "program holds the camera"
        ) from None
    with ExitStack() as stack:

        @stack.callback
        def stop() -> None:
            """Stop the RealSense pipeline; ignore the error if it stopped already at the end of its recording."""
            with suppress(RuntimeError):
                pipeline.stop()

        if is_file:
            profile.get_device().as_playback().set_real_time(False)
        stored = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        # The distortion models of librealsense are not OpenCV's; most colour cameras are without distortion.
        intrinsics = IntrinsicsEntry(fx=stored.fx, fy=stored.fy, cx=stored.ppx, cy=stored.ppy)
        read = _realsense_reader(rs, pipeline, profile, is_file)
        yield stack.enter_context(
            _read_by(read, None if is_file else name, None if any(stored.coeffs) else intrinsics)
        )


def _realsense_reader(
    rs: ModuleType, pipeline: Any, profile: Any, is_file: bool
) -> Callable[[], Frame | None]:
    """Return a function that reads the next frame, with depth if the camera measures it, and returns None at the end.

    `is_file`: the camera is a recording, whose time stamps are used.
    """
    aligned, has_depth = rs.align(rs.stream.color), False
    with suppress(RuntimeError):
        has_depth = bool(profile.get_stream(rs.stream.depth))
    unit_mm = 1e3 * profile.get_device().first_depth_sensor().get_depth_scale() if has_depth else 1.0

    def read() -> Frame | None:
        """Return the next frame; None if none arrives in time."""
        began = time.monotonic()
        try:
            frames = pipeline.wait_for_frames(int(1e3 * LOST_S if not is_file else 1e3))
        except RuntimeError:
            return None
        stamp = frames.get_timestamp() / 1e3 if is_file else began
        depth_mm = None
        if has_depth:
            frames = aligned.process(frames)
            raw = np.asanyarray(frames.get_depth_frame().get_data())
            depth_mm = np.rint(unit_mm * raw).clip(0, np.iinfo(np.uint16).max).astype(np.uint16)
        color = frames.get_color_frame()
        pixels = np.asanyarray(color.get_data()).copy()
        if color.get_profile().format() == rs.format.bgr8:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
        return Frame(pixels, stamp, depth_mm)

    return read
