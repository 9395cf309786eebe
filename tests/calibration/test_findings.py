"""Findings are data: ordered, counted as uncertainty, put into words in one place, kept in files, documented."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.calibrate import calibrate_pose_pairs, calibrate_reconstruction, fitted_case
from jcr.calibration.checks.images import check_remarks
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import (
    Calibration,
    FailedCalibration,
    PublishedCalibration,
    read_calibration,
    validated,
)
from jcr.calibration.summary import summary
from jcr.calibration.verdict import appended, judged
from jcr.findings import Finding, FindingKind, sentence
from jcr.findings.finding import verdict_of, without_consequences
from jcr.findings.messages import GROUPS
from jcr.geometry import rotation_exp, transform
from jcr.records import Intrinsics, PaperResiduals
from refusal import refused
from scenes import capture_of, pairs_of, reconstruction_of
from simulation.problems import hand_eye_problem

DETAILS: dict[str, float | str] = {
    **dict(frame="base", x=0.0, y=0.6, z=0.8, motion="planar", rotation=0.01, part="scale", unit="interval"),
    **dict(reading="their inverses", fits="1 mm", given=1e-3, given_rotation=1e-3, residual=0.01),
    **dict(translation_mm=5.0, rotation_deg=1.0, distance_mm=0.0, reached_mm=9.0, reached_deg=0.1),
    **dict(longer="after", count=5.0, camera="overhead", of=12.0, arm="right"),
    **dict(at="camera", source="images", shown="a focal length of 600 px where 610 is given"),
    **dict(board="chessboard:9x6:SIDE", proposed="aruco:SIDE:DICT_4X4_50", one="board", other="depth camera"),
    **dict(
        needed=3.0,
        mount="base",
        focal_std=0.1,
        rotated="rotated by 90°",
        text="a thing is wrong",
        remedy="",
        at="camera",
    ),
}
"""Details of any kind."""
OWN_DETAILS = {
    FindingKind.FEW_AGREE: {"images": 9.0},
    FindingKind.POSE_CONVENTION: DETAILS | {"given": "90 mm", "remedy": "add --pose-inverted"},
}
"""Details of kinds that give a name another meaning."""


def example(kind: FindingKind) -> Finding:
    return Finding(
        kind=kind, severity="warns", images=("a.png", "b.png"), joints=(2,), value=0.01, std=0.001, p=1e-9,
        details=OWN_DETAILS.get(kind, DETAILS),
    )  # fmt: skip


@pytest.mark.parametrize("kind", FindingKind)
def test_every_kind_has_words_of_one_line(kind: FindingKind):
    finding = example(kind)
    for words in (finding.text, sentence(finding)):
        assert words and "\n" not in words and "nan" not in words and not words.endswith(".")
    assert repr(finding) == f"<Finding {kind.name}, warns: {finding.text}>"
    assert sentence(finding).startswith(finding.text) and sentence(finding).endswith(finding.remedy)


@pytest.mark.parametrize("kind", FindingKind)
def test_what_a_kind_explains_are_kinds_and_its_group_has_a_title(kind: FindingKind):
    assert kind.row.group in GROUPS and {FindingKind(name) for name in kind.row.explains} <= set(FindingKind)
    assert kind not in kind.row.explains


def with_faults(numbers: Calibration, *faults: Finding) -> Calibration:
    return judged(numbers, (), appended((), faults, lambda findings: judged(numbers, (), findings)))


def test_a_fault_that_is_too_much_rejects_and_comes_before_its_consequences():
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    assert solved.verdict == "accepted"
    shift = (0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01)
    fault = replace(example(FindingKind.DELAY), concerns="poses", shift=shift)
    found = with_faults(solved, fault)
    assert [one.kind for one in found.findings] == [FindingKind.DELAY]  # and not that more images would help
    assert found.verdict == "rejected" and found.findings[0].severity == "rejects" and not found.converged
    small = with_faults(solved, replace(fault, shift=(1e-4, *shift[1:6], 0.0)))
    assert small.verdict == "accepted" and small.warnings == (sentence(fault),)
    severities = ("warns", "rejects", "informs")
    assert verdict_of([replace(fault, severity=one) for one in severities]) == "rejected"
    # What else speaks against it comes after.
    uncertain = replace(example(FindingKind.UNCERTAIN), severity="rejects")
    found = with_faults(solved, uncertain, fault)
    assert [one.kind for one in found.findings] == [FindingKind.DELAY, FindingKind.UNCERTAIN]


def test_a_repetitive_scene_is_named_without_warnings_of_the_reconstruction():
    cause = replace(example(FindingKind.REPETITIVE), severity="rejects")
    others = FindingKind.HALF_UNUSED, FindingKind.FEW_IMAGES, FindingKind.RECONSTRUCTION
    found = (cause, *(replace(example(kind), severity="warns") for kind in others))
    assert without_consequences(found) == (cause,) and without_consequences(found[1:]) == found[1:]


@pytest.mark.slow
def test_what_a_cause_explains_is_not_another_fault():
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    pairs = pairs_of(problem.base_from_gripper[::-1], problem.recon_from_camera)
    content = calibrate_pose_pairs(pairs)
    assert content.findings[0].kind is FindingKind.POSE_CONVENTION
    assert FindingKind.UNCERTAIN in {one.kind for one in content.findings}
    assert content.doubt is not None and "reverse order" in content.doubt
    assert not any("add images" in said or "disagree" in said for said in content.remarks)
    assert summary(content).startswith("REJECTED") and "add " not in summary(content)


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [0.0, 1.5])
def test_motions_are_not_the_cause_where_images_are_missing(tilt_deg: float):
    """Twelve general poses, whose first five rotate about one axis or nearly so; only these are registered."""
    rng = np.random.default_rng(3)
    problem = hand_eye_problem(rng, 12, robot_noise=(2e-4, 5e-4))
    gripper = problem.base_from_gripper.copy()
    first = gripper[0]
    yaw = rotation_exp(np.linspace(0, 1.5, 5)[:, None] * [0.0, 0.0, 1.0])
    yaw = rotation_exp(np.radians(tilt_deg) * rng.normal(size=(5, 3))) @ yaw
    gripper[:5] = transform(yaw @ first[:3, :3], first[:3, 3] + 0.2 * rng.normal(size=(5, 3)))
    camera = gripper[:5] @ problem.gripper_from_camera
    made = reconstruction_of(camera, intrinsics=Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480))
    capture = capture_of(gripper)
    found = calibrate_reconstruction(capture, made)
    assert [one.kind for one in found.findings[:2]] == [FindingKind.FEW_USED, FindingKind.UNOBSERVABLE]
    assert found.findings[0].concerns == "reconstruction" and found.observability.advice == ("",)
    alone = capture.of_rows(range(5))
    found = calibrate_reconstruction(alone, made)
    assert found.findings[0].kind is FindingKind.UNOBSERVABLE
    assert "tilt the wrist" in found.observability.advice[0]


def test_a_failure_without_its_reason_and_a_published_result_without_transform_are_refused():
    """A failed calibration.json that was edited to accepted ended in a traceback."""
    failed = FailedCalibration(
        images=(), findings=(replace(example(FindingKind.SLIP), severity="rejects"),)
    ).as_json()
    failed |= {"findings": [], "warnings": [], "verdict": "accepted", "converged": True}
    with refused("no finding states why there is no calibration"):
        validated(json.loads(json.dumps(failed)), Path("a"))
    pose, residuals = np.eye(4), PaperResiduals(0.0, 0.0)
    whole = PublishedCalibration(
        method="paper", images=(), scale=1.0, residuals=residuals, on_gripper=pose, resting=pose
    )
    edited = json.loads(json.dumps(whole.as_json())) | {"gripper_from_camera": None}
    with refused("the transforms are not those of the mount gripper"):
        validated(edited, Path("a"))


def test_findings_are_in_the_file_and_come_back(tmp_path: Path):
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    pairs = pairs_of(problem.base_from_gripper, problem.recon_from_camera)
    hand_eye = calibrate_pose_pairs(pairs).with_findings(*(example(kind) for kind in FindingKind))
    slip = replace(example(FindingKind.SLIP), concerns="mount", shift=(1e-3,) * 7)
    hand_eye = with_faults(hand_eye, *hand_eye.findings, slip)
    content = hand_eye
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(content.as_json()))
    written = json.loads(file.read_text())
    assert written["verdict"] == "not checked" and written["converged"]
    kinds = [one["kind"] for one in written["findings"]]
    assert kinds == [one.kind for one in hand_eye.findings]
    # Causes before consequences.
    assert kinds.index("camera moved on the gripper") < kinds.index("unobservable motion")
    assert all(
        {"severity", "concerns", "images", "joints", "text", "remedy"} <= one.keys()
        for one in written["findings"]
    )
    said = [one["text"] + ("; " + one["remedy"]) * bool(one["remedy"]) for one in written["findings"]]
    assert written["warnings"] == said
    assert read_calibration(file) == content
    parts = [share["covariance"] for share in written["uncertainty"]["budget"].values()]
    assert np.allclose(np.sum(parts, axis=0), hand_eye.covariance, rtol=0, atol=1e-9)
    # A verdict that the findings contradict is no calibration.
    file.write_text(json.dumps(written | {"converged": False}))
    with refused("contradict one another"):
        read_calibration(file)


def test_a_misspelt_field_of_a_finding_fails():
    """The message printed an empty number."""
    sizes = {"value": 0.01, "rotatoin": 0.02, "longer": "before", "count": 6.0}
    with pytest.raises(TypeError, match="rotation_deg"):
        Finding.of(FindingKind.SLIP, "warns", "mount", "3.png", "4.png", **sizes)


def test_images_that_are_left_out_lead_the_warnings_where_they_are_most():
    """5 of 12 images are registered, and the first warning said how sharp they are."""
    problem = hand_eye_problem(np.random.default_rng(4), 12, robot_noise=(2e-4, 5e-4))
    intrinsics = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)
    made = reconstruction_of(problem.recon_from_camera[:5], intrinsics=intrinsics)
    made = replace(made, warnings=("something else",))
    capture = capture_of(problem.base_from_gripper)
    case = fitted_case(capture, made, CalibrateOptions(), errors_of(problem.base_from_gripper[:5]))
    first = check_remarks(case).calibration.findings[0]
    assert first.kind is FindingKind.HALF_UNUSED and first.severity == "warns"
    assert "only 5 of 12 images are used: 7 not registered, 0 in contradiction to the others" in first.text
