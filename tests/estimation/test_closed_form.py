"""The closed form in all its gauges: what may change about a problem changes the answer as it must, and no more."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jcr.estimation.closed_form import closed_form
from jcr.geometry import inverse, retract, rotation_exp, scale_translation, step_between, transform
from simulation.problems import hand_eye_problem

repeatable = settings(derandomize=True, deadline=None, max_examples=30)
seeds = st.integers(0, 2**32 - 1)
counts = st.integers(3, 9)
angles = st.sampled_from([0.0, 1e-9, 0.7, np.pi - 1e-9, np.pi]) | st.floats(0, np.pi)


def noisy(seed: int, count: int):
    """Gripper and camera poses that belong together up to the robot pose noise, and the generator for what follows."""
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, count, robot_noise=(1e-4, 2e-4))
    return problem.base_from_gripper, problem.recon_from_camera, rng


def any_rigid(rng: np.random.Generator, angle: float):
    """A transform that rotates by `angle` about some axis."""
    axis = rng.normal(size=3)
    return transform(rotation_exp(angle * axis / np.linalg.norm(axis)), rng.normal(size=3))


def assert_same(found, expected, tolerance: float = 1e-7):
    (x, scale, z), (x_expected, scale_expected, z_expected) = found, expected
    assert np.abs(step_between(x, x_expected)).max() < tolerance
    assert scale == pytest.approx(scale_expected, rel=tolerance)
    assert np.abs(step_between(z, z_expected)).max() < 10 * tolerance


@repeatable
@given(seeds, counts, angles)
def test_another_base_moves_base_from_recon_alone(seed, count, angle):
    gripper, camera, rng = noisy(seed, count)
    x, scale, z = closed_form(gripper, camera)
    other = any_rigid(rng, angle)
    assert_same(closed_form(other @ gripper, camera), (x, scale, other @ z))


@repeatable
@given(seeds, counts, angles)
def test_another_frame_on_the_gripper_moves_x_alone(seed, count, angle):
    # Without noise: the least squares weigh errors where the gripper's origin is.
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, count)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    x, scale, z = closed_form(gripper, camera)
    tool = any_rigid(rng, angle)
    assert_same(closed_form(gripper @ tool, camera), (inverse(tool) @ x, scale, z))


@repeatable
@given(seeds, st.integers(4, 9), st.sampled_from([0.0, 1e-12, 1e-7, 1e-3]))
def test_half_rotates_between_images_are_like_any_other_motion(seed, count, short_of):
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, count)
    gripper, x = problem.base_from_gripper.copy(), problem.gripper_from_camera
    for k in range(1, count, 2):
        gripper[k] = gripper[k - 1] @ any_rigid(rng, np.pi - short_of)
    z = any_rigid(rng, 1.0)
    camera = scale_translation(inverse(z) @ gripper @ x, 1 / problem.scale)
    assert_same(closed_form(gripper, camera), (x, problem.scale, z), 1e-6)


@repeatable
@given(seeds)
def test_half_rotates_alone_are_solved(seed):
    """About axes at right angles, which makes all motions rotations by 180°: the sines of all vanish together."""
    rotations = np.pi * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    rng = np.random.default_rng(seed)
    gripper = any_rigid(rng, 1.0) @ transform(rotation_exp(rotations), rng.normal(size=(3, 3)))
    x, z = any_rigid(rng, rng.uniform(0, np.pi)), any_rigid(rng, 1.0)
    camera = inverse(z) @ gripper @ x
    gripper = retract(gripper, 1e-6 * rng.normal(size=(3, 6)))
    found, _, base = closed_form(gripper, camera)
    # A rotation by 180° has an axis without a sign: an answer must explain the rotations, and may be another.
    assert np.abs((gripper @ found - base @ camera)[:, :3, :3]).max() < 5e-6
