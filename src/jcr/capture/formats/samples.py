"""Samples of marker-based hand-eye tools: pairs of gripper pose and marker pose, without images.

The frame of a fixed marker is the recon frame: recon_from_camera is the inverse of camera_from_marker.
"""

from pathlib import Path

from jcr.capture.checks import require_frames
from jcr.capture.formats.pose_lists import SUFFIXES, pair_keys, read_rows, read_yaml_or_json
from jcr.capture.formats.table import pose_table
from jcr.capture.options import ReadOptions
from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.records import PosePairs


def recognises(path: Path) -> bool:
    """Test whether a path is a file with samples of MoveIt Calibration or easy_handeye2."""
    is_list = path.is_file() and path.suffix.lower() in (*SUFFIXES, ".samples")
    return is_list and pair_keys(read_yaml_or_json(path)) is not None


def read(path: Path, options: ReadOptions) -> PosePairs:
    """Read samples of MoveIt Calibration (effector_wrt_world, object_wrt_sensor) or easy_handeye2 (robot, tracking).

    The marker frame is the recon frame: recon_from_camera is the inverse of the sample's camera_from_marker (m). Raises
    InputError for eye_on_base, where the camera does not move with the robot and `robot` is inverted.
    """
    content = read_yaml_or_json(path)
    keys = pair_keys(content)
    if keys is None:
        raise InputError(f"{path}: no samples of MoveIt Calibration or easy_handeye2; name such a file")
    kind = "eye_in_hand"  # MoveIt Calibration writes a list, without parameters
    if isinstance(content, dict):
        parameters = content.get("parameters")
        kind = parameters.get("calibration_type") if isinstance(parameters, dict) else None
    if kind == "eye_on_base":
        raise InputError(
            f"{path}: calibration_type eye_on_base, a camera beside the robot; jcr calibrates cameras on the gripper"
        )
    notes = () if kind == "eye_in_hand" else ("calibration_type is not given; taken as eye_in_hand",)
    tables = ((read_rows(content, f"{path}: {key}", key), f"{path}: {key}") for key in keys)
    gripper, marker = (pose_table(*rows, options, where) for rows, where in tables)
    faults = {**marker.faults, **gripper.faults}
    sound = [row for row in range(len(gripper.base_from_gripper)) if row not in faults]
    require_frames(len(sound), str(path))
    return PosePairs(
        source=path,
        images=tuple(f"sample {row + 1}" for row in sound),
        base_from_gripper=gripper.base_from_gripper[sound],
        recon_from_camera=inverse(marker.base_from_gripper[sound]),
        is_metric=True,
        notes=(*notes, *(f"left out: {faults[row]}" for row in sorted(faults))),
    )
