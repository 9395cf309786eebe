"""Joint offsets of a known arm that the residuals of the gripper poses show."""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, CheckResult
from jcr.estimation.pose_effects import joint_offsets
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.wrist import pose_problem
from jcr.findings import Finding, FindingKind
from jcr.records import JointOffsets

MIN_EXAMINED = 4
"""Fewest images from which joint offsets are estimated."""
SURE = 2.5
"""Standard deviations from which a joint's offset is named."""


def check_robot(case: Case) -> CheckResult:
    """Return the offsets of a known arm's joints, from the fit to poses.

    A camera that is not as its model has it changes the cameras' poses: then no joint is named.
    """
    used, arm, joints = case.used, case.robot.arm, case.robot.joints
    if len(used) < MIN_EXAMINED or arm is None or joints is None:
        return CheckResult()
    hand_eye = case.hand_eye
    fit = hand_eye.before or hand_eye
    problem, state = pose_problem(
        case.base_from_gripper[used],
        case.recon_from_camera[used],
        (fit.gripper_from_camera, fit.scale, fit.base_from_recon),
        error_covariance=case.systematic,
        noise_floor=fit.robot_noise.given,
    )
    offsets = joint_offsets(pose_equations(problem, state, None), arm, joints[used])
    of_camera = any(finding.kind.row.group == "camera" for finding in hand_eye.findings)
    found = None if of_camera else _joint_finding(offsets)
    return CheckResult(() if found is None else (found,), replace(hand_eye, joint_offsets=offsets))


def _joint_finding(offsets: JointOffsets) -> Finding | None:
    """Return a finding of the joints that are surely off; None where none is."""
    off = np.flatnonzero(np.abs(offsets.offset) > SURE * offsets.std).tolist()
    if not off:
        return None
    sizes = {f"joint_{k + 1}": float(offsets.offset[k]) for k in off}
    stds = {f"joint_{k + 1}_std": float(offsets.std[k]) for k in off}
    value = float(np.abs(offsets.offset[off]).max())
    finding = Finding.of(FindingKind.JOINT_OFFSETS, "informs", "robot", value=value, **sizes, **stds)
    return replace(finding, joints=tuple(k + 1 for k in off))
