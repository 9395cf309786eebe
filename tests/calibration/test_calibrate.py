"""The calibration stage: a rejected fit is replaced, and errors of given intrinsics are adjusted."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.bundle_adjustment import adjusted
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.case import Case, Model
from jcr.calibration.checks.images import REPETITIVE, share_of_twins
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.camera import parameters, with_parameters
from jcr.capture.images import read_image
from jcr.estimation.intrinsics_prior import camera_about
from jcr.estimation.problem import PoseModel, scale_prior
from jcr.geometry import inverse, retract, step_between, transform
from places import ROOT
from scenes import capture_of, reconstruction_of
from simulation.faults import faulty_capture, reconstructed
from simulation.problems import INTRINSICS, error, hand_eye_problem, observed


def test_the_adjustment_replaces_a_rejected_fit_from_poses():
    """Camera poses that are 40 mm and 5° off, as structure from motion without intrinsics can leave them: the fit from
    poses alone is rejected, and the images that follow from the true poses correct them."""
    rng = np.random.default_rng(2)
    capture, reconstruction = reconstructed(faulty_capture(rng, 12), estimated=False)
    errors = rng.normal(size=(12, 6)) * np.repeat([0.04, np.radians(5.0)], 3)
    found = replace(reconstruction, recon_from_camera=retract(reconstruction.recon_from_camera, errors))
    assert not solve_hand_eye(capture.base_from_gripper, found.recon_from_camera).converged
    calibrated, right = (
        calibrate_reconstruction(capture, found),
        calibrate_reconstruction(capture, reconstruction),
    )
    assert calibrated.converged and calibrated.inliers.all()
    step = step_between(right.gripper_from_camera, calibrated.gripper_from_camera)
    assert (np.abs(step) < 0.1 * np.sqrt(np.diag(right.covariance)[:6])).all()


def test_a_regular_tiling_is_repetitive_and_a_table_with_objects_is_not():
    rng = np.random.default_rng(0)
    tile = cv2.GaussianBlur(rng.uniform(0, 255, (60, 60, 3)), (0, 0), 2.0)
    tiled = 5 * (np.tile(tile, (8, 10, 1)) - tile.mean()) + rng.normal(scale=4, size=(480, 600, 3)) + 128
    assert share_of_twins(tiled.clip(0, 255).astype(np.uint8)) > REPETITIVE
    table = read_image(ROOT / "examples/tabletop/images/00.jpg")
    assert share_of_twins(table) < 0.5


@pytest.mark.slow
def test_cameras_that_were_placed_with_a_wrong_focal_length_are_within_sigma_once_they_are_adjusted():
    """A known scale is part of the adjustment, as a known height is."""
    without, after = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        problem = hand_eye_problem(rng, 10, robot_noise=(1e-4, np.radians(0.01)))
        tracks = observed(problem, rng, 120, 0.1)
        values = parameters(INTRINSICS)
        values[:2] *= 1 + 0.005 * rng.normal()
        values[2:4] += 0.005 * INTRINSICS.width * rng.normal(size=2)
        given = with_parameters(INTRINSICS, values)
        k = np.array([[given.fx, 0, given.cx], [0, given.fy, given.cy], [0, 0, 1.0]])
        camera = []
        for row in range(10):
            seen = tracks.image == row
            _, rotation, translation = cv2.solvePnP(
                tracks.points_in_recon[tracks.point[seen]], tracks.x_px[seen], k, np.array(given.distortion)
            )
            camera.append(inverse(transform(cv2.Rodrigues(rotation)[0], translation[:, 0])))
        solved = solve_hand_eye(problem.base_from_gripper, camera, scale=problem.scale, scale_std=1e-3)
        case = Case(
            capture=capture_of(problem.base_from_gripper, intrinsics=given),
            reconstruction=reconstruction_of(np.array(camera), intrinsics=given, tracks=tracks),
            options=CalibrateOptions(), robot=errors_of(problem.base_from_gripper),
            pose_model=PoseModel(priors=(scale_prior(problem.scale, 1e-3),)), fit=solved, numbers=solved,
            model=Model(tracks=tracks, used=solved.inliers, camera=camera_about(given, True)),
        )  # fmt: skip
        whole = adjusted(case).numbers
        off = error(problem, solved.gripper_from_camera, solved.scale)[:6]
        without.append(np.abs(off / np.sqrt(np.diag(solved.covariance)[:6])).max())
        off = error(problem, whole.gripper_from_camera, whole.scale)[:6]
        after.append(np.abs(off / np.sqrt(np.diag(whole.covariance)[:6])).max())
    assert max(after) < 3 < np.median(without)
    assert np.median(after) > 0.3
