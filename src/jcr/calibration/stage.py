"""The calibration stage: poses first, robustly; then images, points, intrinsics and robot adjusted together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.calibration.bundle import Adjusted, adjust, median_reprojection
from jcr.calibration.camera_faults import CameraFaults, camera_faults
from jcr.calibration.consider import with_intrinsics_considered
from jcr.calibration.cues import height_cue, length_cue, scale_contradiction
from jcr.calibration.depth_check import depth_check
from jcr.calibration.given_intrinsics import lens_doubt
from jcr.calibration.intrinsics_prior import IntrinsicsPrior, prior_about
from jcr.calibration.options import CalibrateOptions, check_options
from jcr.calibration.requirement import advised
from jcr.calibration.robot_errors import of_poses, robot_errors, robot_examined
from jcr.calibration.sequence import sequence_fault
from jcr.capture.checks import how_turned
from jcr.errors import InputError, NotTrustedError
from jcr.geometry import ARM, inverse, retract, scale_translation, step_between
from jcr.handeye.arms import arm_named
from jcr.handeye.conventions import better_reading, convention_finding
from jcr.handeye.fit import Cues, exceeds
from jcr.handeye.residuals import paper_residuals
from jcr.handeye.solve import SCALE_STD, judged, solve_hand_eye
from jcr.handeye.systematic import systematic_errors
from jcr.least_squares import one_blas_thread
from jcr.records import (
    CAMERA,
    Capture,
    Estimate,
    Finding,
    HandEye,
    HeldOut,
    ImageResiduals,
    Intrinsics,
    Kind,
    PaperResiduals,
    PosePairs,
    Reconstruction,
    RobotExamined,
    RobotNoise,
    ScaleCheck,
    ScaleEvidence,
    Tracks,
    verdict_of,
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
        hand_eye = hand_eye.with_findings(unused)
    hand_eye = _in_sequence(hand_eye, capture, reconstruction, systematic)
    if (turned := how_turned(capture)) is not None:
        hand_eye = hand_eye.with_findings(turned)
    # A unit that somebody vouches for was used for the scale, and is no check of it.
    if reconstruction.is_metric and reconstruction.metric_std is None:
        hand_eye = _scale_checked(hand_eye)
    if hand_eye.converged:
        depth = depth_check(capture, reconstruction, hand_eye)
        hand_eye = replace(hand_eye, scale_evidence=replace(hand_eye.scale_evidence, depth=depth))
    known = options.known_height is not None or options.known_length is not None
    if reconstruction.metric_std is None and hand_eye.scale_evidence.depth is None and not known:
        hand_eye = hand_eye.with_findings(Finding(kind=Kind.SCALE_FROM_ROBOT, severity="informs"))
    hand_eye = hand_eye.with_findings(*(_of_reconstruction(text) for text in reconstruction.warnings))
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
        raise NotTrustedError(
            f"{len(camera)} of {len(capture)} images registered",
            "overlap the views more",
            also=(*reconstruction.warnings, *reconstruction.notes),
        )
    noise = _noise(options)
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
    hand_eye = replace(hand_eye, estimate=replace(hand_eye.estimate, intrinsics=reconstruction.intrinsics))
    if contradiction is not None:
        return hand_eye.with_findings(contradiction, first=True)
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
    faults: tuple[Finding, ...] = ()
    if adjustable and not tracks.from_pointmaps and hand_eye.observability.observable:
        found = _camera_faults(
            hand_eye, capture, reconstruction, tracks, noise, adjusted, options, systematic
        )
        if found is not None:
            faults = found.faults
        if found is not None and options.focus == "varies" and hand_eye.converged:
            hand_eye = _refined(hand_eye, found.adjusted, gripper, camera, reconstruction)
            more = np.zeros((7, 7))
            more[:6, :6] = found.more_covariance
            hand_eye = judged(replace(hand_eye, estimate=hand_eye.estimate.with_fault(more)))
    lens_fault = next((fault for fault in faults if fault.kind is Kind.INTRINSICS), None)
    if faults and (lens_fault is None or capture.intrinsics is None):
        return with_faults(hand_eye, faults)
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
    kept = hand_eye.before or hand_eye
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
        return with_faults(hand_eye, faults)
    others = [fault for fault in faults if fault.kind is not Kind.INTRINSICS]
    named = doubt if lens_fault is None else replace(lens_fault, shift=doubt.shift)
    return with_faults(kept, [*others, named])


def with_faults(hand_eye: HandEye, faults: Sequence[Finding]) -> HandEye:
    """With what the faults do counted as uncertainty; they reject where that is more than can be accepted."""
    named = []
    for fault in faults:
        accepted = hand_eye.converged and verdict_of([*named, fault]) != "rejected"
        hand_eye = replace(hand_eye, estimate=hand_eye.estimate.with_fault(fault.covariance))
        # More images, the remedy for a large covariance, do not mend a lens: that finding is left out.
        if not accepted or not judged(hand_eye).converged:
            fault = replace(fault, severity="rejects")
        named.append(fault)
    return hand_eye.with_findings(*named, first=True)


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
    if any(finding.kind in CAMERA for finding in hand_eye.findings):
        return hand_eye
    rows, camera = reconstruction.image_index, reconstruction.recon_from_camera
    names = [capture.images[row] for row in rows]
    fault = sequence_fault(hand_eye, capture.base_from_gripper[rows], camera, names, systematic)
    return hand_eye if fault is None else with_faults(hand_eye, [fault])


def _better(one: HeldOut | None, other: HeldOut | None) -> bool:
    """Whether the leave-one-out error is smaller; not, where there are too few images."""
    return other is not None and missed_m(one) < missed_m(other)


def missed_m(held_out: HeldOut | None) -> float:
    """Both errors on images left out as one length (m), by which calibrations can be compared; infinite without."""
    if held_out is None:
        return float("inf")
    return float(np.hypot(1e-3 * held_out.translation_mm, ARM * np.radians(held_out.rotation_deg)))


def _scale_checked(hand_eye: HandEye) -> HandEye:
    """With how far a network's own metre is from the robot's; a warning where it is far beyond its error."""
    # A network's length of 1 is `scale` metres by the robot.
    std_percent = 100 * float(np.sqrt(hand_eye.covariance[6, 6])) / hand_eye.scale
    check = ScaleCheck(100 * (1 / hand_eye.scale - 1), std_percent)
    hand_eye = replace(hand_eye, scale_evidence=ScaleEvidence(check))
    if abs(np.log(hand_eye.scale)) < max(FAR_SCALE, 3 * np.sqrt(hand_eye.covariance[6, 6])):
        return hand_eye
    return hand_eye.with_findings(
        Finding(
            kind=Kind.NETWORK_SCALE,
            severity="warns",
            mend="poses",
            value=check.off_percent / 100,
            std=check.std_percent / 100,
        )
    )


def _of_reconstruction(text: str) -> Finding:
    return Finding(kind=Kind.RECONSTRUCTION, severity="warns", details={"text": text})


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
    gripper, camera, noise = pairs.base_from_gripper, pairs.recon_from_camera, _noise(options)
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
            return hand_eye.with_findings(Finding(kind=Kind.SCALE_ASSUMED, severity="warns", mend="motion"))
    if not hand_eye.converged:
        return _investigated(hand_eye, gripper, camera)
    if pairs.is_metric and not is_one(hand_eye):
        return hand_eye.with_findings(
            Finding(
                kind=Kind.BOARD_SIZE,
                severity="warns",
                mend="intrinsics",
                value=hand_eye.scale - 1,
                std=hand_eye.scale * float(np.sqrt(hand_eye.covariance[6, 6])),
                details={"marker": 1.0},
            )
        )
    return hand_eye


def is_one(hand_eye: HandEye) -> bool:
    """Whether the scale is 1 within what is known of it."""
    off = abs(float(np.log(hand_eye.scale)))
    return off < max(3 * float(np.sqrt(hand_eye.covariance[6, 6])), METRIC_STD)


def _intrinsics_prior(capture: Capture, found: Intrinsics) -> IntrinsicsPrior:
    return prior_about(found, capture.intrinsics is not None, capture.intrinsics_std)


def _noise(options: CalibrateOptions) -> tuple[float, float] | None:
    if options.robot_noise is None:
        return None
    return options.robot_noise[0] / 1e3, float(np.radians(options.robot_noise[1]))


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
        return hand_eye.with_findings(convention_finding(found, "warns"))
    return hand_eye.with_findings(convention_finding(found), first=True)


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
    noise = RobotNoise(
        *adjusted.noise,
        exceeds(adjusted.noise, adjusted.given_noise),
        adjusted.given_noise,
        adjusted.systematic,
        adjusted.systematic_left,
    )
    return replace(
        hand_eye,
        estimate=Estimate(
            gripper_from_camera=x,
            scale=adjusted.scale,
            base_from_recon=adjusted.base_from_recon,
            covariance=adjusted.covariance,
            budget=adjusted.budget,
            intrinsics=adjusted.bundle.camera,
            intrinsics_covariance=adjusted.intrinsics_covariance,
        ),
        images=ImageResiduals(
            inliers=used,
            translation_residual_m=metres,
            rotation_residual_rad=radians,
            reasons=hand_eye.images.reasons,
            reprojection_px=reprojection,
        ),
        residuals=PaperResiduals(delta_t, delta_r),
        robot=RobotExamined(noise),
        held_out=_held_out(adjusted),
        before=hand_eye,
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
