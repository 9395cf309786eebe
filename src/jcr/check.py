"""Judging a capture before any heavy work: files, motion, what it shows, what to add, how it was written."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.words import angles_in_words
from jcr.camera import fold_distance_px
from jcr.capture.images import BLURRED, brightness_and_sharpness, exposure_fault, read_image
from jcr.errors import NotTrustedError
from jcr.geometry import inverse, rotation_angle
from jcr.handeye.conventions import better_reading, explained
from jcr.handeye.equation import ASSUMED_NOISE
from jcr.handeye.next_poses import next_poses
from jcr.handeye.observability import observability
from jcr.handeye.residuals import angle_ratio
from jcr.handeye.solve import solve_hand_eye
from jcr.progress import Progress
from jcr.reconstruct.board_in_view import proposed
from jcr.reconstruct.colmap import ColmapOptions, reconstruct
from jcr.records import Capture, HandEye, NextPose, Observability, PosePairs, Reconstruction


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
    """From sparse features, where the pictures were looked at and registered."""
    angle_ratio: tuple[float, float] | None
    """Rotation angles between cameras over those between grippers, and its standard deviation; 1 is right whatever
    gripper_from_camera is. None without cameras to compare with."""
    faults: tuple[str, ...]
    """Why a calibration of this capture would not be trusted."""
    remarks: tuple[str, ...]


def check(
    capture: Capture | PosePairs,
    suggest: int = 0,
    look: bool = True,
    robot_noise: tuple[float, float] | None = None,
    reach: Float[ndarray, "2 3"] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Examination:
    """Examine a capture; with `look` its pictures are registered sparsely to hold the poses against them.

    Where the cameras' poses were given instead, the gripper's are held against those.

    `suggest` is how many gripper poses to propose, `robot_noise` (m, rad) one sigma per axis.
    """
    gripper = capture.base_from_gripper
    motion = inverse(gripper)[:, None] @ gripper[None]
    move = float(np.linalg.norm(motion[..., :3, 3], axis=-1).max())
    turn = float(rotation_angle(motion[..., :3, :3]).max())
    sharp, remarks = np.zeros(0), [*capture.notes]
    if isinstance(capture, Capture):
        brightness, sharp = _looks(capture)
        remarks += _picture_remarks(capture, brightness, sharp)
        if capture.intrinsics is not None and (fold := fold_distance_px(capture.intrinsics)) is not None:
            remarks.append(
                f"the stored distortion folds over at {fold:.0f} px from the centre; it will not be used"
            )
    if move < 5e-3 and turn > np.radians(5):
        remarks.append(
            f"the gripper moves by at most {1e3 * move:.2g} mm while it turns by {np.degrees(turn):.0f}°: "
            "positions that were divided by 1000 look so"
        )
    hand_eye, ratio, faults = None, None, []
    found: Reconstruction | PosePairs | None = capture if isinstance(capture, PosePairs) else None
    if look and isinstance(capture, Capture):
        try:
            found = reconstruct(capture, ColmapOptions(seed=seed, dense=False), progress)
            remarks += [*found.warnings, *found.notes]
        except NotTrustedError as error:
            remarks.append(str(error))
            if (
                board := proposed([read_image(capture.folder / name) for name in capture.images])
            ) is not None:
                remarks.append(board)
    if found is not None:
        used = gripper[found.image_index]
        hand_eye = solve_hand_eye(used, found.recon_from_camera, robot_noise=robot_noise)
        if (reading := better_reading(used, found.recon_from_camera)) is not None:
            faults.append(explained(reading))
        faults += [warning for warning in hand_eye.warnings if not hand_eye.converged]
        if hand_eye.converged and hand_eye.inliers.sum() >= 3:
            ratio = angle_ratio(used[hand_eye.inliers], found.recon_from_camera[hand_eye.inliers])
            remarks += angles_in_words(*ratio)
    trusted = hand_eye is not None and hand_eye.converged
    x = hand_eye.gripper_from_camera if hand_eye is not None and trusted else None
    seen = hand_eye.observability if hand_eye is not None else observability(gripper)
    if hand_eye is None:
        faults += [f"{name}; {cure}" for name, cure in zip(seen.unobservable, seen.advice, strict=False)]
    noise = robot_noise or ASSUMED_NOISE
    if hand_eye is not None and trusted and robot_noise is None:
        noise = (hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation)
    expected, suggestions = next_poses(gripper, suggest, x, noise, reach, seed)
    return Examination(
        sharp, move, turn, seen, expected, tuple(suggestions), hand_eye, ratio, tuple(faults), tuple(remarks)
    )


def _looks(capture: Capture) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Mean grey level and relative sharpness of every image."""
    looks = [brightness_and_sharpness(read_image(capture.folder / name)) for name in capture.images]
    brightness, sharpness = np.array(looks).T
    return brightness, sharpness / max(float(np.median(sharpness)), 1e-9)


def _picture_remarks(capture: Capture, brightness: Float[ndarray, " n"], sharpness: Float[ndarray, " n"]):
    for name, grey, sharp in zip(capture.images, brightness, sharpness, strict=True):
        if (fault := exposure_fault(grey)) is not None:
            yield f"{name} is {fault}; expose it anew"
        elif sharp < BLURRED:
            yield f"{name} is blurred ({100 * sharp:.0f} % of the median sharpness); take it again at rest"
