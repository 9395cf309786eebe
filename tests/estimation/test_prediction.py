"""Predicted uncertainty of a calibration against its report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from capture_writers import write_easy_handeye2
from in_process import run_jcr
from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.record import read_calibration
from jcr.capture.read import read_source
from jcr.estimation.prediction import predict
from jcr.geometry import scale_translation
from jcr.pipeline.check import check_capture
from jcr.records import Intrinsics, PosePairs
from scenes import capture_of
from simulation.problems import hand_eye_problem


def test_check_expects_what_the_run_reports(tabletop, done):
    good = run_jcr("check", tabletop, "--quiet", "--json")
    assert good.returncode == 0 and not good.stderr
    found, ran = json.loads(good.stdout), read_calibration(done)
    assert found["verdict"] == ran.verdict == "accepted"
    np.testing.assert_allclose(found["expected_std"], ran.uncertainty.std, rtol=1e-6)
    assert found["expected_images"] == [one.image for one in ran.images if one.used]


def test_what_is_not_known_of_the_camera_is_in_the_expectation():
    capture = capture_of(hand_eye_problem(np.random.default_rng(1), 8).base_from_gripper)
    given = replace(capture, intrinsics=Intrinsics(512.0, 512.0, 319.5, 239.5, 640, 480))
    systematic = errors_of(capture.base_from_gripper).systematic
    known, measured, unknown = (
        predict(one, None, systematic)[1]
        for one in (replace(given, intrinsics_std=np.zeros(9)), given, replace(capture, intrinsics=None))
    )
    assert 1.5 * known.std[3] < measured.std[3] < unknown.std[3]


def test_samples_of_a_marker_expect_their_calibration_and_follow_the_requirement(tmp_path: Path):
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 2e-3))
    metric = scale_translation(problem.recon_from_camera, problem.scale)
    samples = write_easy_handeye2(tmp_path, problem.base_from_gripper, metric)
    pairs = read_source(samples)
    assert isinstance(pairs, PosePairs)
    found, result = check_capture(samples), calibrate_pose_pairs(pairs)
    assert found.expected is not None and found.verdict == result.verdict == "accepted"
    np.testing.assert_allclose(found.expected.std, result.uncertainty.std)
    assert (
        check_capture(samples, options={"calibrate": {"require": (0.01, 1.0)}}).verdict
        == "accepted, but not as exact as needed"
    )
    missed = run_jcr("check", samples, "--require", "0.01", "1")
    assert missed.returncode == 3 and "a calibration would not reach 0.01 mm and 1°" in missed.stdout
    assert run_jcr("check", samples, "--require", "none").returncode == 0
