"""Estimation of the joint offsets of a known arm, and smooth errors of poses that a leave-one-out error hides."""

from dataclasses import replace
from typing import Any

import numpy as np

from jcr.calibration.case import Case
from jcr.estimation.hypotheses import joint_offsets
from jcr.estimation.pose_equations import PoseEquations, pose_equations
from jcr.estimation.problem import pose_problem
from jcr.findings import Finding, FindingKind, joined
from jcr.geometry import ARM

MIN_EXAMINED = 4
"""Fewest used images with which joint offsets are estimated."""
REPORTED_OFFSET = 2.5
"""Size of a joint offset, in standard deviations, above which it is reported."""

INTERPOLATED = 5.0
"""Ratio of smooth errors of the poses to the leave-one-out error from which it is a finding. Of fourteen real captures
two have 3, the others 0.1 to 1.7. Poses computed with the lengths of another arm, along a dense path, have 6.5. With 2.5
the two are named; with 7.5 those poses are not."""


def _equations(case: Case) -> PoseEquations:
    """Return the equations of the used gripper poses, with the errors of the camera poses: of images, or as stated."""
    if case.solution is not None and case.numbers.source == "images":
        return case.solution.poses
    fit, used = case.fit, case.used
    problem, state = pose_problem(
        case.base_from_gripper[used],
        case.recon_from_camera[used],
        (fit.parent_from_camera, fit.scale, fit.body_from_recon.rigid),
        case.pose_model.of(used),
    )
    return pose_equations(problem, state, None)


def check_robot(case: Case) -> Case:
    """Return the case with estimated joint offsets of a known arm, and a finding on the significant ones.

    An offset (true minus reported angle) is significant above REPORTED_OFFSET standard deviations. No joint is reported
    if there are findings about the camera, whose effects also change the camera poses. Nothing is estimated for an
    unknown arm, or with fewer than MIN_EXAMINED used images.
    """
    used, arm, joints = case.used, case.robot.arm, case.robot.joints
    if not case.is_open or len(used) < MIN_EXAMINED or arm is None or joints is None:
        return case
    found = joint_offsets(_equations(case), arm, joints[used])
    case = replace(case, numbers=replace(case.numbers, joint_offsets=found))
    off = np.flatnonzero(np.abs(found.offset) > REPORTED_OFFSET * found.std).tolist()
    if not off or any(one.kind.row.group == "camera" for one in case.findings):
        return case
    degrees = np.degrees([found.offset, found.std]).T
    sizes = joined(f"{degrees[k, 0]:+.2f} ± {degrees[k, 1]:.2f}°" for k in off)
    named = f"joint{'s' * (len(off) > 1)} {joined(str(k + 1) for k in off)}"
    details: dict[str, Any] = {"shown": f"{named} seem off by {sizes}"}
    for k in off:
        details |= {f"joint_{k + 1}": float(found.offset[k]), f"joint_{k + 1}_std": float(found.std[k])}
    details |= {"joints": tuple(k + 1 for k in off), "value": float(np.abs(found.offset[off]).max())}
    return case.found(Finding.of(FindingKind.JOINT_OFFSETS, "informs", "robot", **details))


def check_smooth_errors(case: Case) -> Case:
    """Return the case with a finding if its poses have smooth errors that the leave-one-out error does not show.

    A pose between two near ones is predicted by them with the errors that all three share. Both errors are compared as
    lengths (`LeaveOneOut.length_m`).
    """
    numbers = case.calibration
    held_out, (metres, radians) = numbers.held_out, numbers.robot_noise.systematic_left
    smooth_m = float(np.sqrt(3) * np.hypot(metres, ARM * radians))
    if not numbers.converged or held_out is None or smooth_m < INTERPOLATED * held_out.length_m:
        return case
    size = {"value": metres, "rotation": radians, "held_out": 1e-3 * held_out.translation_mm}
    if case.robot.arm is not None:
        size |= {"joint": numbers.robot_noise.systematic}
    return case.found(Finding.of(FindingKind.SMOOTH_ERRORS, "warns", "robot", **size))
