"""The adjuster's derivatives against differences, and what of its evidence is the images' own."""

from dataclasses import replace

import numpy as np
import pytest
from jcr.estimation.scene import OF_IMAGE, PRISM, Freedom, NuisancePrior, Scene, at_start, stepped
from jcr.estimation.together import adjust

from jcr.estimation.intrinsics_prior import MEASURED, prior_of
from jcr.estimation.projection import ImageProblem, derivatives, view_of
from simulation.cells import CellProblem, cell_problem

COUNT = 6


def two_cameras() -> tuple[CellProblem, Scene, Freedom]:
    """Two cameras on one wrist, whose intrinsics, mounts and single images are all free."""
    problem = cell_problem("wrists", "typical", COUNT, seed=1, points=60)
    images = len(problem.observations.rig)
    freedom = Freedom.of(
        problem.cameras, [prior_of(camera, MEASURED) for camera in problem.cameras], images, [False, True]
    )
    std = np.r_[np.repeat([0.05, 0.3, 0.05, 0.05], images), np.full(PRISM, 0.1)]
    free = NuisancePrior(np.eye(OF_IMAGE * images + PRISM), std)
    scene = Scene(
        world_from_rig=problem.world_from_rig,
        rig_from_camera=problem.rig_from_camera,
        cameras=problem.cameras,
        points_in_world=problem.points_in_world,
    )
    return problem, scene, replace(freedom, nuisance=free)


@pytest.mark.slow
def test_derivatives_are_those_of_the_residuals():
    problem, scene, freedom = two_cameras()
    images = ImageProblem.of(scene, problem.observations, freedom)
    freedom = images.freedom
    scene = at_start(replace(scene, points_in_world=scene.points_in_world[images.points]), freedom)
    rng = np.random.default_rng(0)
    # Off the start, where images differ from their cameras and the cameras from their priors.
    begun = np.zeros(freedom.first_rig + 6 * len(scene.world_from_rig))
    begun[: len(freedom.std)] = 0.02 * freedom.std * rng.normal(size=len(freedom.std))
    scene = stepped(scene, freedom, begun)
    view = view_of(scene, images)
    found = derivatives(scene, view, images, np.ones(len(view.residual_px)))
    rig = problem.observations.rig[images.observations.image]
    first = freedom.first_rig
    for column in range(len(begun)):
        step = np.zeros(len(begun))
        step[column] = 1e-6
        ahead, behind = (view_of(stepped(scene, freedom, sign * step), images) for sign in (1, -1))
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
            view_of(replace(scene, points_in_world=scene.points_in_world + sign * away), images)
            for sign in (1, -1)
        )
        numeric = (ahead.residual_px - behind.residual_px) / 2e-6
        assert numeric == pytest.approx(found.by_point[:, :, axis], rel=1e-4, abs=0.05)


def test_what_robots_report_is_no_part_of_the_evidence_of_images():
    problem, scene, freedom = two_cameras()
    freedom = replace(freedom, nuisance=NuisancePrior(freedom.nuisance.directions[:, :0], np.zeros(0)))
    exact, coarse = (
        adjust(scene, problem.observations, freedom, problem.arms, noise)
        for noise in ((1e-4, 2e-4), (5e-3, 1e-2))
    )
    one, other = (np.diag(found.given.evidence.information) for found in (exact, coarse))
    assert one == pytest.approx(other, rel=0.1)
    # A robot that is exact a hundred times over makes the calibration better, and the images no wiser.
    assert (np.diag(exact.covariance)[:6] < 0.3 * np.diag(coarse.covariance)[:6]).all()
