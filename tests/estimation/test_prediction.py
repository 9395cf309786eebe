"""Predicted uncertainty of a calibration against its report."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.coverage import FACTOR, predicted
from capture_writers import write_easy_handeye2
from in_process import run_jcr
from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.record import read_calibration
from jcr.calibration.robot_errors import errors_of
from jcr.capture.read import read_source
from jcr.estimation.prediction import assumed, predict, typical_camera
from jcr.geometry import scale_translation
from jcr.pipeline.check import Examination, check_capture
from jcr.records import Intrinsics, PosePairs
from simulation.problems import hand_eye_problem

WITHIN = np.log(FACTOR)


@pytest.mark.slow
def test_what_is_expected_is_what_is_reported():
    """Arms of several kinds, six to twenty images, intrinsics given, wrong and unknown."""
    ratios = np.log(predicted(3))
    assert len(ratios) == 3 and (np.abs(ratios) < WITHIN).all(), np.exp(ratios)
    assert (np.abs(np.median(ratios, axis=0)) < np.log(1.25)).all()


def test_check_finds_the_bundled_capture_good_and_expects_what_its_run_reports(tabletop, done, monkeypatch):
    kept: list[Examination] = []

    def noted(*arguments: Any, **options: Any) -> Examination:
        kept.append(check_capture(*arguments, **options))
        return kept[-1]

    monkeypatch.setattr("jcr.pipeline.check.check_capture", noted)
    good = run_jcr("check", tabletop, "--quiet")
    assert good.returncode == 0 and good.stdout.startswith("ACCEPTED") and not good.stderr
    assert "good to calibrate" in good.stdout
    uncertainty, found = read_calibration(done).uncertainty, kept[0].expected
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
        predict(assumed(gripper, camera, None), gripper, systematic)
        for camera in (exact, typical_camera(given, (640, 480)), typical_camera(None, (640, 480)))
    )
    assert 1.5 * known.std[3] < measured.std[3] < unknown.std[3]
    # The shift of a fault that was found is in it, too.
    assumptions = assumed(gripper, exact, None)
    shifted = predict(replace(assumptions, shifts=(1e-3 * np.eye(7)[3],)), gripper, systematic)
    assert shifted.std[3] == pytest.approx(np.hypot(known.std[3], 1e-3))
    assert shifted.seen.rotation_95_deg > known.seen.rotation_95_deg


def test_samples_of_a_marker_expect_their_calibration_and_follow_the_requirement(tmp_path: Path):
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 2e-3))
    metric = scale_translation(problem.recon_from_camera, problem.scale)
    samples = write_easy_handeye2(tmp_path, problem.base_from_gripper, metric)
    pairs = read_source(samples)
    assert isinstance(pairs, PosePairs)
    found, result = check_capture(samples), calibrate_pose_pairs(pairs)
    assert found.expected is not None and found.verdict == result.verdict == "accepted"
    np.testing.assert_allclose(found.expected.std, result.uncertainty.std)
    assert check_capture(samples, require=(0.01, 1.0)).verdict == "accepted, but not as exact as needed"
    missed = run_jcr("check", samples, "--require", "0.01", "1")
    assert missed.returncode == 3 and "a calibration would miss 0.01 mm and 1°" in missed.stdout
    assert run_jcr("check", samples, "--require", "none").returncode == 0
