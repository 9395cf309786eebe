"""Samples of marker-based hand-eye tools: gripper and marker poses of the same instants, without images.

A marker that stands still is a reconstruction's frame: recon_from_camera is the inverse of camera_from_marker.
"""

from pathlib import Path
from typing import Any

from jcr.capture.checks import require_frames
from jcr.capture.formats import Format
from jcr.capture.formats.pose_lists import SUFFIXES, pair_keys, read_content, read_entries
from jcr.capture.formats.table import columns_of_entries, poses_of_columns
from jcr.capture.options import ReadOptions
from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.records import PosePairs


def read(path: Path, options: ReadOptions) -> PosePairs:
    """Read samples of MoveIt Calibration (effector_wrt_world, object_wrt_sensor) or easy_handeye2 (robot, tracking).

    Raises InputError for eye_on_base, where the camera stands beside the robot and `robot` is inverted.
    """
    content = read_content(path)
    keys = pair_keys(content)
    if keys is None:
        raise InputError(
            f"{path}: no list of samples of MoveIt Calibration or easy_handeye2; name such a file"
        )
    notes = _notes(content, path)
    poses, faults = [], dict[int, str]()
    for key in keys:
        where = f"{path}: {key}"
        columns = columns_of_entries(read_entries(content, where, key), options, where)
        found, wrong = poses_of_columns(columns, options, where)
        poses.append(found)
        faults |= wrong | faults
    sound = [row for row in range(len(poses[0])) if row not in faults]
    require_frames(len(sound), str(path))
    return PosePairs(
        source=path,
        images=tuple(f"sample {row + 1}" for row in sound),
        base_from_gripper=poses[0][sound],
        recon_from_camera=inverse(poses[1][sound]),
        is_metric=True,
        notes=(*notes, *(f"left out: {faults[row]}" for row in sorted(faults))),
    )


def _notes(content: Any, path: Path) -> tuple[str, ...]:
    """Return a note where easy_handeye2 does not state the type of calibration; InputError for eye_on_base."""
    parameters = content.get("parameters") if isinstance(content, dict) else None
    if not isinstance(content, dict):
        return ()
    kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
    if kind == "eye_on_base":
        raise InputError(
            f"{path}: calibration_type eye_on_base, a camera beside the robot; jcr calibrates cameras on the gripper"
        )
    return () if kind == "eye_in_hand" else ("calibration_type is not given; taken as eye_in_hand",)


FORMAT = Format(
    name="samples",
    about="samples of MoveIt Calibration or easy_handeye2",
    recognises=lambda path: (
        path.is_file() and path.suffix.lower() in SUFFIXES and pair_keys(read_content(path)) is not None
    ),
    read=read,
)
