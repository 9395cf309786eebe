"""Joints that are off are named with an honest sigma; a straight arm is not accused."""

import numpy as np
import pytest

from jcr.estimation.arms import arm_named
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.estimation.joint_offsets import joint_offsets, systematic_p_value
from jcr.estimation.residuals import angle_ratio
from jcr.estimation.systematic import arm_errors, posed
from jcr.geometry import rotation_exp, transform
from simulation.arms import PresetName
from simulation.problems import bent_problem


def examined(preset: PresetName, seed: int):
    problem = bent_problem(arm_named("ur5e"), preset, 12, seed)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    arm, joints = posed(problem.bent.arm, problem.joints, gripper)
    systematic = arm_errors(arm, joints)
    solved = solve_hand_eye(gripper, camera, systematic=systematic)
    offsets = joint_offsets(solved, gripper, camera, systematic, arm, joints)
    return problem.bent.errors[:6], offsets, systematic_p_value(solved, gripper, camera, systematic)


@pytest.mark.slow
def test_offsets_are_right_within_their_sigma_and_a_bent_arm_is_distinguished_from_a_straight_one():
    off, printed = [], []
    for seed in range(8):
        true, found, p = examined("typical", seed)
        off.append((found.offset - true) / found.std)
        printed.append(found.std / found.prior_std)
        assert p < 1e-3
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4
    # The first and the last joint rotate base and gripper, which nothing shows.
    assert (np.median(printed, axis=0)[[0, 5]] > 0.95).all() and (np.median(printed, axis=0)[1:5] < 0.7).all()
    assert sum(examined("white", seed)[2] < 0.05 for seed in range(12)) <= 2


def test_angles_of_cameras_and_grippers_agree_unless_the_cameras_are_rotated_by_more():
    rng = np.random.default_rng(1)
    vectors = 0.5 * rng.normal(size=(9, 3))
    x = transform(rotation_exp(np.array([0.4, 1.0, -0.3])), np.array([0.1, 0.0, 0.05]))
    gripper = transform(rotation_exp(vectors), rng.normal(size=(9, 3)))
    ratio, std = angle_ratio(gripper, gripper @ x)
    assert ratio == pytest.approx(1.0, abs=1e-9) and std < 1e-9
    about_one = transform(rotation_exp(np.outer(np.linspace(0, 1, 9), [0.0, 0.6, 0.8])), np.zeros((9, 3)))
    wider = transform(rotation_exp(1.02 * np.outer(np.linspace(0, 1, 9), [0.0, 0.6, 0.8])), np.zeros((9, 3)))
    assert angle_ratio(about_one, wider)[0] == pytest.approx(1.02, abs=1e-9)
