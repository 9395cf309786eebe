"""Lengths beside the robot's positions: compared, weighed where they agree, named where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.attack import reconstructed
from benchmarks.simulated.boards import Sheet, with_sheet
from benchmarks.simulated.faults import Faults, faulty_capture
from jcr.calibration.checks.lengths import Length, contradiction
from jcr.calibration.stage import calibrate
from jcr.geometry import step_between
from jcr.records import Finding, HandEye, Kind
from jcr.records.words import sentence

pytestmark = pytest.mark.slow


def calibrated(sheet: Sheet | None, pose_scale: float = 1.0, seed: int = 0) -> tuple[HandEye, np.ndarray]:
    """12 images, and the true transform."""
    rng = np.random.default_rng([seed, 12])
    bare = faulty_capture(rng, 12, Faults(pose_scale=pose_scale))
    found = bare if sheet is None else with_sheet(bare, rng, sheet)
    capture, reconstruction = reconstructed(bare, estimated=False)
    hand_eye = calibrate(capture, replace(reconstruction, tracks=found.tracks))
    return hand_eye, found.gripper_from_camera


def of_kind(hand_eye: HandEye, kind: Kind) -> Finding:
    (found,) = (one for one in hand_eye.findings if one.kind is kind)
    return found


def test_a_board_that_agrees_with_the_robot_makes_the_scale_more_certain():
    alone, _ = calibrated(None)
    both, x = calibrated(Sheet())
    assert both.covariance[6, 6] < 0.9 * alone.covariance[6, 6]
    (board,) = both.scale_evidence.lengths
    assert board.name == "board" and board.used and abs(board.robot_longer_percent) < 1
    assert not any(one.kind is Kind.SCALE_FROM_ROBOT for one in both.findings)
    assert both.converged and not both.warnings
    step = step_between(both.gripper_from_camera, x)
    assert (np.abs(step) < 3 * np.sqrt(np.diag(both.covariance)[:6])).all()
    assert both.budget is not None
    assert np.allclose(np.sum(list(vars(both.budget).values()), axis=0), both.covariance, rtol=0, atol=1e-9)


@pytest.mark.parametrize("pose_scale", [1.015, 0.95])
def test_positions_too_long_are_named_with_the_board_and_the_truth_is_within_what_is_stated(
    pose_scale: float,
):
    hand_eye, x = calibrated(Sheet(bend_m=2e-3), pose_scale)
    named = of_kind(hand_eye, Kind.BOARD_SIZE)
    assert named.std is not None and named.value == pytest.approx(pose_scale - 1, abs=3 * named.std)
    assert not hand_eye.scale_evidence.lengths[0].used
    assert hand_eye.converged == (abs(pose_scale - 1) < 0.03)
    error = np.r_[step_between(hand_eye.gripper_from_camera, x), -np.log(hand_eye.scale)]
    assert (np.abs(error) < 3 * np.sqrt(np.diag(hand_eye.covariance))).all()


def test_a_board_of_30_mm_given_for_one_of_25_rejects_the_calibration_in_one_line():
    hand_eye, _ = calibrated(Sheet(stated_m=0.030))
    assert not hand_eye.converged
    (line,) = hand_eye.warnings
    assert "16.6 ± 0.2 " in line and "% smaller than given; measure its squares" in line


def test_the_side_of_a_board_of_unknown_size_is_stated_by_the_robot():
    hand_eye, _ = calibrated(Sheet(stated_m=None), pose_scale=1.016)
    side = of_kind(hand_eye, Kind.BOARD_SIDE)
    assert side.value is not None and side.std is not None
    assert side.value == pytest.approx(1.016 * 0.025, abs=3 * side.std) and side.std < 1e-4
    assert "if they measure 25.5 mm" in sentence(side) or "if they measure 25 mm, give 0.025" in sentence(
        side
    )
    assert hand_eye.converged and hand_eye.scale_evidence.lengths == ()


def test_of_several_lengths_the_two_that_contradict_each_other_most_surely_are_named():
    robot, board = Length("robot", 0.0, 0.001), Length("board", 0.001, 0.002)
    depth, network = Length("depth camera", -0.15, 0.02), Length("network", 0.1, 0.05)
    assert contradiction([robot, board]) is None
    assert contradiction([robot, board, network]) is None
    assert contradiction([robot, board, depth, network]) == (board, depth)
