"""Cells that rays cross and hit: a wall by hand, and priors, which are surfaces and free nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import analytic_scene
from jcr.records import BOTH, MATCHED, PRIOR

pytestmark = pytest.mark.slow  # torch


def test_rays_cross_what_is_before_a_wall_and_hit_the_wall() -> None:
    from jcr.scene.seen import CROSSED, HIT, carve

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


def test_priors_make_surfaces_and_nothing_free() -> None:
    from jcr.scene.build import build_scene
    from jcr.scene.options import MapOptions
    from jcr.scene.seen import CROSSED, HIT, carve

    whole = analytic_scene.cloud(20_000)
    left = whole.points_in_base[:, 0] < 0
    reason = np.where(left, PRIOR, MATCHED).astype(np.uint8)
    box = np.array([[-0.3, -0.3, -0.05], [0.3, 0.3, 0.45]])

    def seen(rows: np.ndarray, reasons: np.ndarray) -> np.ndarray:
        ends = whole.points_in_base[rows], whole.image[rows], whole.camera_centers_in_base
        return carve(*ends, box, 0.01, reasons[rows] != PRIOR).state.numpy()

    every = np.ones(len(left), bool)
    mixed, measured_alone = seen(every, reason), seen(~left, reason)
    assert not ((mixed & CROSSED) & ~(measured_alone & CROSSED)).any()
    assert ((mixed & HIT) & ~(measured_alone & HIT)).any()

    scene = build_scene(replace(whole, reason=reason), MapOptions(cell=0.02, max_seconds=5.0))
    on_left = whole.points_in_base[left & (np.abs(whole.points_in_base).max(1) < 0.2)]
    assert (scene.query(on_left, unknown="free").occupancy > 0.5).mean() > 0.3
    only = replace(whole, reason=np.full(len(left), PRIOR, np.uint8))
    x = np.random.default_rng(0).uniform([-0.3, -0.3, 0.0], [0.3, 0.3, 0.4], (5000, 3))
    nothing_free = build_scene(only, MapOptions(cell=0.02, max_seconds=0.5))
    assert not (nothing_free.query(x, unknown="occupied").occupancy < 0.5).any()


def test_a_cloud_keeps_reasons_and_sigmas_on_disk(tmp_path: Path) -> None:
    from jcr.scene.cloud import read_cloud, write_cloud

    plain = analytic_scene.cloud(300)
    draw = np.random.default_rng(0)
    reason = draw.choice([MATCHED, PRIOR, BOTH], 300).astype(np.uint8)
    printed = replace(plain, reason=reason, depth_std=draw.uniform(1e-4, 1e-2, 300))
    for cloud in (plain, printed):
        write_cloud(tmp_path / "cloud.ply", cloud)
        back = read_cloud(tmp_path / "cloud.ply")
        for name in ("reason", "depth_std"):
            there, given = getattr(back, name), getattr(cloud, name)
            assert there is given is None or np.allclose(there, given, rtol=1e-6)
