"""The calibration stage: poses first, robustly; then images, points, intrinsics and robot adjusted together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.calibration.bundle import Adjusted, adjust, median_reprojection
from jcr.calibration.camera_faults import CAMERA_FAULT, CameraFaults, Fault, camera_faults
from jcr.calibration.consider import with_intrinsics_considered
from jcr.calibration.cues import height_cue, length_cue, scale_contradiction
from jcr.calibration.depth_check import depth_check
from jcr.calibration.given_intrinsics import lens_doubt
from jcr.calibration.intrinsics_prior import IntrinsicsPrior, prior_about
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.requirement import advised
from jcr.calibration.robot_errors import of_poses, robot_errors, robot_examined
from jcr.calibration.sequence import sequence_fault
from jcr.calibration.words import scale_in_words
from jcr.capture.checks import how_turned
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import inverse, retract, scale_translation, step_between
from jcr.handeye.arms import arm_named
from jcr.handeye.conventions import better_reading, explained
from jcr.handeye.fit import Cues, exceeds
from jcr.handeye.residuals import leave_one_out_m, paper_residuals
from jcr.handeye.solve import SCALE_STD, judged, solve_hand_eye
from jcr.handeye.systematic import systematic_errors
from jcr.least_squares import one_blas_thread
from jcr.records import (
    Capture,
    HandEye,
    HeldOut,
    Intrinsics,
    PosePairs,
    Reconstruction,
    Refinement,
    RobotNoise,
    ScaleCheck,
    Tracks,
)

FAR_SCALE = float(np.log(1.2))
"""Metric networks are a few percent off, at times ten; beyond this a unit is wrong or the calibration."""
MIN_OBSERVATIONS = 200
"""Fewer correspondences than this do not refine what the poses say."""
MOST_OBSERVATIONS = 60_000
"""Adjusted with the robot, which limits what more of them could add: 25 images of 640x480 have as many."""
METRIC_STD = 0.005
"""Relative; a printed marker has the size that its maker says to half a percent."""


@one_blas_thread
def calibrate(
    capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions | None = None
) -> HandEye:
    """Hand-eye calibration of the registered images; per-pose fields are in the reconstruction's order.

    Camera poses that come with their covariance are weighed with it, and that is all. Else bundle adjustment
    follows on correspondences found in the images; on those between pointmaps, whose errors neighbours share,
    its result stands only where it misses images left out by less. Raises InputError for options that cannot be, and
    NotTrustedError with fewer than two registered images.
    """
    check_options(options := options or CalibrateOptions())
    systematic, posed_arm, unused = robot_errors(capture, options)
    systematic = of_poses(systematic, reconstruction.image_index)
    hand_eye = _calibrated(capture, reconstruction, options, systematic)
    if posed_arm is not None:
        arm, joints = posed_arm
        posed_arm = arm, joints[reconstruction.image_index]
    hand_eye = robot_examined(
        hand_eye,
        capture.base_from_gripper[reconstruction.image_index],
        reconstruction.recon_from_camera,
        systematic,
        posed_arm,
    )
    if unused is not None:
        hand_eye = replace(hand_eye, warnings=(*hand_eye.warnings, unused))
    hand_eye = _in_sequence(hand_eye, capture, reconstruction, systematic)
    if (turned := how_turned(capture)) is not None:
        hand_eye = replace(hand_eye, warnings=(*hand_eye.warnings, turned))
    # A unit that somebody vouches for was used for the scale, and is no check of it.
    if reconstruction.is_metric and reconstruction.metric_std is None:
        hand_eye = _scale_checked(hand_eye)
    if hand_eye.converged:
        hand_eye = replace(hand_eye, depth_check=depth_check(capture, reconstruction, hand_eye))
    known = options.known_height is not None or options.known_length is not None
    alone = reconstruction.metric_std is None and hand_eye.depth_check is None and not known
    hand_eye = replace(hand_eye, scale_from_robot_alone=alone)
    gripper = capture.base_from_gripper[reconstruction.image_index]
    return advised(hand_eye, gripper, options, reconstruction.metric_std)


def _calibrated(
    capture: Capture,
    reconstruction: Reconstruction,
    options: CalibrateOptions,
    systematic: Float[ndarray, "r r"],
) -> HandEye:
    gripper = capture.base_from_gripper[reconstruction.image_index]
    evidence = reconstruction.evidence
    camera = reconstruction.recon_from_camera if evidence is None else evidence.recon_from_camera
    if len(camera) < 2:
        few = f"{len(camera)} of {len(capture)} images registered; overlap the views more"
        raise NotTrustedError("; ".join([few, *reconstruction.warnings, *reconstruction.notes]))
    noise = options.robot_noise_m_rad
    cues = _cues(capture, reconstruction, options)
    camera_covariance = None if evidence is None else evidence.covariance
    contradiction = None
    if cues is None and (metric_std := reconstruction.metric_std) is not None:
        free = solve_hand_eye(
            gripper, camera, robot_noise=noise, camera_covariance=camera_covariance, systematic=systematic
        )
        contradiction = scale_contradiction(free, metric_std)
        cues = Cues(scale=(1.0, metric_std))
    hand_eye = solve_hand_eye(
        gripper,
        camera,
        robot_noise=noise,
        cues=cues,
        camera_covariance=camera_covariance,
        systematic=systematic,
    )
    hand_eye = replace(hand_eye, intrinsics=reconstruction.intrinsics)
    if contradiction is not None:
        return replace(hand_eye, converged=False, warnings=(contradiction, *hand_eye.warnings))
    used = hand_eye.inliers
    tracks = _some_of_many(of_images(reconstruction.tracks, used))
    adjustable = (
        options.bundle_adjustment
        # What pointmaps say of the cameras is in their covariance, with the errors that neighbours share; their
        # tracks, taken for independent, make it worse: simulated, 0.2 mm became 1.3 mm.
        and evidence is None
        and cues is None  # bundle adjustment knows the robot's scale and height alone
        and len(tracks.image) >= MIN_OBSERVATIONS
        and used.sum() >= 3
    )
    adjusted = None
    if not hand_eye.converged:
        hand_eye = _investigated(hand_eye, gripper, camera)
    elif adjustable:
        adjusted = adjust(
            gripper[used],
            (hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon),
            camera[used],
            reconstruction.intrinsics,
            tracks,
            noise,
            _intrinsics_prior(capture, reconstruction.intrinsics),
            of_poses(systematic, np.flatnonzero(used)),
        )
        refined = judged(_refined(hand_eye, adjusted, gripper, camera, reconstruction))
        if not tracks.from_pointmaps or _better(refined.held_out, hand_eye.held_out):
            hand_eye = refined
    faults: tuple[Fault, ...] = ()
    if adjustable and not tracks.from_pointmaps and hand_eye.observability.observable:
        found = _camera_faults(
            hand_eye, capture, reconstruction, tracks, noise, adjusted, options, systematic
        )
        if found is not None:
            faults = found.faults
        if found is not None and options.focus == "varies" and hand_eye.converged:
            hand_eye = _refined(hand_eye, found.adjusted, gripper, camera, reconstruction)
            hand_eye.covariance[:6, :6] += found.more_covariance
            hand_eye = judged(hand_eye)
    lens_fault = next((fault.text for fault in faults if fault.of_lens), None)
    if faults and (lens_fault is None or capture.intrinsics is None):
        return _with_faults(hand_eye, faults)
    if (
        adjusted is None
        and hand_eye.converged
        and capture.intrinsics is not None
        and evidence is None
        and not tracks.from_pointmaps
    ):
        prior = _intrinsics_prior(capture, reconstruction.intrinsics)
        of_used = of_poses(systematic, np.flatnonzero(used))
        considered = with_intrinsics_considered(
            hand_eye, gripper[used], camera[used], tracks, reconstruction.intrinsics, prior, cues, of_used
        )
        hand_eye = judged(considered)
    # Of motions that show too little, what is missing comes first; and pointmaps were made with a lens of their own.
    if (
        capture.intrinsics is None
        or not adjustable
        or tracks.from_pointmaps
        or not hand_eye.observability.observable
    ):
        return hand_eye
    # Where the lens is wrong, bundle adjustment bends the robot's poses to it: the fit to camera poses bends least.
    kept = hand_eye if hand_eye.refinement is None else hand_eye.refinement.before
    doubt = lens_doubt(
        kept,
        gripper[used],
        camera[used],
        reconstruction.intrinsics,
        tracks,
        noise,
        of_poses(systematic, np.flatnonzero(used)),
        adjusted,
    )
    if doubt is None:
        return _with_faults(hand_eye, faults)
    others = [fault for fault in faults if not fault.of_lens]
    return _with_faults(kept, [*others, Fault(lens_fault or doubt.text, doubt.shift, of_lens=True)])


def _with_faults(hand_eye: HandEye, faults: Sequence[Fault]) -> HandEye:
    """With what the faults do counted as uncertainty, and named: first, where that is more than can be trusted."""
    for fault in faults:
        by_lens = fault.shift if fault.of_lens else np.zeros(7)
        if hand_eye.lens_shift is not None:
            by_lens = np.hypot(by_lens, hand_eye.lens_shift)
        covariance = hand_eye.covariance + np.outer(fault.shift, fault.shift)
        lens_shift = by_lens if by_lens.any() else None
        earlier, trusted = hand_eye.warnings, hand_eye.converged
        hand_eye = judged(replace(hand_eye, covariance=covariance, lens_shift=lens_shift))
        if trusted and hand_eye.converged and not fault.rejects:
            hand_eye = replace(hand_eye, warnings=(*earlier, fault.text))
        else:
            # More images, the cure for a large covariance, do not mend a lens.
            hand_eye = replace(hand_eye, converged=False, warnings=(fault.text, *earlier))
    return hand_eye


def _camera_faults(
    hand_eye: HandEye,
    capture: Capture,
    reconstruction: Reconstruction,
    tracks: Tracks,
    noise: tuple[float, float] | None,
    adjusted: Adjusted | None,
    options: CalibrateOptions,
    systematic: Float[ndarray, "r r"],
) -> CameraFaults | None:
    """What the used images say against one camera, whether or not their calibration is accepted.

    None of an answer so wrong that the points lie behind the cameras.
    """
    used, start = hand_eye.inliers, (hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon)
    rows, estimated = reconstruction.image_index[used], capture.intrinsics is None

    def readjust(observations: Tracks, intrinsics: Intrinsics) -> Adjusted:
        camera = reconstruction.recon_from_camera[used]
        return adjust(
            capture.base_from_gripper[rows],
            start,
            camera,
            intrinsics,
            observations,
            noise,
            _intrinsics_prior(capture, intrinsics),
            of_poses(systematic, np.flatnonzero(used)),
        )

    names, varies = [capture.images[row] for row in rows], options.focus == "varies"

    def shown_by(adjusted: Adjusted) -> CameraFaults:
        # An answer that is rejected has no uncertainty beside which a fault could be small.
        covariance = adjusted.covariance if hand_eye.converged else np.zeros((7, 7))
        return camera_faults(adjusted, tracks, readjust, covariance, not estimated, names, varies)

    if adjusted is not None:
        return shown_by(adjusted)
    try:
        return shown_by(readjust(tracks, reconstruction.intrinsics))
    except np.linalg.LinAlgError:
        return None


def _in_sequence(
    hand_eye: HandEye, capture: Capture, reconstruction: Reconstruction, systematic: Float[ndarray, "r r"]
) -> HandEye:
    """With a slip, a drift or a delay that the order of the images shows, where no fault of the camera does."""
    if hand_eye.lens_shift is not None or any(CAMERA_FAULT in text for text in hand_eye.warnings):
        return hand_eye
    rows, camera = reconstruction.image_index, reconstruction.recon_from_camera
    names = [capture.images[row] for row in rows]
    fault = sequence_fault(hand_eye, capture.base_from_gripper[rows], camera, names, systematic)
    return hand_eye if fault is None else _with_faults(hand_eye, [fault])


def _better(one: HeldOut | None, other: HeldOut | None) -> bool:
    """Whether the leave-one-out error is smaller; not, where there are too few images."""
    return other is not None and leave_one_out_m(one) < leave_one_out_m(other)


def _scale_checked(hand_eye: HandEye) -> HandEye:
    """With how far a network's own metre is from the robot's; a warning where it is far beyond its error."""
    # A network's length of 1 is `scale` metres by the robot.
    std_percent = 100 * float(np.sqrt(hand_eye.covariance[6, 6])) / hand_eye.scale
    check = ScaleCheck(100 * (1 / hand_eye.scale - 1), std_percent)
    hand_eye = replace(hand_eye, scale_check=check)
    if abs(np.log(hand_eye.scale)) < max(FAR_SCALE, 3 * np.sqrt(hand_eye.covariance[6, 6])):
        return hand_eye
    remark = f"{scale_in_words(check)}; check the unit of the gripper poses"
    return replace(hand_eye, warnings=(*hand_eye.warnings, remark))


def calibrate_poses(pairs: PosePairs, options: CalibrateOptions | None = None) -> HandEye:
    """Hand-eye calibration from camera poses that were given, without images.

    Where they are metric, the scale that is found tells whether the marker had the size that was given; motions
    that do not show a scale are helped by taking it as 1.
    """
    check_options(options := options or CalibrateOptions())
    hand_eye = _calibrated_poses(pairs, options)
    is_known = options.scale is not None or (pairs.is_metric and is_one(hand_eye))
    return advised(hand_eye, pairs.base_from_gripper, options, SCALE_STD if is_known else None)


def _calibrated_poses(pairs: PosePairs, options: CalibrateOptions) -> HandEye:
    gripper, camera, noise = pairs.base_from_gripper, pairs.recon_from_camera, options.robot_noise_m_rad
    if options.known_length is not None:
        raise InputError("--known-length: there are no images in which it could be seen; leave it out")
    offset = None if options.known_height is None else height_cue(gripper, options.known_height / 1e3)
    systematic = systematic_errors(gripper, None if options.robot is None else arm_named(options.robot))
    cues = Cues(offset=offset)
    free = solve_hand_eye(gripper, camera, robot_noise=noise, cues=cues, systematic=systematic)
    scale = 1.0 if options.scale is None and pairs.is_metric else options.scale
    hand_eye = free
    # A known size makes few samples worth more; where the robot's motion excludes it, the motion is believed.
    if scale is not None and (options.scale is not None or not free.converged or is_one(free)):
        hand_eye = solve_hand_eye(
            gripper, camera, robot_noise=noise, cues=cues, systematic=systematic, scale=scale
        )
        if not free.observability.observable and scale == 1.0:
            remark = "the scale is unobservable from these motions: it is taken as 1, from the marker's size"
            return replace(hand_eye, warnings=(*hand_eye.warnings, remark))
    if not hand_eye.converged:
        return _investigated(hand_eye, gripper, camera)
    if pairs.is_metric and not is_one(hand_eye):
        size = f"{100 * abs(1 / hand_eye.scale - 1):.1f} % too {'large' if hand_eye.scale < 1 else 'small'}"
        remark = (
            f"the scale is {hand_eye.scale:.4f} where a marker of known size gives 1: its size was given {size}, or "
            "the camera's focal length is off"
        )
        return replace(hand_eye, warnings=(*hand_eye.warnings, remark))
    return hand_eye


def is_one(hand_eye: HandEye) -> bool:
    """Whether the scale is 1 within what is known of it."""
    off = abs(float(np.log(hand_eye.scale)))
    return off < max(3 * float(np.sqrt(hand_eye.covariance[6, 6])), METRIC_STD)


def _intrinsics_prior(capture: Capture, found: Intrinsics) -> IntrinsicsPrior:
    return prior_about(found, capture.intrinsics is not None, capture.intrinsics_std)


def _cues(capture: Capture, reconstruction: Reconstruction, options: CalibrateOptions) -> Cues | None:
    if options.known_height is None and options.known_length is None:
        return None
    gripper = capture.base_from_gripper[reconstruction.image_index]
    scale = offset = None
    if options.known_height is not None:
        offset = height_cue(gripper, options.known_height / 1e3)
    if options.known_length is not None:
        image, *ends, length_mm = options.known_length
        scale = length_cue(capture, reconstruction, image, np.array(ends).reshape(2, 2), length_mm / 1e3)
    return Cues(scale, offset)


def _investigated(
    hand_eye: HandEye, gripper: Float[ndarray, "m 4 4"], camera: Float[ndarray, "m 4 4"]
) -> HandEye:
    """A fit that failed, with the reading of the poses that would fit, if there is one."""
    found = better_reading(gripper, camera)
    if found is None:
        return hand_eye
    if not hand_eye.observability.observable:
        # Of motions that show too little, another reading may fit by chance: what is missing comes first.
        return replace(hand_eye, warnings=(*hand_eye.warnings, explained(found)))
    return replace(hand_eye, warnings=(explained(found), *hand_eye.warnings))


def of_images(tracks: Tracks, used: Bool[ndarray, " m"]) -> Tracks:
    """The observations of the used images, whose rows are counted again."""
    kept = used[tracks.image]
    row = np.cumsum(used) - 1
    return replace(tracks, image=row[tracks.image[kept]], x_px=tracks.x_px[kept], point=tracks.point[kept])


def _some_of_many(tracks: Tracks) -> Tracks:
    """All observations, or where there are more than are adjusted those of a random choice of the points."""
    if len(tracks.image) <= MOST_OBSERVATIONS:
        return tracks
    count = np.bincount(tracks.point, minlength=len(tracks.points_in_recon))
    order = np.random.default_rng(0).permutation(len(count))
    chosen = np.zeros(len(count), bool)
    chosen[order[np.cumsum(count[order]) <= MOST_OBSERVATIONS]] = True
    rows = chosen[tracks.point]
    return replace(tracks, image=tracks.image[rows], x_px=tracks.x_px[rows], point=tracks.point[rows])


def _refined(
    hand_eye: HandEye,
    adjusted: Adjusted,
    gripper: Float[ndarray, "m 4 4"],
    camera: Float[ndarray, "m 4 4"],
    reconstruction: Reconstruction,
) -> HandEye:
    used = hand_eye.inliers
    x = adjusted.bundle.gripper_from_camera
    # Rejected poses are measured against where their cameras say they were.
    predicted = adjusted.base_from_recon @ scale_translation(camera, adjusted.scale) @ inverse(x)
    predicted[used] = adjusted.bundle.base_from_gripper
    metres, radians = np.linalg.norm(step_between(gripper, predicted).reshape(-1, 2, 3), axis=2).T
    reprojection = np.full(len(used), np.nan)
    reprojection[used] = median_reprojection(adjusted)
    delta_t, delta_r = paper_residuals(gripper, camera, x, adjusted.scale, used)
    moved = step_between(hand_eye.gripper_from_camera, x)
    refinement = Refinement(hand_eye, float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:])))
    return replace(
        hand_eye,
        gripper_from_camera=x,
        scale=adjusted.scale,
        base_from_recon=adjusted.base_from_recon,
        covariance=adjusted.covariance,
        translation_residual_m=metres,
        rotation_residual_rad=radians,
        robot_noise=RobotNoise(
            *adjusted.noise,
            exceeds(adjusted.noise, adjusted.given_noise),
            adjusted.given_noise,
            adjusted.systematic,
            adjusted.systematic_left,
        ),
        budget=adjusted.budget,
        residual_translation=delta_t,
        residual_rotation=delta_r,
        intrinsics=adjusted.bundle.camera,
        intrinsics_covariance=adjusted.intrinsics_covariance,
        held_out=_held_out(adjusted),
        reprojection_px=reprojection,
        refinement=refinement,
    )


def _held_out(adjusted: Adjusted) -> HeldOut | None:
    """Each image's gripper pose predicted by an adjustment that does not use it."""
    m = len(adjusted.missed)
    if m < 4:
        return None
    missed = adjusted.missed
    metres, radians = np.linalg.norm(missed.reshape(m, 2, 3), axis=2).mean(0)
    pixels = median_reprojection(adjusted, retract(adjusted.bundle.base_from_gripper, -missed))
    return HeldOut(
        1e3 * float(metres),
        float(np.degrees(radians)),
        float(np.median(pixels)),
        "each image's gripper pose predicted by the others",
    )
