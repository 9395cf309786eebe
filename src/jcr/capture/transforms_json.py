"""transforms.json of nerfstudio and instant-ngp: images with camera poses, beside a table of gripper poses.

Its cameras have OpenGL's axes (y up, z backward) and pixels counted from the corner of the image, as COLMAP's.
"""

import math
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import HALF_PIXEL
from jcr.capture.checks import checked_intrinsics, read_rigid, require_frames
from jcr.capture.formats.table import IMAGE_SUFFIXES
from jcr.capture.model_cameras import ModelCamera, capture_of_cameras, one_each
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, read_json
from jcr.errors import InputError
from jcr.records import COEFFICIENTS, Capture, DistortionModel, Intrinsics

FILE = "transforms.json"
MODELS = (
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "OPENCV_FISHEYE",
)  # fmt: skip
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_KEYS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_angle_x",
)  # fmt: skip


def read(path: Path, options: ReadOptions) -> Capture:
    """The images that a transforms.json and a table of gripper poses both know."""
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    return capture_of_cameras(folder, _cameras(file), options, file)


def _cameras(file: Path) -> list[ModelCamera]:
    """The cameras of a file, those with most images first: where frames have intrinsics of their own, by these and by
    their folder."""
    names, poses = read_cameras(file)
    content = read_json(file)
    groups: dict[object, list[int]] = {}
    for k, (name, frame) in enumerate(zip(names, content["frames"], strict=True)):
        own = tuple((key, str(frame[key])) for key in _KEYS if key in frame)
        groups.setdefault((own, str(Path(name).parent)) if own else None, []).append(k)
    if one_each([len(rows) for rows in groups.values()]):
        groups = {None: list(range(len(names)))}
    return [
        ModelCamera(
            name=Path(names[rows[0]]).parent.name,
            images=tuple(names[k] for k in rows),
            recon_from_camera=poses[rows],
            moment=tuple(rows),
            intrinsics_of_size=partial(
                _intrinsics, content | {"frames": [content["frames"][k] for k in rows]}, file
            ),
        )
        for rows in sorted(groups.values(), key=lambda rows: (-len(rows), rows[0]))
    ]


def read_cameras(file: Path) -> tuple[list[str], Float[ndarray, "n 4 4"]]:
    """Images by their paths beside the file, and recon_from_camera (n,4,4) with OpenCV's axes."""
    content = read_json(file)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f'{file}: has no list "frames" of file_path and transform_matrix')
    require_frames(len(frames), str(file), 0)
    names, cameras = [], []
    for k, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{file}: frame {k} has no file_path")
        names.append(_located(file, frame["file_path"], k))
        where = f"{file}: transform_matrix of frame {k} ({names[-1]})"
        cameras.append(read_rigid(frame.get("transform_matrix"), where) @ OPENGL_FROM_OPENCV)
    return names, np.stack(cameras)


def _located(file: Path, name: str, k: int) -> str:
    """The image's path, with the ending that some writers leave out."""
    name = str(Path(name))
    for candidate in (name, *(f"{name}{suffix}" for suffix in IMAGE_SUFFIXES)):
        if os.path.isfile(file.parent / candidate):
            break
    else:
        candidate = name
    contained(file.parent, candidate, f"{file}: frame {k}")
    return candidate


def read_intrinsics(file: Path, size: tuple[int, int]) -> Intrinsics:
    """The one set of intrinsics of all frames, of the given size; InputError for several or a strange one."""
    return _intrinsics(read_json(file), file, size)


def _intrinsics(content: dict[str, Any], file: Path, size: tuple[int, int]) -> Intrinsics:
    of_frames = [
        {key: source[key] for key in _KEYS if key in source}
        for source in (content | frame for frame in content["frames"])
    ]
    first = of_frames[0]
    if any(one != first for one in of_frames):
        raise InputError(f"{file}: its frames have different intrinsics; jcr needs images of one camera")
    model = content.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise InputError(f"{file}: camera_model {model}; undistort the images to a pinhole or OPENCV camera")
    distortion_model: DistortionModel = "fisheye" if model == "OPENCV_FISHEYE" else "pinhole"
    if first.get("k4") and distortion_model == "pinhole":
        raise InputError(f"{file}: a distortion with k4, which jcr does not know; undistort the images")
    width, height = size
    made_for = (first.get("w", width), first.get("h", height))
    if made_for != size:
        raise InputError(
            f"{file}: w, h are {made_for[0]}x{made_for[1]}, the images are {width}x{height}; make it fit"
        )
    if "fl_x" not in first and "camera_angle_x" not in first:
        raise InputError(f"{file}: no fl_x, fl_y, cx, cy (or camera_angle_x); add the intrinsics")
    try:
        focal = first.get("fl_x") or width / 2 / math.tan(float(first["camera_angle_x"]) / 2)
        centre = (first.get("cx", width / 2), first.get("cy", height / 2))
        numbers = [focal, first.get("fl_y", focal), *(float(value) - HALF_PIXEL for value in centre)]
    except (KeyError, TypeError, ValueError, OverflowError, ZeroDivisionError):
        raise InputError(f"{file}: fl_x, fl_y, cx, cy and camera_angle_x must be numbers") from None
    distortion = [first.get(key, 0.0) for key in COEFFICIENTS[distortion_model]]
    return checked_intrinsics(numbers, distortion, size, str(file), distortion_model)
