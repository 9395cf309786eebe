"""The first step of a calibration: the fit to camera poses, with what is known of the scale beside them."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.cues import height_cue, length_cue, scale_contradiction
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import RobotErrors
from jcr.errors import RejectedError
from jcr.estimation.hand_eye import SCALE_STD, Offset, solve_hand_eye
from jcr.estimation.problem import offset_prior, scale_prior
from jcr.records import Capture, HandEye, Reconstruction


def fitted(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrors
) -> Case:
    """The case of a capture and its reconstruction, fitted to camera poses.

    `robot` is of the registered images' poses. Raises RejectedError with fewer than two registered images.
    """
    registered = len(reconstruction.image_index)
    if registered < 2:
        raise RejectedError(
            f"{registered} of {len(capture)} images registered",
            "overlap the views more",
            also=(*reconstruction.warnings, *reconstruction.notes),
        )
    gripper = capture.base_from_gripper[reconstruction.image_index]
    (scale, offset), contradiction = _measured(capture, reconstruction, options), None
    if scale is not None and offset is None:
        # Where the motions determine the scale, it is compared with the length beside others (checks/lengths.py).
        scale = None if _solved(gripper, reconstruction, options, robot).converged else scale
    if scale is offset is None and (metric_std := reconstruction.metric_std) is not None:
        free = _solved(gripper, reconstruction, options, robot)
        contradiction = scale_contradiction(free, metric_std)
        scale = 1.0, metric_std
    hand_eye = _solved(gripper, reconstruction, options, robot, scale, offset)
    priors = () if scale is None else (scale_prior(*scale),)
    priors += () if offset is None else (offset_prior(*offset),)
    hand_eye = replace(hand_eye, estimate=replace(hand_eye.estimate, intrinsics=reconstruction.intrinsics))
    return Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot,
        priors=priors,
        hand_eye=hand_eye if contradiction is None else hand_eye.with_findings(contradiction),
    )


def _solved(
    gripper: Float[ndarray, "m 4 4"],
    reconstruction: Reconstruction,
    options: CalibrateOptions,
    robot: RobotErrors,
    scale: tuple[float, float] | None = None,
    offset: Offset | None = None,
) -> HandEye:
    evidence = reconstruction.evidence
    return solve_hand_eye(
        gripper,
        reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera,
        robot_noise=options.robot_noise_m_rad,
        scale=None if scale is None else scale[0],
        scale_std=SCALE_STD if scale is None else scale[1],
        offset=offset,
        camera_covariance=None if evidence is None else evidence.covariance,
        systematic=robot.systematic,
        in_sequence=False,
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
