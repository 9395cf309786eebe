"""Sizes of random and systematic errors of gripper poses, and what is honest about an answer averaged over them."""

import numpy as np
import pytest

from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.distributions import chi2
from jcr.estimation.arms import arm_named
from jcr.estimation.camera_noise import TYPICAL_RAD, camera_error_part
from jcr.estimation.hypotheses import joint_offsets
from jcr.estimation.outlier_rejection import robust_fit
from jcr.estimation.pose_equations import pose_equations, reported_poses
from jcr.estimation.problem import PoseModel, pose_problem
from jcr.estimation.robot_noise import smooth_errors
from jcr.estimation.solve import solve
from jcr.geometry import rotation_exp, step_between, transform
from refusal import refused
from simulation.arms import PresetName
from simulation.problems import bent_problem, error, hand_eye_problem


def poses(rng: np.random.Generator, count: int) -> np.ndarray:
    return transform(rotation_exp(0.6 * rng.normal(size=(count, 3))), 0.2 * rng.normal(size=(count, 3)))


def test_smooth_errors_are_a_covariance_that_the_choice_of_the_base_does_not_change():
    base_from_gripper = poses(np.random.default_rng(0), 9)
    alike = smooth_errors(base_from_gripper)
    np.testing.assert_allclose(alike, alike.T, atol=1e-12)
    assert np.linalg.eigvalsh(alike).min() > -1e-9
    other = transform(rotation_exp(np.array([0.4, -1.0, 2.0])), np.array([1.0, 2.0, 3.0]))
    rotated = np.kron(np.eye(2 * 9), other[:3, :3])
    np.testing.assert_allclose(
        smooth_errors(other @ base_from_gripper), rotated @ alike @ rotated.T, atol=1e-9
    )


def test_a_step_of_the_scale_lengthens_all_ways_after_it():
    cameras, step = poses(np.random.default_rng(1), 7), 1e-6
    ways = np.diff(cameras[:, :3, 3], axis=0)
    moved = np.zeros((7, 6, 6))
    for k in range(6):
        longer = np.where(np.arange(6) >= k, 1 + step, 1.0)[:, None] * ways
        moved[1:, :3, k] = np.cumsum(longer - ways, axis=0) / step
    half = TYPICAL_RAD * moved.reshape(42, 6)
    found = camera_error_part("walk of scale", cameras, 1.0, np.arange(7))
    np.testing.assert_allclose(found, half @ half.T, atol=1e-12)


@pytest.mark.slow
def test_answers_of_a_bent_arm_are_within_their_sigma():
    """More images of an arm with joint offsets made answers of white noise alone worse: 12 of 24 beyond 3 sigma."""
    arm, worst = arm_named("ur5e"), []
    for seed in range(8):
        problem = bent_problem(arm, "typical", 30, seed)
        fit = robust_fit(problem.base_from_gripper, problem.recon_from_camera, PoseModel())
        assert fit.problem.used is not None and fit.problem.used.sum() >= 28
        errors = error(problem, fit.state.x[0], fit.state.scale)[:6]
        worst.append(np.abs(errors / np.sqrt(np.diag(fit.covariance)[:6])).max())
    assert max(worst) < 3.5 and (np.array(worst) > 3).sum() <= 1


@pytest.mark.slow
def test_the_95_percent_region_of_eight_images_of_a_bent_arm_contains_its_error():
    """Eight of 14 views of a panda with known joints: 6 of 12 regions did, the worst squared distance was 82."""
    squared = []
    for seed in range(12):
        problem = bent_problem(arm_named("panda"), "poor", 14, seed)
        rows = np.random.default_rng(seed).permutation(14)[:8]
        found = solve_hand_eye(
            problem.base_from_gripper[rows], problem.recon_from_camera[rows], joints=problem.joints[rows],
            robot=problem.bent.arm,
        )  # fmt: skip
        off = error(problem, found.gripper_from_camera, found.scale)[:6]
        squared.append(off @ np.linalg.solve(found.covariance[:6, :6], off))
    assert (np.array(squared) < chi2.ppf(0.95, 6)).sum() >= 11


def test_a_named_arm_whose_joints_are_known_is_used_and_budgeted():
    problem = bent_problem(arm_named("panda"), "typical", 12, 1)
    poses = problem.base_from_gripper, problem.recon_from_camera
    known = solve_hand_eye(*poses, joints=problem.joints, robot="panda")
    named = solve_hand_eye(*poses, robot="panda")
    nothing = solve_hand_eye(*poses)
    for solved in (known, named, nothing):
        parts = solved.uncertainty.budget
        assert parts is not None and solved.converged
        whole = np.diag(parts.robot_random + parts.robot_systematic + parts.images)
        assert np.allclose(whole, np.diag(solved.covariance), rtol=1e-9)
        # Of a bent arm that repeats to 0.05 mm most of what is open is how it is bent; a smooth field does not bend so
        # sharply, and counts a part of it as random.
        if solved is not nothing:
            assert (np.diag(parts.robot_systematic)[:6] > 4 * np.diag(parts.robot_random)[:6]).all()
        assert 0.02 < np.degrees(solved.robot_noise.systematic) < 0.5
    answers = [solved.gripper_from_camera for solved in (known, named, nothing)]
    assert all(np.abs(one - other).max() > 1e-6 for one in answers for other in answers if one is not other)
    # Another order is the same problem.
    order = np.random.default_rng(0).permutation(12)
    again = solve_hand_eye(*(stack[order] for stack in poses), joints=problem.joints[order], robot="panda")
    assert np.allclose(again.gripper_from_camera, known.gripper_from_camera, atol=1e-7)


@pytest.mark.parametrize(("joints", "robot", "words"), [
    (np.zeros((8, 6)), None, "which robot"),
    (None, "ur99", "not known; choose one of"),
    (np.zeros((8, 7)), "ur5e", r"8 poses of a ur5e need \(8, 6\)"),
    (np.full((8, 6), np.nan), "ur5e", "NaN"),
    (np.zeros((8, 6)), "ur5e", "disagree"),
    (None, "so101", "poses do not fit a so101"),
])  # fmt: skip
def test_poses_and_angles_that_are_not_of_the_robot_are_an_input_error(joints, robot, words):
    problem = hand_eye_problem(np.random.default_rng(2), 8)
    with refused(words):
        solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera, joints=joints, robot=robot)


def examined(preset: PresetName, seed: int):
    problem = bent_problem(arm_named("ur5e"), preset, 12, seed)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    robot = errors_of(gripper, problem.bent.arm, problem.joints)
    solved = solve_hand_eye(gripper, camera, systematic=robot.systematic)
    start = solved.gripper_from_camera, solved.scale, solved.base_from_recon.rigid
    poses = pose_equations(
        *pose_problem(gripper, camera, start, PoseModel(error_covariance=robot.systematic)), None
    )
    return problem.bent.errors[:6], joint_offsets(poses, robot.arm, robot.joints)


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


@pytest.mark.parametrize("camera_std", [0.0, 1e-3])
def test_problem_and_state_of_a_robust_fit_are_in_the_given_frame(camera_std: float):
    """Residuals of the returned state in the returned problem were metres; the covariance was another frame's."""
    problem = hand_eye_problem(np.random.default_rng(1), 10, robot_noise=(3e-4, 1e-3))
    away = transform(np.eye(3), np.array([5.0, -3.0, 2.0]))
    given = away @ problem.recon_from_camera
    covariance = camera_std**2 * np.eye(60) if camera_std else None
    fit = robust_fit(problem.base_from_gripper, given, PoseModel(camera_covariance=covariance))
    assert np.linalg.norm(reported_poses(fit.problem, fit.state)[0], axis=1).max() < 5e-3
    assert np.abs(fit.equations.residual).max() < 5e-3
    again = solve(fit.problem, fit.state)
    assert np.allclose(step_between(again.state.z[0], fit.state.z[0]), 0, atol=1e-6)
    std = np.sqrt(np.diag(again.covariance))
    assert np.allclose(fit.covariance / np.outer(std, std), again.covariance / np.outer(std, std), atol=1e-3)
    errors, own = again.leave_one_out[0], fit.leave_one_out[0]
    assert np.allclose(errors, own, atol=1e-6)


def test_motions_that_determine_nothing_leave_a_covariance_and_a_reason():
    """Poses that only translate, up to noise: the part that X and Z absorb was lost in rounding (-1 % eigenvalues)."""
    rng = np.random.default_rng(7)
    for count in (3, 4, 5):
        offset = transform(rotation_exp(np.array([0.3, -1.0, 0.5])), np.array([0.03, 0.02, 0.1]))
        gripper = transform(np.eye(3), 0.2 * rng.normal(size=(count, 3)))
        camera = gripper @ offset @ transform(rotation_exp(1e-6 * rng.normal(size=(count, 3))), np.zeros(3))
        problem, state = pose_problem(gripper, camera, (offset, 1.0, np.eye(4)))
        values = np.linalg.eigvalsh(pose_equations(problem, state, None).equations.systematic)
        assert values.min() > -1e-9 * values.max()
        turned = gripper @ transform(rotation_exp(rng.uniform(-1, 1, (count, 1)) * [0, 0, 1]), np.zeros(3))
        for poses_of, scale in ((gripper, None), (gripper, 1.0), (turned, 1.0), (gripper[[0] * count], None)):
            found = solve_hand_eye(poses_of, poses_of @ offset, scale=scale)
            assert found.verdict == "rejected" and "unobservable" in str(found.doubt)
