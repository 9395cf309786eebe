"""Records a bag with librealsense itself, of a device in software: colour, and depth of 0.5005 m everywhere."""

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

WIDTH, HEIGHT, FRAMES = 640, 480, 10


def intrinsics(rs: ModuleType) -> Any:
    found = rs.intrinsics()
    found.width, found.height = WIDTH, HEIGHT
    found.fx, found.fy, found.ppx, found.ppy = 600.0, 601.0, 315.0, 242.0
    found.model, found.coeffs = rs.distortion.inverse_brown_conrady, 5 * [0.0]
    return found


def record(file: Path) -> None:
    import pyrealsense2 as rs

    device = rs.software_device()
    named = {
        "Stereo Module": (rs.stream.depth, rs.format.z16, 2),
        "RGB Camera": (rs.stream.color, rs.format.rgb8, 3),
    }
    profiles, plain = [], []
    for number, (name, (kind, form, size)) in enumerate(named.items()):
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = kind, 0, number, form
        stream.width, stream.height, stream.fps, stream.bpp = WIDTH, HEIGHT, 30, size
        stream.intrinsics = intrinsics(rs)
        sensor = device.add_sensor(name)
        plain.append(sensor)
        profiles.append(sensor.add_video_stream(stream))
        if kind == rs.stream.depth:
            sensor.add_read_only_option(rs.option.depth_units, 0.0005)
            still = rs.extrinsics()
            still.rotation, still.translation = np.eye(3).ravel().tolist(), [0.0, 0.0, 0.0]
    profiles[0].register_extrinsics_to(profiles[1], still)
    recorder = rs.recorder(str(file), device)
    sensors = recorder.query_sensors()
    queue = rs.frame_queue(50)
    for sensor, profile in zip(sensors, profiles, strict=True):
        sensor.open(profile)
        sensor.start(queue)
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = np.full((HEIGHT, WIDTH), 1001, np.uint16)
    for number in range(FRAMES):
        for sensor, profile, pixels, size in zip(plain, profiles, (depth, image), (2, 3), strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp, frame.stride = pixels, size, size * WIDTH
            frame.timestamp, frame.frame_number = 100.0 * (number + 1), number + 1
            frame.domain = rs.timestamp_domain.hardware_clock
            frame.profile = profile.as_video_stream_profile()
            sensor.on_video_frame(frame)
        queue.wait_for_frame()
        queue.wait_for_frame()
    for sensor in sensors:
        sensor.stop()
        sensor.close()
