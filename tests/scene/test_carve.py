"""Which cells rays cross and hit, of rays that one can follow by hand."""

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # torch


def test_rays_cross_what_is_before_a_wall_and_hit_the_wall() -> None:
    from jcr.scene.carve import carve
    from jcr.scene.seen import CROSSED, HIT

    side = np.linspace(-0.05, 0.05, 101)
    wall = np.stack([*np.meshgrid(side, side), np.full((101, 101), 0.002)], -1).reshape(-1, 3)
    center = np.array([[0.0, 0.0, 0.5]])
    box = np.array([[-0.1, -0.1, -0.04], [0.1, 0.1, 0.3]])

    def states(measured: bool) -> np.ndarray:
        rows = np.zeros(len(wall), int)
        seen = carve(wall, rows, center, box, 0.01, np.full(len(wall), measured))
        return seen.state.numpy()[:, 10, 10]  # of the cells beside the axis, from z = -0.04 on

    column = states(True)
    assert column.tolist()[:4] == [0, 0, 0, HIT]  # half a cell behind the wall, and nothing farther behind
    assert column[4] & HIT
    assert (column[5:] & CROSSED).all()
    assert not (states(False) & CROSSED).any() and (states(False) & HIT).any()
