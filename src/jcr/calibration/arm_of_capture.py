"""The arm of a capture, and the prior covariance of its systematic errors: joint and link errors, or smooth ones."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.capture.urdf_chain import read_chain
from jcr.errors import InputError
from jcr.estimation.arms import arm_named
from jcr.estimation.inverse_kinematics import LengthError, inverse_kinematics, mounted_arm
from jcr.estimation.kinematics import Arm, Joints, with_tool
from jcr.estimation.robot_noise import arm_errors, of_poses, smooth_errors
from jcr.findings import Finding, FindingKind
from jcr.geometry import Poses
from jcr.records import Capture

REFUSED = (0.01, np.radians(1.0))
"""Largest misfit of poses to the named robot, as a share of its reach and in rad; above, InputError is raised."""


@dataclass(frozen=True)
class RobotErrorPrior:
    """Prior covariance of the systematic errors of gripper poses, and the arm and joint angles it is computed from."""

    systematic: Float[ndarray, "r r"]
    """Covariance (m, rad) of the pose errors for joint errors of 1 rad, r = 6 times the number of poses."""
    arm: Arm | None = None
    """Kinematics of the arm and its tool; None: unknown, errors vary smoothly over the poses."""
    joints: Joints | None = None
    """Joint angles (rad) at the poses; None without an arm."""
    unused: Finding | None = None
    """Finding that the poses do not fit the arm that the capture names; None if they fit or no arm is named."""

    def of(self, poses: Int[ndarray, " m"]) -> "RobotErrorPrior":
        """Return the prior of the errors of some poses, given by their indices, in the order of the indices."""
        joints = None if self.joints is None else self.joints[poses]
        return replace(self, systematic=of_poses(self.systematic, poses), joints=joints)


def robot_errors(
    capture: Capture, options: CalibrateOptions, later: Capture | None = None
) -> RobotErrorPrior:
    """Return the prior covariance of systematic errors of a capture's gripper poses, then of a `later` capture's.

    Raises InputError if the poses do not fit the arm of the option `robot`. Raises LengthError for any arm if all poses
    are too long by one factor for their joint angles. An arm that only the capture names and that the poses do not fit
    is not used; `unused` of the result is then a finding.
    """
    gripper, joints = capture.base_from_gripper, capture.joints
    if later is not None:
        gripper = np.concatenate([gripper, later.base_from_gripper])
        joints = None if joints is None or later.joints is None else np.concatenate([joints, later.joints])
    name = options.robot or capture.robot
    try:
        arm = None if name is None else arm_named(name)
        if name is None and capture.urdf is not None and capture.joints is not None:
            arm = read_chain(capture.urdf, capture.joints.shape[1])
        return errors_of(gripper, arm, joints)
    except LengthError:
        raise
    except InputError as error:
        if options.robot is not None:
            raise InputError(f"robot {options.robot}: {error}") from None
        unused = Finding.of(FindingKind.ROBOT_UNUSED, "warns", "robot", text=str(error))
        return replace(errors_of(gripper), unused=unused)


def errors_of(gripper: Poses, arm: Arm | None = None, joints: Joints | None = None) -> RobotErrorPrior:
    """Return the prior covariance of systematic errors of gripper poses, for an arm or (None) an unknown robot.

    The covariance is that for an error size of 1 rad (`RobotErrorPrior.systematic`). `gripper` holds base_from_gripper
    (m). `joints` (n,dof) are the joint angles (rad), to which base and tool of the arm are fitted; None: inverse
    kinematics computes angles and tool. Raises InputError if the poses do not fit the arm and the angles.
    """
    if arm is None:
        return RobotErrorPrior(smooth_errors(gripper))
    if joints is not None:
        arm = mounted_arm(arm, joints, gripper)
    else:
        posture = inverse_kinematics(arm, gripper)
        metres, radians = posture.misfit.max(0)
        if metres > REFUSED[0] * arm.reach or radians > REFUSED[1]:
            raise InputError(
                f"poses do not fit a {arm.name}: {1e3 * metres:.0f} mm, {np.degrees(radians):.1f}° off; name another "
                "robot, or leave it out"
            )
        arm, joints = with_tool(arm, posture.flange_from_tool), posture.joints
    return RobotErrorPrior(arm_errors(arm, joints), arm, joints)
