"""The camera's place on the gripper as ROS tools take it: tf2, URDF, xacro, easy_handeye2, MoveIt, camera_info.

Every text names its frames and units, and the reason where the calibration is rejected.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr import __version__
from jcr.errors import InputError
from jcr.geometry import inverse, roll_pitch_yaw, skew, transform
from jcr.records import COEFFICIENTS, Intrinsics

PARENT, CHILD, BASE = "tool0", "camera_color_optical_frame", "base_link"
"""Frame names where the user gives none."""

_DISTORTIONS = {"pinhole": "plumb_bob", "rational": "rational_polynomial", "fisheye": "equidistant"}
ROOT_FROM_OPTICAL = transform(Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).as_matrix().round(), np.zeros(3))
"""REP-103: the root link has x forward, y left, z up; the optical frame z forward, x right, y down."""

_FRAME_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.\-]*")


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """A frame of the camera, fixed on the gripper, under its names in ROS."""

    parent: str
    child: str
    parent_from_child: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"]
    """As geometry_msgs orders it: x, y, z (m), rotation about x, y, z (rad), all along axes of the parent."""
    base: str = BASE
    """The robot's base, for the formats that ask for it."""
    doubt: str | None = None
    """Why the calibration is rejected; None when it is."""
    intrinsics: Intrinsics | None = None
    """Those that the transform belongs to: with others it places points elsewhere. None where they are not known."""


def camera_mount(
    gripper_from_camera: Float[ndarray, "4 4"],
    covariance: Float[ndarray, "7 7"],
    parent: str = PARENT,
    child: str = CHILD,
    base: str = BASE,
    doubt: str | None = None,
    intrinsics: Intrinsics | None = None,
) -> CameraMount:
    """The optical frame on the gripper; `covariance` is in `jcr.records.COVARIANCE_ORDER`.

    Raises InputError for names that are none in ROS, and where two frames have the same one.
    """
    for name in (parent, child, base):
        require_frame_name(name)
    if parent == child:
        raise InputError(f"parent and child frame are both {parent!r}; name two different frames")
    return CameraMount(
        parent=parent,
        child=child,
        parent_from_child=gripper_from_camera,
        covariance=covariance[:6, :6],
        base=base,
        doubt=doubt,
        intrinsics=intrinsics,
    )


def on_root(
    mount: CameraMount, root: str, root_from_optical: Float[ndarray, "4 4"] = ROOT_FROM_OPTICAL
) -> CameraMount:
    """The mount of the link from which a camera's own frames hang, for a frame can have one parent only.

    parent_from_root = parent_from_optical · inverse(root_from_optical). With q the root's place seen from the
    optical frame in axes of the parent, the errors (dt, r) move the root by dt + r × q.
    """
    require_frame_name(root)
    if root in (mount.parent, mount.child):
        raise InputError(f"root frame {root!r}: is the name of another frame; name the camera's root link")
    optical_from_root = inverse(root_from_optical)
    q = mount.parent_from_child[:3, :3] @ optical_from_root[:3, 3]
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(q)
    return replace(
        mount,
        child=root,
        parent_from_child=mount.parent_from_child @ optical_from_root,
        covariance=jacobian @ mount.covariance @ jacobian.T,
    )


def require_frame_name(name: str) -> None:
    """InputError for what tf2 or XML would not take as a frame's name."""
    if not _FRAME_NAME.fullmatch(name):
        raise InputError(f"frame {name!r}: write letters, digits, _ . - and /, and no / in front")


def static_transform_publisher(parent: str, child: str, parent_from_child: Float[ndarray, "4 4"]) -> str:
    """The ROS 2 command that publishes the transform."""
    arguments = _publisher_arguments(parent, child, parent_from_child)
    return f"ros2 run tf2_ros static_transform_publisher {' '.join(arguments)}"


def urdf_origin(parent_from_child: Float[ndarray, "4 4"]) -> str:
    """The origin element of a URDF or xacro joint."""
    xyz, rpy = parent_from_child[:3, 3], roll_pitch_yaw(parent_from_child[:3, :3])
    return f'<origin xyz="{" ".join(map(_number, xyz))}" rpy="{" ".join(map(_number, rpy))}"/>'


def ros2_launch(mount: CameraMount, *others: CameraMount) -> str:
    """A ROS 2 launch file (XML) that publishes the transform, and those of further cameras and arms."""
    nodes = []
    for k, one in enumerate((mount, *others)):
        arguments = " ".join(_publisher_arguments(one.parent, one.child, one.parent_from_child))
        name = "hand_eye_publisher" if k == 0 else f"{re.sub('[^A-Za-z0-9_]', '_', one.child)}_publisher"
        nodes.append(
            f"{_xml_comment(one)}\n"
            f'  <node pkg="tf2_ros" exec="static_transform_publisher" name="{name}" args="{arguments}"/>\n'
        )
    return f"<launch>\n{''.join(nodes)}</launch>\n"


def moveit_launch(mount: CameraMount) -> str:
    """A ROS 2 launch file (Python), laid out as MoveIt Calibration saves its own."""
    kind = "EYE-TO-HAND" if mount.parent == mount.base else "EYE-IN-HAND"
    arguments = _publisher_arguments(mount.parent, mount.child, mount.parent_from_child)
    rows = "\n".join(
        f'                "{name}", "{value}",'
        for name, value in zip(arguments[::2], arguments[1::2], strict=True)
    )
    return f'''{_comments(mount)}
"""{kind}: {mount.parent} -> {mount.child}"""
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    nodes = [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            output="log",
            arguments=[
{rows}
            ],
        ),
    ]
    return LaunchDescription(nodes)
'''


def urdf(mount: CameraMount, *others: CameraMount) -> str:
    """A URDF of the two links and the fixed joint between them, and of further cameras and arms."""
    every, parts = (mount, *others), []
    links = dict.fromkeys(name for one in every for name in (one.parent, one.child))
    for one in every:
        parts.append(f"""{_xml_comment(one)}
  <joint name="{one.child}_joint" type="fixed">
    <parent link="{one.parent}"/>
    <child link="{one.child}"/>
    {urdf_origin(one.parent_from_child)}
  </joint>
""")
    named = "".join(f'  <link name="{name}"/>\n' for name in links)
    return f"""<?xml version="1.0"?>
<robot name="hand_eye">
{named}{"".join(parts)}</robot>
"""


def xacro(mount: CameraMount) -> str:
    """A xacro macro that adds the camera's link and joint to a robot: <xacro:hand_eye_camera/>."""
    return f"""<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
{_xml_comment(mount)}
  <xacro:macro name="hand_eye_camera" params="parent:={mount.parent} child:={mount.child}">
    <link name="${{child}}"/>
    <joint name="${{child}}_joint" type="fixed">
      <parent link="${{parent}}"/>
      <child link="${{child}}"/>
      {urdf_origin(mount.parent_from_child)}
    </joint>
  </xacro:macro>
</robot>
"""


def easy_handeye2(mount: CameraMount, name: str) -> str:
    """A .calib file of easy_handeye2, whose publisher finds it as ~/.ros2/easy_handeye2/calibrations/NAME.calib."""
    content = {
        "parameters": {
            "name": name,
            "calibration_type": "eye_on_base" if mount.parent == mount.base else "eye_in_hand",
            "robot_base_frame": mount.base,
            "robot_effector_frame": PARENT if mount.parent == mount.base else mount.parent,
            "tracking_base_frame": mount.child,
            "tracking_marker_frame": "none",
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", mount.parent_from_child[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", _quat_xyzw(mount.parent_from_child), strict=True)),
        },
    }
    return _yaml(mount, content, flow=False)


def joint_offsets(
    offset_and_std_deg: Sequence[tuple[float, float]], p: float | None, doubt: str | None = None
) -> str:
    """YAML of what to add to each reported joint angle (rad), with its standard deviation, from the base on.

    `p` is the chance of the residuals without any systematic error.
    """
    content = {
        "joint_offsets_rad": [float(np.radians(offset)) for offset, _ in offset_and_std_deg],
        "std_rad": [float(np.radians(std)) for _, std in offset_and_std_deg],
        "p": p,
    }
    about = (
        "true joint angle = reported + offset; what no pose shows keeps the standard deviation of any joint"
    )
    if doubt is not None:
        about += f"\n# REJECTED: {doubt}"
    return f"# {about}\n{yaml.safe_dump(content, sort_keys=False)}"


def pose_with_covariance(mount: CameraMount) -> str:
    """A geometry_msgs/PoseWithCovarianceStamped as YAML: 36 numbers, row by row."""
    content = {
        "header": {"frame_id": mount.parent},
        "pose": {
            "pose": {
                "position": dict(zip("xyz", mount.parent_from_child[:3, 3].tolist(), strict=True)),
                "orientation": dict(zip("xyzw", _quat_xyzw(mount.parent_from_child), strict=True)),
            },
            "covariance": mount.covariance.ravel().tolist(),
        },
    }
    order = "covariance: x y z in m, then rotation about x y z in rad, along axes of the parent frame"
    return _yaml(mount, content, order)


def camera_info(mount: CameraMount, intrinsics: Intrinsics) -> str:
    """The intrinsics as camera_info_manager reads them; pixels, (0, 0) is the centre of the first."""

    def matrix(values: ndarray) -> dict[str, Any]:
        return {"rows": len(values), "cols": values.shape[1], "data": values.ravel().tolist()}

    content = {
        "image_width": intrinsics.width,
        "image_height": intrinsics.height,
        "camera_name": mount.child.replace("/", "_"),
        "camera_matrix": matrix(intrinsics.matrix),
        "distortion_model": _DISTORTIONS[intrinsics.model],
        "distortion_coefficients": matrix(np.array([intrinsics.distortion])),
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(np.column_stack([intrinsics.matrix, np.zeros(3)])),
    }
    return _yaml(
        mount, content, f"intrinsics in pixels; distortion {' '.join(COEFFICIENTS[intrinsics.model])}"
    )


def notes(mount: CameraMount) -> list[str]:
    """The lines that every file begins with: frames, units, intrinsics and a reason for rejection."""
    lines = [f"{mount.child} in {mount.parent}: metres, radians, quaternions x y z w; jcr {__version__}"]
    if (given := mount.intrinsics) is not None:
        coefficients = zip(COEFFICIENTS[given.model], given.distortion, strict=True)
        distortion = ", ".join(f"{name} {value:.6g}" for name, value in coefficients)
        lines.append(
            f"belongs to these intrinsics ({given.width} x {given.height} px): fx {given.fx:.6g}, fy {given.fy:.6g}, cx "
            f"{given.cx:.6g}, cy {given.cy:.6g}, {given.model} {distortion}"
        )
    return lines if mount.doubt is None else [*lines, f"REJECTED: {mount.doubt}"]


def _publisher_arguments(parent: str, child: str, parent_from_child: Float[ndarray, "4 4"]) -> list[str]:
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = [*parent_from_child[:3, 3], *_quat_xyzw(parent_from_child)]
    numbers = [word for pair in zip(names, map(_number, values), strict=True) for word in pair]
    return [*numbers, "--frame-id", parent, "--child-frame-id", child]


def _quat_xyzw(a_from_b: Float[ndarray, "4 4"]) -> list[float]:
    return Rotation.from_matrix(a_from_b[:3, :3]).as_quat(canonical=True).tolist()


def _number(value: float) -> str:
    return f"{value:.12f}"


def _comments(mount: CameraMount, *more: str) -> str:
    return "\n".join(f"# {' '.join(line.split())}" for line in [*notes(mount), *more])


def _xml_comment(mount: CameraMount) -> str:
    # Two hyphens would end the comment.
    text = "; ".join(" ".join(line.split()) for line in notes(mount))
    return f"  <!-- {re.sub('-(?=-)', '- ', text)} -->"


def _yaml(mount: CameraMount, content: dict[str, Any], *more: str, flow: bool | None = None) -> str:
    body = yaml.safe_dump(content, sort_keys=False, default_flow_style=flow, width=110)
    return f"{_comments(mount, *more)}\n{body}"
