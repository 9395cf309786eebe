"""The section that hands the transform over, in every notation, ready to copy."""

import json
from html import escape

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
from jcr.report.markup import filled
from jcr.report.notations import Notation, matrix_json, notations
from jcr.rounding import decimals_of, significant


def transform_section(hand_eye: HandEye, mount: Mount = "gripper") -> str:
    """Matrix, quaternion, angles and rotation vector with their uncertainty; lines for ROS and URDF.

    Of a fixed camera the transform is base_from_camera.
    """
    x, parent = hand_eye.gripper_from_camera, PARENT if mount == "gripper" else BASE
    ros, urdf = static_transform_publisher(parent, CHILD, x), urdf_origin(x)
    std = np.sqrt(np.diag(hand_eye.covariance))
    turn, along = decimals_of(float(std[3:6].max())), decimals_of(float(std[:3].max()))
    rows = [
        "".join(f"{value:>{turn + 5}.{turn}f}" for value in row[:3]) + f"{row[3]:>{along + 5}.{along}f}"
        for row in x
    ]
    covariance = json.dumps({"order": COVARIANCE_ORDER, "covariance": hand_eye.covariance.tolist()})
    return filled(
        "transform.html",
        matrix="\n".join(rows),
        copy_covariance=copy_button(covariance, "the covariance"),
        covariance="\n".join(" ".join(f"{value:>10.2e}" for value in row) for row in hand_eye.covariance),
        order=", ".join(COVARIANCE_ORDER),
        copy_matrix=copy_button(matrix_json(x), "the matrix"),
        notations="\n".join(_notation(part) for part in notations(x, hand_eye.covariance)),
        ros=escape(ros),
        copy_ros=copy_button(ros, "the ROS 2 command"),
        urdf=escape(urdf),
        copy_urdf=copy_button(urdf, "the URDF origin"),
        camera_info=_camera_info(hand_eye),
        parent=parent,
        where="Where the camera sits on the gripper"
        if mount == "gripper"
        else "Where the fixed camera stands",
        to="gripper frame of the given poses" if mount == "gripper" else "robot's base frame",
        name=f"{mount}_from_camera",
        whose="the frame of the gripper poses" if mount == "gripper" else "the robot's base",
        child=CHILD,
        doubt="" if hand_eye.converged else '<p class="why">Rejected: see above.</p>',
    )


def _camera_info(hand_eye: HandEye) -> str:
    """The intrinsics that belong to the transform; empty where there are none."""
    if hand_eye.intrinsics is None:
        return ""
    mount = camera_mount(hand_eye.gripper_from_camera, hand_eye.covariance, PARENT, CHILD)
    text = camera_info(mount, hand_eye.intrinsics)
    return (
        '<div class="notation wide"><header><h3>camera_info (ROS)</h3>'
        f"{copy_button(text, 'camera_info')}</header><details><summary>intrinsics as camera_info_manager reads them"
        f'</summary><pre>{escape(text)}</pre></details><p class="note">The transform was found with these: use both '
        "together.</p></div>"
    )


def _notation(part: Notation) -> str:
    unit = {"": "", "deg": "°"}.get(part.unit, f" {part.unit}")
    rows = []
    for name, value, std in zip(part.components, part.value, part.std, strict=True):
        decimals = decimals_of(float(std))
        spread = f"{significant(1e3 * std)} mm" if part.unit == "m" else f"{significant(std)}{unit}"
        rows.append(
            f'<tr><td>{name}</td><td class="value">{value:.{decimals}f}{unit}</td>'
            f'<td class="soft">±{spread}</td></tr>'
        )
    title = part.name + (f" ({part.unit})" if part.unit else "")
    note = f'<p class="note">{escape(part.note)}</p>' if part.note else ""
    button = copy_button(json.dumps(part.value.round(9).tolist()), title)
    return (
        f'<div class="notation"><header><h3>{title}</h3>{button}</header>'
        f"<table>{''.join(rows)}</table>{note}</div>"
    )


def copy_button(text: str, what: str) -> str:
    """A button that copies the text; `what` says to a screen reader what that is."""
    return f'<button data-copy="{escape(text)}" aria-label="copy {escape(what)}">copy</button>'
