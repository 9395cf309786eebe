"""Samples of marker-based hand-eye tools: pairs of gripper pose and marker pose, without images.

The frame of a fixed marker is the recon frame: recon_from_camera is the inverse of camera_from_marker.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jcr.capture.checks import require_frames
from jcr.capture.documents import read_content
from jcr.capture.documents.nested import leaves
from jcr.capture.documents.table import table_of
from jcr.capture.options import ReadOptions
from jcr.capture.readings import Candidate, readings_of
from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.records import PosePairs

POSE_KEYS = (("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking"))
"""Keys of the gripper pose and the marker pose in a sample of MoveIt Calibration and of easy_handeye2."""
SAMPLE_SUFFIXES = (".yaml", ".yml", ".json", ".samples")


def recognises(path: Path) -> bool:
    """Test whether a path is a file with samples of MoveIt Calibration or easy_handeye2."""
    return (
        path.is_file() and path.suffix.lower() in SAMPLE_SUFFIXES and _pairs(read_content(path)) is not None
    )


def read(path: Path, options: ReadOptions) -> PosePairs:
    """Read samples of MoveIt Calibration (effector_wrt_world, object_wrt_sensor) or easy_handeye2 (robot, tracking).

    The marker frame is the recon frame: recon_from_camera is the inverse of the sample's camera_from_marker (m). Raises
    InputError for eye_on_base, where the camera does not move with the robot and `robot` is inverted.
    """
    content = read_content(path)
    found = _pairs(content)
    if found is None:
        raise InputError(f"{path}: no samples of MoveIt Calibration or easy_handeye2; name such a file")
    entries, keys = found
    require_frames(len(entries), str(path))
    kind = "eye_in_hand"  # MoveIt Calibration writes a list, without parameters
    if isinstance(content, dict):
        parameters = content.get("parameters")
        kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
    if kind == "eye_on_base":
        raise InputError(
            f"{path}: calibration_type eye_on_base, a camera beside the robot; jcr calibrates cameras on the gripper"
        )
    notes = () if kind == "eye_in_hand" else ("calibration_type is not given; taken as eye_in_hand",)
    (reading, gripper), (_, marker) = (_poses(path, entries, key, options) for key in keys)
    sound = np.flatnonzero(np.isfinite(gripper).all((1, 2)) & np.isfinite(marker).all((1, 2)))
    require_frames(len(sound), str(path))
    lost = np.setdiff1d(np.arange(len(entries)), sound).tolist()
    left_out = [f"left out: sample {row + 1} holds no pair of poses" for row in lost]
    return PosePairs(
        source=path,
        images=tuple(f"sample {row + 1}" for row in sound),
        base_from_gripper=gripper[sound],
        recon_from_camera=inverse(marker[sound]),
        is_metric=True,
        notes=(*notes, *left_out),
        is_inverted=reading.inverted,
    )


def _pairs(content: Any) -> tuple[list[Any], tuple[str, str]] | None:
    """Return the samples in the content of a file, and their keys of gripper and marker pose; None without samples."""
    lists = [content, *(content.values() if isinstance(content, dict) else ())]
    for entries in (one for one in lists if isinstance(one, list) and one and isinstance(one[0], dict)):
        for keys in POSE_KEYS:
            if set(keys) <= entries[0].keys():
                return entries, keys
    return None


def _poses(path: Path, entries: Sequence[Any], key: str, options: ReadOptions) -> Candidate:
    """Return the reading and the poses (m) of one key of the samples; raise InputError if it holds no poses.

    A marker's pose is camera_from_marker; only the gripper's pose is inverted by `options`.
    """
    is_gripper = key in {gripper for gripper, _ in POSE_KEYS}
    own = replace(options, pose_columns=None) if is_gripper else ReadOptions(pose_units=options.pose_units)
    rows = [leaves(path, one[key]) if isinstance(one, dict) and key in one else None for one in entries]
    table = table_of(path, rows)
    for candidate in readings_of(table, own, f"{path}: {key}")[1] if table else ():
        if candidate[0].inverted == own.pose_inverted:
            return candidate
    raise InputError(f"{path}: {key} holds no poses; give position and quaternion, or 16 numbers of a matrix")
