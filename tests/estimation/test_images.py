"""The adjuster's derivatives against differences, and what of its evidence is the images' own."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cameras import answered
from jcr.estimation import elimination
from jcr.estimation.elimination import Derivatives, Sightings, with_fixed_points, without_points
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.estimation.problem import (
    OF_IMAGE,
    PRISM,
    Problem,
    State,
    stepped,
    with_observations,
)
from jcr.estimation.projection import derivatives, view_of
from jcr.estimation.solve import solve
from simulation.cells import CellProblem, Kind, cell_problem

COUNT = 6


def two_cameras(nuisances: bool) -> tuple[CellProblem, Problem, State]:
    """Two cameras on one wrist, whose intrinsics and mounts are free, and single images where `nuisances`."""
    cell = cell_problem("wrists", "typical", COUNT, seed=1, points=60)
    images = len(cell.observations.rig)
    own, second = (camera_with_prior(camera, MEASURED) for camera in cell.cameras)
    problem = Problem(
        arms=tuple(cell.arms),
        n_rigs=len(cell.world_from_rig),
        cameras=(own, replace(second, mount_free=True)),
    )
    if nuisances:
        problem = replace(
            problem,
            freed=np.eye(18 + OF_IMAGE * images + PRISM)[:, 18:],
            freed_std=np.r_[np.repeat([0.05, 0.3, 0.05, 0.05], images), np.full(PRISM, 0.1)],
        )
    state = State(
        x=np.stack([x for x, _ in cell.starts]),
        scale=1.0,
        z=np.stack([z for _, z in cell.starts]),
        world_from_rig=cell.world_from_rig,
        rig_from_camera=cell.rig_from_camera,
        points_in_world=cell.points_in_world,
    )
    return cell, *with_observations(problem, state, cell.observations)


@pytest.mark.slow
def test_derivatives_are_those_of_the_residuals():
    _, problem, state = two_cameras(nuisances=True)
    assert problem.observations is not None
    rng = np.random.default_rng(0)
    # Off the start, where images differ from their cameras and the cameras from their priors.
    begun = np.zeros(problem.columns.count)
    std = problem.prior_std(state)
    begun[: len(std)] = 0.02 * std * rng.normal(size=len(std))
    state = stepped(problem, state, None, begun)
    view = view_of(problem, state)
    found = derivatives(problem, state, view, np.ones(len(view.residual_px)))
    rig = problem.observations.rig[problem.observations.image]
    first = problem.columns.first_rig
    for column in range(len(begun)):
        step = np.zeros(len(begun))
        step[column] = 1e-6
        ahead, behind = (view_of(problem, stepped(problem, state, None, sign * step)) for sign in (1, -1))
        numeric = (ahead.residual_px - behind.residual_px) / 2e-6
        if column < first:
            analytic = found.shared[:, :, column]
        else:
            moved = (column - first) // 6
            analytic = np.where((rig == moved)[:, None], found.own[:, :, (column - first) % 6], 0.0)
        assert numeric == pytest.approx(analytic, rel=1e-4, abs=0.01), column
    for axis in range(3):
        away = np.zeros(3)
        away[axis] = 1e-6
        ahead, behind = (
            view_of(problem, replace(state, points_in_world=state.points_in_world + sign * away))
            for sign in (1, -1)
        )
        numeric = (ahead.residual_px - behind.residual_px) / 2e-6
        assert numeric == pytest.approx(found.by_point[:, :, axis], rel=1e-4, abs=0.05)


def test_what_robots_report_is_no_part_of_the_evidence_of_images():
    _, problem, state = two_cameras(nuisances=False)
    exact, coarse = (
        solve(replace(problem, robot_noise_floor=noise), state) for noise in ((1e-4, 2e-4), (5e-3, 1e-2))
    )
    one, other = (np.diag(found.images.information) for found in (exact, coarse))
    assert one == pytest.approx(other, rel=0.1)
    # A robot that is exact a hundred times over makes the calibration better, and the images no wiser.
    assert (np.diag(exact.covariance)[:6] < 0.3 * np.diag(coarse.covariance)[:6]).all()


@pytest.mark.parametrize(("kind", "seed"), [("fixed", 0), ("wrists", 0), ("arms", 2)])
def test_rounds_settle_from_a_scale_that_is_several_times_too_small(kind: Kind, seed: int):
    """Steps that were cut short gave the combination of rounds a direction in which the scale shrank."""
    found = answered(cell_problem(kind, "typical", 8, seed), seed)
    assert found.settled and found.iterations < 12


SHARED, OWN, IMAGES, POINTS = 4, 3, 5, 12


@pytest.mark.parametrize("together", [5, 1024])
def test_the_step_is_that_of_the_whole_system(monkeypatch, together: int):
    monkeypatch.setattr(elimination, "POINTS_AT_ONCE", together)
    rng = np.random.default_rng(1)
    # Each point in some of the images; in one of them twice, as by two cameras on one wrist.
    drawn = [np.sort(np.r_[i := rng.permutation(IMAGES)[:3], i[0]]) for _ in range(POINTS)]
    image, point = np.concatenate(drawn), np.repeat(np.arange(POINTS), 4)
    shared, own, by_point = (rng.normal(size=(len(image), 2, n)) for n in (SHARED, OWN, 3))
    residual = rng.normal(size=(len(image), 2))
    rows = Derivatives(shared=shared, own=own, by_point=by_point, residual=residual)
    seen = Sightings.of(point, image, IMAGES)
    size = SHARED + OWN * IMAGES
    whole = np.zeros((len(image), 2, size + 3 * POINTS))
    for k in range(len(image)):
        whole[k, :, :SHARED] = rows.shared[k]
        whole[k, :, SHARED + OWN * image[k] :][:, :OWN] = rows.own[k]
        whole[k, :, size + 3 * point[k] :][:, :3] = rows.by_point[k]
    expected = -np.linalg.lstsq(whole.reshape(-1, whole.shape[2]), rows.residual.ravel(), rcond=None)[0]
    normal = without_points(*with_fixed_points(rows, seen), rows, seen)
    step = np.linalg.solve(normal.hessian, normal.right)
    assert step == pytest.approx(expected[:size], rel=1e-5, abs=1e-6)
    moved = normal.stepped(np.zeros((POINTS, 3)), step)
    assert moved.ravel() == pytest.approx(expected[size:], rel=1e-5, abs=1e-6)
