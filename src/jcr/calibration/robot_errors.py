"""What is known of the arm's systematic errors before the fit, and what the residuals tell of the arm after it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.capture.urdf_chain import read_chain
from jcr.errors import InputError
from jcr.handeye.arms import arm_named
from jcr.handeye.joint_offsets import joint_offsets, systematic_p_value
from jcr.handeye.mounting import LengthError
from jcr.handeye.residuals import angle_ratio
from jcr.handeye.robots import Arm, Joints
from jcr.handeye.systematic import arm_errors, posed, systematic_errors
from jcr.records import Capture, HandEye

MIN_EXAMINED = 4
"""Images from which something may be said of the robot's own errors."""


def robot_examined(
    hand_eye: HandEye,
    gripper: Float[ndarray, "m 4 4"],
    camera: Float[ndarray, "m 4 4"],
    systematic: Float[ndarray, "r r"],
    posed_arm: tuple[Arm, Joints] | None,
) -> HandEye:
    """With what the used poses tell of the robot itself."""
    used = np.flatnonzero(hand_eye.inliers)
    if len(used) < MIN_EXAMINED or not hand_eye.observability.observable:
        return hand_eye
    before = hand_eye if hand_eye.refinement is None else hand_eye.refinement.before
    of_used = before, gripper[used], camera[used], of_poses(systematic, used)
    hand_eye = replace(
        hand_eye,
        systematic_p=systematic_p_value(*of_used),
        angle_ratio=angle_ratio(gripper[used], camera[used]),
    )
    if posed_arm is None:
        return hand_eye
    arm, joints = posed_arm
    return replace(hand_eye, joint_offsets=joint_offsets(*of_used, arm, joints[used]))


def robot_errors(
    capture: Capture, options: CalibrateOptions, later: Capture | None = None
) -> tuple[Float[ndarray, "r r"], tuple[Arm, Joints] | None, str | None]:
    """Covariance of the systematic errors of the capture's gripper poses and of `later` ones of the same robot, the arm
    with its tool and joint angles, and why an arm is not used.

    InputError where the poses are not those of the arm that the user named, or all too long by one factor for that of
    their joint angles; else what a capture says of itself is only doubted.
    """
    gripper, joints = capture.base_from_gripper, capture.joints
    if later is not None:
        gripper = np.concatenate([gripper, later.base_from_gripper])
        joints = None if joints is None or later.joints is None else np.concatenate([joints, later.joints])
    try:
        arm = _arm(capture, options)
        if arm is None:
            return systematic_errors(gripper), None, None
        posed_arm = posed(arm, joints, gripper)
        return arm_errors(*posed_arm), posed_arm, None
    except LengthError:
        raise
    except InputError as error:
        if options.robot is not None:
            raise InputError(f"--robot {options.robot}: {error}") from None
        return systematic_errors(gripper), None, f"the capture's robot is not used: {error}"


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
