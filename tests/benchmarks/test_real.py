"""Measures of the bench of real captures: scatter of corners in the base frame, and references from boards."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.real import WristCamera, measure, pixels_of
from benchmarks.references import Corners, reference
from jcr.camera import parameters
from jcr.geometry import step_between
from jcr.records import Intrinsics
from simulation.problems import TARGET_IN_BASE, HandEyeProblem, hand_eye_problem

CAMERA = Intrinsics(620.0, 620.0, 322.0, 236.0, 640, 480, (-0.08, 0.03, 0.0, 0.0, 0.0))
NOISE_PX = 0.1
X_IN_BOARD = np.stack([*np.meshgrid(np.arange(8), np.arange(5)), np.zeros((5, 8))], -1).reshape(-1, 3) * 0.025


def seen(
    problem: HandEyeProblem, bend: float = 0.0, noise_px: float = NOISE_PX
) -> tuple[WristCamera, Corners]:
    """Return the true camera, and a board about the target, its edges raised by `bend` (m), in its images."""
    camera = WristCamera(CAMERA, problem.gripper_from_camera, problem.true_base_from_gripper)
    x_in_base = X_IN_BOARD - X_IN_BOARD.mean(0)
    x_in_base[:, 2] = bend * (x_in_base[:, 0] / x_in_base[:, 0].max()) ** 2
    image, corner = (index.ravel() for index in np.indices((len(problem.base_from_gripper), len(X_IN_BOARD))))
    corners = Corners(image, corner, np.zeros((len(image), 2)), X_IN_BOARD)
    x_px = pixels_of(camera, corners, x_in_base + TARGET_IN_BASE)
    return camera, replace(corners, x_px=x_px + noise_px * np.random.default_rng(1).normal(size=x_px.shape))


def test_corners_of_an_exact_calibration_scatter_in_proportion_to_the_noise_of_pixels_whatever_the_sheet():
    problem = hand_eye_problem(np.random.default_rng(3), 10)
    for bend in (0.0, 0.003):
        exact = measure(*seen(problem, bend, 0.0))
        assert exact.scatter < 1e-7
        once, twice = (measure(*seen(problem, bend, noise)).scatter for noise in (NOISE_PX, 2 * NOISE_PX))
        assert twice / once == pytest.approx(2.0, rel=0.01)
    # The rms height of the sheet about its best plane: the parabola less its mean.
    height = 0.003 * (np.linspace(-1, 1, 8) ** 2)
    assert measure(*seen(problem, 0.003, 0.0)).flat == pytest.approx(height.std(), rel=1e-3)


@pytest.mark.slow
def test_references_state_their_own_error():
    """Errors over σ of X and intrinsics of boards that are bent and of another size than stated: χ² per parameter."""
    squared = []
    for seed in range(2):
        problem = hand_eye_problem(np.random.default_rng(seed), 10, robot_noise=(4e-4, 1e-3))
        camera, corners = seen(problem, 0.001)
        stated = replace(corners, x_in_board=X_IN_BOARD / 1.02)
        found = reference(problem.base_from_gripper, stated, (CAMERA.width, CAMERA.height))
        off = np.r_[
            step_between(found.gripper_from_camera, camera.gripper_from_camera),
            parameters(CAMERA) - parameters(found.intrinsics),
        ]
        squared.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        assert found.size == pytest.approx(1.02, abs=0.005)
        assert found.noise[0] == pytest.approx(4e-4, rel=0.5) and found.rms_px < 2 * NOISE_PX
    # The mean square of 30 parameters is 1 ± 0.26.
    assert 0.22 < np.mean(squared) < 1.78
