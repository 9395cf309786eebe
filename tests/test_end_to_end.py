"""The whole job from pointmaps with a network's errors, against the truth of a simulated capture."""

import numpy as np
import pytest

from benchmarks.pointmaps import end_to_end
from jcr.errors import InputError
from jcr.records import Intrinsics
from simulation.render import render
from simulation.scenes import make_scene


@pytest.mark.gl
@pytest.mark.slow
def test_predictions_become_a_calibration_and_a_map_in_metres():
    camera = Intrinsics(610.0, 610.0, 319.5, 239.5, 640, 480)
    try:
        next(render(make_scene("measuring", 0), camera, np.eye(4)[None], textured=False, with_truth=False))
    except InputError as error:
        pytest.skip(str(error))
    found = end_to_end(5, 1, (0.0, 0.0))
    assert found.translation_mm < 1.5
    assert found.rotation_deg < 0.1
    assert found.scale_percent < 0.3
    assert found.surface_mm < 5
    assert found.sigmas < 2
