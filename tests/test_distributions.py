"""Tails and quantiles beside those of scipy.stats."""

import numpy as np
import pytest
from scipy import stats

from jcr.distributions import chi2
from jcr.distributions import f as f_distribution


@pytest.mark.parametrize("name", ["cdf", "sf", "ppf", "isf"])
def test_chi_squared_is_that_of_scipy(name: str) -> None:
    x = np.array([0.0, 0.05, 0.5, 0.95]) if name in ("ppf", "isf") else np.array([0.0, 0.3, 6.0, 300.0])
    for freedom in (1.0, 6.0, 40.0):
        np.testing.assert_allclose(
            getattr(chi2, name)(x, freedom), getattr(stats.chi2, name)(x, freedom), rtol=1e-10
        )


def test_the_tail_of_f_is_that_of_scipy_down_to_nothing() -> None:
    x = np.array([0.0, 1.0, 30.0, 1e3])
    np.testing.assert_allclose(f_distribution.logsf(x, 3, 200), stats.f.logsf(x, 3, 200), rtol=1e-8)
    # Beyond the smallest number the logarithm stays finite and keeps its order.
    values = f_distribution.logsf(np.array([1e5, 1e7, 1e9]), 3, 200)
    assert np.isfinite(values).all() and (np.diff(values) < 0).all()
