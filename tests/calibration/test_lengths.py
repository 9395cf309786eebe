"""Lengths beside the robot's positions: compared, weighed where they agree, named where they do not."""

from dataclasses import replace

import numpy as np
import pytest

from jcr.calibration import stage
from jcr.calibration.checks import lengths
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.stage import calibrate_reconstruction
from jcr.findings import Finding, FindingKind, sentence
from jcr.geometry import step_between
from jcr.records import DepthCheck
from simulation.boards import Sheet, with_sheet
from simulation.faults import Faults, faulty_capture, reconstructed

pytestmark = pytest.mark.slow


def calibrated(
    sheet: Sheet | None, pose_scale: float = 1.0, seed: int = 0, options: CalibrateOptions | None = None
) -> tuple[Calibration, np.ndarray]:
    """12 images, and the true transform."""
    rng = np.random.default_rng([seed, 12])
    bare = faulty_capture(rng, 12, Faults(pose_scale=pose_scale))
    found = bare if sheet is None else with_sheet(bare, rng, sheet)
    capture, reconstruction = reconstructed(bare, estimated=False)
    hand_eye = calibrate_reconstruction(capture, replace(reconstruction, tracks=found.tracks), options)
    return hand_eye, found.gripper_from_camera


def of_pixels(monkeypatch: pytest.MonkeyPatch, metres_per_unit: float) -> None:
    """A known length makes the simulated reconstruction, which is in metres, so much larger."""
    for module in (stage, lengths):
        monkeypatch.setattr(module, "length_cue", lambda *_: (metres_per_unit, 0.01))


def of_kind(hand_eye: Calibration, kind: FindingKind) -> Finding:
    (found,) = (one for one in hand_eye.findings if one.kind is kind)
    return found


def test_a_board_that_agrees_with_the_robot_makes_the_scale_more_certain():
    alone, _ = calibrated(None)
    both, x = calibrated(Sheet())
    assert both.covariance[6, 6] < 0.9 * alone.covariance[6, 6]
    (board,) = both.lengths
    assert board.name == "board" and board.used and abs(board.robot_longer_percent) < 1
    assert not any(one.kind is FindingKind.SCALE_FROM_ROBOT for one in both.findings)
    assert both.converged and not both.warnings
    step = step_between(both.gripper_from_camera, x)
    assert (np.abs(step) < 3 * np.sqrt(np.diag(both.covariance)[:6])).all()
    assert both.uncertainty.budget is not None
    assert np.allclose(
        np.sum(list(vars(both.uncertainty.budget).values()), axis=0), both.covariance, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("pose_scale", [1.015, 0.95])
def test_a_board_that_contradicts_the_robot_s_lengths_is_named_and_not_used(pose_scale: float):
    """A misprinted board is likelier than positions that are all too long, which no image shows."""
    hand_eye, _ = calibrated(Sheet(bend_m=2e-3), pose_scale)
    named = of_kind(hand_eye, FindingKind.BOARD_SIZE)
    assert named.std is not None and named.value == pytest.approx(pose_scale - 1, abs=3 * named.std)
    assert hand_eye.converged and named.shift is None and not hand_eye.lengths[0].used


def test_a_board_of_30_mm_given_for_one_of_25_rejects_the_calibration_in_one_line():
    hand_eye, _ = calibrated(Sheet(stated_m=0.030))
    assert not hand_eye.converged
    (line,) = hand_eye.warnings
    assert "16.6 ± 0.2" in line and "% smaller than given; measure its squares" in line


@pytest.mark.parametrize(
    ("sheet", "kind"),
    [
        (Sheet(stretch=0.01), FindingKind.BOARD_STRETCHED),
        (Sheet(stretch=0.03), FindingKind.BOARD_STRETCHED),
        (Sheet(moved_m=3e-3), FindingKind.BOARD_MOVED),
        (Sheet(moved_m=1e-3), FindingKind.BOARD_MOVED),
        (Sheet(size_error=0.02), FindingKind.BOARD_SIZE),
        (Sheet(bend_m=3e-3), FindingKind.BOARD_BENT),
    ],
)
def test_a_board_that_is_wrong_is_named_and_leaves_the_result_as_it_is_without(
    sheet: Sheet, kind: FindingKind
):
    alone, _ = calibrated(None, seed=1)
    hand_eye, x = calibrated(sheet, seed=1)
    assert of_kind(hand_eye, kind).severity == ("informs" if kind is FindingKind.BOARD_BENT else "warns")
    # The shape of a bent board, and the corners of a moved one in most images, are still good.
    is_used = kind in {FindingKind.BOARD_BENT, FindingKind.BOARD_MOVED}
    assert hand_eye.converged and any(one.used for one in hand_eye.lengths) == is_used
    std, without = (np.sqrt(np.diag(one.covariance)) for one in (hand_eye, alone))
    assert (std < 1.1 * without).all()
    assert (np.abs(step_between(hand_eye.gripper_from_camera, x)) < 3 * std[:6]).all()


def test_the_side_of_a_board_of_unknown_size_is_stated_by_the_robot():
    hand_eye, _ = calibrated(Sheet(stated_m=None), pose_scale=1.016)
    side = of_kind(hand_eye, FindingKind.BOARD_SIDE)
    assert side.value is not None and side.std is not None
    assert side.value == pytest.approx(1.016 * 0.025, abs=3 * side.std) and side.std < 1e-4
    assert hand_eye.converged and hand_eye.lengths == ()


def test_a_known_length_that_contradicts_the_robot_rejects_unless_a_board_agrees_with_the_robot(
    monkeypatch: pytest.MonkeyPatch,
):
    options = CalibrateOptions(known_length=("00.png", 1.0, 2.0, 300.0, 200.0, 100.0))
    of_pixels(monkeypatch, 1.05)
    alone, _ = calibrated(None, options=options)
    named = of_kind(alone, FindingKind.SCALES)
    assert (named.severity, named.details) == ("rejects", {"one": "robot", "other": "known length"})
    (line,) = alone.warnings
    assert "the robot's positions and the known length contradict each other by 4." in line
    assert line.endswith(" ± 1.0 %; measure both again")
    both, _ = calibrated(Sheet(), options=options)
    named = of_kind(both, FindingKind.SCALES)
    assert both.converged and named.severity == "warns" and named.shift is None
    assert sentence(named) == (
        "the size of the board and the known length contradict each other by 4.8 ± 1.0 %; measure both again"
    )
    assert [one.name for one in both.lengths] == ["board", "known length"]


def test_a_depth_camera_that_contradicts_robot_and_board_is_named_with_the_percent(
    monkeypatch: pytest.MonkeyPatch,
):
    measured = DepthCheck(
        off_percent=9.0,
        std_percent=0.3,
        noise_m=1e-3,
        noise_per_m=1e-3,
        distances_m=(0.4, 0.7),
        images=12,
        features=900,
    )
    monkeypatch.setattr(lengths, "depth_check", lambda *_: measured)
    hand_eye, _ = calibrated(Sheet())
    named = of_kind(hand_eye, FindingKind.SCALES)
    assert named.details["other"] == "depth camera" and named.severity == "warns" and hand_eye.converged
    assert "the depth camera contradict each other by 8.3 ± 2.0 %" in sentence(named)
