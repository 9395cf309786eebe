"""Joint offsets of a known arm and their standard deviations against the simulated ones."""

import numpy as np
import pytest

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.estimation.arms import arm_named
from jcr.estimation.hypotheses import joint_offsets
from jcr.estimation.inverse_kinematics import posed
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import pose_problem
from jcr.estimation.robot_noise import arm_errors
from simulation.arms import PresetName
from simulation.problems import bent_problem


def examined(preset: PresetName, seed: int):
    problem = bent_problem(arm_named("ur5e"), preset, 12, seed)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    arm, joints = posed(problem.bent.arm, problem.joints, gripper)
    systematic = arm_errors(arm, joints)
    solved = solve_hand_eye(gripper, camera, systematic=systematic)
    start = solved.gripper_from_camera, solved.scale, solved.base_from_recon.rigid
    poses = pose_equations(*pose_problem(gripper, camera, start, error_covariance=systematic), None)
    return problem.bent.errors[:6], joint_offsets(poses, arm, joints)


@pytest.mark.slow
def test_offsets_are_right_within_their_sigma():
    off, printed = [], []
    for seed in range(8):
        true, found = examined("typical", seed)
        off.append((found.offset - true) / found.std)
        printed.append(found.std / found.prior_std)
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4
    # The first and the last joint rotate base and gripper, which nothing shows.
    assert (np.median(printed, axis=0)[[0, 5]] > 0.95).all() and (np.median(printed, axis=0)[1:5] < 0.7).all()
