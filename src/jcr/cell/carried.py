"""Eye-to-hand: a fixed camera that watches what the gripper carries. The hand-eye equation with its roles exchanged.

Seen from the carried thing the camera moves as if the base had it in its hand: with the inverse gripper poses everything
that calibrates a wrist camera calibrates this one, from matches that the robot checks to the verdict. Only the robot's
errors are not those of inverse poses, so that the answer and its covariance are found once more with the errors where
they are (ties.py).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jcr.calibration.intrinsics_prior import prior_about
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import MIN_OBSERVATIONS, calibrate, of_images
from jcr.cell.alone import found_alone, not_registered, of_camera
from jcr.cell.background import write_moving_parts
from jcr.cell.bundle import Freedom, Pictures, Scene, adjust_images
from jcr.cell.found import CameraFound
from jcr.cell.ties import Tie, tied
from jcr.errors import NotTrustedError
from jcr.geometry import inverse, scale_translation
from jcr.handeye.solve import judged, solve_hand_eye
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions, reconstruct
from jcr.records import Capture, CellCamera, HandEye, Reconstruction, RobotNoise


def exchanged(capture: Capture) -> Capture:
    """The capture as if its base were the gripper: for reconstruction and calibration of a camera that is fixed.

    What it says of the arm is left out, for the kinematics are those of the poses as they were.
    """
    return replace(
        capture,
        base_from_gripper=inverse(capture.base_from_gripper),
        mount="gripper",
        others=(),
        joints=None,
        robot=None,
        urdf=None,
    )


def calibrated_alone(
    capture: Capture,
    camera: CellCamera,
    moving: Path,
    reconstruct_options: ReconstructOptions,
    options: CalibrateOptions,
    progress: Progress,
) -> CameraFound:
    """A further camera that watches the gripper of a capture; `moving` is a folder for images of what moves."""
    own = of_camera(capture, camera)
    write_moving_parts(own.folder, own.images, moving)
    seen = replace(exchanged(own), folder=moving)
    try:
        reconstruction = reconstruct(seen, replace(reconstruct_options, backend="auto"), progress)
        found = refined(own, reconstruction, calibrate(seen, reconstruction, options), options)
    except NotTrustedError as error:
        return not_registered(camera, str(error))
    middle = found.base_from_recon[:3, 3] + found.base_from_recon[:3, :3] @ (
        found.scale * np.median(reconstruction.tracks.points_in_recon, axis=0)
    )
    in_base = own.base_from_gripper[:, :3, :3] @ middle + own.base_from_gripper[:, :3, 3]
    away = float(np.median((in_base - found.gripper_from_camera[:3, 3]) @ found.gripper_from_camera[:3, 2]))
    return found_alone(own, camera, reconstruction, found, away)


def refined(
    capture: Capture, reconstruction: Reconstruction, found: HandEye, options: CalibrateOptions | None = None
) -> HandEye:
    """The calibration of the exchanged capture with the robot's errors where they are.

    Its gripper_from_camera is base_from_camera, its base_from_recon gripper_from_recon; residuals are of the gripper
    poses as they were reported. One that is rejected stays as it was, with what explains it where that is known.
    """
    options = options or CalibrateOptions()
    if not found.converged:
        return _explained(capture, reconstruction, found)
    used = np.flatnonzero(found.inliers)
    rows = reconstruction.image_index[used]
    rigs = scale_translation(reconstruction.recon_from_camera[used], found.scale)
    own = of_images(reconstruction.tracks, found.inliers)
    if found.refinement is None or own.from_pointmaps or len(own.image) < MIN_OBSERVATIONS:
        return found
    lens = prior_about(reconstruction.intrinsics, capture.intrinsics is not None, capture.intrinsics_std)
    each = np.arange(len(used))
    imaged = adjust_images(
        Scene(
            rigs,
            np.eye(4)[None],
            (reconstruction.intrinsics,),
            found.scale * own.points_in_recon.astype(float),
        ),
        Pictures(each, np.zeros_like(each), own.image, own.x_px, own.point),
        Freedom((lens,), np.array([False])),
    )
    systematic, _, _ = robot_errors(capture, options)
    among = (6 * rows[:, None] + np.arange(6)).ravel()
    noise = options.robot_noise_m_rad
    start = found.gripper_from_camera, found.base_from_recon
    tie = Tie(each, capture.base_from_gripper[rows], systematic[np.ix_(among, among)], start, exchanged=True)
    answer = tied(imaged, [tie], 1.0, noise)
    more = np.zeros((7, 7)) if found.lens_shift is None else np.outer(found.lens_shift, found.lens_shift)
    robot = RobotNoise(
        *answer.noise, noise is None, noise, found.robot_noise.systematic, answer.systematic_left
    )
    return judged(
        replace(
            found,
            gripper_from_camera=answer.placed.x[0],
            scale=found.scale * answer.placed.scale,
            base_from_recon=answer.placed.z[0],
            covariance=answer.covariance[:7, :7] + more,
            robot_noise=robot,
            intrinsics=answer.placed.scene.cameras[0],
            budget=None,
            next_poses=(),
        )
    )


def _explained(capture: Capture, reconstruction: Reconstruction, found: HandEye) -> HandEye:
    """A failure, with the reason where the images are those of a camera on the gripper."""
    rows = reconstruction.image_index
    on_gripper = solve_hand_eye(capture.base_from_gripper[rows], reconstruction.recon_from_camera)
    if not on_gripper.converged:
        return found
    why = (
        f"the images fit a camera that the gripper carries, not a fixed one: write mount gripper for "
        f"{capture.camera_name}"
    )
    return replace(found, warnings=(why, *found.warnings))
