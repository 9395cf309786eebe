import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jcr.errors import InputError
from jcr.geometry import (
    ARM,
    Similarity,
    adjoint,
    apply,
    fit_similarity,
    inverse,
    motion_length,
    nearest_rotation,
    require_rigid,
    retract,
    rotation_between_deg,
    rotation_exp,
    rotation_log,
    step_axes,
    step_between,
    transform,
    twist_from_step,
)

repeatable = settings(derandomize=True, deadline=None, max_examples=60)
unit = st.floats(-1, 1, allow_nan=False)
angle = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-7, np.pi - 1e-7, np.pi - 1e-12, np.pi]), st.floats(0, np.pi)
)
axis = st.tuples(unit, unit, unit).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
rotation_vector = st.builds(lambda v, theta: theta * v / np.linalg.norm(v), axis, angle)
rigid = st.builds(
    lambda w, t: transform(rotation_exp(w), 3.0 * np.array(t)), rotation_vector, st.tuples(unit, unit, unit)
)


@repeatable
@given(rotation_vector)
def test_log_inverts_exp_from_zero_to_pi(vector):
    rotation = rotation_exp(vector)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.allclose(rotation_exp(rotation_log(rotation)), rotation, atol=1e-9)
    assert np.isclose(np.linalg.norm(rotation_log(rotation)), np.linalg.norm(vector), atol=1e-7)


@repeatable
@given(rigid, rigid, rigid)
def test_rigid_transforms_are_a_group_and_a_step_leads_from_any_to_any_other(a, b, c):
    assert np.allclose((a @ b) @ c, a @ (b @ c), atol=1e-12)
    assert np.allclose(a @ inverse(a), np.eye(4), atol=1e-12)
    assert np.allclose(inverse(a @ b), inverse(b) @ inverse(a), atol=1e-12)
    assert np.allclose(adjoint((a @ b)[None]), adjoint(a[None]) @ adjoint(b[None]), atol=1e-11)
    assert np.isclose(motion_length(a), motion_length(inverse(a)), rtol=0, atol=1e-6)
    step = step_between(a, b)
    assert np.linalg.norm(step[3:]) < np.pi + 1e-12
    assert np.allclose(retract(a, step), b, atol=1e-9)
    length = np.linalg.norm(step[:3]) + ARM * np.linalg.norm(step[3:])
    assert np.isclose(motion_length(inverse(a) @ b), length)


@repeatable
@given(rigid, arrays(np.float64, 6, elements=st.floats(-1e-4, 1e-4, allow_subnormal=False)), axis)
def test_a_step_moves_points_as_its_twist_and_its_motion_in_other_axes_do(a_from_b, step, x_in_b):
    here, there = (apply(pose, x_in_b) for pose in (a_from_b, retract(a_from_b, step)))
    twist = twist_from_step(a_from_b) @ step
    assert np.allclose(there - here, twist[:3] + np.cross(twist[3:], here), atol=1e-7)
    rotation = a_from_b[:3, :3]
    on_the_right = step_axes(rotation.T) @ step
    assert np.allclose(adjoint(a_from_b[None])[0] @ on_the_right, twist, atol=1e-12)


def test_similarity_is_recovered_exactly_and_ignores_points_without_weight():
    rng = np.random.default_rng(1)
    a_from_b, scale = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3)), 2.7
    x_in_b = rng.normal(size=(20, 3))
    x_in_a = Similarity(a_from_b, scale)(x_in_b)
    x_in_a[0] += 5.0
    weights = np.r_[0.0, np.ones(19)]
    found, found_scale = fit_similarity(x_in_a, x_in_b, weights)
    assert np.allclose(found, a_from_b, atol=1e-9)
    assert found_scale == pytest.approx(scale, abs=1e-9)
    found, scale = fit_similarity(np.ones((4, 3)), np.ones((4, 3)), np.zeros(4))
    assert scale == 1.0 and np.isfinite(found).all(), "points without weight have no extent"


def test_angles_near_zero_and_reflections_have_a_rotation():
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -0.9]))) == pytest.approx(1.0)
    rotation = rotation_exp(np.array([0.0, 1e-7, 0.0]))
    assert rotation_between_deg(np.eye(3), rotation) == pytest.approx(np.degrees(1e-7), rel=1e-6)


@pytest.mark.parametrize(("matrix", "words"), [
    (np.diag([2.0, 2.0, 2.0, 1.0]), "scaled by 2"),
    (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
    (transform(np.eye(3), np.array([1.0, 2.0, 3.0])).T, "transposed"),
    (np.full((4, 4), np.nan), "NaN"),
    (np.eye(4) + 0.1 * np.eye(4)[::-1], "not 0 0 0 1"),
    (np.eye(4) + 0.2 * np.eye(4)[[1, 2, 0, 3]] * (np.arange(4)[:, None] == 0), "not a rotation matrix"),
])  # fmt: skip
def test_what_is_not_rigid_is_named(matrix, words):
    with pytest.raises(InputError, match=words) as error:
        require_rigid(matrix, "frame 3")
    assert str(error.value).startswith("frame 3: ")
