"""What a camera's model leaves of its distortion."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.estimation.intrinsics_prior import ESTIMATED, TYPICAL, camera_with_prior
from jcr.estimation.solve import Solution
from jcr.estimation.wrist import adjust_wrist
from jcr.records import Intrinsics
from simulation.problems import INTRINSICS, hand_eye_problem, observed


@cache
def adjusted(warp_px: float) -> Solution:
    """Of images whose pixels a wave over the image displaces, which no coefficient describes."""
    rng = np.random.default_rng(3)
    problem = hand_eye_problem(rng, 12, robot_noise=(1e-4, np.radians(0.01)))
    tracks = observed(problem, rng, 400, 0.1)
    u, v = (2 * np.pi * tracks.x_px / [INTRINSICS.width, INTRINSICS.height]).T
    tracks = replace(tracks, x_px=tracks.x_px + warp_px * np.stack([np.sin(v), np.sin(u)], axis=1))
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    guess = Intrinsics(619.0, 619.0, 319.5, 239.5, 640, 480)
    return adjust_wrist(
        problem.base_from_gripper,
        (start.gripper_from_camera, start.scale, start.base_from_recon.rigid),
        problem.recon_from_camera,
        camera_with_prior(guess, ESTIMATED),
        tracks,
    )


@pytest.mark.slow
def test_the_size_of_what_the_model_leaves_is_found():
    of_none, of_some, of_much = (adjusted(warp_px).state.model_error_std[0] for warp_px in (0.0, 0.3, 1.0))
    assert of_none < 0.5 * TYPICAL
    assert of_much / of_some == pytest.approx(1.0 / 0.3, rel=0.3)


def test_what_the_model_leaves_is_not_taken_for_pixel_noise():
    noise = adjusted(0.3).images.state.pixel_noise
    assert noise.sigma_px[0] == pytest.approx(0.1, rel=0.15) and noise.inflation < 1.5


def test_it_makes_the_intrinsics_as_uncertain_as_it_is_large():
    std = [np.sqrt(np.diag(adjusted(warp_px).intrinsics_covariance(0)))[2] for warp_px in (0.0, 0.3, 1.0)]
    assert std[0] < std[1] < std[2]
