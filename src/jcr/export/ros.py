"""Camera frames as text for ROS tools: tf2 launch files, URDF, easy_handeye2, MoveIt, camera_info.

Every text contains the names of its frames, its units, the intrinsics of the camera, and the reason of a rejection.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr import __version__
from jcr.errors import InputError
from jcr.export.options import ExportOptions
from jcr.files import read_bytes
from jcr.geometry import ROOT_FROM_OPTICAL, inverse, roll_pitch_yaw
from jcr.records import COEFFICIENTS, FRAME_NAME, Intrinsics

PARENT, CHILD, BASE = "GRIPPER_FRAME", "camera_color_optical_frame", "base"
"""Names of gripper, camera and robot base where the capture names none; the first is to be replaced by the user."""

_DISTORTIONS = {
    "pinhole": "plumb_bob",
    "rational": "rational_polynomial",
    "thin_prism": "rational_polynomial",
    "fisheye": "equidistant",
}


@dataclass(frozen=True, kw_only=True)
class CameraMount:
    """Frame of a camera, or of another arm's base, and its transform to the parent frame to which it is fixed.

    Construction raises InputError for invalid frame names, and if parent and child have the same name.
    """

    parent: str
    child: str
    parent_from_child: Float[ndarray, "4 4"]
    base: str = BASE
    """Base frame of the arm that carries the parent frame; it is itself the parent of a fixed camera."""
    effector: str = PARENT
    """Gripper frame of the arm, for formats that require one also for a fixed camera."""
    doubt: str | None = None
    """Reason why the calibration is rejected; None if it is accepted."""
    intrinsics: Intrinsics | None = None
    """Intrinsics with which the transform was estimated; None if unknown."""

    def __post_init__(self) -> None:
        """Raise InputError for invalid frame names, and if parent and child have the same name."""
        for name in (self.parent, self.child, self.base, self.effector):
            require_frame_name(name)
        if self.parent == self.child:
            raise InputError(f"parent and child frame are both {self.parent!r}; name two different frames")

    @property
    def is_fixed(self) -> bool:
        """True if the parent frame is the base of the robot, as for a fixed camera."""
        return self.parent == self.base


def require_frame_name(name: str) -> None:
    """Raise InputError for a frame name that tf2 or XML would not accept."""
    if not FRAME_NAME.fullmatch(name):
        raise InputError(f"frame {name!r}: write letters, digits, _ . - and /, and no / in front")


def on_root(
    mount: CameraMount, root: str, root_from_optical: Float[ndarray, "4 4"] = ROOT_FROM_OPTICAL
) -> CameraMount:
    """Return the mount with the camera driver's root link `root` as child instead of the optical frame.

    The driver already publishes a parent of the optical frame, and a frame can have only one. The result has the
    transform parent_from_root = parent_from_optical · inverse(root_from_optical). Raises InputError if `root` is the
    name of parent or child.
    """
    if root in (mount.parent, mount.child):
        raise InputError(f"root frame {root!r}: is the name of another frame; name the camera's root link")
    return replace(mount, child=root, parent_from_child=mount.parent_from_child @ inverse(root_from_optical))


def static_transform_publisher(mount: CameraMount) -> str:
    """Return the shell command that publishes the transform of a mount in ROS 2."""
    return f"ros2 run tf2_ros static_transform_publisher {' '.join(_publisher_arguments(mount))}"


def urdf_origin(parent_from_child: Float[ndarray, "4 4"]) -> str:
    """Return parent_from_child as the XML element `origin` of a URDF joint: xyz (m), rpy (rad, about fixed axes)."""
    parts = parent_from_child[:3, 3], roll_pitch_yaw(parent_from_child[:3, :3])
    xyz, rpy = (" ".join(f"{value:.12f}" for value in part) for part in parts)
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def ros2_launch(mount: CameraMount, others: Sequence[CameraMount] = ()) -> str:
    """Return a ROS 2 launch file (XML) that publishes the transforms of the camera (`mount`) and of `others`."""
    nodes = []
    for k, one in enumerate((mount, *others)):
        arguments = " ".join(_publisher_arguments(one))
        name = "hand_eye_publisher" if k == 0 else f"{re.sub('[^A-Za-z0-9_]', '_', one.child)}_publisher"
        nodes.append(
            f"{xml_comment(*notes(one))}\n"
            f'  <node pkg="tf2_ros" exec="static_transform_publisher" name="{name}" args="{arguments}"/>\n'
        )
    return f"<launch>\n{''.join(nodes)}</launch>\n"


def moveit_launch(mount: CameraMount) -> str:
    """Return a ROS 2 launch file (Python) in the layout that MoveIt Calibration saves."""
    kind = "EYE-TO-HAND" if mount.is_fixed else "EYE-IN-HAND"
    arguments = _publisher_arguments(mount)
    pairs = zip(arguments[::2], arguments[1::2], strict=True)
    rows = "\n".join(f'                "{name}", "{value}",' for name, value in pairs)
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


def urdf(mount: CameraMount, others: Sequence[CameraMount] = (), options: ExportOptions | None = None) -> str:
    """Return a URDF with a fixed joint for each camera and each other arm, and with a single root link.

    If there are cameras on a gripper and fixed cameras, a floating joint stands for the arm between base and gripper.
    With `options.into`, that robot description is returned, with the origin of the camera's joint replaced.
    """
    if options is not None and options.into is not None:
        return _into_robot(options.into, mount)
    every = (mount, *others)
    fixed = [_joint(one.parent, one.child, urdf_origin(one.parent_from_child)) for one in every]
    joints = [f"{xml_comment(*notes(one))}\n{joint}" for one, joint in zip(every, fixed, strict=True)]
    moving = [one for one in every if not one.is_fixed] if any(one.is_fixed for one in every) else []
    arms = dict.fromkeys((one.base, one.parent) for one in moving)
    arm = xml_comment("stands for the arm, which moves: leave it out where the robot's own URDF has it")
    joints += [f"{arm}\n{_joint(base, gripper)}" for base, gripper in arms]
    pairs = [*arms, *((one.parent, one.child) for one in every)]
    links = dict.fromkeys(name for pair in pairs for name in pair)
    named = "".join(f'  <link name="{name}"/>\n' for name in links)
    return f"""<?xml version="1.0"?>
<robot name="hand_eye">
{named}{"".join(joints)}
  <!-- To add the camera to the URDF or xacro of a robot:
  <link name="{mount.child}"/>
{fixed[0]}  -->
</robot>
"""


_XML_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_JOINT = re.compile(r"<joint\b[^>]*>.*?</joint\s*>", re.DOTALL)
_ORIGIN = re.compile(r"<origin\b[^>]*?(?:/>|>\s*</origin\s*>)", re.DOTALL)


def _into_robot(file: Path, mount: CameraMount) -> str:
    """Return a URDF or xacro file with the transform of a mount as origin of the joint whose child is the mount's child.

    All other text is kept. Expressions of xacro in the names of links are ignored. Raises InputError unless there is one
    such joint, fixed and below the parent of the mount.
    """
    try:
        text = read_bytes(file).decode()
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}; name the URDF or xacro of a robot") from None
    except UnicodeDecodeError:
        raise InputError(f"{file}: not UTF-8 text; name the URDF or xacro of a robot") from None
    # Comments keep their place and length, so that places are those of the text.
    plain = _XML_COMMENT.sub(lambda found: " " * len(found[0]), text)
    joints = {found: _links_of(found[0]) for found in _JOINT.finditer(plain)}
    own = [found for found, (_, child) in joints.items() if child == mount.child]
    if len(own) != 1:
        children = ", ".join(sorted({child for _, child in joints.values()})) or "none"
        raise InputError(
            f"{file}: {len(own) or 'no'} joints have the child {mount.child}; name one of its links by --child-frame or "
            f"--to-root: {children}"
        )
    (joint,) = own
    if (parent := joints[joint][0]) != mount.parent:
        raise InputError(
            f"{file}: the joint of {mount.child} has the parent {parent}, the transform is from {mount.parent}; give "
            "poses of that link, or change the joint"
        )
    if not re.match(r"""<joint\b[^>]*\btype\s*=\s*["']fixed["']""", joint[0]):
        raise InputError(f"{file}: the joint of {mount.child} is not fixed; make it fixed")
    origin = _ORIGIN.search(joint[0])
    if origin is not None:
        start, end = joint.start() + origin.start(), joint.start() + origin.end()
        return text[:start] + urdf_origin(mount.parent_from_child) + text[end:]
    start = joint.start() + joint[0].index(">") + 1
    space = re.match(r"\s*", plain[start:])
    assert space is not None
    return text[:start] + space[0] + urdf_origin(mount.parent_from_child) + text[start:]


def _links_of(joint: str) -> tuple[str, str]:
    """Return the names of the parent and child link in the text of a URDF joint, without expressions of xacro."""
    names = [
        re.search(rf"""<{kind}\b[^>]*\blink\s*=\s*["']([^"']*)["']""", joint) for kind in ("parent", "child")
    ]
    parent, child = (
        "" if name is None else re.sub(r"\$\{[^}]*\}|\$\([^)]*\)", "", name[1]) for name in names
    )
    return parent, child


def _joint(parent: str, child: str, origin: str | None = None) -> str:
    """Return the XML of a URDF joint between two links: fixed with the element `origin`; floating if that is None."""
    placed = "" if origin is None else f"    {origin}\n"
    return f"""  <joint name="{child}_joint" type="{"floating" if origin is None else "fixed"}">
    <parent link="{parent}"/>
    <child link="{child}"/>
{placed}  </joint>
"""


def easy_handeye2(mount: CameraMount, name: str) -> str:
    """Return the text of a .calib file, which easy_handeye2 reads as ~/.ros2/easy_handeye2/calibrations/NAME.calib.

    Its transform is parent_from_child of the mount.
    """
    content = {
        "parameters": {
            "name": name,
            "calibration_type": "eye_on_base" if mount.is_fixed else "eye_in_hand",
            "robot_base_frame": mount.base,
            "robot_effector_frame": mount.effector if mount.is_fixed else mount.parent,
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


def camera_info(mount: CameraMount) -> str:
    """Return the intrinsics of a mount as YAML for camera_info_manager (px); (0, 0) is the centre of the first pixel.

    Raises InputError if the intrinsics are unknown.
    """
    if (intrinsics := mount.intrinsics) is None:
        raise InputError("no intrinsics: camera poses were given without images; export another format")

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
    order = f"intrinsics in pixels; distortion {' '.join(COEFFICIENTS[intrinsics.model])}"
    return _yaml(mount, content, order)


def notes(mount: CameraMount) -> list[str]:
    """Return the comments for the start of an exported file, one text a line: frames, units, intrinsics, rejection."""
    lines = [f"{mount.child} in {mount.parent}: metres, radians, quaternions x y z w; jcr {__version__}"]
    if (given := mount.intrinsics) is not None:
        coefficients = zip(COEFFICIENTS[given.model], given.distortion, strict=True)
        distortion = ", ".join(f"{name} {value:.6g}" for name, value in coefficients)
        lines.append(
            f"belongs to these intrinsics ({given.width} x {given.height} px): fx {given.fx:.6g}, fy {given.fy:.6g}, cx "
            f"{given.cx:.6g}, cy {given.cy:.6g}, {given.model} {distortion}"
        )
    return lines if mount.doubt is None else [*lines, f"REJECTED: {mount.doubt}"]


def _publisher_arguments(mount: CameraMount) -> list[str]:
    """Return the arguments of static_transform_publisher: position (m), quaternion x, y, z, w, and both frames."""
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = [*mount.parent_from_child[:3, 3], *_quat_xyzw(mount.parent_from_child)]
    numbers = [word for name, value in zip(names, values, strict=True) for word in (name, f"{value:.12f}")]
    return [*numbers, "--frame-id", mount.parent, "--child-frame-id", mount.child]


def _quat_xyzw(a_from_b: Float[ndarray, "4 4"]) -> list[float]:
    """Return the rotation of a transform as quaternion x, y, z, w with w >= 0."""
    return Rotation.from_matrix(a_from_b[:3, :3]).as_quat(canonical=True).tolist()


def _comments(mount: CameraMount, *more: str) -> str:
    """Return the notes of a mount (frames, units, rejection) and the lines `more` as comments of YAML or Python."""
    return "\n".join(f"# {' '.join(line.split())}" for line in [*notes(mount), *more])


def xml_comment(*lines: str) -> str:
    """Return lines as one XML comment; consecutive hyphens, which would end it, are separated."""
    text = "; ".join(" ".join(line.split()) for line in lines)
    return f"  <!-- {re.sub('-(?=-)', '- ', text)} -->"


def _yaml(mount: CameraMount, content: Mapping[str, Any], *more: str, flow: bool | None = None) -> str:
    """Return YAML text: the notes of a mount (frames, units, rejection) and `more` as comments, then the content."""
    body = yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=flow, width=110)
    return f"{_comments(mount, *more)}\n{body}"
