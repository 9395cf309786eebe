"""What do the residuals show of the robot itself: systematic errors, joints that are off, angles that differ?"""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, Checked
from jcr.calibration.robot_errors import of_poses
from jcr.estimation.joint_offsets import joint_offsets, systematic_p_value
from jcr.estimation.residuals import angle_ratio
from jcr.records import CAMERA, AngleRatio, Finding, Kind, RobotExamined

MIN_EXAMINED = 4
"""Images from which something may be said of the robot's own errors."""
CLEAR = 0.01
"""Chance of residuals by random errors alone, below which systematic ones are spoken of."""
SURE = 2.5
"""Standard deviations from which a joint's offset, or a ratio of angles, is named."""
NOTABLE_RATIO = 0.003
NOTABLE_ERRORS = 3e-5, float(np.radians(0.003))
"""m, rad: smaller systematic errors, which every real arm has, are not reported."""


def check_robot(case: Case) -> Checked:
    """Systematic errors, joint offsets, and camera angles that differ from the robot's, by the fit to poses."""
    used, arm, joints = case.used, case.robot.arm, case.robot.joints
    if len(used) < MIN_EXAMINED:
        return Checked()
    hand_eye = case.hand_eye
    gripper, camera = case.base_from_gripper[used], case.reconstruction.recon_from_camera[used]
    fit = hand_eye.before or hand_eye, gripper, camera, of_poses(case.robot.systematic, used)
    offsets = None if arm is None or joints is None else joint_offsets(*fit, arm, joints[used])
    ratio = AngleRatio(*angle_ratio(gripper, camera))
    examined = RobotExamined(hand_eye.robot_noise, systematic_p_value(*fit), offsets, ratio)
    found = [_systematic_finding(examined), angle_finding(ratio.ratio, ratio.std)]
    # A camera that is not as it was taken for changes the cameras' poses: that is no fault of the robot.
    if any(finding.kind in CAMERA for finding in hand_eye.findings):
        found = []
    return Checked(tuple(filter(None, found)), replace(hand_eye, robot=examined))


def angle_finding(ratio: float, std: float) -> Finding | None:
    """Camera angles over gripper angles, where they are clearly not 1; which X it is does not matter."""
    if abs(ratio - 1) <= max(SURE * std, NOTABLE_RATIO):
        return None
    return Finding.of(Kind.ANGLE_RATIO, "informs", "robot", value=ratio, std=std)


def _systematic_finding(robot: RobotExamined) -> Finding | None:
    """Systematic errors of the poses where they are clear, by joint where single joints are surely off."""
    left, p = robot.noise.systematic_left, robot.systematic_p
    if p is None or p >= CLEAR or (left[0] <= NOTABLE_ERRORS[0] and left[1] <= NOTABLE_ERRORS[1]):
        return None
    offsets = robot.joint_offsets
    off = [] if offsets is None else np.flatnonzero(np.abs(offsets.offset) > SURE * offsets.std).tolist()
    if offsets is None or not off:
        return Finding.of(Kind.SYSTEMATIC_ERRORS, "informs", "robot", value=left[0], p=p, rotation=left[1])
    sizes = {f"joint_{k + 1}": float(offsets.offset[k]) for k in off}
    stds = {f"joint_{k + 1}_std": float(offsets.std[k]) for k in off}
    value = float(np.abs(offsets.offset[off]).max())
    finding = Finding.of(Kind.JOINT_OFFSETS, "informs", "robot", value=value, p=p, **sizes, **stds)
    return replace(finding, joints=tuple(k + 1 for k in off))
