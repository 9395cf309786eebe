"""Covariances of calibrations: what cannot be one is refused, and comparisons explain differences by their causes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr.calibration.difference import StatedTransform, compare
from jcr.calibration.record import Calibration, read_calibration
from jcr.calibration.summary import corner_in_words, mixed_pair_mm, summary
from jcr.camera import NORMALIZED
from jcr.cli import dispatch
from jcr.geometry import ROOT_FROM_OPTICAL, inverse, retract, rotation_exp, transform
from jcr.number_format import significant
from jcr.records import JointOffsets
from jcr.report.verdict import head
from places import ROOT

ACCEPTED = ROOT / "tests" / "calibrations" / "accepted.json"
CHANGES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "zeroed": (np.zeros_like, "has no variance"),
    "one error zeroed": (lambda c: c * np.outer(np.arange(7) != 2, np.arange(7) != 2), "has no variance"),
    "negative": (lambda c: -c, "a negative variance"),
    # Each pair of errors by itself could be; three that are all opposite to one another cannot.
    "not positive": (lambda c: _std(c) * (np.eye(7) - 0.8 * (1 - np.eye(7))), "negative variance"),
    "one combination without variance": (lambda c: _std(c), "has no variance"),
}


def _std(covariance: np.ndarray) -> np.ndarray:
    std = np.sqrt(np.diag(covariance))
    return np.outer(std, std)


@pytest.mark.parametrize("change", CHANGES)
def test_what_is_no_covariance_is_refused(change: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made, words = CHANGES[change]
    content = json.loads(ACCEPTED.read_text())
    covariance = np.array(content["uncertainty"]["covariance"])
    content["uncertainty"]["covariance"] = made(covariance).tolist()
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    for command in (
        ["compare", tmp_path, ACCEPTED], ["compare", ACCEPTED, tmp_path], ["export", tmp_path, "urdf"],
    ):  # fmt: skip
        assert dispatch([str(word) for word in command]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "calibration.json" in line and words in line


def test_robot_errors_are_in_millimetres_and_degrees_in_the_file():
    found = read_calibration(ACCEPTED)
    assert isinstance(found, Calibration)
    left = 2e-3, np.radians(0.5)
    noise = replace(found.robot_noise, systematic=float(np.radians(0.25)), systematic_left=left)
    joints = JointOffsets(offset=np.radians([1.0, -2.0]), std=np.radians([0.1, 0.2]), prior_std=0.01)
    stated = replace(found, robot_noise=noise, joint_offsets=joints).as_json()["robot_errors"]
    sizes = [stated[name] for name in ("systematic_deg", "translation_mm", "rotation_deg")]
    assert sizes == pytest.approx([0.25, 2.0, 0.5])
    assert [list(one.values()) for one in stated["joints"]] == [
        pytest.approx([1.0, 0.1]),
        pytest.approx([-2.0, 0.2]),
    ]


def test_the_error_of_a_mixed_pair_is_that_of_the_rays():
    found = read_calibration(ACCEPTED)
    assert isinstance(found, Calibration) and found.with_given_intrinsics is not None
    camera = replace(NORMALIZED, fx=500.0, fy=500.0, cx=499.5, cy=0.0, width=1000, height=1)
    other = replace(found.with_given_intrinsics, intrinsics=replace(camera, fx=505.0))
    found = replace(found, intrinsics=camera.with_std(None), with_given_intrinsics=other)
    seen = found.uncertainty.seen
    turned = np.arctan2(499.5, 500.0) - np.arctan2(499.5, 505.0)
    expected = 2 * np.sin(turned / 2) * seen.distance_mm
    assert mixed_pair_mm(found) == pytest.approx(expected)
    assert f"a point is up to {significant(expected)} mm off" in summary(found)
    assert mixed_pair_mm(replace(found, with_given_intrinsics=None)) is None


def test_a_corner_that_misses_the_requirement_is_named_with_reason_and_remedy():
    found = read_calibration(ACCEPTED)
    assert isinstance(found, Calibration) and found.requirement is not None
    assert (seen := found.uncertainty.seen) is not None and not corner_in_words(found)
    for centre_mm in (6.5, 3.0):
        required = replace(found.requirement, reached_mm=centre_mm)
        corners = replace(seen.corners, within_95_mm=125.0)
        of_centre = replace(seen, within_95_mm=centre_mm, corners=corners)
        missed = replace(found, requirement=required, uncertainty=replace(found.uncertainty, seen=of_centre))
        assert "\n            in the corners the distortion is extrapolated" in summary(missed)
        assert ("not met in the corners" in summary(missed)) == required.met
        (tile,) = [tile for tile in head(missed)["tiles"]["tiles"] if "corner" in tile[0]]
        assert tile[3] == "first missed"


HAND_EYE = transform(rotation_exp(np.array([0.1, -0.05, 0.8])), np.array([0.05, 0.02, 0.06]))
TOOL = transform(rotation_exp(np.array([0.0, 0.0, np.pi / 4])), np.array([0.0, 0.0, -0.1034]))
CAUSES = {
    "camera_from_gripper": inverse(HAND_EYE),
    "root link": HAND_EYE @ inverse(ROOT_FROM_OPTICAL) @ transform(np.eye(3), np.array([0.0, 0.015, 0.0])),
    "OpenGL": HAND_EYE @ np.diag([1.0, -1.0, -1.0, 1.0]),
    "millimetres": HAND_EYE + 999 * np.pad(HAND_EYE[:3, 3:], ((0, 1), (3, 0))),
    "103 mm along z of this one's and rotated by 45° about it": inverse(TOOL) @ HAND_EYE,
}


@pytest.mark.parametrize("cause", CAUSES)
def test_another_frame_is_named_as_the_cause_of_a_difference(cause: str, tmp_path: Path, capsys):
    found = compare(HAND_EYE, CAUSES[cause])
    assert found.likely_cause is not None and cause in found.likely_cause
    for name, matrix in (("a", HAND_EYE), ("b", CAUSES[cause])):
        (tmp_path / f"{name}.json").write_text(json.dumps({"gripper_from_camera": matrix.tolist()}))
    dispatch(["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json")])
    assert f"Remedy      compare first {found.likely_cause}" in capsys.readouterr().out


def test_other_intrinsics_are_named_where_they_explain_a_difference_and_a_slip_is_not():
    ours = read_calibration(ACCEPTED)
    assert isinstance(ours, Calibration) and ours.with_given_intrinsics is not None
    joint = ours.uncertainty.joint
    by = joint.covariance[:6, 7:] @ np.linalg.pinv(joint.covariance[7:, 7:], rcond=1e-12, hermitian=True)
    off = np.r_[6.0, 6.0, 4.0, -3.0, np.zeros(len(by[0]) - 4)]
    moved = retract(ours.gripper_from_camera, by @ off)
    found = compare(ours, moved)
    assert found.p_value is not None and found.p_value < 1e-3 and found.likely_cause is not None
    assert f"the intrinsics: those of the other (fx {ours.intrinsics.fx + 6:.1f}" in found.likely_cause
    other = replace(ours, on_gripper=moved, intrinsics=replace(ours.intrinsics, fx=ours.intrinsics.fx + 1))
    assert compare(ours, other).likely_cause is None, (
        "the intrinsics of the other are known, and do not explain it"
    )
    slipped = retract(ours.gripper_from_camera, np.array([0.004, -0.003, 0.001, 0.01, 0.002, -0.02]))
    assert compare(ours, slipped).likely_cause is None
    assert compare(HAND_EYE, retract(HAND_EYE, np.array([1e-3, 1e-3, 0, 0.002, 0, 0]))).likely_cause is None


def test_parts_that_are_not_the_whole_decide_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The whole is the covariance; what its parts leave has no name."""
    content = json.loads(ACCEPTED.read_text())
    for part in content["uncertainty"]["budget"].values():
        part["covariance"] = np.zeros((7, 7)).tolist()
    content["gripper_from_camera"][0][3] += 1e-3
    (tmp_path / "calibration.json").write_text(json.dumps(content))
    assert dispatch(["compare", str(tmp_path), str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["chi2"] == 0
    assert dispatch(["compare", str(tmp_path), str(ACCEPTED), "--json"]) == 3, "more than the errors explain"
    found = json.loads(capsys.readouterr().out)
    assert found["chi2"] > 0 and found["explained_by"]["reference"] == pytest.approx(0.5, abs=0.01)
    assert sum(found["explained_by"].values()) == pytest.approx(1.0)


X = transform(rotation_exp(np.array([0.3, -1.0, 0.4])), np.array([0.05, 0.02, 0.08]))


def test_p_values_of_drawn_differences_are_uniform_and_shares_sum_to_one():
    rng, values = np.random.default_rng(0), []
    root = 1e-3 * rng.normal(size=(6, 6))
    robot, images = root @ root.T, np.diag(np.full(6, 1e-6))
    for _ in range(400):
        step = rng.multivariate_normal(np.zeros(6), 2 * robot + 2 * images)
        parts = {"robot_random": robot, "images": images}
        found = compare(StatedTransform(X, parts), StatedTransform(retract(X, step), parts))
        values.append(found.p_value)
        assert sum(found.explained_by.values()) == pytest.approx(1.0)
    assert found.sigmas == pytest.approx(np.abs(step) / np.sqrt(np.diag(2 * robot + 2 * images)))
    assert abs(np.mean(np.array(values) < 0.5) - 0.5) < 0.09
    assert np.mean(np.array(values) < 0.05) < 0.09


def test_without_any_covariance_there_is_a_difference_and_no_verdict():
    found = compare(StatedTransform(X), StatedTransform(retract(X, np.full(6, 1e-3))))
    assert found.p_value is None and found.sigmas is None
    assert np.linalg.norm(found.translation_m) == pytest.approx(1e-3 * np.sqrt(3))
