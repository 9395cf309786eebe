"""Fewer rounds to a fixed point."""

import numpy as np
import pytest

from jcr.estimation.acceleration import Acceleration


def rounds_until_it_stays(left: np.ndarray, most: int = 400) -> int:
    """Of x ← L x + c from 0, whose unknowns keep a share each of what they lacked."""
    rotation = np.linalg.qr(np.random.default_rng(0).normal(size=(len(left), len(left))))[0]
    share, there = rotation * left @ rotation.T, rotation.sum(0)
    x, acceleration = np.zeros(len(left)), Acceleration()
    for count in range(most):
        end = there + share @ (x - there)
        if np.abs(end - x).max() < 1e-6:
            assert end == pytest.approx(there, abs=1e-4)
            return count
        x = acceleration.next(x, end, np.ones(len(x)))
    return most


def test_a_round_that_leaves_nine_tenths_needs_few():
    assert rounds_until_it_stays(np.array([0.9, 0.5, 0.2, 0.0])) <= 20  # without, more than 100


def test_unknowns_of_no_weight_follow():
    acceleration, x = Acceleration(), np.zeros(2)
    for _ in range(5):
        x = acceleration.next(x, 0.8 * x + 0.2 * np.array([1.0, 3.0]), np.array([1.0, 0.0]))
    assert x == pytest.approx([1.0, 3.0], abs=1e-3)
