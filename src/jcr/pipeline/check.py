"""Quick check of a capture before a run: files, motion, features, and the pose convention."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.boards.proposal import proposed
from jcr.calibration.calibrate import calibrate_pose_pairs, calibration_of, checked_case
from jcr.calibration.case import Case
from jcr.calibration.checks.images import as_causes, view_findings
from jcr.calibration.checks.unused_images import left_out_poses
from jcr.calibration.options import GRASPING, CalibrateOptions, RequiredAccuracy
from jcr.calibration.record import Calibration
from jcr.calibration.required_accuracy import requirement_of
from jcr.calibration.robot_errors import RobotErrorPrior, errors_of, robot_errors
from jcr.capture.images import exposure_fault, read_image
from jcr.capture.read import read_source
from jcr.errors import RejectedError, count_of
from jcr.estimation.observability import observability
from jcr.estimation.prediction import (
    MIN_PREDICTED_IMAGES,
    Assumptions,
    PredictedCamera,
    assumed,
    median_distance,
    predict,
    typical_camera,
)
from jcr.extras import xfeat_is_installed
from jcr.features.matchers import FeatureName
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
from jcr.geometry import largest_motion
from jcr.number_format import significant
from jcr.pipeline.reading_decision import decided_by_images, first_reading
from jcr.progress import Progress, silent
from jcr.records import Capture, Observability, PosePairs, Uncertainty
from jcr.sfm.colmap import reconstruct_colmap

QUICK, QUICK_SIZE_PX = 15, 800
"""Number of images of the quick reconstruction, and their longer side (px), so that it takes 3 to 9 s. A usual capture
has no more images, so that each of its poses is compared; eight take half of the time."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Result of the check of a capture: motion, expected uncertainty, findings, and notes."""

    capture: Capture | PosePairs
    """Capture with the reading of its poses; it still has `candidates` if the images were not asked."""
    largest_move_m: float
    """Largest distance between the gripper's origins in two poses."""
    largest_rotation_rad: float
    """Largest angle between two gripper poses."""
    observability: Observability
    expected: Uncertainty | None
    """Predicted uncertainty of a calibration from the `counted` images, None for fewer than three of them; of PosePairs
    and of a fixed camera the uncertainty of `hand_eye`."""
    counted: Int[ndarray, " c"]
    """Rows of the images that are expected to register: those that did or, if not all were tried, the clear ones."""
    compared: Int[ndarray, " t"] | None
    """Rows of the images whose poses were compared with the camera poses; None if none were."""
    hand_eye: Calibration | None
    """Calibration from sparse features, or from given camera poses; None if no images were registered."""
    findings: tuple[Finding, ...]
    """Findings of the calibration and of the images, strongest first."""
    notes: tuple[str, ...]
    """Sentences on the files, the exposure of images, and the pairing of images with poses."""

    @property
    def verdict(self) -> Verdict:
        """Expected verdict on a calibration of the capture; "not checked" if the reading of its poses is undecided."""
        verdict = verdict_of(self.findings)
        undecided = isinstance(self.capture, Capture) and self.capture.candidates
        return "not checked" if undecided and verdict != "rejected" else verdict

    def __repr__(self) -> str:
        seen = self.expected and self.expected.seen
        point = f", a point within {significant(seen.within_95_mm)} mm (95 %)" if seen else ""
        first = "".join(f"; {one.text}" for one in self.findings[:1])
        return f"<Examination: {self.verdict}, {count_of(len(self.capture), 'image')}{point}{first}>"


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Comparison of gripper poses with camera poses, by a calibration of both."""

    hand_eye: Calibration | None = None
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    tried: Int[ndarray, " t"] = field(default_factory=lambda: np.zeros(0, int))
    registered: Int[ndarray, " c"] = field(default_factory=lambda: np.zeros(0, int))
    assumptions: Assumptions | None = None
    """Camera and robot as the calibration estimates them; None if it is rejected, or of a fixed camera."""


def check_capture(
    capture: Capture | PosePairs | str | Path,
    look: bool = True,
    robot_noise: tuple[float, float] | None = None,
    progress: Progress = silent,
    thorough: bool = False,
    require: RequiredAccuracy = GRASPING,
) -> Examination:
    """Examine a capture, or the capture at a path: its motion, images, and expected uncertainty.

    `look`: reconstruct the images from sparse features and compare the camera poses with the gripper poses. A few images
    of reduced size are used first, and all images if the first result is rejected or leaves an image out, or if
    `thorough` is set. PosePairs have given camera poses, which are compared instead. `robot_noise` is the standard
    deviation per axis (m, rad). `require` is the required accuracy (mm, degrees); a finding states if the one that is
    expected from the images misses it. Raises InputError if gripper poses and joint angles contradict each other.
    """
    if isinstance(capture, str | Path):
        capture = read_source(capture, progress=progress)
    if isinstance(capture, Capture) and capture.candidates:
        capture = decided_by_images(capture, progress=progress)[0] if look else first_reading(capture)
    move_m, rotation_rad = largest_motion(given := capture.base_from_gripper)
    noise = robot_noise and (1e3 * robot_noise[0], np.degrees(robot_noise[1]))
    options = CalibrateOptions(robot_noise=noise, require=require)
    views, remarks, shown, expected = (), [], _Comparison(), None
    robot, clear = errors_of(given), np.arange(len(capture))
    if isinstance(capture, Capture):
        robot, views = robot_errors(capture, CalibrateOptions()), view_findings(capture)
        clear, remarks = _look(capture, views)
    if isinstance(capture, PosePairs) or (look and verdict_of(views) != "rejected"):
        shown = _compare(capture, robot, options, progress, thorough)
    counted = np.union1d(np.setdiff1d(clear, shown.tried), shown.registered)
    rows = counted if len(counted) >= MIN_PREDICTED_IMAGES else np.arange(len(capture))
    gripper, hand_eye, assumptions = given[rows], shown.hand_eye, shown.assumptions
    seen = observability(gripper, assumptions and assumptions.gripper_from_camera)
    if hand_eye is not None and len(shown.tried) == len(capture):
        seen = hand_eye.observability
    found = [*shown.findings, *(seen.findings if hand_eye is None else ()), *filter(None, [robot.unused])]
    found += as_causes(views) if verdict_of(found) == "rejected" else views
    if isinstance(capture, PosePairs) or capture.mount == "base":
        # Nothing is predicted for given camera poses, nor for a fixed camera, whose images `predict` does not simulate.
        expected = hand_eye and hand_eye.uncertainty
    elif len(counted) >= MIN_PREDICTED_IMAGES and not capture.candidates:
        camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
        of_rows = assumptions or assumed(gripper, camera, robot_noise)
        expected = predict(of_rows, gripper, robot.of(rows).systematic)
        found += _missed(shown, of_rows, expected, found, len(counted), options)
    if look and isinstance(capture, Capture) and verdict_of(found) != "accepted":
        found += proposed(capture, None)
    return Examination(
        capture=capture,
        largest_move_m=move_m,
        largest_rotation_rad=rotation_rad,
        observability=seen,
        expected=expected,
        counted=counted,
        compared=shown.tried if len(shown.tried) else None,
        hand_eye=hand_eye,
        findings=strongest_first({sentence(one): one for one in found}.values()),
        notes=(*capture.notes, *_unit_doubt(move_m, rotation_rad), *remarks, *shown.notes),
    )


def _missed(
    shown: _Comparison,
    assumptions: Assumptions,
    expected: Uncertainty,
    found: list[Finding],
    images: int,
    options: CalibrateOptions,
) -> tuple[Finding, ...]:
    """Return the finding that the expected accuracy misses the required one; empty if it is met, or for a rejection.

    `shown` has the causes of the error that the images show; without them the prediction's are taken.
    """
    hand_eye, arm_known = shown.hand_eye, False
    if hand_eye is not None:
        # The images show the causes of the error, as they do to a run; a prediction assumes a scene.
        expected, arm_known = (
            replace(expected, budget=hand_eye.uncertainty.budget),
            hand_eye.joint_offsets is not None,
        )
    x = assumptions.gripper_from_camera
    return requirement_of(x, expected, found, images, options, arm_known)[1]


def _unit_doubt(move_m: float, rotation_rad: float) -> list[str]:
    """Return a note if the largest motion of the gripper is below 5 mm, but rotates; empty otherwise."""
    if move_m >= 5e-3 or rotation_rad <= np.radians(5):
        return []
    moved = f"by at most {1e3 * move_m:.2g} mm while it rotates by {np.degrees(rotation_rad):.0f}°"
    return [f"the gripper moves {moved}: the positions may have been divided by 1000"]


def _look(capture: Capture, views: tuple[Finding, ...]) -> tuple[Int[ndarray, " c"], list[str]]:
    """Return the indices of well exposed sharp images, and remarks on the exposure of the others."""
    blurred = {name for one in views if one.kind is FindingKind.BLURRED for name in one.images}
    clear, remarks = list[int](), list[str]()
    for row, name in enumerate(capture.images):
        if (fault := exposure_fault(read_image(capture.folder / name))) is not None:
            remarks.append(f"{name} is {fault}; expose it again")
        elif name not in blurred:
            clear.append(row)
    return np.array(clear, dtype=int), remarks


def _compare(
    capture: Capture | PosePairs,
    robot: RobotErrorPrior,
    options: CalibrateOptions,
    progress: Progress,
    thorough: bool,
) -> _Comparison:
    """Calibrate from gripper and camera poses, and return whether and how well both agree.

    The camera poses of PosePairs are given, others are reconstructed from features: first those of QUICK images of
    reduced size; then those of all images if `thorough` is set, or if the first comparison fails, is rejected or leaves
    an image out. If all images are rejected, learned features are tried, as a run does, where they are installed.
    """
    rows = np.arange(len(capture))
    if isinstance(capture, PosePairs):
        hand_eye = calibrate_pose_pairs(capture, options)
        used = np.flatnonzero(hand_eye.inliers)
        return _Comparison(hand_eye=hand_eye, findings=hand_eye.findings, tried=rows, registered=used)
    tried, of_tried, size_px = capture, robot, WORKING_SIZE_PX
    if not thorough:
        rows, size_px = spread_rows(len(capture)), QUICK_SIZE_PX
        tried, of_tried = replace(capture.of_rows(rows), depths=None), robot.of(rows)
    found = _by_features(tried, rows, of_tried, options, "sift", size_px, progress)
    # At reduced size the images may not tell which of two contradicting images is wrong.
    is_rejected = found.hand_eye is None or verdict_of(found.hand_eye.findings) == "rejected"
    if not thorough and (found.hand_eye is None or is_rejected or not found.hand_eye.inliers.all()):
        return _compare(capture, robot, options, progress, thorough=True)
    if is_rejected and xfeat_is_installed():
        learned = _by_features(tried, rows, of_tried, options, "xfeat", size_px, progress)
        if verdict_of(learned.findings) != "rejected":
            return learned
    return found


def _by_features(
    tried: Capture,
    rows: Int[ndarray, " t"],
    of_tried: RobotErrorPrior,
    options: CalibrateOptions,
    features: FeatureName,
    size_px: int,
    progress: Progress,
) -> _Comparison:
    """Reconstruct the images `tried`, in `rows` of the capture, by `features`, and compare their poses."""
    try:
        made = reconstruct_colmap(tried, features, 0, progress, size_px)
    except RejectedError as error:
        return _Comparison(findings=no_reconstruction(error))
    case = checked_case(tried, made, options, of_tried.of(made.image_index))
    hand_eye, assumptions = case.calibration, None
    if hand_eye.converged:
        if tried.mount == "gripper":
            assumptions = assumptions_of(case)
        else:
            hand_eye = calibration_of(case)
        hand_eye = hand_eye.with_findings(*left_out_poses(tried, made, hand_eye))
    return _Comparison(
        hand_eye=hand_eye,
        findings=hand_eye.findings,
        notes=made.notes,
        tried=rows,
        registered=rows[made.image_index[case.model.used]],
        assumptions=assumptions,
    )


def assumptions_of(case: Case) -> Assumptions:
    """Return the assumptions of predictions: new images and gripper poses are like the used ones of the case.

    If the case's images were not adjusted, camera poses are assumed to be given and exact (`Assumptions.camera` None).
    """
    x, used, distance_m = case.calibration.gripper_from_camera, case.base_from_gripper[case.used], None
    if case.solution is not None:
        distance_m = case.scene_distance_m
    shifted = [one for one in case.calibration.findings if one.shift is not None]
    return Assumptions(
        gripper_from_camera=x,
        distance_m=median_distance(used @ x) if distance_m is None else distance_m,
        noise=case.calibration.robot_noise,
        scale_std=case.reconstruction.metric_std,
        camera=None if case.solution is None or distance_m is None else PredictedCamera.of(case.solution),
        shifts=tuple(np.array([*(one.shift or ()), *(one.intrinsics_shift or ())]) for one in shifted),
    )


def spread_rows(count: int) -> Int[ndarray, " k"]:
    """Return the indices, from 0, of up to QUICK images, spread evenly over `count` images in their order."""
    return np.linspace(0, count - 1, min(count, QUICK)).round().astype(int)
