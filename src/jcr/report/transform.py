"""Section of the hand-eye transform in the notations of robot software, ready to copy."""

import json

import numpy as np
from scipy.spatial.transform import Rotation

from jcr.export.ros import (
    BASE,
    CHILD,
    PARENT,
    CameraMount,
    camera_info,
    static_transform_publisher,
    urdf_origin,
)
from jcr.geometry import roll_pitch_yaw
from jcr.records import COVARIANCE_ORDER, HandEye, Mount
from jcr.report.render import Section
from jcr.report.sketch import sketch
from jcr.rounding import significant

FIXED_AXES = "fixed axes x, y, z: R = Rz(yaw)·Ry(pitch)·Rx(roll)"


def transform_section(hand_eye: HandEye, mount: Mount = "gripper") -> Section:
    """Return the section of gripper_from_camera, or of base_from_camera for a fixed camera."""
    x, parent = hand_eye.gripper_from_camera, PARENT if mount == "gripper" else BASE
    std = np.sqrt(np.diag(hand_eye.covariance))
    rotation = Rotation.from_matrix(x[:3, :3])
    rpy, order = roll_pitch_yaw(x[:3, :3]), list(COVARIANCE_ORDER)
    angles = ("roll", "pitch", "yaw")
    along = ", ".join(significant(1e3 * value) for value in std[:3])
    about = ", ".join(significant(value) for value in np.degrees(std[3:6]))
    notations = [
        ("Translation (m)", "xyz", x[:3, 3], f"±{along} mm"),
        ("Quaternion", "xyzw", rotation.as_quat(canonical=True), "x, y, z, w: the scalar last"),
        ("Roll, pitch, yaw (rad)", angles, rpy, FIXED_AXES),
        ("Roll, pitch, yaw (deg)", angles, np.degrees(rpy), FIXED_AXES),
        ("Rotation vector (rad)", ("rx", "ry", "rz"), rotation.as_rotvec(), "axis times angle"),
    ]
    mounted = CameraMount(
        parent=parent, child=CHILD, parent_from_child=x, base=BASE, intrinsics=hand_eye.intrinsics
    )
    content = {
        "sketch": sketch(x, hand_eye.intrinsics, mount),
        "mount": mount,
        "parent": parent,
        "child": CHILD,
        "rejected": not hand_eye.converged,
        "matrix": "\n".join("".join(f"{value:>10.6f}" for value in row) for row in x[:3]),
        "copied_matrix": "[" + ",\n ".join(json.dumps(row) for row in x.tolist()) + "]",
        "along": f"±{along} mm",
        "about": about,
        "notations": [
            {
                "title": title,
                "copied": json.dumps(value.round(9).tolist()),
                "rows": [(name, f"{one:.6f}") for name, one in zip(names, value, strict=True)],
                "note": note,
            }
            for title, names, value, note in notations
        ],
        "ros": static_transform_publisher(parent, CHILD, x),
        "urdf": urdf_origin(x),
        "covariance": "\n".join(" ".join(f"{value:>10.2e}" for value in row) for row in hand_eye.covariance),
        "copied_covariance": json.dumps({"order": order, "covariance": hand_eye.covariance.tolist()}),
        "order": order,
        "camera_info": None if hand_eye.intrinsics is None else camera_info(mounted),
    }
    return Section("transform", content)
