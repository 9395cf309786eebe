"""Calibration from given camera poses, without images."""

from dataclasses import replace
from functools import partial

import numpy as np

from jcr.calibration.case import with_findings
from jcr.calibration.checks.convention import better_reading, convention_finding
from jcr.calibration.checks.effects import effects_of_fit, with_rejected_runs
from jcr.calibration.cues import height_cue
from jcr.calibration.hand_eye import SCALE_STD, solve_hand_eye
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.record import Calibration
from jcr.calibration.requirement import advised, assumptions_of_poses
from jcr.calibration.robot_errors import RobotErrorPrior, errors_of
from jcr.errors import InputError
from jcr.estimation.arms import arm_named
from jcr.estimation.problem import pose_problem
from jcr.findings import Finding, FindingKind, is_explained
from jcr.records import PosePairs

METRIC_STD = 0.005
"""Relative standard deviation of the size of a printed marker."""


def calibrate_pose_pairs(pairs: PosePairs, options: CalibrateOptions | None = None) -> Calibration:
    """Calibrate from given camera poses, without images.

    The estimated scale of metric poses tests the given size of the marker; where motions do not determine the scale, it
    is taken as 1.
    """
    check_options(options := options or CalibrateOptions())
    robot = errors_of(pairs.base_from_gripper, None if options.robot is None else arm_named(options.robot))
    hand_eye = _calibrated_poses(pairs, options, robot)
    if hand_eye.observability.observable and not is_explained(hand_eye.findings):
        start = hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon.rigid
        problem, state = pose_problem(
            pairs.base_from_gripper,
            pairs.recon_from_camera,
            start,
            error_covariance=robot.systematic,
            noise_floor=options.robot_noise_m_rad,
        )
        problem = replace(problem, used=with_rejected_runs(hand_eye.inliers))
        hand_eye = with_findings(hand_eye, effects_of_fit(problem, state, hand_eye, pairs.images))
    is_known = options.scale is not None or (pairs.is_metric and is_one(hand_eye))
    gripper = pairs.base_from_gripper
    assumptions = assumptions_of_poses(hand_eye, gripper[hand_eye.inliers], SCALE_STD if is_known else None)
    return advised(hand_eye, gripper, options, robot, assumptions).of_capture(pairs, pairs)


def _calibrated_poses(pairs: PosePairs, options: CalibrateOptions, robot: RobotErrorPrior) -> Calibration:
    gripper, camera, noise = pairs.base_from_gripper, pairs.recon_from_camera, options.robot_noise_m_rad
    if options.known_length is not None:
        raise InputError("--known-length: there are no images in which it could be seen; leave it out")
    height = options.known_height
    solve = partial(
        solve_hand_eye,
        gripper,
        camera,
        robot_noise=noise,
        offset=None if height is None else height_cue(gripper, height / 1e3),
        systematic=robot.systematic,
        in_sequence=not pairs.is_metric,  # poses of a marker of known size are found each by itself
        names=pairs.images,
    )
    hand_eye = free = solve()
    scale = 1.0 if options.scale is None and pairs.is_metric else options.scale
    # A known size makes few samples worth more; where the robot's motion excludes it, the motion decides.
    if scale is not None and (options.scale is not None or not free.converged or is_one(free)):
        hand_eye = solve(scale=scale)
        if not free.observability.observable and scale == 1.0:
            return hand_eye.with_findings(Finding.of(FindingKind.SCALE_ASSUMED, "warns", "motion"))
    if not hand_eye.converged:
        found = better_reading(gripper, camera)
        if found is None:
            return hand_eye
        # Of degenerate motions another convention may fit by chance: what is missing comes first.
        severity = "rejects" if hand_eye.observability.observable else "warns"
        return hand_eye.with_findings(convention_finding(found, severity))
    if pairs.is_metric and not is_one(hand_eye):
        return hand_eye.with_findings(
            Finding.of(
                FindingKind.BOARD_SIZE,
                "warns",
                "intrinsics",
                value=hand_eye.scale - 1,
                std=hand_eye.scale * float(np.sqrt(hand_eye.covariance[6, 6])),
                marker=1.0,
            )
        )
    return hand_eye


def is_one(hand_eye: Calibration) -> bool:
    """Return whether the scale is 1 within its uncertainty."""
    off = abs(float(np.log(hand_eye.scale)))
    return off < max(3 * float(np.sqrt(hand_eye.covariance[6, 6])), METRIC_STD)
