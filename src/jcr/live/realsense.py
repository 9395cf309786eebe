"""Intel RealSense cameras with pyrealsense2: images, aligned depth, and the intrinsics stored by the maker."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from jcr.errors import InputError
from jcr.extras import extra
from jcr.live.cameras import TIMEOUT_S, Camera, CameraOptions, Frame, Frames
from jcr.records.capture_json import IntrinsicsEntry

REALSENSE = "realsense"
"""Name for `--camera`, followed by `:SERIAL` or `:FILE` where needed."""
SIZE = (1280, 720)
"""Default resolution, px, which every D400 gives."""
DEPTH_LIMIT_MM = 65_535
FITTED_PX = 0.05
"""Largest difference (px) between OpenCV's coefficients and the maker's distortion."""


@contextmanager
def open_realsense(serial: str, options: CameraOptions) -> Iterator[Camera]:
    """Open the camera with a serial number, the first one where it is empty, or a recording (.bag).

    Raises InputError when the package or the camera is missing, or the camera does not follow the options.
    """
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
        config.enable_stream(rs.stream.color, *(options.camera_size or SIZE), rs.format.rgb8)
        config.enable_stream(rs.stream.depth)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise InputError(
            f"--camera {name}: {' '.join(str(error).split())}; see what rs-enumerate-devices lists, and whether another "
            "program holds the camera"
        ) from None
    frames = None
    try:
        if is_file:
            profile.get_device().as_playback().set_real_time(False)
        else:
            _apply_options(rs, profile, options)
        stored = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        read = _reader(rs, pipeline, profile, is_file)
        frames = Frames(read, None if is_file else name)
        yield Camera(frames, frames.latest, intrinsics_of_realsense(rs, stored))
    finally:
        if frames is not None:
            frames.close()
        with suppress(RuntimeError):
            pipeline.stop()


def _reader(rs: ModuleType, pipeline: Any, profile: Any, is_file: bool) -> Callable[[], Frame | None]:
    """Return a function that reads the next frame, with depth where the camera measures it; None at the end."""
    aligned, has_depth = rs.align(rs.stream.color), False
    with suppress(RuntimeError):
        has_depth = bool(profile.get_stream(rs.stream.depth))
    unit_mm = 1e3 * profile.get_device().first_depth_sensor().get_depth_scale() if has_depth else 1.0

    def read() -> Frame | None:
        """Return the next frame."""
        began = time.monotonic()
        try:
            frames = pipeline.wait_for_frames(int(1e3 * TIMEOUT_S if not is_file else 1e3))
        except RuntimeError:
            return None
        stamp = frames.get_timestamp() / 1e3 if is_file else began
        depth_mm = None
        if has_depth:
            frames = aligned.process(frames)
            raw = np.asanyarray(frames.get_depth_frame().get_data())
            depth_mm = np.rint(unit_mm * raw).clip(0, DEPTH_LIMIT_MM).astype(np.uint16)
        color = frames.get_color_frame()
        pixels = np.asanyarray(color.get_data()).copy()
        if color.get_profile().format() == rs.format.bgr8:
            pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
        return Frame(pixels, stamp, depth_mm)

    return read


def _apply_options(rs: ModuleType, profile: Any, options: CameraOptions) -> None:
    """Fix exposure and focus; raise InputError where the camera has no such setting or range."""
    sensor = profile.get_device().first_color_sensor()
    wanted = [
        (rs.option.exposure, options.exposure, "--exposure"),
        (rs.option.focus_position, options.focus, "--focus"),
    ]
    for option, value, flag in wanted:
        if value is None:
            continue
        if not sensor.supports(option):
            raise InputError(f"{flag} {value:g}: this camera has no such setting; leave the option out")
        if flag == "--exposure":
            sensor.set_option(rs.option.enable_auto_exposure, 0)
        limits = sensor.get_option_range(option)
        if not limits.min <= value <= limits.max:
            raise InputError(f"{flag} {value:g}: this camera takes {limits.min:g} to {limits.max:g}")
        sensor.set_option(option, value)


def intrinsics_of_realsense(rs: ModuleType, stored: Any) -> IntrinsicsEntry | None:
    """Return intrinsics for capture.json; None where OpenCV's coefficients differ from the maker's by FITTED_PX.

    librealsense has distortions of its own ("Projection in Intel RealSense SDK 2.0"), among them an inverse one. Its
    own deprojection gives the ray of each pixel, and the coefficients are linear in where rays go.
    """
    intrinsics = IntrinsicsEntry(fx=stored.fx, fy=stored.fy, cx=stored.ppx, cy=stored.ppy)
    if not any(stored.coeffs):
        return intrinsics
    u, v = np.meshgrid(np.linspace(0, stored.width - 1, 25), np.linspace(0, stored.height - 1, 19))
    x_px = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = np.array([rs.rs2_deproject_pixel_to_point(stored, pixel.tolist(), 1.0) for pixel in x_px])
    (x, y), r2 = rays[:, :2].T, (rays[:, :2] ** 2).sum(1)
    seen = (x_px - [stored.ppx, stored.ppy]) / [stored.fx, stored.fy]
    by_x = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=1)
    by_y = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=1)
    matrix, goal = np.vstack([by_x, by_y]), np.concatenate([seen[:, 0] - x, seen[:, 1] - y])
    coefficients = np.linalg.lstsq(matrix, goal, rcond=None)[0]
    off_px = max(stored.fx, stored.fy) * np.abs(matrix @ coefficients - goal).max()
    fitted = intrinsics.model_copy(update={"distortion": coefficients.tolist()})
    return fitted if off_px < FITTED_PX else None
