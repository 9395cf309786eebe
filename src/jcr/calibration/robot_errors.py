"""What is known of the systematic errors of gripper poses before they are fitted: those of an arm, or of any."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.capture.urdf_chain import read_chain
from jcr.errors import InputError
from jcr.estimation.arms import arm_named
from jcr.estimation.equation import Poses
from jcr.estimation.inverse_kinematics import reach_toward
from jcr.estimation.kinematics import Arm, Joints
from jcr.estimation.mounting import LengthError
from jcr.estimation.next_poses import nearest
from jcr.estimation.systematic import arm_errors, posed, smooth_errors
from jcr.findings import Finding, FindingKind
from jcr.records import Capture


@dataclass(frozen=True)
class RobotErrors:
    """What is known of the systematic errors of gripper poses before they are fitted."""

    systematic: Float[ndarray, "r r"]
    """Their covariance at 1 rad, r = 6 times the poses."""
    arm: Arm | None = None
    """With its tool; None where it is not known."""
    joints: Joints | None = None
    """Of the arm, at the poses."""
    unused: Finding | None = None
    """Why the arm that a capture names is not used."""

    def of(self, poses: Int[ndarray, " m"]) -> "RobotErrors":
        """Of some of the poses."""
        joints = None if self.joints is None else self.joints[poses]
        return replace(self, systematic=of_poses(self.systematic, poses), joints=joints)

    def with_poses(self, base_from_gripper: Poses, added: Float[ndarray, "c 4 4"]) -> Float[ndarray, "s s"]:
        """Covariance at 1 rad of the errors of these poses and then of others that the robot may go to, in the posture
        that it has at the nearest of these."""
        if len(added) == 0:
            return self.systematic
        if self.arm is None or self.joints is None:
            return smooth_errors(np.concatenate([base_from_gripper, added]))
        start = self.joints[nearest(added, base_from_gripper)]
        return arm_errors(self.arm, np.concatenate([self.joints, reach_toward(self.arm, added, start)]))


def robot_errors(capture: Capture, options: CalibrateOptions, later: Capture | None = None) -> RobotErrors:
    """What is known of the errors of the capture's gripper poses and of `later` ones of the same robot.

    InputError where the poses are not those of the arm that the user named, or all too long by one factor for that of
    their joint angles; an arm that only the capture names is then not used.
    """
    gripper, joints = capture.base_from_gripper, capture.joints
    if later is not None:
        gripper = np.concatenate([gripper, later.base_from_gripper])
        joints = None if joints is None or later.joints is None else np.concatenate([joints, later.joints])
    try:
        return errors_of(gripper, _arm(capture, options), joints)
    except LengthError:
        raise
    except InputError as error:
        if options.robot is not None:
            raise InputError(f"--robot {options.robot}: {error}") from None
        unused = Finding.of(FindingKind.ROBOT_UNUSED, "warns", "robot", text=str(error))
        return replace(errors_of(gripper), unused=unused)


def errors_of(gripper: Poses, arm: Arm | None = None, joints: Joints | None = None) -> RobotErrors:
    """Of these poses of an arm at these joint angles (rad), or of any robot; unknown angles are found from the poses.

    InputError where poses, joints and arm do not fit.
    """
    if arm is None:
        return RobotErrors(smooth_errors(gripper))
    arm, joints = posed(arm, joints, gripper)
    return RobotErrors(arm_errors(arm, joints), arm, joints)


def _arm(capture: Capture, options: CalibrateOptions) -> Arm | None:
    name = options.robot or capture.robot
    if name is not None:
        return arm_named(name)
    if capture.urdf is None or capture.joints is None:
        return None
    return read_chain(capture.urdf, capture.joints.shape[1])


def of_poses(covariance: Float[ndarray, "r r"], poses: Int[ndarray, " m"]) -> Float[ndarray, "s s"]:
    """The covariance of some of the poses."""
    rows = (6 * poses[:, None] + np.arange(6)).ravel()
    return covariance[np.ix_(rows, rows)]
