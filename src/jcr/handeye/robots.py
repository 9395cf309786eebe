"""Serial arms: forward kinematics, and the errors by which a real arm differs from the one its controller computes.

A chain is F₁ R(a₁, q₁) F₂ R(a₂, q₂) … R(aₙ, qₙ) F: fixed transforms between joint frames, and a rotation about
an axis in each. Denavit-Hartenberg tables of both conventions and URDF chains have that form.

Each joint has errors φ of four kinds:

- `joint`: offset of its zero, q + φ (rad).
- `link`: error of where its axis sits on the link before it, F · exp(ξ): two translations (m) and two rotations
  (rad), perpendicular to the axis. A rotation about the axis is the joint offset; a translation along the axis
  moves a later axis or the gripper, and is contained in their errors. With a constant at the gripper these are
  complete (Mooring, Roth and Driels, "Fundamentals of Manipulator Calibration", 1991; parallel axes need the
  rotations, as in Hayati 1983).
- `sag`: elastic deflection under gravity, φ times the horizontal lever of the gripper about the joint's axis,
  divided by the arm's reach (rad at full stretch).
- `gear`: eccentric encoder or gear, q + φ₁ sin q + φ₂ cos q (rad).

Errors that only move the base (the offset of the first joint) or the gripper (that of the last joint) are not
identifiable: they add to the hand-eye transform or to the base, which the estimator leaves free anyway.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import ARM, rotation_exp, skew, transform

Joints = Float[ndarray, "n dof"]
Kind = Literal["joint", "link", "sag", "gear"]
KINDS: tuple[Kind, ...] = ("joint", "link")
"""The main errors of industrial arms; sag and eccentric gears belong to light and low-cost ones."""
PER_JOINT: dict[Kind, tuple[str, ...]] = {
    "joint": ("joint {}",),
    "link": ("link {} shift 1", "link {} shift 2", "link {} tilt 1", "link {} tilt 2"),
    "sag": ("joint {} sag",),
    "gear": ("joint {} gear sine", "joint {} gear cosine"),
}


@dataclass(frozen=True, eq=False)
class Arm:
    """A chain of revolute joints from the base to the gripper (the flange, unless said otherwise)."""

    name: str
    parent_from_joint: Float[ndarray, "dof 4 4"]
    """Each joint's frame in that of the joint before it (the base), at angle zero."""
    axes: Float[ndarray, "dof 3"]
    """Unit vectors in the joints' frames."""
    last_from_gripper: Float[ndarray, "4 4"]
    limits: Float[ndarray, "dof 2"]
    """Lowest and highest angle (rad)."""
    rest: Float[ndarray, " dof"]
    """A usual posture (rad) over a table, gripper down; the initial estimate of inverse kinematics."""
    forward: Float[ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit vector in the gripper frame along which a tool points."""

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.axes)

    @property
    def reach(self) -> float:
        """Longest way from the second joint's axis to the gripper along the links, in metres."""
        links = [*self.parent_from_joint[2:, :3, 3], self.last_from_gripper[:3, 3]]
        return float(np.linalg.norm(links, axis=1).sum())


@dataclass(frozen=True)
class ErrorSizes:
    """One-sigma sizes of an arm's errors."""

    joint_offset: float = 0.0
    """rad, of each joint."""
    link: float = 0.0
    """m, of each translation of a link. Its rotations have this divided by geometry.ARM (0.3 m), a typical length
    of a link, in rad: 0.3 mm goes with 0.06°."""
    sag: float = 0.0
    """rad, of each joint with the arm stretched out."""
    gear: float = 0.0
    """rad, of sine and cosine each."""


def from_dh(
    name: str,
    rows: Sequence[tuple[float, float, float, float]],
    limits: Sequence[tuple[float, float]],
    rest: Sequence[float],
    *,
    modified: bool,
    last_from_gripper: Float[ndarray, "4 4"] | None = None,
) -> Arm:
    """An arm from rows (a, d, α, θ₀) in metres and radians, of standard (distal) or modified (Craig) parameters.

    Standard: R_z(q+θ₀) T_z(d) T_x(a) R_x(α). Modified: R_x(α) T_x(a) R_z(q+θ₀) T_z(d), α and a being those of
    the link before.
    """
    frame = np.eye(4)
    frames = []
    for a, d, alpha, theta in rows:
        about_x = _dh_x(a, alpha)
        about_z = transform(rotation_exp(np.array([0.0, 0.0, theta])), np.array([0.0, 0.0, d]))
        frames.append(frame @ about_x if modified else frame)
        frame = about_z if modified else about_z @ about_x
    if last_from_gripper is not None:
        frame = frame @ last_from_gripper
    axes = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    return Arm(name, np.stack(frames), axes, frame, np.array(limits, float), np.array(rest, float))


def _dh_x(a: float, alpha: float) -> Float[ndarray, "4 4"]:
    return transform(rotation_exp(np.array([alpha, 0.0, 0.0])), np.array([a, 0.0, 0.0]))


def with_tool(arm: Arm, flange_from_tool: Float[ndarray, "4 4"]) -> Arm:
    """The arm with its gripper frame at a tool."""
    return replace(arm, last_from_gripper=arm.last_from_gripper @ flange_from_tool)


def joint_frames(arm: Arm, joints: Joints) -> tuple[Float[ndarray, "n dof 4 4"], Float[ndarray, "n 4 4"]]:
    """base_from_joint of each joint, not yet rotated by it, and base_from_gripper."""
    return _chain(arm, joints, np.broadcast_to(arm.parent_from_joint, (*joints.shape, 4, 4)))


def forward_kinematics(arm: Arm, joints: Joints) -> Float[ndarray, "n 4 4"]:
    """base_from_gripper (n,4,4) of the nominal arm at joint angles (n,dof) in rad."""
    return joint_frames(arm, joints)[1]


def kinematic_jacobian(arm: Arm, joints: Joints) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, "n 6 dof"]]:
    """base_from_gripper, and its twist (v of the gripper's origin, ω; base axes) per rad of each joint."""
    frames, gripper = joint_frames(arm, joints)
    return gripper, np.swapaxes(_about(frames, gripper, arm.axes), 1, 2)


def error_names(arm: Arm, kinds: Sequence[Kind] = KINDS) -> tuple[str, ...]:
    """Names of the columns of `error_jacobian`, joints counted from 1: "joint 3", "link 2 tilt 1"."""
    return tuple(text.format(i + 1) for kind in kinds for i in range(arm.dof) for text in PER_JOINT[kind])


def error_std(arm: Arm, sizes: ErrorSizes, kinds: Sequence[Kind] = KINDS) -> Float[ndarray, " p"]:
    """Prior standard deviation of each column: m for the two shifts of a link, else rad."""
    of_kind: dict[Kind, list[float]] = {
        "joint": [sizes.joint_offset],
        "link": [sizes.link] * 2 + [sizes.link / ARM] * 2,
        "sag": [sizes.sag],
        "gear": [sizes.gear] * 2,
    }
    return np.concatenate([np.tile(of_kind[kind], arm.dof) for kind in kinds])


def error_jacobian(arm: Arm, joints: Joints, kinds: Sequence[Kind] = KINDS) -> Float[ndarray, "n 6 p"]:
    """Derivative of the gripper's true pose by the arm's errors, at errors zero.

    Rows are those of `equation.residuals`, steps of geometry.retract from the reported pose (m, rad; base axes), to
    which errors φ add `error_jacobian · φ`.
    """
    frames, gripper = joint_frames(arm, joints)
    about = _about(frames, gripper, arm.axes)
    blocks: dict[Kind, Float[ndarray, "n dof k 6"]] = {}
    if "joint" in kinds:
        blocks["joint"] = about[:, :, None]
    if "link" in kinds:
        sideways = frames[..., :3, :3] @ _perpendicular(arm.axes)
        shifts = np.zeros((*joints.shape, 2, 6))
        shifts[..., :3] = np.swapaxes(sideways, -1, -2)
        tilts = np.stack([_twist(frames, gripper, sideways[..., k]) for k in range(2)], 2)
        blocks["link"] = np.concatenate([shifts, tilts], axis=2)
    if "sag" in kinds:
        # The derivative of the gripper's height by the angle is the lever of its weight about the axis.
        blocks["sag"] = (about * (about[..., 2:3] / arm.reach))[:, :, None]
    if "gear" in kinds:
        waves = np.stack([np.sin(joints), np.cos(joints)], -1)
        blocks["gear"] = waves[..., None] * about[:, :, None]
    columns = np.concatenate([blocks[kind].reshape(len(joints), -1, 6) for kind in kinds], axis=1)
    return np.swapaxes(columns, 1, 2)


def bent_kinematics(
    arm: Arm, joints: Joints, errors: Float[ndarray, " p"], kinds: Sequence[Kind] = KINDS
) -> Float[ndarray, "n 4 4"]:
    """base_from_gripper (n,4,4) of an arm with errors (p,), in the order of `error_names`, at reported joint angles.

    Exact, except that the lever of sag is that of the nominal arm.
    """
    parts = _split(arm, errors, kinds)
    angles = joints + parts["joint"][:, 0]
    if "gear" in kinds:
        angles = angles + np.sin(joints) * parts["gear"][:, 0] + np.cos(joints) * parts["gear"][:, 1]
    if "sag" in kinds:
        lever = _about(*joint_frames(arm, joints), arm.axes)[..., 2]
        angles = angles + lever / arm.reach * parts["sag"][:, 0]
    sideways = _perpendicular(arm.axes)
    link = parts["link"]
    moved = transform(
        rotation_exp((sideways @ link[:, 2:, None])[..., 0]), (sideways @ link[:, :2, None])[..., 0]
    )
    return _chain(arm, angles, np.broadcast_to(arm.parent_from_joint @ moved, (*joints.shape, 4, 4)))[1]


def _split(
    arm: Arm, errors: Float[ndarray, " p"], kinds: Sequence[Kind]
) -> dict[Kind, Float[ndarray, "dof k"]]:
    parts: dict[Kind, Float[ndarray, "dof k"]] = {
        kind: np.zeros((arm.dof, len(texts))) for kind, texts in PER_JOINT.items()
    }
    at = 0
    for kind in kinds:
        size = parts[kind].size
        parts[kind] = errors[at : at + size].reshape(parts[kind].shape)
        at += size
    return parts


def _chain(
    arm: Arm, angles: Joints, parent_from_joint: Float[ndarray, "n dof 4 4"]
) -> tuple[Float[ndarray, "n dof 4 4"], Float[ndarray, "n 4 4"]]:
    turn = np.zeros((*angles.shape, 4, 4))
    cross = skew(arm.axes)
    turn[..., :3, :3] = (
        np.eye(3)
        + np.sin(angles)[..., None, None] * cross
        + (1 - np.cos(angles))[..., None, None] * (cross @ cross)
    )
    turn[..., 3, 3] = 1.0
    frames = np.empty((*angles.shape, 4, 4))
    at = np.broadcast_to(np.eye(4), (len(angles), 4, 4))
    for i in range(arm.dof):
        frames[:, i] = at @ parent_from_joint[:, i]
        at = frames[:, i] @ turn[:, i]
    return frames, at @ arm.last_from_gripper


def _about(
    frames: Float[ndarray, "n dof 4 4"], gripper: Float[ndarray, "n 4 4"], axes: Float[ndarray, "dof 3"]
) -> Float[ndarray, "n dof 6"]:
    """The gripper's twist (v of its origin, ω; base axes) per rad of each joint."""
    return _twist(frames, gripper, (frames[..., :3, :3] @ axes[..., None])[..., 0])


def _twist(
    frames: Float[ndarray, "n dof 4 4"],
    gripper: Float[ndarray, "n 4 4"],
    axis_in_base: Float[ndarray, "n dof 3"],
) -> Float[ndarray, "n dof 6"]:
    lever = gripper[:, None, :3, 3] - frames[..., :3, 3]
    return np.concatenate([np.cross(axis_in_base, lever), axis_in_base], axis=-1)


def _perpendicular(axes: Float[ndarray, "dof 3"]) -> Float[ndarray, "dof 3 2"]:
    """Two unit vectors perpendicular to each axis: the frame's x and y where the axis is its z."""
    order = np.argsort(np.abs(axes), axis=1, kind="stable")
    first = np.eye(3)[order[:, 0]]
    first = first - (first * axes).sum(1, keepdims=True) * axes
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axes, first)], -1)


def unwrapped(angles: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """Angles in [-π, π)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
