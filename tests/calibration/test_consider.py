"""Errors of given intrinsics in a calibration from camera poses that were found with them."""

import cv2
import numpy as np
import pytest

from jcr.calibration.adjust import with_intrinsics_considered
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.camera import parameters, with_parameters
from jcr.estimation.intrinsics_prior import camera_with_prior
from jcr.estimation.problem import scale_prior
from jcr.estimation.robot_noise import smooth_errors
from jcr.geometry import inverse, transform
from simulation.problems import INTRINSICS, error, hand_eye_problem, observed


@pytest.mark.slow
def test_cameras_that_were_placed_with_a_wrong_focal_length_are_within_sigma_once_it_is_considered():
    without, considered = [], []
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
        whole = with_intrinsics_considered(
            solved,
            problem.base_from_gripper,
            np.array(camera),
            tracks,
            camera_with_prior(given),
            (scale_prior(problem.scale, 1e-3),),
            smooth_errors(problem.base_from_gripper),
        )
        off = error(problem, solved.gripper_from_camera, solved.scale)[:6]
        without.append(np.abs(off / np.sqrt(np.diag(solved.covariance)[:6])).max())
        considered.append(np.abs(off / np.sqrt(np.diag(whole.covariance)[:6])).max())
    assert max(considered) < 3 < np.median(without)
    assert np.median(considered) > 0.3
