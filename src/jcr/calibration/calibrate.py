"""Stage calibrate, for a reconstructed capture or given camera poses: fit, bundle adjustment, checks, requirement."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.arm_of_capture import RobotErrorPrior, errors_of, robot_errors
from jcr.calibration.bundle_adjustment import adjusted
from jcr.calibration.case import Case, Model, camera_of
from jcr.calibration.checks.boards import check_board_shapes, check_boards
from jcr.calibration.checks.convention import better_reading, check_convention, inverted_pair
from jcr.calibration.checks.effects import check_effects, effects_of_fit
from jcr.calibration.checks.images import check_mount, check_pieces, check_remarks
from jcr.calibration.checks.lengths import LEAST_CONTRADICTION, check_lengths, check_predicted_focal
from jcr.calibration.checks.robot import check_robot, check_smooth_errors
from jcr.calibration.checks.unused_images import check_pairing
from jcr.calibration.hand_eye import SCALE_STD, fit_poses, solve_hand_eye
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.record import Calibration
from jcr.calibration.required_accuracy import advised
from jcr.calibration.verdict import appended, judged, with_shifts, with_uncertainty
from jcr.camera import usable_intrinsics
from jcr.errors import InputError, RejectedError
from jcr.estimation.arms import arm_named
from jcr.estimation.closed_form import ONE_AXIS
from jcr.estimation.point_uncertainty import scene_points, scene_uncertainty, with_given_intrinsics
from jcr.estimation.pose_misfit import pose_misfit
from jcr.estimation.problem import PoseModel, offset_prior, scale_prior
from jcr.findings import Finding, FindingKind, is_explained
from jcr.geometry import Poses, rotation_angle
from jcr.least_squares import one_blas_thread
from jcr.records import Capture, LengthCheck, PosePairs, Reconstruction

CHECKS = (
    check_convention,
    check_pairing,
    check_board_shapes,
    check_effects,
    check_pieces,
    check_predicted_focal,
    check_boards,
    check_lengths,
    check_robot,
    check_smooth_errors,
    check_mount,
    check_remarks,
)
"""Checks in the order in which they run, causes before consequences.

The pose convention of a rejected calibration is tested early, because poses of another convention make all later checks
meaningless. Rejected calibrations are also tested for effects on camera and robot, which may explain the rejection.
"""
HEIGHT_STD = 1e-3
"""Standard deviation (m) of a height measured with a ruler."""
CONTRADICTED = (4.0, 0.02)
"""Smallest difference of a known scale and the robot's scale that is a contradiction: in standard deviations, and as a
fraction of the scale; both limits are exceeded."""


@one_blas_thread
def calibrate_reconstruction(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions | None = None
) -> Calibration:
    """Calibrate a capture from its reconstruction: fit, bundle adjustment, checks, and required accuracy.

    Camera poses with a covariance (`evidence`) are fitted with it and not adjusted. For correspondences between
    pointmaps, whose errors are correlated, the bundle adjustment replaces the fit only if its leave-one-out error is
    smaller. Raises InputError for invalid options, and RejectedError with fewer than two registered images.
    """
    check_options(options := options or CalibrateOptions())
    robot = robot_errors(capture, options).of(reconstruction.image_index)
    return calibration_of(checked_case(capture, reconstruction, options, robot)).of_capture(
        capture, reconstruction
    )


def calibration_of(case: Case) -> Calibration:
    """Return the calibration of a case with its required accuracy, and with the pair for the given intrinsics."""
    found, distance_m, scene = case.calibration, case.scene_distance_m, None
    if distance_m is not None and case.solution is not None:
        scene = scene_uncertainty(scene_points(case.solution))
    found = advised(found, case.moving, case.options, distance_m, scene)
    if found.intrinsics is not None:
        source = "estimated" if case.capture.intrinsics is None else "given"
        found = replace(found, intrinsics_source=source)
    if case.capture.intrinsics is None or distance_m is None or case.carries == "scene":
        return found
    x, uncertainty, camera = found.gripper_from_camera, found.uncertainty, found.intrinsics
    pair = with_given_intrinsics(x, uncertainty, camera, case.reconstruction.intrinsics, distance_m)
    return replace(found, with_given_intrinsics=pair)


@one_blas_thread
def checked_case(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrorPrior
) -> Case:
    """Return the case after fit, adjustment and checks, without required accuracy.

    A rejected calibration is returned with its findings, not raised; a check that its geometry makes impossible is
    skipped. `robot` is the error prior of the registered images' gripper poses.
    """
    case = adjusted(fitted_case(capture, reconstruction, options, robot))
    for check in CHECKS:
        try:
            case = check(case)
        except np.linalg.LinAlgError:
            # With a rejected calibration, points may lie behind the cameras; a check that fails then is skipped.
            if case.calibration.converged:
                raise
    return case


def fitted_case(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions, robot: RobotErrorPrior
) -> Case:
    """Return the case with the fit to camera poses; known scale and height are priors of the fit.

    `robot` is the error prior of the registered images' gripper poses. Raises RejectedError with fewer than two
    registered images.
    """
    evidence, rows = reconstruction.evidence, reconstruction.image_index
    if reconstruction.intrinsics not in (capture.intrinsics, usable_intrinsics(capture.intrinsics)[0]):
        # The reconstruction estimated intrinsics, because none were given or the given ones did not fit the images.
        capture = replace(capture, intrinsics=None, intrinsics_std=None)
    if len(rows) < 2:
        raise RejectedError(
            f"{len(rows)} of {len(capture)} images registered",
            "overlap the views more",
            also=(*reconstruction.warnings, *reconstruction.notes),
        )
    gripper, metric_std, found = capture.base_from_gripper[rows], reconstruction.metric_std, list[Finding]()
    height = options.known_height
    assumed = PoseModel(
        camera_covariance=None if evidence is None else evidence.covariance,
        error_covariance=robot.systematic,
        noise_floor=options.robot_noise_m_rad,
        priors=() if height is None else (offset_prior(*height_cue(gripper, height / 1e3)),),
        carries="scene" if capture.mount == "base" else "camera",
    )
    camera = reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera
    names = [capture.images[row] for row in rows]
    fit = free = fit_poses(gripper, camera, names, assumed)
    if metric_std is not None:
        off, std = float(np.log(free.scale)), float(np.sqrt(free.covariance[6, 6]))
        sigmas, share = CONTRADICTED
        is_accepted = judged(free, free.findings).converged
        if is_accepted and abs(off) >= max(share, sigmas * float(np.hypot(std, metric_std))):
            size = {"value": float(np.expm1(off)), "std": std}
            found.append(Finding.of(FindingKind.BOARD_SIZE, "rejects", "poses", **size))
        assumed = replace(assumed, priors=(scale_prior(1.0, metric_std), *assumed.priors))
        fit = fit_poses(gripper, camera, names, assumed)
    fit = replace(fit, intrinsics=reconstruction.intrinsics.with_std(None))
    model = Model(tracks=reconstruction.tracks, used=fit.inliers, camera=camera_of(capture, reconstruction))
    return Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot,
        pose_model=assumed,
        fit=fit,
        model=model,
        numbers=fit,
        findings=tuple(found),
    )


def height_cue(base_from_gripper: Poses, height: float) -> tuple[Float[ndarray, "3"], float, float]:
    """Return the axis that all rotations of a planar motion share, the camera's coordinate along it, and its std.

    The axis is a unit vector in the gripper frame, with its sign such that it points up in the base frame. The
    coordinate (m) counts from the gripper's origin; the third number is its standard deviation (m). `height` (m) is the
    measured height of the camera above the gripper's origin, which is returned as the coordinate.

    Raises InputError if the gripper does not rotate about one common axis.
    """
    u, _, vt = np.linalg.svd(base_from_gripper[:, :3, :3].mean(0))
    up = np.sign(u[2, 0]) or 1.0
    axis_in_base, axis_in_gripper = up * u[:, 0], up * vt[0]
    wander = np.linalg.norm(base_from_gripper[:, :3, :3] @ axis_in_gripper - axis_in_base, axis=1)
    rotation = rotation_angle(np.swapaxes(base_from_gripper[:1, :3, :3], 1, 2) @ base_from_gripper[:, :3, :3])
    if np.sqrt((wander**2).mean()) > ONE_AXIS or rotation.max() < ONE_AXIS:
        raise InputError(
            "known_height: the gripper does not rotate about one common axis, along which a height could be "
            "known; leave the option out"
        )
    return axis_in_gripper, height, HEIGHT_STD


def calibrate_pose_pairs(pairs: PosePairs, options: CalibrateOptions | None = None) -> Calibration:
    """Calibrate from given pairs of gripper and camera poses, without images.

    For metric camera poses, an estimated scale other than 1 shows a wrong marker size; a scale that the motions do not
    determine is assumed to be 1. Raises InputError for invalid options, and for poses that do not fit the named arm.
    """
    check_options(options := options or CalibrateOptions())
    gripper = pairs.base_from_gripper
    robot = errors_of(gripper, None if options.robot is None else arm_named(options.robot))
    hand_eye = _calibrated_poses(pairs, options, robot)
    if hand_eye.observability.observable and not is_explained(hand_eye.findings):
        model = PoseModel(error_covariance=robot.systematic, noise_floor=options.robot_noise_m_rad)
        found = effects_of_fit(gripper, pairs.recon_from_camera, hand_eye, pairs.images, model)

        def calibration(findings: Sequence[Finding]) -> Calibration:
            shifted = with_uncertainty(hand_eye, with_shifts(hand_eye.uncertainty, findings))
            return shifted.with_findings(*findings)

        hand_eye = calibration(appended((), found, calibration))
    return advised(hand_eye, gripper, options).of_capture(pairs, pairs)


def _calibrated_poses(pairs: PosePairs, options: CalibrateOptions, robot: RobotErrorPrior) -> Calibration:
    """Return the fit to given camera poses, with findings about a wrong scale or a wrong pose convention.

    `robot` is the error prior of the gripper poses of `pairs`.
    """
    gripper, camera, height = pairs.base_from_gripper, pairs.recon_from_camera, options.known_height
    solve = partial(
        solve_hand_eye,
        gripper,
        camera,
        robot_noise=options.robot_noise_m_rad,
        offset=None if height is None else height_cue(gripper, height / 1e3),
        systematic=robot.systematic,
        # Each pose of a marker of known size is estimated independently.
        camera_errors="independent" if pairs.is_metric else "in sequence",
        names=pairs.images,
    )
    hand_eye = free = solve()
    scale = 1.0 if options.scale is None and pairs.is_metric else options.scale
    # The known scale is a prior unless the scale estimated from the motions contradicts the metric poses.
    if scale is not None and (options.scale is not None or not free.converged or is_one(free)):
        hand_eye = solve(scale=scale)
        if options.scale is None and free.converged:
            longer = 100 * (free.scale - 1)
            size = LengthCheck(
                name="board", robot_longer_percent=longer, std_percent=100 * SCALE_STD, used=True
            )
            hand_eye = replace(hand_eye, lengths=(size,))
        if not free.observability.observable and scale == 1.0:
            return hand_eye.with_findings(Finding.of(FindingKind.SCALE_ASSUMED, "warns", "motion"))
    if not hand_eye.converged:
        return hand_eye.with_findings(*better_reading(gripper, camera, hand_eye.observability.observable))
    if pairs.is_inverted:
        errors = f"{1e3 * hand_eye.robot_noise.together[0]:.1f} mm per axis"
        return hand_eye.with_findings(inverted_pair(pose_misfit(gripper, camera), errors))
    if pairs.is_metric and not is_one(hand_eye):
        std = hand_eye.scale * float(np.sqrt(hand_eye.covariance[6, 6]))
        size = {"value": hand_eye.scale - 1, "std": std, "marker": 1.0}
        return hand_eye.with_findings(Finding.of(FindingKind.BOARD_SIZE, "warns", "intrinsics", **size))
    return hand_eye


def is_one(hand_eye: Calibration) -> bool:
    """Return whether |log scale| is below LEAST_CONTRADICTION or below three standard deviations, and counts as 0."""
    off = abs(float(np.log(hand_eye.scale)))
    return off < max(3 * float(np.sqrt(hand_eye.covariance[6, 6])), LEAST_CONTRADICTION)
