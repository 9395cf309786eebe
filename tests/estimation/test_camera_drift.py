"""Camera poses whose errors add up along the sequence: found, weighed, and not found where errors are independent."""

import numpy as np

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.geometry import rotation_exp, transform
from simulation.problems import HandEyeProblem, error, hand_eye_problem

GROWTH = (3e-3, 3e-3)
"""m, rad per image."""


def drifting(seed: int, count: int = 40) -> tuple[HandEyeProblem, np.ndarray]:
    """Camera poses whose motions from one to the next have errors, as visual odometry has them."""
    rng = np.random.default_rng([seed, 8])
    problem = hand_eye_problem(rng, count, robot_noise=(2e-4, 5e-4))
    true = problem.recon_from_camera
    found = [true[0]]
    for before, after in zip(true[:-1], true[1:], strict=True):
        error_of_motion = transform(
            rotation_exp(GROWTH[1] * rng.normal(size=3)), GROWTH[0] / problem.scale * rng.normal(size=3)
        )
        found.append(found[-1] @ np.linalg.inv(before) @ after @ error_of_motion)
    return problem, np.stack(found)


def test_growing_errors_are_weighed_and_in_the_uncertainty():
    squared, metres = list[float](), dict[bool, list[float]]()
    for seed in range(4):
        problem, camera = drifting(seed)
        for in_sequence in (False, True):
            solved = solve_hand_eye(problem.base_from_gripper, camera, in_sequence=in_sequence)
            off = error(problem, solved.gripper_from_camera, solved.scale)[:6]
            metres.setdefault(in_sequence, []).append(float(np.linalg.norm(off[:3])))
        squared.append(float(off @ np.linalg.solve(solved.covariance[:6, :6], off)))
    assert np.median(metres[True]) < 0.5 * np.median(metres[False])
    assert np.median(squared) < 12.6 and max(squared) < 25


def test_independent_errors_do_not_grow():
    for seed in range(4):
        problem = hand_eye_problem(
            np.random.default_rng(seed), 24, robot_noise=(3e-4, 1e-3), camera_noise=(5e-4, 1e-3)
        )
        poses = problem.base_from_gripper, problem.recon_from_camera
        plain, either = (solve_hand_eye(*poses, in_sequence=flag) for flag in (False, True))
        assert np.array_equal(plain.covariance, either.covariance)
