"""Two calibrations compared: what both report explains their difference, by cause."""

import numpy as np
import pytest

from jcr.calibration.difference import StatedTransform, difference
from jcr.geometry import retract, rotation_exp, transform

X = transform(rotation_exp(np.array([0.3, -1.0, 0.4])), np.array([0.05, 0.02, 0.08]))


def known(x: np.ndarray, parts: dict[str, np.ndarray]) -> StatedTransform:
    return StatedTransform(x, sum(parts.values(), np.zeros((6, 6))), parts)


def test_p_values_of_drawn_differences_are_uniform_and_shares_sum_to_one():
    rng, values = np.random.default_rng(0), []
    root = 1e-3 * rng.normal(size=(6, 6))
    robot, images = root @ root.T, np.diag(np.full(6, 1e-6))
    for _ in range(400):
        step = rng.multivariate_normal(np.zeros(6), 2 * robot + 2 * images)
        parts = {"robot_random": robot, "images": images}
        found = difference(known(X, parts), known(retract(X, step), parts))
        values.append(found.p_value)
        assert sum(found.explained_by.values()) == pytest.approx(1.0)
    assert abs(np.mean(np.array(values) < 0.5) - 0.5) < 0.09
    assert np.mean(np.array(values) < 0.05) < 0.09


def test_without_any_covariance_there_is_a_difference_and_no_verdict():
    found = difference(StatedTransform(X), StatedTransform(retract(X, np.full(6, 1e-3))))
    assert found.p_value is None and found.sigmas is None
    assert np.linalg.norm(found.translation_m) == pytest.approx(1e-3 * np.sqrt(3))
