"""Corners in the base: of an exact calibration they scatter by the pixels' noise, and wrong intrinsics show."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import real
from benchmarks.real import Corners, WristCamera, measure, pixels_of, predicted
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.records import Intrinsics
from simulation.problems import TARGET_IN_BASE, HandEyeProblem, hand_eye_problem

CAMERA = Intrinsics(620.0, 620.0, 322.0, 236.0, 640, 480, (-0.08, 0.03, 0.0, 0.0, 0.0))
NOISE_PX = 0.1
X_IN_BOARD = np.stack([*np.meshgrid(np.arange(8), np.arange(5)), np.zeros((5, 8))], -1).reshape(-1, 3) * 0.025


def seen(problem: HandEyeProblem, bend: float = 0.0) -> tuple[WristCamera, Corners]:
    """The true camera, and a board about the target, its edges raised by `bend` (m), in its images."""
    camera = WristCamera(CAMERA, problem.gripper_from_camera, problem.true_base_from_gripper)
    x_in_base = X_IN_BOARD - X_IN_BOARD.mean(0)
    x_in_base[:, 2] = bend * (x_in_base[:, 0] / x_in_base[:, 0].max()) ** 2
    image, corner = (index.ravel() for index in np.indices((len(problem.base_from_gripper), len(X_IN_BOARD))))
    corners = Corners(image, corner, np.zeros((len(image), 2)), X_IN_BOARD)
    x_px = pixels_of(camera, corners, x_in_base + TARGET_IN_BASE)
    noise = np.random.default_rng(1).normal(scale=NOISE_PX, size=x_px.shape)
    return camera, replace(corners, x_px=x_px + noise)


def test_an_exact_calibration_scatters_by_the_noise_of_pixels_and_a_wrong_focal_length_shows():
    camera, corners = seen(hand_eye_problem(np.random.default_rng(3), 10))
    exact = measure(camera, corners)
    depth = np.linalg.norm(camera.base_from_camera[:, :3, 3] - TARGET_IN_BASE, axis=1)
    lateral = np.sqrt(2) * NOISE_PX * np.sqrt((depth**2).mean()) / CAMERA.fx
    # The noise of the distance along the ray comes in addition.
    assert lateral < exact.scatter < 2 * lateral
    assert exact.side == pytest.approx(1.0, abs=5e-4)
    assert exact.flat < 1e-4
    wrong = replace(camera, intrinsics=replace(CAMERA, fx=1.01 * CAMERA.fx, fy=1.01 * CAMERA.fy))
    off = measure(wrong, corners)
    # Lengths across the ray are wrong by it, distances are not: the robot's metre gives those.
    assert off.side == pytest.approx(0.99, abs=5e-4)
    assert off.scatter > 1.5 * exact.scatter


def test_a_sheet_that_bends_is_not_flat_and_scatters_no_more():
    problem = hand_eye_problem(np.random.default_rng(3), 10)
    flat, bent = (measure(*seen(problem, bend)) for bend in (0.0, 0.003))
    assert bent.flat > 8e-4 > 4 * flat.flat
    assert bent.scatter < 1.1 * flat.scatter


@pytest.mark.slow
def test_the_scatter_is_predicted_from_what_a_calibration_states(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(real, "DRAWS", 40)
    ratios = []
    for seed in range(3):
        problem = hand_eye_problem(np.random.default_rng(seed), 12, robot_noise=(4e-4, 1e-3))
        hand_eye = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        camera, corners = seen(problem)
        found = replace(
            camera,
            gripper_from_camera=hand_eye.gripper_from_camera,
            base_from_gripper=problem.base_from_gripper,
        )
        draws = predicted(found, hand_eye, corners, NOISE_PX)
        ratios.append(measure(found, corners).scatter / np.sqrt((np.array(draws) ** 2).mean()))
    assert 0.7 < np.median(ratios) < 1.4
