"""Many poses with smooth systematic errors: the diagonal equations against the dense ones, and their speed."""

import time

import numpy as np
import pytest

from jcr.estimation import components, smooth
from jcr.estimation.arms import arm_named
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.geometry import step_between
from simulation.problems import bent_problem, error, hand_eye_problem


@pytest.mark.parametrize("wrong", [0, 3])
def test_results_are_those_of_the_dense_equations(monkeypatch: pytest.MonkeyPatch, wrong: int):
    problem = bent_problem(arm_named("ur5e"), "typical", 40, 1)
    gripper = problem.base_from_gripper.copy()
    gripper[:wrong, :3, 3] += 0.05
    monkeypatch.setattr(components, "TOO_MANY", 20)
    found = []
    for fewest in (1000, 10):
        monkeypatch.setattr(smooth, "FEWEST", fewest)
        monkeypatch.setattr(smooth, "FEWEST_TO_COMPARE", fewest)
        found.append(solve_hand_eye(gripper, problem.recon_from_camera))
    dense, fast = found
    std = np.sqrt(np.diag(dense.covariance))
    assert (np.abs(step_between(dense.gripper_from_camera, fast.gripper_from_camera)) < 1e-5 * std[:6]).all()
    assert np.sqrt(np.diag(fast.covariance)) == pytest.approx(std, rel=1e-5)
    assert dense.inliers.tolist() == fast.inliers.tolist() == [False] * wrong + [True] * (40 - wrong)
    assert dense.leave_one_out is not None and fast.leave_one_out is not None
    assert fast.leave_one_out.translation_mm == pytest.approx(dense.leave_one_out.translation_mm, rel=1e-5)
    assert dense.budget is not None and fast.budget is not None
    for cause in ("robot_random", "robot_systematic"):
        one, other = (np.diag(getattr(budget, cause)) for budget in (dense.budget, fast.budget))
        assert one == pytest.approx(other, rel=1e-3)


def test_two_hundred_poses_take_seconds():
    problem = hand_eye_problem(np.random.default_rng(3), 200, robot_noise=(5e-4, 1e-3))
    start = time.process_time()
    solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    assert time.process_time() - start < 6
    off = error(problem, solved.gripper_from_camera, solved.scale)
    assert (np.abs(off) < 4 * np.sqrt(np.diag(solved.covariance))).all()
