"""That shapes are checked while tests run, and again in every test."""

import jaxtyping
import numpy as np
import pytest

import shape_checks
from jcr.geometry import inverse


def test_a_wrong_shape_is_found_in_the_first_calls_of_every_test(request: pytest.FixtureRequest):
    if not request.config.getoption("--jaxtyping-packages", None):
        pytest.skip("shapes are not checked in this run")
    wrong = np.eye(4)[:3]
    with pytest.raises(jaxtyping.TypeCheckError):
        inverse(wrong)
    for _ in range(shape_checks.CALLS):
        inverse(np.eye(4))
    inverse(wrong)
    shape_checks.begin()
    for _ in range(shape_checks.CALLS - 1):
        inverse(np.eye(4))
    with pytest.raises(jaxtyping.TypeCheckError):
        inverse(wrong)
