"""Eye-to-hand: a fixed camera that watches what the gripper carries. The hand-eye equation with its roles exchanged.

In the frame of the carried object the camera moves as a wrist camera does in the base: with the inverse gripper poses
everything that calibrates a wrist camera calibrates this one, from matches that the robot checks to the verdict. Only
the robot's errors are not those of inverse poses, so that the answer and its covariance are found once more with the
errors where they are (estimation/image_robots.py).
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from jcr.calibration.adjust import adjust_case, estimate_of
from jcr.calibration.case import MIN_OBSERVATIONS, Case
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import robot_errors
from jcr.calibration.stage import calibrate
from jcr.cell.alone import found_alone, not_registered, of_camera
from jcr.cell.background import write_moving_parts
from jcr.cell.found import CameraFound
from jcr.errors import RejectedError
from jcr.estimation.hand_eye import judged, solve_hand_eye
from jcr.geometry import inverse
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions, reconstruct
from jcr.records import Capture, CellCamera, Finding, HandEye, Kind, Reconstruction


def exchanged(capture: Capture) -> Capture:
    """The capture as if its base were the gripper: for reconstruction and calibration of a camera that is fixed.

    The arm's name, URDF and joints are left out, for the kinematics are those of the poses as they were.
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
    except RejectedError as error:
        return not_registered(camera, error)
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
    if not found.is_sound:
        return _explained(capture, reconstruction, found)
    robot = robot_errors(capture, options).of(reconstruction.image_index)
    case = Case(
        capture=capture,
        reconstruction=reconstruction,
        options=options,
        robot=robot,
        cues=None,
        hand_eye=found,
    )
    if found.before is None or case.tracks.from_pointmaps or len(case.tracks.image) < MIN_OBSERVATIONS:
        return found
    answer = adjust_case(case, exchanged=True)
    faults = np.zeros((7, 7)) if found.budget is None else found.budget.faults
    return judged(
        replace(
            found,
            estimate=estimate_of(answer, case.tracks).with_fault(faults),
            robot=replace(found.robot, noise=answer.noise),
            plan=replace(found.plan, next_poses=()),
        )
    )


def _explained(capture: Capture, reconstruction: Reconstruction, found: HandEye) -> HandEye:
    """A failure, with the reason where the images are those of a camera on the gripper."""
    rows = reconstruction.image_index
    on_gripper = solve_hand_eye(capture.base_from_gripper[rows], reconstruction.recon_from_camera)
    if not on_gripper.converged:
        return found
    why = Finding.of(Kind.WRONG_MOUNT, "rejects", "mount", camera=capture.camera_name)
    return found.with_findings(why)
