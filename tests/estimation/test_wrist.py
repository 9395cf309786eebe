"""The adjustment of a wrist camera on simulated observations with a known answer."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.camera import parameters, with_parameters
from jcr.estimation.image_equations import adjust_images, median_reprojection_px
from jcr.estimation.intrinsics_prior import (
    ESTIMATED,
    FIXED,
    MEASURED,
    TYPICAL,
    CameraPrior,
    camera_with_prior,
)
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.problem import NO_ARM, wrist_problem
from jcr.estimation.solve import Solution, adjust_wrist, recon_frame
from jcr.records import Intrinsics, Tracks
from simulation.problems import INTRINSICS, HandEyeProblem, error, hand_eye_problem, observed


def solved(
    problem: HandEyeProblem, tracks: Tracks, intrinsics: Intrinsics | CameraPrior = INTRINSICS, **options
) -> Solution:
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    return adjust_wrist(
        problem.base_from_gripper,
        (start.gripper_from_camera, start.scale, start.base_from_recon.rigid),
        problem.recon_from_camera,
        intrinsics,
        tracks,
        **options,
    )


def test_camera_noise_is_beaten_by_the_images():
    rng = np.random.default_rng(1)
    problem = hand_eye_problem(rng, 10, camera_noise=(2e-3, np.radians(0.3)))
    tracks = observed(problem, rng, 400, 0.3)
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    adjusted = solved(problem, tracks)
    before = error(problem, start.gripper_from_camera, start.scale)
    after = error(problem, adjusted.state.x[0], problem.scale)
    assert np.linalg.norm(after[:3]) < 0.3e-3
    assert np.degrees(np.linalg.norm(after[3:6])) < 0.03
    assert np.linalg.norm(after[:3]) < 0.3 * np.linalg.norm(before[:3])
    evidence = adjusted.images
    assert np.nanmax(median_reprojection_px(evidence.problem, evidence.view)) < 0.6


@pytest.mark.parametrize("views", [2, 3, 8])
def test_noise_of_the_images_is_found_from_short_tracks_too(views: int):
    # A point seen twice takes up three of its four errors.
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 8, robot_noise=(1e-4, np.radians(0.01)))
    tracks = observed(problem, rng, 400, 0.3)
    order = rng.permutation(len(tracks.image))
    few = np.zeros(len(order), dtype=bool)
    for point in np.unique(tracks.point):
        few[order[tracks.point[order] == point][:views]] = True
    tracks = tracks.only(few)
    assert solved(problem, tracks).images.state.pixel_noise.sigma_px[0] == pytest.approx(0.3, rel=0.1)


@pytest.mark.long
def test_robot_noise_is_found_and_the_ellipsoid_covers():
    noise = (5e-4, np.radians(0.1))
    runs, inside, estimates = 30, 0, []
    for seed in range(runs):
        rng = np.random.default_rng([4, seed])
        problem = hand_eye_problem(rng, 10, robot_noise=noise)
        tracks = observed(problem, rng, 80, 0.3)
        adjusted = solved(problem, tracks)
        errors = error(problem, adjusted.state.x[0], recon_frame(adjusted, tracks)[0])
        inside += errors @ np.linalg.solve(adjusted.covariance[:7, :7], errors) < chi2.ppf(0.95, 7)
        # A part of a few random errors looks smooth.
        estimates.append(adjusted.noise.together)
    assert inside / runs >= 0.88
    assert np.mean(estimates, axis=0) == pytest.approx(noise, rel=0.2)


def test_intrinsics_go_as_far_from_what_was_given_as_their_standard_deviation_lets_them():
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 8, robot_noise=(2e-4, np.radians(0.03)))
    tracks = observed(problem, rng, 300, 0.3)
    off = with_parameters(INTRINSICS, parameters(INTRINSICS) + np.r_[3.0, 3.0, 4.0, 4.0, np.zeros(5)])
    exact, usual = (solved(problem, tracks, camera_with_prior(off, std)) for std in (np.zeros(9), MEASURED))
    assert exact.problem.intrinsics(exact.state)[0] == off
    std = np.sqrt(np.diag(usual.intrinsics_covariance(0)))
    assert (
        abs(usual.problem.intrinsics(usual.state)[0].fx - INTRINSICS.fx)
        < 3 * std[0]
        < abs(off.fx - INTRINSICS.fx) * 3
    )
    errors = [error(problem, found.state.x[0], problem.scale)[:6] for found in (exact, usual)]
    sigmas = [
        np.abs(gap / np.sqrt(np.diag(found.covariance)[:6])).max()
        for gap, found in zip(errors, (exact, usual), strict=True)
    ]
    assert sigmas[1] < 3 < sigmas[0]
    assert usual.budget.intrinsics[2, 2] > 0 and not exact.budget.intrinsics.any()


@cache
def warped(warp_px: float) -> Solution:
    """Of images whose pixels a wave over the image displaces, which no coefficient describes."""
    rng = np.random.default_rng(3)
    problem = hand_eye_problem(rng, 12, robot_noise=(1e-4, np.radians(0.01)))
    tracks = observed(problem, rng, 400, 0.1)
    u, v = (2 * np.pi * tracks.x_px / [INTRINSICS.width, INTRINSICS.height]).T
    tracks = replace(tracks, x_px=tracks.x_px + warp_px * np.stack([np.sin(v), np.sin(u)], axis=1))
    return solved(
        problem, tracks, camera_with_prior(Intrinsics(619.0, 619.0, 319.5, 239.5, 640, 480), ESTIMATED)
    )


@pytest.mark.slow
def test_the_error_that_the_model_leaves_has_its_size_and_makes_the_intrinsics_uncertain():
    exact, some, much = (warped(warp_px) for warp_px in (0.0, 0.3, 1.0))
    size = [one.state.model_error_std[0] for one in (exact, some, much)]
    assert size[0] < 0.5 * TYPICAL
    assert size[2] / size[1] == pytest.approx(1.0 / 0.3, rel=0.3)
    std = [np.sqrt(np.diag(one.intrinsics_covariance(0)))[2] for one in (exact, some, much)]
    assert std[0] < std[1] < std[2]


def test_the_error_that_the_model_leaves_is_not_taken_for_pixel_noise():
    noise = warped(0.3).images.state.pixel_noise
    assert noise is not None and noise.sigma_px[0] == pytest.approx(0.1, rel=0.15) and noise.inflation < 1.5


SEEDS = range(2)


@cache
def estimated_noise(seed: int, stated: str) -> PixelNoise:
    """Return the pixel noise of 12 images with observations of 0.05 to 0.5 px.

    `stated` is "nothing", "size" (up to a factor), or "chance": sizes that have nothing to do with the errors.
    """
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, 12)
    exact = observed(problem, rng, 300, 0.0)
    std_px = np.exp(rng.uniform(np.log(0.05), np.log(0.5), len(exact.image)))
    x_px = exact.x_px + std_px[:, None] * rng.normal(size=exact.x_px.shape)
    of = {"nothing": None, "size": 3 * std_px, "chance": rng.permutation(std_px)}
    tracks = Tracks(
        image=exact.image,
        x_px=x_px,
        point=exact.point,
        points_in_recon=exact.points_in_recon,
        std_px=of[stated],
    )
    camera = camera_with_prior(INTRINSICS, FIXED)
    given = wrist_problem(None, NO_ARM, problem.recon_from_camera, camera, tracks)
    found = adjust_images(*given).pixel_noise
    assert found is not None
    return found


@pytest.mark.slow
def test_what_matches_state_is_believed_as_far_as_residuals_show_it():
    common = {
        name: [estimated_noise(seed, name).common for seed in SEEDS] for name in ("nothing", "size", "chance")
    }
    assert max(common["size"]) <= 0.06
    assert common["chance"] == common["nothing"] == [1.0] * len(SEEDS)
    assert estimated_noise(0, "size").sigma_px[0] == pytest.approx(np.sqrt(0.05 * 0.5), rel=0.2)
