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
from jcr.records import AngleRatio, Capture, Finding, HandEye, Kind, RobotExamined

MIN_EXAMINED = 4
"""Images from which something may be said of the robot's own errors."""
CLEAR = 0.01
"""Chance of residuals by random errors alone, below which systematic ones are spoken of."""
SURE = 2.5
"""Standard deviations from which a joint's offset, or a ratio of angles, is named."""
NOTABLE_RATIO = 0.003
NOTABLE_ERRORS = 3e-5, float(np.radians(0.003))
"""m, rad; real arms err by more, and of less nobody need hear."""


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
    before = hand_eye.before or hand_eye
    of_used = before, gripper[used], camera[used], of_poses(systematic, used)
    offsets = None
    if posed_arm is not None:
        arm, joints = posed_arm
        offsets = joint_offsets(*of_used, arm, joints[used])
    ratio = AngleRatio(*angle_ratio(gripper[used], camera[used]))
    examined = RobotExamined(hand_eye.robot_noise, systematic_p_value(*of_used), offsets, ratio)
    found = filter(None, (_systematic_finding(examined), angle_finding(ratio.ratio, ratio.std)))
    return replace(hand_eye, robot=examined).with_findings(*found)


def angle_finding(ratio: float, std: float) -> Finding | None:
    """Camera angles over gripper angles, where they are clearly not 1; which X it is does not matter."""
    if abs(ratio - 1) <= max(SURE * std, NOTABLE_RATIO):
        return None
    return Finding(kind=Kind.ANGLE_RATIO, severity="informs", mend="robot", value=ratio, std=std)


def _systematic_finding(robot: RobotExamined) -> Finding | None:
    """Systematic errors of the poses where they are clear, by joint where single joints are surely off."""
    left, p = robot.noise.systematic_left, robot.systematic_p
    if p is None or p >= CLEAR or (left[0] <= NOTABLE_ERRORS[0] and left[1] <= NOTABLE_ERRORS[1]):
        return None
    offsets = robot.joint_offsets
    off = [] if offsets is None else np.flatnonzero(np.abs(offsets.offset) > SURE * offsets.std).tolist()
    if offsets is None or not off:
        return Finding(
            kind=Kind.SYSTEMATIC_ERRORS,
            severity="informs",
            mend="robot",
            value=left[0],
            p=p,
            details={"rotation": left[1]},
        )
    sizes = {f"joint_{k + 1}": float(offsets.offset[k]) for k in off}
    stds = {f"joint_{k + 1}_std": float(offsets.std[k]) for k in off}
    return Finding(
        kind=Kind.JOINT_OFFSETS,
        severity="informs",
        mend="robot",
        joints=tuple(k + 1 for k in off),
        value=float(np.abs(offsets.offset[off]).max()),
        p=p,
        details=sizes | stds,
    )


def robot_errors(
    capture: Capture, options: CalibrateOptions, later: Capture | None = None
) -> tuple[Float[ndarray, "r r"], tuple[Arm, Joints] | None, Finding | None]:
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
        unused = Finding(kind=Kind.ROBOT_UNUSED, severity="warns", mend="robot", details={"text": str(error)})
        return systematic_errors(gripper), None, unused


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
