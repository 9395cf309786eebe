"""What `jcr check` names before heavy work: a camera at rest, poses that were exchanged, images that show nothing."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jcr
from jcr.calibration.checks.images import view_findings
from jcr.calibration.checks.unused_images import left_out_poses
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.capture.images import BLURRED_EDGE, edge_width, encode_png, read_image
from jcr.cli import dispatch
from jcr.findings import FindingKind, warnings_of
from jcr.geometry import inverse, step_between
from jcr.pipeline.check import check_capture
from jcr.records import Intrinsics
from places import SHARED
from scenes import capture_of, reconstruction_of
from simulation.problems import hand_eye_problem

RNG = np.random.default_rng(0)


def test_a_camera_at_rest_is_named_before_anything_is_matched(small_capture: Path, tmp_path: Path, capsys):
    folder = shutil.copytree(small_capture, tmp_path / "still")
    one = read_image(folder / "images/00.jpg").astype(float)
    for file in (folder / "images").iterdir():
        file.write_bytes(encode_png(np.clip(one + RNG.normal(0, 6, one.shape), 0, 255).astype(np.uint8)))
    assert dispatch(["check", str(folder), "--json"]) == 3
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["verdict"] == "rejected" and "all images show the same view" in found["warnings"][0]
    assert not said.err


def test_blur_is_measured_by_the_image_itself(tabletop: Path):
    """Not against the other images, which may all be blurred; a plain wall with noise has no edges to judge by."""
    sharp = [read_image(tabletop / f"images/{k:02d}.jpg") for k in range(12)]
    assert max(edge_width(image) for image in sharp) < 0.6 * BLURRED_EDGE
    along = np.zeros((21, 21), np.float32)
    along[10] = 1 / 21
    for blurred in (cv2.GaussianBlur(sharp[0], (0, 0), 5), cv2.filter2D(sharp[0], -1, along)):
        assert edge_width(np.asarray(blurred, np.uint8)) > BLURRED_EDGE
    assert edge_width(RNG.normal(120, 4, sharp[0].shape).astype(np.uint8)) == 0.0
    assert edge_width(sharp[0][:16, :16]) == 0.0, "too small to be measured"
    few = np.full((480, 640, 3), 60, np.uint8)
    few[180:300, 220:400] = 200
    assert edge_width(few) < 0.6 * BLURRED_EDGE, "an image with few edges is not blurred"
    assert edge_width(cv2.GaussianBlur(few, (0, 0), 5)) > BLURRED_EDGE


def test_nothing_is_stated_of_an_undecided_reading(small_capture: Path, tmp_path: Path, capsys):
    poses = jcr.read_capture(small_capture).base_from_gripper
    shutil.copytree(small_capture / "images", tmp_path / "images")
    turned = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    np.savetxt(tmp_path / "p.csv", np.hstack([1e3 * poses[:, :3, 3], turned]), delimiter=",")
    assert dispatch(["check", str(tmp_path), "--poses-only"]) == 3
    said = capsys.readouterr().out
    assert said.startswith("NOT DECIDED") and "leave out --poses-only or name the reading" in said
    assert not any(word in said for word in ("Motion", "Expected", "1σ"))
    assert dispatch(["check", str(tmp_path), "--poses-only", "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "not checked" and found["expected_std"] is None and found["undecided"]


def test_a_motion_that_is_expected_to_miss_the_required_accuracy_is_not_accepted(small_capture: Path):
    capture = jcr.read_capture(small_capture)
    required = {"calibrate": {"require": (12.0, 1.0)}}
    few, all_of_them = (check_capture(capture.of_rows(range(n)), False, required) for n in (3, len(capture)))
    assert few.verdict == "accepted, but not as exact as needed" and few.expected is not None
    assert all_of_them.verdict == "accepted", all_of_them
    assert (
        check_capture(capture.of_rows(range(3)), False, {"calibrate": {"require": "none"}}).verdict
        == "accepted"
    )


def test_poses_that_were_exchanged_are_named():
    problem = hand_eye_problem(np.random.default_rng(1), 12, robot_noise=(2e-4, 5e-4))
    right = problem.base_from_gripper
    gripper = right.copy()
    gripper[[3, 8]] = gripper[[8, 3]]
    gripper[5, :3, 3] += 0.08
    capture = capture_of(gripper)
    made = reconstruction_of(
        problem.recon_from_camera, intrinsics=Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)
    )
    hand_eye = solve_hand_eye(gripper, problem.recon_from_camera)
    assert hand_eye.converged and not hand_eye.inliers[[3, 5, 8]].any()
    found = left_out_poses(capture, made, hand_eye)
    assert [(one.kind, one.severity, one.images) for one in found] == [
        (FindingKind.POSES_SWAPPED, "rejects", ("3.png", "8.png")),
    ]
    of_right = solve_hand_eye(right, problem.recon_from_camera)
    images = [replace(one, used=k != 4) for k, one in enumerate(of_right.images)]
    of_right = replace(of_right, images=tuple(images))
    assert not left_out_poses(replace(capture, base_from_gripper=right), made, of_right)


@pytest.mark.slow
def test_each_pose_of_a_usual_capture_is_compared(half_capture: Path):
    """Eight of twelve images were looked at, so that a wrong pose of another one was not noticed."""
    capture = jcr.read_capture(half_capture)
    poses = capture.base_from_gripper.copy()
    poses[4, :3, :3] = poses[4, :3, :3] @ Rotation.from_euler("z", 20, degrees=True).as_matrix()
    found = check_capture(replace(capture, base_from_gripper=poses))
    assert found.calibration is not None
    assert "20° from where the other images put it" in (found.calibration.images[4].reason or "")
    assert 4 not in found.counted and len(found.counted) == len(capture) - 1


@pytest.mark.skipif(not (SHARED / "data").is_dir(), reason="the real captures are not here")
@pytest.mark.long
def test_check_names_the_remedy_the_board_and_the_images_that_a_run_names():
    """The systematic robot error was named; a few more images are enough."""
    found = check_capture(SHARED / "data/realman_carpet")
    (missed,) = [one for one in found.findings if one.kind is FindingKind.NOT_EXACT_ENOUGH]
    assert missed.concerns == "images" and "add 3 more" in missed.remedy, missed.remedy
    assert "not as exact as needed, 20 images, a point within" in repr(found)
    (board,) = [one for one in found.findings if one.kind is FindingKind.BOARD_IN_VIEW]
    assert "--board chessboard:11x8:SIDE" in board.remedy
    plain = check_capture(SHARED / "data/franka_plain_background")
    assert "as exact as needed, 8 images" in repr(plain), (
        "SIFT registers no image; a run finds learned features"
    )
    belt = check_capture(SHARED / "attacks/scene_belt")
    assert any("objects seem to have moved" in one for one in warnings_of(belt.findings))
    found = check_capture(SHARED / "data/ur_snack_table")
    assert not any("moved" in one for one in warnings_of(found.findings))
    assert found.calibration is not None, "at 800 px image_8 seemed to be wrong"
    assert [one.image for one in found.calibration.images if not one.used] == ["images/image_7.jpg"]


@pytest.mark.slow
def test_a_fixed_camera_is_checked_by_what_moves_with_the_gripper(half_capture: Path):
    """Its images were called all the same, or the check ended in an error. A table in the gripper moves as a whole."""
    capture = jcr.read_capture(half_capture)
    fixed = replace(capture, mount="base", base_from_gripper=inverse(capture.base_from_gripper))
    found, of_wrist = check_capture(fixed), check_capture(capture)
    assert found.verdict == "accepted" and found.calibration is not None and of_wrist.calibration is not None
    apart = step_between(found.calibration.base_from_camera, of_wrist.calibration.gripper_from_camera)
    assert np.abs(apart[:3]).max() < 1e-3 and found.expected is found.calibration.uncertainty
    assert found.expected is not None and found.expected.seen is not None
    still = replace(fixed, images=fixed.images[:1] * 3, base_from_gripper=fixed.base_from_gripper[:3])
    assert not view_findings(still)
