"""Check of a capture before any heavy work: files, motion, features, poses to add, and the pose convention."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.boards.proposal import proposed
from jcr.calibration.case import Case
from jcr.calibration.checks.capture import as_causes, view_findings
from jcr.calibration.checks.left_out import left_out_poses
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.poses import calibrate_poses, is_one
from jcr.calibration.requirement import Proposals, assumptions_of, assumptions_of_poses
from jcr.calibration.robot_errors import RobotErrors, errors_of, robot_errors
from jcr.calibration.stage import checked
from jcr.camera import fold_distance_px
from jcr.capture.formats.table import OpenConventionError, possible_options
from jcr.capture.images import brightness_and_sharpness, exposure_fault, read_image
from jcr.capture.options import ReadOptions
from jcr.capture.read import read_capture, read_source
from jcr.errors import InputError, RejectedError
from jcr.estimation.hand_eye import SCALE_STD, solve_hand_eye
from jcr.estimation.observability import observability
from jcr.estimation.prediction import (
    FEWEST,
    Assumptions,
    PredictedCamera,
    Prediction,
    assumed,
    typical_camera,
)
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
from jcr.records import Capture, HandEye, NextPose, Observability, PosePairs
from jcr.sfm.colmap import reconstruct_colmap
from jcr.sfm.options import ColmapOptions

CLEARER = 3.0
"""Factor by which poses in one convention must fit the images better than in the others."""
QUICK, QUICK_SIZE_PX = 8, 800
"""Number of images that are registered first, and their long side (px): both take seconds."""


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Result of the check of a capture."""

    sharpness: Float[ndarray, " n"]
    """Variance of the Laplacian, relative to the median image's; empty where there are no images."""
    largest_move_m: float
    largest_rotation_rad: float
    """Largest angle between two gripper poses."""
    observability: Observability
    expected: Prediction | None
    """Accuracy that a calibration of the counted images would report; None of fewer than three."""
    counted: Int[ndarray, " c"]
    """Rows of the images that are expected to register: those that did; of images not tried, those that are clear."""
    suggestions: tuple[NextPose, ...]
    hand_eye: HandEye | None
    """The calibration by sparse features; None where the images were not registered."""
    findings: tuple[Finding, ...]
    """Findings of the calibration and of the images, strongest first."""
    notes: tuple[str, ...]
    """Remarks on the files, their exposure and their pairing, in words."""

    @property
    def expected_std(self) -> Float[ndarray, "7"] | None:
        """Standard deviations of that calibration, in records.COVARIANCE_ORDER."""
        return None if self.expected is None else self.expected.std

    @property
    def verdict(self) -> Verdict:
        """Verdict that a calibration of the capture is expected to get."""
        return verdict_of(self.findings)


def check_capture(
    capture: Capture | PosePairs | str | Path,
    suggest: int = 0,
    look: bool = True,
    robot_noise: tuple[float, float] | None = None,
    reach: ArrayLike | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    thorough: bool = False,
) -> Examination:
    """Examine a capture, or what lies at its path.

    With `look` its images are registered sparsely and compared with the poses. A few of them at a small size tell in
    seconds; where these speak against the capture, or where it is to be `thorough`, all are registered as a calibration
    does. Where the cameras' poses were given instead, the gripper's are compared with those.

    `suggest` is how many gripper poses to propose, `robot_noise` (m, rad) one sigma per axis. InputError where gripper
    poses and joint angles contradict each other.
    """
    if isinstance(capture, str | Path):
        capture = read_and_compare(capture, progress=progress)
    alone, shown = _examine_alone(capture), _Comparison()
    if isinstance(capture, PosePairs):
        shown = _compare_pairs(capture, robot_noise)
    elif look and verdict_of(alone.views) != "rejected":
        shown = _compare_with_images(capture, alone.robot, robot_noise, seed, progress, thorough)
    counted = alone.clear if shown.registered is None else shown.registered
    rows = counted if len(counted) >= FEWEST else np.arange(len(capture))
    gripper, assumptions = capture.base_from_gripper[rows], shown.assumptions
    if assumptions is None:
        assumptions = assumed(gripper, _camera(capture), robot_noise)
    x = None if shown.assumptions is None else assumptions.gripper_from_camera
    seen = shown.observability or observability(gripper, x)
    found = [*shown.findings, *(() if shown.hand_eye is not None else seen.findings), *alone.unused]
    is_rejected = verdict_of(found) == "rejected"
    found += as_causes(alone.views) if is_rejected else alone.views
    box = None if reach is None else np.asarray(reach, float)
    proposals = Proposals.of(assumptions, gripper, alone.robot.of(rows), suggest, box, seed)
    return Examination(
        sharpness=alone.sharpness,
        largest_move_m=alone.move_m,
        largest_rotation_rad=alone.rotation_rad,
        observability=seen,
        expected=proposals.predict(0) if len(counted) >= FEWEST else None,
        counted=counted,
        suggestions=tuple(replace(one, like=int(rows[one.like])) for one in proposals.next_poses(suggest)),
        hand_eye=shown.hand_eye,
        findings=strongest_first({sentence(one): one for one in found}.values()),
        notes=(*alone.notes, *shown.notes),
    )


@dataclass(frozen=True, kw_only=True)
class _CaptureFindings:
    """Findings of files, poses and images by themselves."""

    robot: RobotErrors
    move_m: float
    rotation_rad: float
    """Largest angle between two gripper poses."""
    clear: Int[ndarray, " c"]
    """Rows of the images that are sharp and well exposed."""
    sharpness: Float[ndarray, " n"]
    views: tuple[Finding, ...]
    """Findings of the images alone."""
    notes: tuple[str, ...]
    unused: tuple[Finding, ...] = ()
    """Finding of a robot whose model is not used."""


def _examine_alone(capture: Capture | PosePairs) -> _CaptureFindings:
    gripper = capture.base_from_gripper
    move_m, rotation_rad = largest_motion(gripper)
    alone = _CaptureFindings(
        robot=errors_of(gripper),
        move_m=move_m,
        rotation_rad=rotation_rad,
        clear=np.arange(len(gripper)),
        sharpness=np.zeros(0),
        views=(),
        notes=tuple(capture.notes),
    )
    if alone.move_m < 5e-3 and alone.rotation_rad > np.radians(5):
        divided = (
            f"the gripper moves by at most {1e3 * alone.move_m:.2g} mm while it rotates by "
            f"{np.degrees(alone.rotation_rad):.0f}°: the positions may have been divided by 1000"
        )
        alone = replace(alone, notes=(*alone.notes, divided))
    return _with_images(alone, capture) if isinstance(capture, Capture) else alone


def _with_images(alone: _CaptureFindings, capture: Capture) -> _CaptureFindings:
    robot, views = robot_errors(capture, CalibrateOptions()), view_findings(capture)
    brightness, sharpness = _brightness_and_sharpness_of_each(capture)
    blurred = {name for one in views if one.kind is FindingKind.BLURRED for name in one.images}
    clear = [
        exposure_fault(grey) is None and name not in blurred
        for name, grey in zip(capture.images, brightness, strict=True)
    ]
    return replace(
        alone,
        robot=robot,
        clear=np.flatnonzero(clear),
        sharpness=sharpness,
        views=views,
        notes=(*alone.notes, *_remarks(capture, brightness)),
        unused=() if robot.unused is None else (robot.unused,),
    )


def _camera(capture: Capture | PosePairs) -> PredictedCamera | None:
    """Return the camera as it is assumed before its images are matched."""
    if isinstance(capture, PosePairs):
        return None
    return typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """Comparison of gripper poses with cameras."""

    hand_eye: HandEye | None = None
    """None where no cameras were found."""
    findings: tuple[Finding, ...] = ()
    notes: tuple[str, ...] = ()
    registered: Int[ndarray, " c"] | None = None
    """Rows of the images that a calibration would use; None where not all were looked at."""
    assumptions: Assumptions | None = None
    """Camera and robot as found; None where nothing was found, or it would be rejected."""

    @property
    def observability(self) -> Observability | None:
        """Observability of the compared poses; None where some were not compared."""
        if self.hand_eye is None or self.registered is None:
            return None
        return self.hand_eye.observability


def _compare_with_images(
    capture: Capture,
    robot: RobotErrors,
    robot_noise: tuple[float, float] | None,
    seed: int,
    progress: Progress | None,
    thorough: bool,
) -> _Comparison:
    """Compare the gripper poses with few small images and, where that is not enough, with all of them."""
    if not thorough and len(capture) > QUICK:
        rows = spread_rows(len(capture))
        few = _of_rows(capture, rows)
        shown = _compare_registered(few, robot.of(rows), robot_noise, seed, progress, QUICK_SIZE_PX)
        is_sound = verdict_of(shown.findings) != "rejected"
        if is_sound and shown.registered is not None and len(shown.registered) == QUICK:
            return replace(shown, registered=None)
    return _compare_registered(capture, robot, robot_noise, seed, progress)


def read_and_compare(
    path: str | Path,
    options: ReadOptions | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress | None = None,
) -> Capture | PosePairs:
    """Read a capture; where its file leaves the pose convention open, find the one that the images fit.

    Raises InputError where the images do not tell either.
    """
    try:
        return read_source(path, options, into=into, progress=progress)
    except OpenConventionError:
        read = list[tuple[Capture, ReadOptions]]()
        for possible in possible_options(options or ReadOptions()):
            for one in possible:
                with suppress(InputError):
                    read.append((read_capture(path, one), one))
                    break
        found = _best_fit(read, progress)
        if found is None:
            raise InputError(
                f"{path}: columns rx, ry, rz may be a rotation vector or angles, and the images do not tell which; add "
                "--pose-convention ur or --pose-convention yaskawa"
            ) from None
        return found


def _best_fit(read: list[tuple[Capture, ReadOptions]], progress: Progress | None) -> Capture | None:
    """Return the capture whose poses agree with the images far better than those of the others, with a note."""
    if not read:
        return None
    rows = spread_rows(len(read[0][0]))
    few = _of_rows(read[0][0], rows)
    try:
        found = reconstruct_colmap(few, ColmapOptions(working_size_px=QUICK_SIZE_PX), progress)
    except RejectedError:
        return None
    fits = []
    for capture, options in read:
        gripper = capture.base_from_gripper[rows][found.image_index]
        noise = solve_hand_eye(gripper, found.recon_from_camera, in_sequence=False).robot_noise
        off = f"{1e3 * noise.translation:.2g} mm and {np.degrees(noise.rotation):.2g}°"
        fits.append((float(noise.translation + ARM * noise.rotation), off, capture, options))
    (best, off, capture, options), *others = sorted(fits, key=lambda fit: fit[0])
    if others and others[0][0] < CLEARER * best:
        return None
    units = "" if options.pose_units == "auto" else f" --pose-units {options.pose_units}"
    worse = "".join(f", those of {one.pose_convention} only to {text}" for _, text, _, one in others)
    note = (
        f"columns rx, ry, rz are read with --pose-convention {options.pose_convention}{units}: these poses agree with "
        f"the images to {off} per axis{worse}; give these options to jcr run"
    )
    return replace(capture, notes=(*capture.notes, note))


def spread_rows(count: int) -> Int[ndarray, " k"]:
    """Return the rows of the images, out of `count`, that are examined first."""
    return np.linspace(0, count - 1, min(count, QUICK)).round().astype(int)


def _of_rows(capture: Capture, rows: Int[ndarray, " k"]) -> Capture:
    joints = None if capture.joints is None else capture.joints[rows]
    names = tuple(capture.images[row] for row in rows)
    return replace(
        capture, images=names, base_from_gripper=capture.base_from_gripper[rows], joints=joints, depths=None
    )


def _compare_registered(
    capture: Capture,
    robot: RobotErrors,
    robot_noise: tuple[float, float] | None,
    seed: int,
    progress: Progress | None,
    size_px: int | None = None,
) -> _Comparison:
    """Compare the gripper poses with cameras that are reconstructed from features."""
    options = ColmapOptions(seed=seed)
    if size_px is not None:
        options = replace(options, working_size_px=size_px)
    try:
        found = reconstruct_colmap(capture, options, progress)
    except RejectedError as error:
        board = None
        if size_px is None:
            board = proposed([read_image(capture.folder / name) for name in capture.images])
        return _Comparison(findings=(*no_reconstruction(error), *(() if board is None else (board,))))
    rows = found.image_index
    options_then = CalibrateOptions(robot_noise=_mm_deg(robot_noise))
    case = checked(capture, found, options_then, robot.of(rows))
    shown = _compare_by_calibration(capture, case)
    return replace(
        shown,
        notes=found.notes,
        registered=rows[case.hand_eye.inliers],
        assumptions=assumptions_of(case) if case.hand_eye.converged else None,
    )


def _compare_by_calibration(capture: Capture, case: Case) -> _Comparison:
    """Return the findings of a calibration, with those of the poses that it left out."""
    hand_eye = case.hand_eye
    if hand_eye.converged:
        hand_eye = hand_eye.with_findings(*left_out_poses(capture, case.reconstruction, hand_eye))
    return _Comparison(hand_eye=hand_eye, findings=hand_eye.findings)


def _compare_pairs(pairs: PosePairs, noise: tuple[float, float] | None) -> _Comparison:
    """Compare gripper poses with camera poses that were given, by the calibration of both."""
    hand_eye = calibrate_poses(pairs, CalibrateOptions(robot_noise=_mm_deg(noise)))
    used, assumptions = hand_eye.inliers, None
    if hand_eye.converged:
        scale_std = SCALE_STD if pairs.is_metric and is_one(hand_eye) else None
        assumptions = assumptions_of_poses(hand_eye, pairs.base_from_gripper[used], scale_std)
    return _Comparison(
        hand_eye=hand_eye,
        findings=hand_eye.findings,
        registered=np.flatnonzero(used),
        assumptions=assumptions,
    )


def _mm_deg(noise: tuple[float, float] | None) -> tuple[float, float] | None:
    return None if noise is None else (1e3 * noise[0], float(np.degrees(noise[1])))


def _brightness_and_sharpness_of_each(capture: Capture) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Return the mean grey level and the relative sharpness of every image."""
    looks = [brightness_and_sharpness(read_image(capture.folder / name)) for name in capture.images]
    brightness, sharpness = np.array(looks).T
    return brightness, sharpness / max(float(np.median(sharpness)), 1e-9)


def _remarks(capture: Capture, brightness: Float[ndarray, " n"]) -> Iterator[str]:
    """Yield remarks on the exposure of images and on intrinsics."""
    for name, grey in zip(capture.images, brightness, strict=True):
        if (fault := exposure_fault(grey)) is not None:
            yield f"{name} is {fault}; expose it again"
    if capture.intrinsics is not None and (fold := fold_distance_px(capture.intrinsics)) is not None:
        yield f"the stored distortion folds over at {fold:.0f} px from the centre; it will not be used"
