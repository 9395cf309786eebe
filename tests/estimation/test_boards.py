"""Corners of boards in the adjustment: the shape that is known of them, and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest

from jcr.estimation.intrinsics_prior import FIXED, camera_with_prior
from jcr.estimation.problem import image_step, similarities
from jcr.estimation.projection import derivatives, shape_residuals
from jcr.estimation.solve import Solution
from jcr.estimation.wrist import adjust_wrist
from simulation.boards import Sheet, with_sheet
from simulation.faults import Faults, faulty_capture

pytestmark = pytest.mark.slow


def adjusted(seed: int, sheet: Sheet | None, images: int = 8) -> Solution:
    rng = np.random.default_rng(seed)
    found = faulty_capture(rng, images, Faults(robot_noise=(1e-5, 1e-5)))
    found = found if sheet is None else with_sheet(found, rng, sheet)
    cameras = found.base_from_camera
    start = found.gripper_from_camera, 1.0, np.eye(4)
    prior = camera_with_prior(found.intrinsics, FIXED)
    return adjust_wrist(found.base_from_gripper, start, cameras, prior, found.tracks)


def test_the_derivatives_of_corners_are_those_of_their_residuals():
    given = adjusted(0, Sheet(bend_m=2e-3)).images
    scene, problem, boards = given.state, given.problem, given.problem.boards
    assert boards is not None
    freedom, shape = problem.columns, scene.camera_steps[problem.columns.boards]
    rows = boards.derivatives(
        scene.world_from_rig, scene.points_in_world, shape, freedom.boards, freedom.first_rig
    )
    rng, count = np.random.default_rng(0), freedom.count
    for _ in range(3):
        step = np.zeros(count)
        step[freedom.boards] = 1e-3 * rng.normal(size=len(shape))
        step[-6:] = 1e-3 * rng.normal(size=6)
        off = 1e-3 * rng.normal(size=scene.points_in_world.shape)
        tiny = 1e-4
        ends = []
        for sign in (1, -1):
            there = image_step(problem, scene, sign * tiny * step)
            there = replace(there, points_in_world=scene.points_in_world + sign * tiny * off)
            ends.append(shape_residuals(problem, there))
        expected = (ends[0] - ends[1]) / (2 * tiny)
        found = rows.shared @ step[: freedom.first_rig] + rows.own @ step[-6:]
        found += (rows.by_point @ np.repeat(off[boards.point], 2, axis=0)[..., None])[..., 0]
        assert np.allclose(found.reshape(-1, 4)[:, :3], expected, atol=1e-5 * np.abs(expected).max())


def test_the_shape_of_a_board_is_the_same_at_any_size_and_place_of_the_world():
    given = adjusted(1, Sheet()).images
    problem, scene = given.problem, given.state
    weighted = derivatives(problem, scene, given.view, given.weight)
    by_world = similarities(problem, scene)
    first, (_, point, rig, _) = problem.columns.first_rig, problem.rows
    own = by_world[first:].reshape(-1, 6, 7)[rig]
    p = scene.points_in_world
    of_points = np.zeros((len(p), 3, 7))
    of_points[:, :, 0], of_points[:, :, 1:4] = p, np.eye(3)
    of_points[:, :, 4:] = np.cross(np.eye(3), p[:, None]).swapaxes(1, 2)
    moved = weighted.shared @ by_world[:first] + weighted.own @ own + weighted.by_point @ of_points[point]
    assert np.abs(moved).max() < 1e-8 * np.abs(weighted.by_point).max()


@pytest.mark.parametrize("bend_m", [0.0, 3e-3])
def test_a_sheet_is_found_as_large_and_as_bent_as_it_is(bend_m: float):
    """A bend of ten times the usual one is the corners' to show."""
    found = adjusted(2, Sheet(bend_m=bend_m), images=12)
    given = found.images
    boards = given.problem.boards
    assert boards is not None
    shape = given.state.camera_steps[given.problem.columns.boards]
    size = found.state.scale * boards.unit * np.exp(shape[0])
    assert size == pytest.approx(1.0, abs=5e-4)
    height = boards.bend(shape)
    assert np.ptp(height) == pytest.approx(bend_m, abs=3e-4)
