"""The section that hands the transform over, in every notation, ready to copy."""

import json
from typing import Any

import numpy as np

from jcr.export.ros import (
    BASE,
    CHILD,
    PARENT,
    camera_info,
    camera_mount,
    static_transform_publisher,
    urdf_origin,
)
from jcr.records import COVARIANCE_ORDER, HandEye, Mount
from jcr.report.notations import Notation, matrix_json, notations
from jcr.report.render import Section
from jcr.rounding import decimals_of, significant


def transform_section(hand_eye: HandEye, mount: Mount = "gripper") -> Section:
    """Matrix, quaternion, angles and rotation vector with their uncertainty; lines for ROS and URDF.

    Of a fixed camera the transform is base_from_camera.
    """
    x, parent = hand_eye.gripper_from_camera, PARENT if mount == "gripper" else BASE
    std = np.sqrt(np.diag(hand_eye.covariance))
    rotation, along = decimals_of(float(std[3:6].max())), decimals_of(float(std[:3].max()))
    rows = [
        "".join(f"{value:>{rotation + 5}.{rotation}f}" for value in row[:3])
        + f"{row[3]:>{along + 5}.{along}f}"
        for row in x
    ]
    order = list(COVARIANCE_ORDER)
    content = {
        "mount": mount,
        "parent": parent,
        "child": CHILD,
        "rejected": not hand_eye.converged,
        "matrix": "\n".join(rows),
        "copied_matrix": matrix_json(x),
        "notations": [_notation(part) for part in notations(x, hand_eye.covariance)],
        "ros": static_transform_publisher(parent, CHILD, x),
        "urdf": urdf_origin(x),
        "covariance": "\n".join(" ".join(f"{value:>10.2e}" for value in row) for row in hand_eye.covariance),
        "copied_covariance": json.dumps({"order": order, "covariance": hand_eye.covariance.tolist()}),
        "order": order,
        "camera_info": _camera_info(hand_eye),
    }
    return Section("transform", content)


def _camera_info(hand_eye: HandEye) -> str | None:
    """The intrinsics that belong to the transform; None where there are none."""
    if hand_eye.intrinsics is None:
        return None
    mount = camera_mount(hand_eye.gripper_from_camera, hand_eye.covariance, PARENT, CHILD)
    return camera_info(mount, hand_eye.intrinsics)


def _notation(part: Notation) -> dict[str, Any]:
    unit = {"": "", "deg": "°"}.get(part.unit, f" {part.unit}")
    rows = []
    for name, value, std in zip(part.components, part.value, part.std, strict=True):
        spread = f"{significant(1e3 * std)} mm" if part.unit == "m" else f"{significant(std)}{unit}"
        rows.append((name, f"{value:.{decimals_of(float(std))}f}{unit}", f"±{spread}"))
    return {
        "title": part.name + (f" ({part.unit})" if part.unit else ""),
        "copied": json.dumps(part.value.round(9).tolist()),
        "rows": rows,
        "note": part.note,
    }
