"""Given intrinsics that the images contradict are named, and those that are right never."""

import re
from dataclasses import replace

import numpy as np
import pytest

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.stage import calibrate_reconstruction
from jcr.records import Capture, Intrinsics, Reconstruction
from scenes import capture_of, reconstruction_of
from simulation.problems import INTRINSICS, HandEyeProblem, error, hand_eye_problem, observed


def pictured(
    seed: int, images: int, intrinsics: Intrinsics | None, **motion
) -> tuple[HandEyeProblem, Capture, Reconstruction]:
    """Images of a camera with INTRINSICS, calibrated with `intrinsics` as given; None: none are given."""
    rng = np.random.default_rng([seed, images])
    problem = hand_eye_problem(
        rng, images, robot_noise=(5e-4, np.radians(0.1)), camera_noise=(1e-3, np.radians(0.1)), **motion
    )
    tracks = observed(problem, rng, 250, 0.5)
    capture = capture_of(problem.base_from_gripper, intrinsics=intrinsics)
    reconstruction = reconstruction_of(
        problem.recon_from_camera, intrinsics=intrinsics or INTRINSICS, tracks=tracks
    )
    return problem, capture, reconstruction


def calibrated(
    seed: int, images: int, intrinsics: Intrinsics | None, options: CalibrateOptions | None = None, **motion
) -> tuple[HandEyeProblem, Calibration]:
    problem, capture, reconstruction = pictured(seed, images, intrinsics, **motion)
    return problem, calibrate_reconstruction(capture, reconstruction, options)


def scaled(factor: float) -> Intrinsics:
    return replace(INTRINSICS, fx=INTRINSICS.fx * factor, fy=INTRINSICS.fy * factor)


def said(hand_eye: Calibration) -> str:
    """What is said of the intrinsics."""
    return next((text for text in hand_eye.warnings if text.startswith("the images show ")), "")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "motion"),
    [(3, {}), (10, {}), (5, {"pattern": "translation", "deviation": np.radians(6.0)})],
)
def test_a_true_intrinsics_is_never_named(images: int, motion: dict) -> None:
    assert said(calibrated(0, images, INTRINSICS, **motion)[1]) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "images"), [(0.8, 5), (1.05, 10)])
def test_a_wrong_focal_length_is_named_with_the_right_one(factor: float, images: int) -> None:
    problem, hand_eye = calibrated(0, images, scaled(factor))
    found = re.match(
        r"the images show focal lengths of \(([\d.]+), [\d.]+\) ± \S+ px where \(([\d.]+), ", said(hand_eye)
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(INTRINSICS.fx, rel=0.01)
    assert float(found[2]) == pytest.approx(INTRINSICS.fx * factor, abs=0.5)
    assert hand_eye.warnings[0] == said(hand_eye)
    # The calibration is that of the intrinsics which the images show.
    assert hand_eye.intrinsics is not None and hand_eye.intrinsics.fx == pytest.approx(
        INTRINSICS.fx, rel=0.01
    )
    off = error(problem, hand_eye.gripper_from_camera, hand_eye.scale)
    assert (np.abs(off) < 3 * np.sqrt(np.diag(hand_eye.covariance))).all()


@pytest.mark.slow
def test_more_views_are_not_promised_to_make_up_for_a_wrong_intrinsics() -> None:
    offset, promised, reported = [], [], []
    for intrinsics in (INTRINSICS, scaled(1.03), scaled(1.2)):
        _, capture, reconstruction = pictured(0, 5, intrinsics)
        hand_eye = calibrate_reconstruction(capture, reconstruction, CalibrateOptions(next_poses=2))
        offset.append(hand_eye.gripper_from_camera[:3, 3])
        promised.append(np.linalg.norm(hand_eye.next_poses[-1].expected_std[:3]))
        reported.append(np.sqrt(np.trace(hand_eye.covariance[:3, :3])))
    assert promised[0] < 0.7 * reported[0]
    for k in (1, 2):
        assert np.linalg.norm(offset[k] - offset[0]) < promised[k] < reported[k]
