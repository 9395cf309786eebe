"""An arm that differs from the one that its controller computes: joint offsets, link errors, sag, eccentric gears.

Offsets and link errors are those of estimation/kinematics.py. Light and low-cost arms have two kinds more:

- sag: elastic deflection under gravity, φ times the horizontal lever of the gripper about the joint's axis, divided by
  the arm's reach (rad at full stretch);
- an eccentric encoder or gear, q + φ₁ sin q + φ₂ cos q (rad).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.kinematics import (
    LINK_ERRORS,
    Arm,
    Joints,
    axis_twists,
    error_std,
    forward_kinematics,
    joint_frames,
    perpendicular,
)
from jcr.geometry import rotation_exp, transform

NAMES = (
    ("joint {}",),
    ("link {} shift 1", "link {} shift 2", "link {} tilt 1", "link {} tilt 2"),
    ("joint {} sag",),
    ("joint {} gear sine", "joint {} gear cosine"),
)
"""Of the errors of each joint, counted from 1: those of all joints of the first kind, then of the second."""


@dataclass(frozen=True)
class ErrorSizes:
    """One-sigma sizes of an arm's errors."""

    joint_offset: float = 0.0
    """rad, of each joint."""
    link: float = 0.0
    """m, of each translation of a link; its rotations go with it (robots.error_std)."""
    sag: float = 0.0
    """rad, of each joint with the arm stretched out."""
    gear: float = 0.0
    """rad, of sine and cosine each."""


@dataclass(frozen=True)
class BentArm:
    """An arm with drawn errors."""

    arm: Arm
    errors: Float[ndarray, " p"]
    """The errors in the order of `error_names`; m and rad."""

    def reported(self, joints: Joints) -> Float[ndarray, "n 4 4"]:
        """base_from_gripper (n,4,4) as the controller computes it."""
        return forward_kinematics(self.arm, joints)

    def true(self, joints: Joints) -> Float[ndarray, "n 4 4"]:
        """base_from_gripper (n,4,4) of the bent arm; exact, except that the lever of sag is that of the nominal arm."""
        dof, arm = self.arm.dof, self.arm
        offset, link, sag, gear = np.split(self.errors, dof * np.cumsum([1, LINK_ERRORS, 1]))
        sine, cosine = gear.reshape(dof, 2).T
        lever = axis_twists(arm, *joint_frames(arm, joints))[..., 2]
        angles = joints + offset + np.sin(joints) * sine + np.cos(joints) * cosine + lever / arm.reach * sag
        sideways, link = perpendicular(arm.axes), link.reshape(dof, 2, 2, 1)
        shift, tilt = (sideways @ link[:, part] for part in range(2))
        moved = transform(rotation_exp(tilt[..., 0]), shift[..., 0])
        return forward_kinematics(replace(arm, parent_from_joint=arm.parent_from_joint @ moved), angles)

    def named_errors(self) -> dict[str, float]:
        """The errors that are not zero, by name (m, rad)."""
        names = error_names(self.arm)
        return {name: float(value) for name, value in zip(names, self.errors, strict=True) if value}


def error_names(arm: Arm) -> tuple[str, ...]:
    """Names of an arm's errors in their order: "joint 3", "link 2 tilt 1"."""
    return tuple(text.format(i + 1) for texts in NAMES for i in range(arm.dof) for text in texts)


def bend(arm: Arm, sizes: ErrorSizes, rng: np.random.Generator) -> BentArm:
    """The arm with random errors of the given sizes."""
    std = np.r_[
        error_std(arm, sizes.joint_offset, sizes.link),
        np.repeat([sizes.sag, sizes.gear], [arm.dof, 2 * arm.dof]),
    ]
    return BentArm(arm, std * rng.normal(size=len(std)))
