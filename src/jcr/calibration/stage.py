"""Calibration of a capture: fit to camera poses, bundle adjustment, checks, verdict, requirement."""

from dataclasses import replace

import numpy as np

from jcr.calibration.adjust import with_adjusted_images
from jcr.calibration.case import Case
from jcr.calibration.checks.table import CHECKS
from jcr.calibration.cues import height_cue, length_cue, scale_contradiction
from jcr.calibration.hand_eye import SCALE_STD, Offset, solve_hand_eye
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.record import Calibration
from jcr.calibration.requirement import advised, assumptions_of
from jcr.calibration.robot_errors import RobotErrorPrior, robot_errors
from jcr.errors import RejectedError
from jcr.estimation.point_uncertainty import with_given_intrinsics
from jcr.estimation.problem import offset_prior, scale_prior
from jcr.least_squares import one_blas_thread
from jcr.records import Capture, Reconstruction


@one_blas_thread
def calibrate_reconstruction(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions | None = None
) -> Calibration:
    """Calibrate the registered images of a capture.

    Camera poses with a covariance are weighed with it and not adjusted. Other images are adjusted with the poses; on
    correspondences between pointmaps, whose errors neighbours share, the adjustment stands only where its leave-one-out
    error is smaller. Raises InputError for options that cannot be, and RejectedError with fewer than two registered
    images.
    """
    check_options(options := options or CalibrateOptions())
    robot = robot_errors(capture, options).of(reconstruction.image_index)
    case = calibrate_case(capture, reconstruction, options, robot)
    hand_eye = case.hand_eye
    if capture.intrinsics is not None and (distance_m := case.scene_distance_m) is not None:
        x, uncertainty, camera = hand_eye.gripper_from_camera, hand_eye.uncertainty, hand_eye.intrinsics
        pair = with_given_intrinsics(x, uncertainty, camera, reconstruction.intrinsics, distance_m)
        hand_eye = replace(hand_eye, with_given_intrinsics=pair)
    return hand_eye.of_capture(capture, reconstruction)


def calibrate_case(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrorPrior
) -> Case:
    """Return the case after fit, adjustment, checks and advice; `robot` is of the registered images."""
    case = checked_case(capture, reconstruction, options, robot)
    gripper, assumptions = case.base_from_gripper, assumptions_of(case)
    found = advised(case.hand_eye, gripper, options, robot, assumptions, case.scene_uncertainty)
    return replace(case, hand_eye=found)


@one_blas_thread
def checked_case(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrorPrior
) -> Case:
    """Return the case after fit, adjustment and checks, without advice; `robot` is of the registered images."""
    case = with_adjusted_images(fit_poses(capture, reconstruction, options, robot))
    for check, is_needed in CHECKS:
        if is_needed(case):
            try:
                case = check(case)
            except np.linalg.LinAlgError:
                # A rejected fit may be so wrong, points behind the cameras, that there is nothing to compute.
                if case.hand_eye.converged:
                    raise
    return case


def fit_poses(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrorPrior
) -> Case:
    """Fit the hand-eye transform to camera poses, with the known lengths that replace what the motions do not show.

    `robot` is of the registered images' poses. Raises RejectedError with fewer than two registered images.
    """
    registered = len(reconstruction.image_index)
    if registered < 2:
        raise RejectedError(
            f"{registered} of {len(capture)} images registered",
            "overlap the views more",
            also=(*reconstruction.warnings, *reconstruction.notes),
        )
    (scale, offset), contradiction = _measured(capture, reconstruction, options), None
    if scale is not None and offset is None:
        # Where the motions determine the scale, it is compared with the length beside others (checks/lengths.py).
        scale = None if _solved(capture, reconstruction, options, robot).converged else scale
    if scale is offset is None and (metric_std := reconstruction.metric_std) is not None:
        free = _solved(capture, reconstruction, options, robot)
        contradiction = scale_contradiction(free, metric_std)
        scale = 1.0, metric_std
    hand_eye = _solved(capture, reconstruction, options, robot, scale, offset)
    priors = () if scale is None else (scale_prior(*scale),)
    priors += () if offset is None else (offset_prior(*offset),)
    hand_eye = replace(hand_eye, intrinsics=reconstruction.intrinsics.with_std(None))
    return Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot,
        priors=priors,
        hand_eye=hand_eye if contradiction is None else hand_eye.with_findings(contradiction),
    )


def _solved(
    capture: Capture,
    reconstruction: Reconstruction,
    options: CalibrateOptions,
    robot: RobotErrorPrior,
    scale: tuple[float, float] | None = None,
    offset: Offset | None = None,
) -> Calibration:
    evidence, rows = reconstruction.evidence, reconstruction.image_index
    return solve_hand_eye(
        capture.base_from_gripper[rows],
        reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera,
        robot_noise=options.robot_noise_m_rad,
        scale=None if scale is None else scale[0],
        scale_std=SCALE_STD if scale is None else scale[1],
        offset=offset,
        camera_covariance=None if evidence is None else evidence.covariance,
        systematic=robot.systematic,
        in_sequence=False,
        names=[capture.images[row] for row in rows],
    )


def _measured(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions
) -> tuple[tuple[float, float] | None, Offset | None]:
    """Return the scale and the height that the user measured, each with its standard deviation."""
    gripper = capture.base_from_gripper[reconstruction.image_index]
    scale = offset = None
    if options.known_height is not None:
        offset = height_cue(gripper, options.known_height / 1e3)
    if options.known_length is not None:
        image, *ends, length_mm = options.known_length
        ends_px = np.array(ends).reshape(2, 2)
        scale = length_cue(capture, reconstruction, image, ends_px, length_mm / 1e3)
    return scale, offset
