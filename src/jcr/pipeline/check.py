"""Quick check of a capture before a run: files, motion, features, and the pose convention."""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.boards.proposal import proposed
from jcr.calibration.case import Case
from jcr.calibration.checks.capture import as_causes, view_findings
from jcr.calibration.checks.left_out import left_out_poses
from jcr.calibration.hand_eye import SCALE_STD, solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import RobotErrorPrior, errors_of, robot_errors
from jcr.calibration.stage import calibrate_pose_pairs, checked_case, is_one
from jcr.capture.formats.table import OpenConventionError, possible_options
from jcr.capture.images import brightness_and_sharpness, exposure_fault, read_image
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture, read_source
from jcr.errors import InputError, RejectedError
from jcr.estimation.observability import observability
from jcr.estimation.prediction import (
    FEWEST,
    Assumptions,
    PredictedCamera,
    assumed,
    median_distance,
    predict,
    typical_camera,
)
from jcr.features.sift import WORKING_SIZE_PX
from jcr.findings import (
    Finding,
    FindingKind,
    Verdict,
    no_reconstruction,
    sentence,
    strongest_first,
    verdict_of,
)
from jcr.geometry import ARM, largest_motion
from jcr.progress import Progress
from jcr.records import Capture, Observability, PosePairs, Uncertainty
from jcr.rounding import significant
from jcr.sfm.colmap import reconstruct_colmap

CLEARER = 3.0
"""Factor by which the poses of one convention must fit the images better than those of any other to be selected."""
QUICK, QUICK_SIZE_PX = 8, 800
"""Number of images of the quick reconstruction, and their longer side (px), so that it takes seconds."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Result of the check of a capture: motion, expected uncertainty, findings, and notes."""

    sharpness: Float[ndarray, " n"]
    """Variance of the Laplacian of each image, divided by the median; empty for a capture without images."""
    largest_move_m: float
    """Largest distance between the gripper's origins in two poses."""
    largest_rotation_rad: float
    """Largest angle between two gripper poses."""
    observability: Observability
    expected: Uncertainty | None
    """Predicted uncertainty of a calibration from the `counted` images; None for fewer than three of them."""
    counted: Int[ndarray, " c"]
    """Rows of the images that are expected to register: those that did or, if not all were tried, the clear ones."""
    hand_eye: Calibration | None
    """Calibration from sparse features, or from given camera poses; None if no images were registered."""
    findings: tuple[Finding, ...]
    """Findings of the calibration and of the images, strongest first."""
    notes: tuple[str, ...]
    """Sentences on the files, the exposure of images, and the pairing of images with poses."""

    @property
    def verdict(self) -> Verdict:
        """Expected verdict on a calibration of the capture."""
        return verdict_of(self.findings)


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Comparison of gripper poses with camera poses, by a calibration of both."""

    hand_eye: Calibration | None = None
    """Calibration; None if no camera poses were found."""
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    registered: Int[ndarray, " c"] | None = None
    """Rows of the images that the calibration uses; None if only some of the images were compared."""
    assumptions: Assumptions | None = None
    """Camera and robot as the calibration estimates them; None if there is none, or it is rejected."""


def check_capture(
    capture: Capture | PosePairs | str | Path,
    look: bool = True,
    robot_noise: tuple[float, float] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    thorough: bool = False,
) -> Examination:
    """Examine a capture, or the capture at a path: its motion, images, and expected uncertainty.

    `look`: reconstruct the images from sparse features and compare the camera poses with the gripper poses. A few images
    of reduced size are used first, and all images if the first result is rejected or `thorough` is set. PosePairs have
    given camera poses, which are compared instead. `robot_noise` is the standard deviation per axis (m, rad), `seed`
    that of the reconstruction. Raises InputError if gripper poses and joint angles contradict each other.
    """
    if isinstance(capture, str | Path):
        capture = read_and_compare(capture, progress=progress)[0]
    given = capture.base_from_gripper
    (move_m, rotation_rad), notes = largest_motion(given), [*capture.notes]
    if move_m < 5e-3 and rotation_rad > np.radians(5):
        moved = f"by at most {1e3 * move_m:.2g} mm while it rotates by {np.degrees(rotation_rad):.0f}°"
        notes.append(f"the gripper moves {moved}: the positions may have been divided by 1000")
    options = CalibrateOptions(robot_noise=robot_noise and (1e3 * robot_noise[0], np.degrees(robot_noise[1])))
    camera, sharpness, views, shown = None, np.zeros(0), (), _Comparison()
    if isinstance(capture, PosePairs):
        robot, clear = errors_of(given), np.arange(len(capture))
        shown = _compare(capture, robot, options, seed, progress, thorough)
    else:
        robot, views = robot_errors(capture, CalibrateOptions()), view_findings(capture)
        clear, sharpness, remarks = _look(capture, views)
        notes += remarks
        camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
        if look and verdict_of(views) != "rejected":
            shown = _compare(capture, robot, options, seed, progress, thorough)
    counted = clear if shown.registered is None else shown.registered
    rows = counted if len(counted) >= FEWEST else np.arange(len(capture))
    gripper, hand_eye, assumptions = given[rows], shown.hand_eye, shown.assumptions
    seen = observability(gripper, assumptions and assumptions.gripper_from_camera)
    if hand_eye is not None and shown.registered is not None:
        seen = hand_eye.observability
    of_motion = () if hand_eye is not None else seen.findings
    found = [*shown.findings, *of_motion, *filter(None, [robot.unused])]
    found += as_causes(views) if verdict_of(found) == "rejected" else views
    expected = None
    if len(counted) >= FEWEST:
        of_rows = assumptions or assumed(gripper, camera, robot_noise)
        expected = predict(of_rows, gripper, robot.of(rows).systematic)
    return Examination(
        sharpness=sharpness,
        largest_move_m=move_m,
        largest_rotation_rad=rotation_rad,
        observability=seen,
        expected=expected,
        counted=counted,
        hand_eye=hand_eye,
        findings=strongest_first({sentence(one): one for one in found}.values()),
        notes=(*notes, *shown.notes),
    )


def _look(
    capture: Capture, views: tuple[Finding, ...]
) -> tuple[Int[ndarray, " c"], Float[ndarray, " n"], list[str]]:
    """Return the indices of well exposed sharp images, the sharpness of all n images, and remarks on their exposure.

    The sharpness is the variance of the Laplacian, divided by the median of all images. `views` are the findings of
    `view_findings`, which name the blurred images.
    """
    looks = [brightness_and_sharpness(read_image(capture.folder / name)) for name in capture.images]
    brightness, sharpness = np.array(looks).T
    blurred = {name for one in views if one.kind is FindingKind.BLURRED for name in one.images}
    faults = [exposure_fault(grey) for grey in brightness]
    pairs = list(zip(capture.images, faults, strict=True))
    clear = np.flatnonzero([fault is None and name not in blurred for name, fault in pairs])
    remarks = [f"{name} is {fault}; expose it again" for name, fault in pairs if fault is not None]
    return clear, sharpness / max(float(np.median(sharpness)), 1e-9), remarks


def _compare(
    capture: Capture | PosePairs,
    robot: RobotErrorPrior,
    options: CalibrateOptions,
    seed: int,
    progress: Progress | None,
    thorough: bool,
) -> _Comparison:
    """Calibrate from gripper and camera poses, and return whether and how well both agree.

    `robot` is the prior of the robot errors of all images, `seed` that of the reconstruction. The camera poses of
    PosePairs are given, others are reconstructed from features: first those of QUICK images of reduced size; then those
    of all images if `thorough` is set, or if the first comparison fails, is rejected, or does not use all QUICK images.
    """
    if isinstance(capture, PosePairs):
        hand_eye, assumptions = calibrate_pose_pairs(capture, options), None
        used, findings = hand_eye.inliers, hand_eye.findings
        if hand_eye.converged:
            scale_std = SCALE_STD if capture.is_metric and is_one(hand_eye) else None
            assumptions = assumptions_of_poses(hand_eye, capture.base_from_gripper[used], scale_std)
        rows = np.flatnonzero(used)
        return _Comparison(hand_eye=hand_eye, findings=findings, registered=rows, assumptions=assumptions)
    is_quick = not thorough and len(capture) > QUICK
    tried, of_tried, size_px = capture, robot, WORKING_SIZE_PX
    if is_quick:
        rows, size_px = spread_rows(len(capture)), QUICK_SIZE_PX
        tried, of_tried = replace(capture.of_rows(rows), depths=None), robot.of(rows)
    try:
        made = reconstruct_colmap(tried, "sift", seed, progress, size_px)
    except RejectedError as error:
        if is_quick:
            return _compare(capture, robot, options, seed, progress, thorough=True)
        return _Comparison(findings=(*no_reconstruction(error), *proposed(capture, None)))
    case = checked_case(tried, made, options, of_tried.of(made.image_index))
    hand_eye, assumptions, registered = case.hand_eye, None, made.image_index[case.hand_eye.inliers]
    if hand_eye.converged:
        assumptions = assumptions_of(case)
        hand_eye = hand_eye.with_findings(*left_out_poses(tried, made, hand_eye))
    if is_quick and (verdict_of(hand_eye.findings) == "rejected" or len(registered) < QUICK):
        return _compare(capture, robot, options, seed, progress, thorough=True)
    return _Comparison(
        hand_eye=hand_eye,
        findings=hand_eye.findings,
        notes=made.notes,
        registered=None if is_quick else registered,
        assumptions=assumptions,
    )


def assumptions_of(case: Case) -> Assumptions:
    """Return the assumptions of predictions: new images and gripper poses are like the used ones of the case.

    If the case's images were not adjusted, camera poses are assumed to be given and exact (`Assumptions.camera` None).
    """
    used, metric_std = case.base_from_gripper[case.used], case.reconstruction.metric_std
    assumptions = assumptions_of_poses(case.hand_eye, used, metric_std)
    if case.adjusted is None or (distance := case.scene_distance_m) is None:
        return assumptions
    return replace(assumptions, distance_m=distance, camera=PredictedCamera.of(case.adjusted))


def assumptions_of_poses(
    hand_eye: Calibration, used: Float[ndarray, "n 4 4"], scale_std: float | None
) -> Assumptions:
    """Return the assumptions of predictions for a calibration from camera poses; `used` are its used gripper poses.

    `scale_std` is the relative standard deviation of a known scale; None: the scale is estimated.
    """
    return Assumptions(
        gripper_from_camera=hand_eye.gripper_from_camera,
        distance_m=median_distance(used @ hand_eye.gripper_from_camera),
        noise=hand_eye.robot_noise,
        scale_std=scale_std,
    )


def read_and_compare(
    path: str | Path,
    options: ReadOptions | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress | None = None,
) -> tuple[Capture | PosePairs, ReadOptions]:
    """Read a capture; if its file does not determine the pose convention, select the one that fits the images best.

    Return the capture, with a note on the selected convention, and the options with which it was read. The fit is the
    median residual between gripper poses and camera poses from a few images of reduced size. Its unit is m: translation
    plus 0.3 m times rotation (rad). `into` is the new folder to which the images of a recording are extracted. Raises
    InputError if the images cannot be reconstructed, or the best convention does not fit three times better than the
    second.
    """
    options = options or ReadOptions()
    with suppress(OpenConventionError):
        return read_source(path, options, into=into, progress=progress), options
    read = list[tuple[Capture, ReadOptions]]()
    for possible in possible_options(options):
        for one in possible:
            with suppress(InputError):
                read.append((read_capture(path, one), one))
                break
    fits = list[tuple[float, str, Capture, ReadOptions]]()
    with suppress(RejectedError):  # the images cannot be reconstructed
        found = None
        for capture, one in read:
            rows = spread_rows(len(capture))
            found = found or reconstruct_colmap(capture.of_rows(rows), "sift", 0, progress, QUICK_SIZE_PX)
            gripper = capture.base_from_gripper[rows][found.image_index]
            fit = solve_hand_eye(gripper, found.recon_from_camera, camera_errors="none")
            # Residuals are used, because the noise of a rejected fit is an assumption and does not depend on the poses.
            residuals = [(image.translation_residual_mm, image.rotation_residual_deg) for image in fit.images]
            mm, deg = np.median(np.array(residuals, dtype=float), axis=0)
            off = f"{significant(mm)} mm and {significant(deg)}°"
            fits.append((float(1e-3 * mm + ARM * np.radians(deg)), off, capture, one))
    fits.sort(key=lambda fit: fit[0])
    if not fits or (len(fits) > 1 and fits[1][0] < CLEARER * fits[0][0]):
        raise InputError(
            f"{path}: columns rx, ry, rz may be a rotation vector or angles, and the images do not tell which; add "
            "--pose-convention ur or --pose-convention yaskawa"
        )
    (_, off, capture, options), *others = fits
    units = "" if options.pose_units == "auto" else f" --pose-units {options.pose_units}"
    worse = "".join(f", those of {one.pose_convention} only to {text}" for _, text, _, one in others)
    note = (
        f"columns rx, ry, rz are read with --pose-convention {options.pose_convention}{units}: these poses agree with "
        f"the images to {off} (median){worse}; give these options to jcr run"
    )
    return replace(capture, notes=(*capture.notes, note)), options


def spread_rows(count: int) -> Int[ndarray, " k"]:
    """Return the indices, from 0, of up to eight (QUICK) images, spread evenly over `count` images in their order."""
    return np.linspace(0, count - 1, min(count, QUICK)).round().astype(int)
