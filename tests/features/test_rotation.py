"""X's rotation from pairs of images, before any map: exact, and with wrong pairs among them."""

import numpy as np
import pytest

from jcr.estimation.closed_form import motions
from jcr.features.gate import rotation_of_x
from jcr.geometry import rotation_angle, rotation_exp
from simulation.problems import hand_eye_problem


def pairs(seed: int, n: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    problem = hand_eye_problem(np.random.default_rng(seed), n)
    i, j = np.triu_indices(n, 1)
    camera = motions(problem.base_from_gripper @ problem.gripper_from_camera)
    return (
        motions(problem.base_from_gripper)[i, j, :3, :3],
        camera[i, j, :3, :3],
        problem.gripper_from_camera[:3, :3],
    )


def test_exact_pairs_give_the_exact_rotation():
    gripper, camera, x = pairs(0)
    found = rotation_of_x(gripper, camera, np.full(len(gripper), 0.05))
    assert found is not None and found.agreeing.all()
    assert rotation_angle(found.rotation.T @ x) < 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_wrong_pairs_are_found_out(seed: int):
    """Half of the pairs rotated by the angle of the gripper about an axis of chance, which the angle does not show."""
    rng = np.random.default_rng(seed)
    gripper, camera, x = pairs(seed)
    camera = rotation_exp(rng.normal(scale=2e-3, size=(len(camera), 3))) @ camera
    wrong = rng.permutation(len(camera))[: len(camera) // 2]
    axis = rng.normal(size=(len(wrong), 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    camera[wrong] = rotation_exp(axis * np.asarray(rotation_angle(gripper[wrong]))[:, None])
    found = rotation_of_x(gripper, camera, np.full(len(gripper), 0.02))
    assert found is not None
    assert rotation_angle(found.rotation.T @ x) < 5e-3
    right = np.setdiff1d(np.arange(len(camera)), wrong)
    assert found.agreeing[right].mean() > 0.9
    assert found.agreeing[wrong].mean() < 0.25


def test_the_covariance_is_that_of_many_draws():
    rng = np.random.default_rng(0)
    gripper, camera, x = pairs(1, 6)
    errors, stds = [], []
    for _ in range(60):
        noisy = rotation_exp(rng.normal(scale=3e-3, size=(len(camera), 3))) @ camera
        found = rotation_of_x(gripper, noisy, np.full(len(gripper), 0.05))
        assert found is not None
        errors.append(rotation_angle(found.rotation.T @ x))
        stds.append(np.sqrt(np.trace(found.covariance)))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(stds)
    assert 0.7 < ratio < 1.3


def test_one_axis_fixes_nothing():
    x = rotation_exp(np.array([0.3, -0.2, 1.0]))
    gripper = rotation_exp(np.linspace(0.2, 1.5, 10)[:, None] * np.array([0.0, 0.0, 1.0]))
    assert rotation_of_x(gripper, x.T @ gripper @ x, np.full(10, 0.02)) is None
