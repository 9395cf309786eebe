"""industrial_calibration's cal_data.yaml: images and one pose file each."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jcr.capture.checks import checked_capture
from jcr.capture.formats.table import with_camera_info
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, read_yaml
from jcr.capture.robot_poses import poses_from_numbers
from jcr.errors import InputError
from jcr.records import Capture

FILE = "cal_data.yaml"
_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def read(path: Path, options: ReadOptions) -> Capture:
    """`data: [{image: path, pose: path}]`; a pose file has x, y, z in metres and qx, qy, qz, qw."""
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    content = read_yaml(file)
    data = content.get("data") if isinstance(content, dict) else None
    if not isinstance(data, list):
        raise InputError(f'{file}: has no list "data" of image and pose; name a cal_data.yaml')
    images, numbers = [], []
    for k, entry in enumerate(data, start=1):
        if not isinstance(entry, dict) or not {"image", "pose"} <= entry.keys():
            raise InputError(f"{file}: entry {k} needs image and pose, two paths")
        pose_file = contained(folder, str(entry["pose"]), f"{file}: entry {k}")
        pose = read_yaml(pose_file)
        try:
            numbers.append([float(pose[key]) for key in _KEYS])
        except (TypeError, KeyError, ValueError, OverflowError):
            raise InputError(f"{pose_file}: needs the numbers {', '.join(_KEYS)}") from None
        images.append(str(entry["image"]))
    rows = np.reshape(np.array(numbers, dtype=np.float64), (-1, 7))
    poses = poses_from_numbers(rows, "quat-xyzw", options.pose_units, str(file))
    return replace(with_camera_info(checked_capture(folder, images, poses, str(file)), options), source=file)
