"""Findings are data: ordered, counted as uncertainty, put into words in one place, kept in files, documented."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jcr.calibration.case import with_findings
from jcr.calibration.poses import calibrate_poses
from jcr.calibration.record import calibration_of, read_calibration
from jcr.calibration.stage import calibrate
from jcr.calibration.words import summary
from jcr.errors import InputError
from jcr.estimation.hand_eye import fit_hand_eye
from jcr.findings import Finding, FindingKind, remedy, sentence, text
from jcr.findings.table import GROUPS
from jcr.geometry import rotation_exp, transform
from jcr.records import Capture, HandEye, Intrinsics, PosePairs, Reconstruction, Tracks
from simulation.problems import hand_eye_problem

"""Files as the version before findings wrote them."""
AT = {"frame": "gripper", "x": 0.0, "y": 0.6, "z": 0.8}
INTRINSICS = {
    f"{name}{of}": 600.0 + k for name in ("fx", "fy", "cx", "cy") for k, of in enumerate(("", "_given"))
}
SIZE = {"rotation": 0.01}
EXAMPLES: dict[FindingKind, dict] = {
    FindingKind.UNOBSERVABLE: {"details": {"motion": "planar"} | AT, "value": 0.01},
    FindingKind.FEW_IMAGES: {"value": 3.0},
    FindingKind.FEW_AGREE: {"value": 3.0, "details": {"images": 9.0}},
    FindingKind.POSES_CONTRADICT_IMAGES: {"value": 0.1, "details": SIZE},
    FindingKind.POSE_CONVENTION: {
        "details": {
            "reading": "their inverses (gripper_from_base was given)",
            "fits": "1 mm",
            "given": "90 mm",
            "remedy": "add --pose-inverted",
        }
    },
    FindingKind.NOISE_ABOVE_GIVEN: {"value": 0.01, "details": SIZE | {"given": 1e-3, "given_rotation": 1e-3}},
    FindingKind.UNCERTAIN: {"value": 0.1, "details": {"part": "scale"}},
    FindingKind.LEAVE_ONE_OUT: {"value": 0.1, "details": {"residual": 0.01}},
    FindingKind.NOT_EXACT_ENOUGH: {
        "details": {
            "translation_mm": 5.0,
            "rotation_deg": 1.0,
            "asked": 0.0,
            "distance_mm": 0.0,
            "reached_mm": 9.0,
            "reached_deg": 0.1,
        }
    },
    FindingKind.ROLLING_SHUTTER: {"value": 6.0, "std": 0.5, "p": 1e-9},
    FindingKind.ROLLING_SHUTTER_BY_IMAGE: {"value": 6.0, "p": 1e-9},
    FindingKind.THIN_PRISM: {"value": 6.0, "std": 0.5, "p": 1e-9},
    FindingKind.CENTRE_SAGS: {"value": 15.0, "std": 0.5, "p": 1e-9},
    FindingKind.FAR_FROM_GRIPPER: {"value": 0.8},
    FindingKind.POINTS_CROWDED: {"value": 0.01},
    FindingKind.ZOOM: {"value": 0.01, "std": 0.001, "p": 1e-9, "images": ("a.png", "b.png")},
    FindingKind.INTRINSICS: {
        "p": 1e-9,
        "details": INTRINSICS | {"fx_std": 0.1, "fy_std": 0.1, "cx_std": 0.1},
    },
    FindingKind.SLIP: {
        "value": 0.01,
        "p": 1e-9,
        "images": ("a.png", "b.png"),
        "details": SIZE | {"longer": "after", "count": 5.0},
    },
    FindingKind.BASE_MOVED: {
        "value": 0.01,
        "p": 1e-9,
        "images": ("a.png", "b.png"),
        "details": SIZE | {"longer": "after", "count": 5.0},
    },
    FindingKind.DRIFT: {"value": 0.01, "p": 1e-9, "details": SIZE},
    FindingKind.DELAY: {"value": 0.41, "std": 0.03, "p": 1e-9, "details": {"unit": "interval"}},
    FindingKind.WRONG_MOUNT: {"details": {"camera": "overhead"}},
    FindingKind.JOINT_OFFSETS: {
        "joints": (2,),
        "p": 1e-9,
        "details": {"joint_2": 0.01, "joint_2_std": 0.001},
    },
    FindingKind.LENGTHS: {"value": 0.02, "std": 0.002, "p": 1e-9, "details": AT | {"frame": "base"}},
    FindingKind.IMAGES_ROTATED: {"value": 6.0, "details": {"rotated": "rotated by 90°"}},
    FindingKind.BOARD_IN_VIEW: {"details": {"board": "chessboard:9x6:SIDE"}},
    FindingKind.SCALES: {"value": 0.03, "std": 0.005, "details": {"one": "board", "other": "known length"}},
    FindingKind.BOARD_SIDE: {"value": 0.0254, "std": 5e-5, "details": {"board": "chessboard:9x6:SIDE"}},
    FindingKind.BOARD_MOVED: {"images": ("03.png",), "details": {"board": "chessboard:9x6:0.025"}},
    FindingKind.BOARD_STRETCHED: {"value": 0.01, "details": {"board": "chessboard:9x6:0.025"}},
    FindingKind.BOARD_NOT_FOUND: {
        "details": {"board": "chessboard:9x6:0.025", "proposed": "aruco:SIDE:DICT_4X4_50"}
    },
    FindingKind.OWN_REJECTED: {"details": {"camera": "wrist"}},
    FindingKind.FEW_POINTS_SHARED: {"value": 3.0, "images": ("a.png",)},
    FindingKind.FEW_LOCALISED: {"value": 2.0, "details": {"needed": 3.0}},
    FindingKind.SECOND_ON_ARM: {"details": {"arm": "right"}},
    FindingKind.ONE_GRIPPER_POSE: {"images": ("a.png",)},
    FindingKind.NOT_FIXED: {"value": 0.1, "images": ("a.png", "b.png"), "details": SIZE},
    FindingKind.NOT_RIGID: {"value": 0.1, "details": {"camera": "wrist"}},
    FindingKind.IMAGE_MISSES: {"value": 9.0, "images": ("a.png",), "details": {"mount": "base"}},
    FindingKind.PLACE_UNCERTAIN: {
        "value": 0.1,
        "details": SIZE | {"focal_std": 0.1},
        "concerns": "intrinsics",
    },
    FindingKind.AT_ANOTHER_CAMERA: {"images": ("a.png",), "details": {"camera": "wrist"}},
    FindingKind.BLURRED: {"value": 14.0, "images": ("a.png", "b.png"), "details": {"of": 4.0}},
    FindingKind.REPETITIVE: {"value": 0.95},
    FindingKind.FEW_USED: {"value": 4.0, "details": {"of": 12.0}},
    FindingKind.PIECES: {"value": 5.0, "images": ("a.png",), "details": {"of": 12.0}},
    FindingKind.STATIC_IMAGES: {"value": 0.2, "details": SIZE},
    FindingKind.POSES_SWAPPED: {"images": ("a.png", "b.png")},
    FindingKind.POSE_CONTRADICTS_IMAGE: {"value": 0.1, "images": ("a.png",), "details": SIZE},
    FindingKind.NOT_REGISTERED: {"images": ("a.png",), "details": {"text": "matches no other image"}},
    FindingKind.CLOCK_JUMPS: {"value": 0.5, "images": ("a.png",)},
}
"""What a kind needs to be said; the others a value with its sigma and chance, or words of their own."""


def example(kind: FindingKind) -> Finding:
    plain = {"value": 0.01, "std": 0.001, "p": 1e-9, "details": {"text": "a thing is wrong", "remedy": ""}}
    return Finding(kind=kind, severity="warns", **EXAMPLES.get(kind, plain))


@pytest.fixture(scope="module")
def solved() -> HandEye:
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    return fit_hand_eye(problem.base_from_gripper, problem.recon_from_camera)


@pytest.mark.parametrize("kind", FindingKind)
def test_every_kind_has_words_of_one_line(kind: FindingKind):
    finding = example(kind)
    for words in (text(finding), sentence(finding)):
        assert words and "\n" not in words and "nan" not in words and not words.endswith(".")
    assert sentence(finding).startswith(text(finding)) and sentence(finding).endswith(remedy(finding))


@pytest.mark.parametrize("kind", FindingKind)
def test_what_a_kind_explains_are_kinds_and_its_group_has_a_title(kind: FindingKind):
    assert kind.row.group in GROUPS and {FindingKind(name) for name in kind.row.explains} <= set(FindingKind)
    assert kind not in kind.row.explains


def test_a_fault_that_is_too_much_rejects_and_comes_before_its_consequences(solved: HandEye):
    assert solved.verdict == "accepted"
    shift = (0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01)
    fault = replace(example(FindingKind.DELAY), concerns="poses", shift=shift)
    found = with_findings(solved, (fault,))
    assert [one.kind for one in found.findings] == [FindingKind.DELAY]  # and not that more images would help
    assert found.verdict == "rejected" and found.findings[0].severity == "rejects" and not found.converged
    small = with_findings(solved, (replace(fault, shift=(1e-4, *shift[1:6], 0.0)),))
    assert small.verdict == "accepted with warnings" and small.warnings == (sentence(fault),)
    # What else speaks against it comes after.
    uncertain = replace(example(FindingKind.UNCERTAIN), severity="rejects")
    found = with_findings(solved.with_findings(uncertain), (fault,))
    assert [one.kind for one in found.findings] == [FindingKind.DELAY, FindingKind.UNCERTAIN]


@pytest.mark.slow
def test_what_a_cause_explains_is_not_another_fault():
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    names = tuple(f"{k}.png" for k in range(12))
    pairs = PosePairs(
        source=Path("a"),
        images=names,
        base_from_gripper=problem.base_from_gripper[::-1],
        recon_from_camera=problem.recon_from_camera,
        is_metric=False,
    )
    content = calibration_of(pairs, pairs, calibrate_poses(pairs), {}, "0")
    assert content.findings[0].kind is FindingKind.POSE_CONVENTION and FindingKind.UNCERTAIN in {
        one.kind for one in content.findings
    }
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
    made = Reconstruction(
        image_index=np.arange(5),
        recon_from_camera=camera,
        intrinsics=Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480),
        tracks=Tracks(
            image=np.zeros(0, int),
            x_px=np.zeros((0, 2)),
            point=np.zeros(0, int),
            points_in_recon=np.zeros((0, 3)),
        ),
        backend="colmap",
    )
    capture = Capture(
        folder=Path(),
        images=tuple(f"{k}.png" for k in range(12)),
        base_from_gripper=gripper,
        image_size=(640, 480),
    )
    found = calibrate(capture, made)
    assert [one.kind for one in found.findings[:2]] == [FindingKind.FEW_USED, FindingKind.UNOBSERVABLE]
    assert found.findings[0].concerns == "reconstruction" and found.observability.advice == ("",)
    alone = replace(capture, images=capture.images[:5], base_from_gripper=gripper[:5])
    found = calibrate(alone, made)
    assert (
        found.findings[0].kind is FindingKind.UNOBSERVABLE
        and "tilt the wrist" in found.observability.advice[0]
    )


def test_findings_are_in_the_file_and_come_back(tmp_path: Path):
    problem = hand_eye_problem(np.random.default_rng(0), 12, robot_noise=(5e-4, 1e-3))
    names = tuple(f"{k}.png" for k in range(12))
    pairs = PosePairs(
        source=Path("a"),
        images=names,
        base_from_gripper=problem.base_from_gripper,
        recon_from_camera=problem.recon_from_camera,
        is_metric=False,
    )
    hand_eye = calibrate_poses(pairs).with_findings(*(example(kind) for kind in FindingKind))
    hand_eye = with_findings(
        hand_eye, (replace(example(FindingKind.SLIP), concerns="mount", shift=(1e-3,) * 7),)
    )
    content = calibration_of(pairs, pairs, hand_eye, {}, "0")
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(content.as_json()))
    written = json.loads(file.read_text())
    assert written["verdict"] == "accepted with warnings" and written["converged"]
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
    with pytest.raises(InputError, match="contradict one another"):
        read_calibration(file)
