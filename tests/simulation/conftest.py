import numpy as np
import pytest

from jcr.errors import InputError
from jcr.records import Intrinsics
from simulation.render import render
from simulation.scenes import make_scene


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips, with the remedy, where nothing can be drawn: `make test` needs no system library."""
    camera = Intrinsics(64.0, 64.0, 31.5, 23.5, 64, 48)
    try:
        next(render(make_scene("measuring", 0), camera, np.eye(4)[None], textured=False, with_truth=False))
    except InputError as error:
        pytest.skip(str(error))
