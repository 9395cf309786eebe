"""Calibration from given camera poses, without images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr import __version__
from jcr.calibration.case import with_findings
from jcr.calibration.checks.effects import effects_of_fit, with_rejected_runs
from jcr.calibration.conventions import better_reading, convention_finding
from jcr.calibration.cues import height_cue
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.record import Calibration, calibration_of
from jcr.calibration.requirement import advised, assumptions_of_poses
from jcr.calibration.robot_errors import RobotErrors, errors_of
from jcr.errors import InputError
from jcr.estimation.arms import arm_named
from jcr.estimation.hand_eye import SCALE_STD, Offset, fit_hand_eye
from jcr.estimation.kinematics import Arm
from jcr.estimation.problem import pose_problem
from jcr.findings import Finding, FindingKind, is_explained
from jcr.records import HandEye, PosePairs

METRIC_STD = 0.005
"""Relative standard deviation of the size of a printed marker."""


def solve_hand_eye(  # noqa: PLR0913 (each is a fact about the capture)
    base_from_gripper: ArrayLike,
    recon_from_camera: ArrayLike,
    *,
    robot_noise: tuple[float, float] | None = None,
    offset: Offset | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    scale: float | None = None,
    scale_std: float = SCALE_STD,
    joints: ArrayLike | None = None,
    robot: str | Arm | None = None,
    in_sequence: bool = True,
) -> Calibration:
    """Return the hand-eye calibration with unknown scale from camera poses of your own.

    Takes two stacks (n,4,4), n ≥ 2, taken at the same instants and in the same order: gripper poses in the base frame
    (m) and camera poses in any frame and unit. `robot_noise` is a lower bound on the noise of the gripper poses (1
    sigma per axis: m, rad); the residuals may show more. `camera_covariance` (6n,6n) of the steps of
    the cameras (geometry.retract; recon axes) is needed if these are not exact compared with the gripper poses.

    `robot` names the arm (jcr.estimation.arms.ROBOT_NAMES) and `joints` (n,dof) are its angles (rad), starting at the
    base: they determine how joint offsets and link errors affect the poses. With `robot` only, the angles are computed
    from the poses; with neither, systematic errors are assumed to vary smoothly over the poses.

    `scale` (metres per unit of the camera poses, 1 if these are metric) is known to `scale_std` (relative); without it
    the scale is estimated. `offset` is an axis of the gripper frame, the position of the camera along it (m), and its
    standard deviation (m), for motions that do not determine it.

    `in_sequence`: the camera poses may have been found one after the other, as by visual odometry or SLAM. Errors that
    add up along their order are then tested and included.

    Raises InputError for shapes, values or counts that cannot be poses, and for poses or angles that do not fit the
    robot. Degenerate motion raises nothing; it is in the result (`observability`, `converged`).
    """
    hand_eye = fit_hand_eye(
        base_from_gripper,
        recon_from_camera,
        robot_noise=robot_noise,
        offset=offset,
        camera_covariance=camera_covariance,
        scale=scale,
        scale_std=scale_std,
        joints=joints,
        robot=robot,
        in_sequence=in_sequence,
    )
    pairs = PosePairs(
        source=Path(),
        images=tuple(f"pose {k}" for k in range(len(hand_eye.inliers))),
        base_from_gripper=np.asarray(base_from_gripper, float),
        recon_from_camera=np.asarray(recon_from_camera, float),
        is_metric=scale == 1.0,
    )
    return calibration_of(pairs, pairs, hand_eye, {}, __version__)


def calibrate_poses(pairs: PosePairs, options: CalibrateOptions | None = None) -> HandEye:
    """Calibrate from given camera poses, without images.

    The estimated scale of metric poses tests the given size of the marker; where motions do not determine the scale, it
    is taken as 1.
    """
    check_options(options := options or CalibrateOptions())
    robot = errors_of(pairs.base_from_gripper, None if options.robot is None else arm_named(options.robot))
    hand_eye = _calibrated_poses(pairs, options, robot)
    if hand_eye.observability.observable and not is_explained(hand_eye.findings):
        start = hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon
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
    return advised(hand_eye, gripper, options, robot, assumptions)


def _calibrated_poses(pairs: PosePairs, options: CalibrateOptions, robot: RobotErrors) -> HandEye:
    gripper, camera, noise = pairs.base_from_gripper, pairs.recon_from_camera, options.robot_noise_m_rad
    if options.known_length is not None:
        raise InputError("--known-length: there are no images in which it could be seen; leave it out")
    height = options.known_height
    offset = None if height is None else height_cue(gripper, height / 1e3)
    systematic = robot.systematic
    # Poses of a marker of known size are found each by itself.
    in_sequence = not pairs.is_metric
    free = fit_hand_eye(
        gripper, camera, robot_noise=noise, offset=offset, systematic=systematic, in_sequence=in_sequence
    )
    scale = 1.0 if options.scale is None and pairs.is_metric else options.scale
    hand_eye = free
    # A known size makes few samples worth more; where the robot's motion excludes it, the motion decides.
    if scale is not None and (options.scale is not None or not free.converged or is_one(free)):
        hand_eye = fit_hand_eye(
            gripper,
            camera,
            robot_noise=noise,
            offset=offset,
            systematic=systematic,
            scale=scale,
            in_sequence=in_sequence,
        )
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


def is_one(hand_eye: HandEye) -> bool:
    """Return whether the scale is 1 within its uncertainty."""
    off = abs(float(np.log(hand_eye.scale)))
    return off < max(3 * float(np.sqrt(hand_eye.covariance[6, 6])), METRIC_STD)
