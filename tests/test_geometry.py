import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jcr.errors import InputError
from jcr.geometry import (
    apply,
    apply_similarity,
    fit_similarity,
    inverse,
    nearest_rotation,
    require_rigid,
    rotation_between_deg,
    rotation_exp,
    rotation_log,
    transform,
)

unit = st.floats(-1, 1, allow_nan=False)
angle = st.one_of(
    st.sampled_from([0.0, 1e-12, 1e-7, np.pi - 1e-7, np.pi - 1e-12, np.pi]), st.floats(0, np.pi)
)


@given(st.tuples(unit, unit, unit).filter(lambda v: np.linalg.norm(v) > 0.1), angle)
def test_log_inverts_exp_from_zero_to_pi(axis, theta):
    vector = theta * np.array(axis) / np.linalg.norm(axis)
    rotation = rotation_exp(vector)
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.allclose(rotation_exp(rotation_log(rotation)), rotation, atol=1e-9)
    assert np.isclose(np.linalg.norm(rotation_log(rotation)), theta, atol=1e-7)


def test_inverse_undoes_a_batch():
    rng = np.random.default_rng(0)
    a_from_b = transform(rotation_exp(rng.normal(size=(4, 5, 3))), rng.normal(size=(4, 5, 3)))
    assert np.allclose(a_from_b @ inverse(a_from_b), np.eye(4), atol=1e-12)


def test_similarity_is_recovered_exactly_and_ignores_zero_weights():
    rng = np.random.default_rng(1)
    a_from_b, scale = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3)), 2.7
    x_in_b = rng.normal(size=(20, 3))
    x_in_a = apply_similarity(a_from_b, scale, x_in_b)
    x_in_a[0] += 5.0
    weights = np.r_[0.0, np.ones(19)]
    found, found_scale = fit_similarity(x_in_a, x_in_b, weights)
    assert np.allclose(found, a_from_b, atol=1e-9)
    assert found_scale == pytest.approx(scale, abs=1e-9)
    assert np.allclose(apply(found, found_scale * x_in_b[1:]), x_in_a[1:], atol=1e-9)


def test_nearest_rotation_of_a_reflection_is_proper():
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -0.9]))) == pytest.approx(1.0)


def test_angle_between_rotations_is_accurate_near_zero():
    turn = rotation_exp(np.array([0.0, 1e-7, 0.0]))
    assert rotation_between_deg(np.eye(3), turn) == pytest.approx(np.degrees(1e-7), rel=1e-6)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), "scaled by 2"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
        (transform(np.eye(3), np.array([1.0, 2.0, 3.0])).T, "transposed"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.eye(4) + 0.1 * np.eye(4)[::-1], "not 0 0 0 1"),
        (
            transform(np.array([[1.0, 0.2, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3)),
            "no rotation",
        ),
    ],
)
def test_what_is_not_rigid_is_named(matrix, words):
    with pytest.raises(InputError, match=words) as error:
        require_rigid(matrix, "frame 3")
    assert str(error.value).startswith("frame 3: ")
