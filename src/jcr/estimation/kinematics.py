"""Serial arms: forward kinematics, Jacobians, and the kinematic errors of a real arm against its nominal model.

A chain is F₁ R(a₁, q₁) F₂ R(a₂, q₂) … R(aₙ, qₙ) F: fixed transforms between joint frames, and a rotation about
an axis in each. Denavit-Hartenberg tables of both conventions and URDF chains have that form.

Each joint has errors of two kinds, the main ones of industrial arms:

- the offset of its zero, q + φ (rad);
- the error of its axis on the previous link, F · exp(ξ): two translations (m) and two rotations (rad), perpendicular
  to the axis. A rotation about the axis is the joint offset; a translation along the axis is contained in the errors
  of the next axis or of the gripper.

Together with a constant error at the gripper they are complete (Mooring, Roth and Driels, "Fundamentals of Manipulator
Calibration", 1991; parallel axes need the rotations, as in Hayati 1983). Errors that only move the base (offset of the
first joint) or the gripper (offset of the last joint) are not identifiable: the hand-eye transform or base_from_recon
absorbs them.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import ARM, Poses, Transform, rotation_exp, transform

Joints = Float[ndarray, "n dof"]
LINK_ERRORS = 4
"""Number of link errors of each joint: two translations, two rotations."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Arm:
    """Kinematic model of a serial arm: revolute joints from the base to the gripper frame, usually the flange."""

    name: str
    parent_from_joint: Float[ndarray, "dof 4 4"]
    """Frame of each joint in the frame of the previous joint (of the base for the first), at angle zero."""
    axes: Float[ndarray, "dof 3"]
    """Unit vector of each joint's axis, in the joint's frame."""
    last_from_gripper: Transform
    """Gripper frame in the frame of the last joint."""
    limits: Float[ndarray, "dof 2"]
    """Smallest and largest angle of each joint (rad)."""
    rest: Float[ndarray, " dof"]
    """Rest posture: joint angles (rad) of a typical pose over a table with the gripper down."""
    forward: Float[ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit vector in the gripper frame along which a tool points."""

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.axes)

    @property
    def reach(self) -> float:
        """Sum of the link lengths from the second joint's axis to the gripper (m)."""
        links = [*self.parent_from_joint[2:, :3, 3], self.last_from_gripper[:3, 3]]
        return float(np.linalg.norm(links, axis=1).sum())


def with_tool(arm: Arm, flange_from_tool: Transform) -> Arm:
    """Return the arm whose gripper frame is the tool, `flange_from_tool` relative to the present gripper frame."""
    return replace(arm, last_from_gripper=arm.last_from_gripper @ flange_from_tool)


def joint_frames(arm: Arm, joints: Joints) -> tuple[Float[ndarray, "n dof 4 4"], Poses]:
    """Return base_from_joint (n,dof,4,4) without each joint's own rotation, and base_from_gripper (n,4,4).

    `joints` (n,dof) are the joint angles in rad.
    """
    rotated = transform(rotation_exp(joints[..., None] * arm.axes), np.zeros(3))
    frames = np.empty((*joints.shape, 4, 4))
    at = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    for i in range(arm.dof):
        frames[:, i] = at @ arm.parent_from_joint[i]
        at = frames[:, i] @ rotated[:, i]
    return frames, at @ arm.last_from_gripper


def forward_kinematics(arm: Arm, joints: Joints) -> Poses:
    """Return base_from_gripper (n,4,4) of the nominal arm at joint angles (n,dof) in rad."""
    return joint_frames(arm, joints)[1]


def kinematic_jacobian(arm: Arm, joints: Joints) -> tuple[Poses, Float[ndarray, "n 6 dof"]]:
    """Return base_from_gripper and its Jacobian: velocity (of its origin, m; then ω, rad; base axes) per rad of a joint.

    `joints` (n,dof) are the joint angles in rad.
    """
    frames, gripper = joint_frames(arm, joints)
    return gripper, np.swapaxes(twists(frames, gripper, arm.axes), 1, 2)


def error_std(arm: Arm, joint_offset: float, link: float) -> Float[ndarray, " p"]:
    """Return the standard deviation of each of the p = 5 dof kinematic errors, in the order of `error_jacobian`.

    `joint_offset` (rad) and `link` (m) are the standard deviations of joint offsets and link translations. Link
    rotations have `link` / geometry.ARM, the typical length of a link: 0.3 mm goes with 0.06°.
    """
    return np.r_[np.full(arm.dof, joint_offset), np.tile([link, link, link / ARM, link / ARM], arm.dof)]


def error_jacobian(arm: Arm, joints: Joints) -> Float[ndarray, "n 6 p"]:
    """Return the derivative of the gripper's true pose by the p = 5 dof kinematic errors, at errors zero.

    Rows are the step from the nominal to the true pose (m, rad; base axes). Columns are the offsets of all joints
    (rad), then for each joint two translations (m) and two rotations (rad) of its axis, perpendicular to the axis.
    """
    frames, gripper = joint_frames(arm, joints)
    sideways, links = perpendicular(arm.axes), np.zeros((*joints.shape, LINK_ERRORS, 6))
    links[..., :2, :3] = np.swapaxes(frames[..., :3, :3] @ sideways, -1, -2)
    for k in range(2):
        links[..., 2 + k, :] = twists(frames, gripper, sideways[..., k])
    about = twists(frames, gripper, arm.axes)
    return np.swapaxes(np.concatenate([about, links.reshape(len(joints), -1, 6)], axis=1), 1, 2)


def twists(
    frames: Float[ndarray, "n dof 4 4"], gripper: Poses, axes: Float[ndarray, "dof 3"]
) -> Float[ndarray, "n dof 6"]:
    """Return the gripper's velocity (of its origin, then ω; base axes) per rad of rotation about an axis of each joint.

    The axes, in the joint frames, pass through their origins. `frames` and `gripper` are base_from_joint and
    base_from_gripper, the results of `joint_frames`.
    """
    axis_in_base = (frames[..., :3, :3] @ axes[..., None])[..., 0]
    lever = gripper[:, None, :3, 3] - frames[..., :3, 3]
    return np.concatenate([np.cross(axis_in_base, lever), axis_in_base], axis=-1)


def perpendicular(axes: Float[ndarray, "dof 3"]) -> Float[ndarray, "dof 3 2"]:
    """Return two unit vectors (columns) perpendicular to each axis; for an axis along z they are along x and y."""
    order = np.argsort(np.abs(axes), axis=1, kind="stable")
    first = np.eye(3)[order[:, 0]]
    first = first - (first * axes).sum(1, keepdims=True) * axes
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], -1)
