"""Observations that count by what their matches state, as far as the images bear it out."""

from functools import cache

import numpy as np
import pytest

from jcr.estimation.image_equations import adjust_images
from jcr.estimation.intrinsics_prior import FIXED, camera_with_prior
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.problem import Observations, image_problem
from jcr.records import Tracks
from simulation.problems import INTRINSICS, hand_eye_problem, observed

SEEDS = range(6)


@cache
def adjusted(seed: int, stated: str) -> PixelNoise:
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
    camera, observations = camera_with_prior(INTRINSICS, FIXED), Observations.of_one_camera(tracks, 12)
    given = image_problem(problem.recon_from_camera, camera, observations, exact.points_in_recon)
    found = adjust_images(*given).state.pixel_noise
    assert found is not None
    return found


@pytest.mark.slow
def test_what_matches_state_is_believed_as_far_as_residuals_show_it():
    common = {name: [adjusted(seed, name).common for seed in SEEDS] for name in ("nothing", "size", "chance")}
    assert max(common["size"]) <= 0.06
    assert common["chance"] == common["nothing"] == [1.0] * len(SEEDS)
    assert adjusted(0, "size").sigma_px[0] == pytest.approx(np.sqrt(0.05 * 0.5), rel=0.2)
