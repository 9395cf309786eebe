"""The relative pose of two images: the derivatives that refine it."""

import numpy as np
import pytest

from jcr.features.two_view import _by_step, _retracted, sampson_px
from jcr.geometry import rotation_exp


def test_the_derivatives_are_those_of_the_distances():
    rng = np.random.default_rng(0)
    rotation, direction = rotation_exp(0.3 * rng.normal(size=3)), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    ray_i, ray_j = 0.5 * rng.normal(size=(2, 40, 2))
    for column, unit in zip(_by_step(rotation, direction, ray_i, ray_j, 600.0).T, np.eye(5), strict=True):
        ahead, behind = (
            sampson_px(*_retracted(rotation, direction, sign * unit), ray_i, ray_j, 600.0)
            for sign in (1e-6, -1e-6)
        )
        assert (ahead - behind) / 2e-6 == pytest.approx(column, rel=1e-4, abs=1e-2)
