"""Judging a capture before any heavy work: files, motion, what it shows, what to add, how it was written."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.checks.left_out import left_out_poses
from jcr.calibration.checks.robot import angle_finding
from jcr.calibration.checks.views import as_causes, view_findings
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate
from jcr.camera import fold_distance_px
from jcr.capture.images import brightness_and_sharpness, exposure_fault, read_image
from jcr.capture.read import read_source
from jcr.errors import NotTrustedError
from jcr.geometry import largest_motion
from jcr.handeye.conventions import better_reading, convention_finding
from jcr.handeye.equation import ASSUMED_NOISE
from jcr.handeye.next_poses import next_poses
from jcr.handeye.observability import observability
from jcr.handeye.residuals import angle_ratio
from jcr.handeye.solve import solve_hand_eye
from jcr.progress import Progress
from jcr.reconstruct.board_in_view import proposed
from jcr.reconstruct.colmap import ColmapOptions, reconstruct
from jcr.records import (
    CAMERA,
    Capture,
    Finding,
    HandEye,
    NextPose,
    Observability,
    PosePairs,
    Reconstruction,
    Verdict,
    without_consequences,
)
from jcr.records.words import remedy, sentence, unobservable

QUICK, QUICK_SIZE_PX = 8, 800
"""Images that tell in seconds whether the poses are theirs, and the long side at which they do."""


@dataclass(frozen=True)
class Examination:
    """What is known of a capture before it is calibrated."""

    sharpness: Float[ndarray, " n"]
    """Variance of the Laplacian, relative to the median image's; empty where there are no images."""
    largest_move_m: float
    largest_turn_rad: float
    """Between any two gripper poses."""
    observability: Observability
    expected_std: Float[ndarray, "7"]
    """records.COVARIANCE_ORDER, for the noise that was given or assumed."""
    suggestions: tuple[NextPose, ...]
    hand_eye: HandEye | None
    """From sparse features, where the images were looked at and registered."""
    angle_ratio: tuple[float, float] | None
    """Rotation angles between cameras over those between grippers, and its standard deviation; 1 is right whatever
    gripper_from_camera is. None without cameras to compare with."""
    faults: tuple[str, ...]
    """Why a calibration of this capture would be rejected."""
    remarks: tuple[str, ...]

    @property
    def verdict(self) -> Verdict:
        """What its calibration would be."""
        if self.faults:
            return "rejected"
        return "accepted" if self.hand_eye is None else self.hand_eye.verdict


def check(
    capture: Capture | PosePairs | str | Path,
    suggest: int = 0,
    look: bool = True,
    robot_noise: tuple[float, float] | None = None,
    reach: Float[ndarray, "2 3"] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
    thorough: bool = False,
) -> Examination:
    """Examine a capture, or what lies at its path.

    With `look` its images are registered sparsely to hold the poses against them.

    A few of them at a small size tell in seconds; where these speak against the capture, or where it is to be
    `thorough`, all are registered as a calibration does. Where the cameras' poses were given instead, the gripper's are
    held against those.

    `suggest` is how many gripper poses to propose, `robot_noise` (m, rad) one sigma per axis. InputError where gripper
    poses and joint angles contradict each other.
    """
    if isinstance(capture, str | Path):
        capture = read_source(capture)
    gripper = capture.base_from_gripper
    move, turn = largest_motion(gripper)
    sharp, remarks = np.zeros(0), [*capture.notes]
    views: tuple[Finding, ...] = ()
    if isinstance(capture, Capture):
        brightness, sharp = _looks(capture)
        views = view_findings(capture)
        remarks += _exposure_remarks(capture, brightness)
        if capture.intrinsics is not None and (fold := fold_distance_px(capture.intrinsics)) is not None:
            remarks.append(
                f"the stored distortion folds over at {fold:.0f} px from the centre; it will not be used"
            )
    if move < 5e-3 and turn > np.radians(5):
        remarks.append(
            f"the gripper moves by at most {1e3 * move:.2g} mm while it rotates by {np.degrees(turn):.0f}°: "
            "the positions may have been divided by 1000"
        )
    if isinstance(capture, Capture):
        unused = robot_errors(capture, CalibrateOptions()).unused
        remarks += [] if unused is None else [sentence(unused)]
    faults = [sentence(one) for one in views if one.severity == "rejects"]
    held, quick = None, False
    if isinstance(capture, PosePairs):
        held = _held_against(gripper, capture, robot_noise)
    elif look and not faults:
        held, quick = _looked_at(capture, robot_noise, seed, progress, thorough)
    hand_eye, ratio = (None, None) if held is None else (held.hand_eye, held.ratio)
    if held is not None:
        faults += held.faults
        remarks += held.remarks
    if ratio is not None and (hand_eye is None or not any(one.kind in CAMERA for one in hand_eye.findings)):
        angles = angle_finding(*ratio)
        remarks += [] if angles is None else [sentence(angles)]
    trusted = hand_eye is not None and hand_eye.converged
    x = hand_eye.gripper_from_camera if hand_eye is not None and trusted else None
    seen = observability(gripper, x) if hand_eye is None or quick else hand_eye.observability
    if hand_eye is None:
        faults += [f"{unobservable(one)}; {remedy(one)}" for one in seen.findings]
    if faults:
        views = as_causes(views)
        faults = list(
            dict.fromkeys((*(sentence(one) for one in views if one.severity == "rejects"), *faults))
        )
    remarks += [sentence(one) for one in views if one.severity == "warns"]
    noise = robot_noise or ASSUMED_NOISE
    if hand_eye is not None and trusted and robot_noise is None:
        noise = (hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation)
    expected, suggestions = next_poses(gripper, suggest, x, noise, reach, seed)
    return Examination(
        sharp, move, turn, seen, expected, tuple(suggestions), hand_eye, ratio, tuple(faults), tuple(remarks)
    )


@dataclass(frozen=True)
class _Held:
    """Gripper poses held against cameras."""

    hand_eye: HandEye | None
    """None where no cameras were found."""
    ratio: tuple[float, float] | None
    faults: tuple[str, ...]
    remarks: tuple[str, ...] = ()


def _looked_at(
    capture: Capture,
    robot_noise: tuple[float, float] | None,
    seed: int,
    progress: Progress | None,
    thorough: bool,
) -> "tuple[_Held, bool]":
    """The gripper poses held against the images, and whether few small ones were enough."""
    if not thorough and len(capture) > QUICK:
        rows = np.linspace(0, len(capture) - 1, QUICK).round().astype(int)
        held = _registered(_of_rows(capture, rows), robot_noise, seed, progress, QUICK_SIZE_PX)
        agree = held.hand_eye is not None and held.hand_eye.inliers.sum() == QUICK
        # Angles that differ have a cause, which all images at full size may show.
        if agree and not held.faults and (held.ratio is None or angle_finding(*held.ratio) is None):
            return held, True
    return _registered(capture, robot_noise, seed, progress), False


def _of_rows(capture: Capture, rows: Int[ndarray, " k"]) -> Capture:
    joints = None if capture.joints is None else capture.joints[rows]
    names = tuple(capture.images[row] for row in rows)
    return replace(
        capture, images=names, base_from_gripper=capture.base_from_gripper[rows], joints=joints, depths=None
    )


def _registered(
    capture: Capture,
    robot_noise: tuple[float, float] | None,
    seed: int,
    progress: Progress | None,
    size_px: int | None = None,
) -> _Held:
    """The gripper poses held against cameras that features find, and what else that shows."""
    options = ColmapOptions(seed=seed)
    if size_px is not None:
        options = replace(options, working_size_px=size_px)
    try:
        found = reconstruct(capture, options, progress)
    except NotTrustedError as error:
        board = None
        if size_px is None:
            board = proposed([read_image(capture.folder / name) for name in capture.images])
        return _Held(None, None, (str(error),), () if board is None else (sentence(board),))
    if size_px is not None:
        return _held_against(capture.base_from_gripper[found.image_index], found, robot_noise)
    mm_deg = None if robot_noise is None else (1e3 * robot_noise[0], float(np.degrees(robot_noise[1])))
    hand_eye = calibrate(capture, found, CalibrateOptions(robot_noise=mm_deg))
    if hand_eye.converged:
        hand_eye = hand_eye.with_findings(*left_out_poses(capture, found, hand_eye))
    ratio, said = hand_eye.robot.angle_ratio, without_consequences(hand_eye.findings)
    return _Held(
        hand_eye,
        None if ratio is None or not hand_eye.converged else (ratio.ratio, ratio.std),
        tuple(sentence(one) for one in said if one.severity == "rejects"),
        (*(sentence(one) for one in said if one.severity == "warns"), *found.notes),
    )


def _held_against(
    used: Float[ndarray, "m 4 4"],
    found: Reconstruction | PosePairs,
    robot_noise: tuple[float, float] | None,
) -> _Held:
    camera = found.recon_from_camera
    hand_eye, ratio = solve_hand_eye(used, camera, robot_noise=robot_noise), None
    reading = better_reading(used, camera)
    faults = [] if reading is None else [sentence(convention_finding(reading))]
    faults += [warning for warning in hand_eye.warnings if not hand_eye.converged]
    remarks = [warning for warning in hand_eye.warnings if hand_eye.converged]
    if hand_eye.converged and hand_eye.inliers.sum() >= 3:
        ratio = angle_ratio(used[hand_eye.inliers], camera[hand_eye.inliers])
    return _Held(hand_eye, ratio, tuple(faults), tuple(remarks))


def _looks(capture: Capture) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Mean grey level and relative sharpness of every image."""
    looks = [brightness_and_sharpness(read_image(capture.folder / name)) for name in capture.images]
    brightness, sharpness = np.array(looks).T
    return brightness, sharpness / max(float(np.median(sharpness)), 1e-9)


def _exposure_remarks(capture: Capture, brightness: Float[ndarray, " n"]):
    for name, grey in zip(capture.images, brightness, strict=True):
        if (fault := exposure_fault(grey)) is not None:
            yield f"{name} is {fault}; expose it again"
