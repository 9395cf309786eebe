"""Uncertainty of points that the camera sees, against draws and against simulated truth."""

from functools import cache

import numpy as np
import pytest

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.camera import parameters, unproject, with_parameters
from jcr.estimation.intrinsics_prior import ESTIMATED, camera_with_prior
from jcr.estimation.point_uncertainty import (
    point_covariance,
    point_in_base,
    scene_points,
    scene_uncertainty,
    within_95,
)
from jcr.estimation.solve import Solution, adjust_wrist, uncertainty_of
from jcr.geometry import apply, inverse, retract
from jcr.records import Intrinsics, RobotNoise, Tracks, Uncertainty
from simulation.problems import INTRINSICS, HandEyeProblem, hand_eye_problem, observed

X_PX = np.array([[319.5, 239.5], [40.0, 30.0], [600.0, 450.0]])
DISTANCE_M = 0.45


def adjusted(problem: HandEyeProblem, seed: int) -> tuple[Solution, Tracks, Calibration]:
    tracks = observed(problem, np.random.default_rng([seed, 1]), 300, 0.3)
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    found = adjust_wrist(
        problem.base_from_gripper,
        (start.gripper_from_camera, start.scale, start.base_from_recon.rigid),
        problem.recon_from_camera,
        camera_with_prior(INTRINSICS, ESTIMATED),
        tracks,
    )
    return found, tracks, start


@cache
def estimated(seed: int = 0) -> tuple[np.ndarray, Uncertainty, Intrinsics, RobotNoise]:
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, 10, robot_noise=(5e-4, np.radians(0.05)))
    found, tracks, start = adjusted(problem, seed)
    camera = found.problem.intrinsics(found.state)[0]
    return found.state.x[0], uncertainty_of(found), camera, start.robot_noise


def placed(x: np.ndarray, camera: Intrinsics, log_scale: float = 0.0) -> np.ndarray:
    ray = unproject(camera, X_PX)
    return apply(x, np.exp(log_scale) * DISTANCE_M * ray / np.linalg.norm(ray, axis=1, keepdims=True))


def test_covariance_of_a_seen_point_is_that_of_draws_of_all_that_places_it():
    x, uncertainty, camera, _ = estimated()
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(16), uncertainty.whole, 4000, method="eigh")
    drawn = np.array(
        [
            placed(
                retract(x, step[:6]),
                with_parameters(camera, parameters(camera) + step[7:]),
                step[6],
            )
            for step in steps
        ]
    )
    in_camera = drawn @ x[:3, :3]
    for k, covariance in enumerate(point_covariance(x, uncertainty, camera, X_PX, DISTANCE_M)):
        assert np.cov(in_camera[:, k].T) == pytest.approx(covariance, abs=0.06 * np.trace(covariance))


def test_errors_of_the_gripper_pose_stand_beside_those_of_the_calibration():
    x, uncertainty, camera, noise = estimated()
    pose = inverse(np.linalg.inv(x))
    ray = unproject(camera, X_PX)
    depth_m = DISTANCE_M * ray[:, 2] / np.linalg.norm(ray, axis=1)
    x_in_base, found = point_in_base(x, uncertainty, camera, noise, X_PX, depth_m, pose)
    assert x_in_base == pytest.approx(apply(pose, placed(x, camera)))
    here = point_covariance(x, uncertainty, camera, X_PX, DISTANCE_M)
    on_gripper = placed(x, camera)[1]
    rng, drawn = np.random.default_rng(0), np.zeros((4000, 3))
    for metres, radians in ((noise.translation, noise.rotation), noise.systematic_left):
        steps = rng.normal(size=(4000, 6)) * np.repeat((metres, radians), 3)
        drawn += [apply(retract(pose, step), on_gripper) for step in steps]
    to_base = pose[:3, :3] @ x[:3, :3]
    expected = to_base @ here[1] @ to_base.T + np.cov(drawn.T)
    assert found[1] == pytest.approx(expected, abs=0.06 * np.trace(found[1]))


@pytest.mark.slow
def test_points_of_the_scene_are_where_they_are_said_to_be():
    inside, sizes = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        problem = hand_eye_problem(rng, 10, robot_noise=(5e-4, np.radians(0.05)))
        found, _, _ = adjusted(problem, seed)
        in_base, together, own = points = scene_points(found)
        # The tracks are of points that the problem drew first, in the base.
        true = np.random.default_rng([seed, 1]).uniform([0.25, -0.25, 0.0], [0.75, 0.25, 0.12], (300, 3))
        nearest = np.linalg.norm(in_base[:, None] - true, axis=2).min(1)
        n = np.arange(len(nearest))
        covariance = together[n, :, n] + own
        inside.append(nearest < np.array([within_95(one) for one in covariance]))
        scene = scene_uncertainty(points)
        sizes.append(np.trace(scene.covariance_at(in_base), axis1=1, axis2=2).mean())
        assert sizes[-1] == pytest.approx(np.trace(together[n, :, n], axis1=1, axis2=2).mean(), rel=0.1)
    assert np.concatenate(inside).mean() > 0.8
