"""Samples of marker-based hand-eye tools: gripper and marker poses side by side, no images.

A marker that stands still is a reconstruction's frame: recon_from_camera is the inverse of camera_from_marker.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.checks import check_metres, read_rigid
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import read_yaml
from jcr.capture.robot_poses import poses_from_numbers
from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.records import PosePairs


def read_moveit(path: Path, options: ReadOptions) -> PosePairs:
    """MoveIt Calibration: a list of effector_wrt_world and object_wrt_sensor, 16 numbers each, row-major."""
    content = read_yaml(path)
    if not isinstance(content, list):
        raise InputError(
            f"{path}: no list of effector_wrt_world and object_wrt_sensor; name MoveIt's samples file"
        )
    return _pairs(path, content, ("effector_wrt_world", "object_wrt_sensor"), _row_major)


def read_easy_handeye2(path: Path, options: ReadOptions) -> PosePairs:
    """easy_handeye2 .samples: robot is base to effector, tracking camera to marker; translation and quaternion.

    Raises InputError for eye_on_base, where the camera stands beside the robot and `robot` is inverted.
    """
    content = read_yaml(path)
    samples = content.get("samples") if isinstance(content, dict) else None
    if not isinstance(samples, list):
        raise InputError(
            f'{path}: has no list "samples" of robot and tracking; name an easy_handeye2 .samples file'
        )
    parameters = content.get("parameters")
    kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
    if kind == "eye_on_base":
        raise InputError(
            f"{path}: calibration_type eye_on_base, a camera beside the robot; jcr calibrates cameras on the gripper"
        )
    notes = () if kind == "eye_in_hand" else ("calibration_type is not given; taken as eye_in_hand",)
    return _pairs(path, samples, ("robot", "tracking"), _parts, notes)


def _pairs(
    path: Path,
    samples: list[Any],
    keys: tuple[str, str],
    read: Callable[[Any, str, str], Float[ndarray, "4 4"]],
    notes: tuple[str, ...] = (),
) -> PosePairs:
    """Poses of the gripper and of the marker in the camera, below these keys of each sample."""
    gripper, marker = (
        np.reshape([read(one, key, f"{path}: sample {k}") for k, one in enumerate(samples, 1)], (-1, 4, 4))
        for key in keys
    )
    if len(gripper) < 3:
        raise InputError(f"{path}: {len(gripper)} samples; at least 3 are needed, 12 are good")
    check_metres(gripper, str(path))
    check_metres(marker, f"{path}: the marker")
    names = tuple(f"sample {k}" for k in range(1, len(gripper) + 1))
    return PosePairs(
        source=path,
        images=names,
        base_from_gripper=gripper,
        recon_from_camera=inverse(marker),
        is_metric=True,
        notes=notes,
    )


def _row_major(entry: Any, key: str, where: str) -> Float[ndarray, "4 4"]:
    numbers = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(numbers, list) or len(numbers) != 16:
        raise InputError(f"{where}: {key} must be 16 numbers, a 4x4 matrix row by row")
    return read_rigid([numbers[k : k + 4] for k in range(0, 16, 4)], f"{where}: {key}")


def _parts(entry: Any, key: str, where: str) -> Float[ndarray, "4 4"]:
    try:
        part = entry[key]
        numbers = [float(part["translation"][axis]) for axis in "xyz"]
        numbers += [float(part["rotation"][axis]) for axis in "xyzw"]
    except (TypeError, KeyError, ValueError, OverflowError):
        raise InputError(f"{where}: {key} needs translation x, y, z and rotation x, y, z, w") from None
    return poses_from_numbers(np.array([numbers]), "quat-xyzw", "m-rad", f"{where}: {key}")[0]
