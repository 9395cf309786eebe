"""Predicted uncertainty of a calibration against its report, and the poses to add."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.coverage import FACTOR, predicted
from in_process import run_jcr
from jcr.calibration.record import read_calibration
from jcr.calibration.requirement import better_poses, next_poses, predictions
from jcr.calibration.robot_errors import errors_of
from jcr.estimation.prediction import assumed, predict, typical_camera
from jcr.pipeline.check import Examination, check_capture
from jcr.records import Intrinsics, NextPose
from simulation.problems import HandEyeProblem, hand_eye_problem

WITHIN = np.log(FACTOR)


@pytest.mark.slow
def test_what_is_expected_is_what_is_reported():
    """Arms of several kinds, six to twenty images, intrinsics given, wrong and unknown."""
    ratios = np.log(predicted(5))
    assert len(ratios) == 5 and (np.abs(ratios) < WITHIN).all(), np.exp(ratios)
    assert (np.abs(np.median(ratios, axis=0)) < np.log(1.25)).all()


@pytest.mark.slow
def test_check_finds_the_bundled_capture_good_and_expects_what_its_run_reports(
    tabletop: Path, done: Path, monkeypatch: pytest.MonkeyPatch
):
    kept: list[Examination] = []

    def noted(*arguments: Any, **options: Any) -> Examination:
        kept.append(check_capture(*arguments, **options))
        return kept[-1]

    monkeypatch.setattr("jcr.pipeline.check.check_capture", noted)
    good = run_jcr("check", tabletop, "--quiet", "--suggest", 1)
    assert good.returncode == 0 and good.stdout.startswith("ACCEPTED") and not good.stderr
    assert "good to calibrate" in good.stdout and "\nAdd pose 1  " in good.stdout
    uncertainty, found = read_calibration(done).uncertainty, kept[0].expected
    assert uncertainty is not None and uncertainty.seen is not None
    assert found is not None and found.seen is not None
    assert abs(np.log(found.seen.within_95_mm / uncertainty.seen.within_95_mm)) < WITHIN
    assert abs(np.log(found.seen.rotation_95_deg / uncertainty.seen.rotation_95_deg)) < WITHIN
    assert (np.abs(np.log(found.std[:3] / (1e-3 * np.array(uncertainty.translation_std_mm)))) < WITHIN).all()
    assert (np.abs(np.log(np.degrees(found.std[3:6]) / uncertainty.rotation_std_deg)) < WITHIN).all()


def test_what_is_not_known_of_the_camera_is_in_the_expectation():
    gripper = hand_eye_problem(np.random.default_rng(1), 8).base_from_gripper
    given = Intrinsics(512.0, 512.0, 319.5, 239.5, 640, 480)
    exact = typical_camera(given, (640, 480), np.zeros(9))
    systematic = errors_of(gripper).systematic
    known, measured, unknown = (
        predict(assumed(gripper, camera), gripper, systematic)
        for camera in (exact, typical_camera(given, (640, 480)), typical_camera(None, (640, 480)))
    )
    assert 1.5 * known.std[3] < measured.std[3] < unknown.std[3]


def expected_with(
    problem: HandEyeProblem, noise: tuple[float, float] | None, count: int, reach: np.ndarray | None = None
) -> tuple[np.ndarray, tuple[NextPose, ...]]:
    """Standard deviations expected of a problem's poses, and the poses to add to them."""
    gripper, x = problem.base_from_gripper, problem.gripper_from_camera
    assumptions = replace(assumed(gripper, None, noise), gripper_from_camera=x)
    added = better_poses(assumptions, gripper, errors_of(gripper), count, reach)
    predicted = predictions(assumptions, gripper, errors_of(gripper), added)
    names = [str(k) for k in range(len(gripper))]
    return predicted(0).std, next_poses(gripper, names, added, predicted)


def test_proposed_poses_keep_their_promise_and_stay_in_reach():
    problem = hand_eye_problem(np.random.default_rng(2), 5)
    reach = np.array([[0.2, -0.4, 0.2], [0.8, 0.4, 0.8]])
    now, proposed = expected_with(problem, (5e-4, np.radians(0.1)), 3, reach)
    assert len(proposed) == 3
    last = now
    for pose in proposed:
        assert (pose.expected_std < last + 1e-12).all()
        last = pose.expected_std
        position = pose.base_from_gripper[:3, 3]
        assert (position >= reach[0] - 0.01).all() and (position <= reach[1] + 0.01).all()
    assert last[:3].max() < 0.75 * now[:3].max()
    assert proposed[2].within_95_mm < proposed[0].within_95_mm


def test_a_planar_capture_is_asked_to_tilt():
    problem = hand_eye_problem(np.random.default_rng(3), 8, "planar")
    now, proposed = expected_with(problem, None, 2)
    down = problem.base_from_gripper[0, 2, :3]
    tilt = [np.degrees(np.arccos(pose.base_from_gripper[2, :3] @ down)) for pose in proposed]
    assert max(tilt) > 10.0
    assert proposed[-1].expected_std[:3].max() < 0.02 * now[:3].max()
