"""The proposed pose shows the scene and is never proposed twice; its numbers, in an arm's notation, lead back to it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy import ndarray

from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.capture.controllers import CONVENTIONS, numbers_from_poses, poses_from_numbers
from jcr.estimation.arms import arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.geometry import apply, inverse, rotation_angle, rotation_exp, transform
from jcr.live.next_pose import AIMED, ELSEWHERE_M, joints_at, propose
from jcr.live.progress import Notation, Progress, next_lines
from jcr.live.robot import typed_poses
from jcr.records import Capture, NextPose, Uncertainty
from scenes import capture_of
from simulation.poses import looking_at

SCENE = np.array([0.5, 0.0, 0.1])
TILTED = transform(rotation_exp(np.array([0.6, 0.2, 0.0])), np.array([0.06, -0.03, 0.05]))
"""gripper_from_camera of a camera that looks 36° past the gripper's axis."""


def seen() -> tuple[Capture, Calibration]:
    """A capture of four views from one line, and the rejected calibration of it: rotations about one axis only."""
    rng = np.random.default_rng(0)
    facing = looking_at(SCENE + np.array([0.0, -0.3, 0.45]), SCENE, rng)
    about = [transform(rotation_exp(np.array([0.0, 0.0, angle])), SCENE) for angle in (-0.5, -0.2, 0.2, 0.5)]
    cameras = np.array([one @ transform(np.eye(3), -SCENE) @ facing for one in about])
    cameras[2, :3, 3] += 0.03
    poses = cameras @ inverse(TILTED)
    capture = capture_of(poses)
    return capture, solve_hand_eye(poses, cameras)


def next_pose(
    capture: Capture,
    registered: int = 4,
    hand_eye: Calibration | None = None,
    refused: tuple[ndarray, ...] = (),
) -> ndarray:
    return propose(capture, np.arange(registered), hand_eye, refused=refused)["next_pose"].base_from_gripper


def past_scene(base_from_gripper: ndarray) -> float:
    """The angle (rad) by which the camera looks past the scene."""
    x, y, z = apply(inverse(base_from_gripper @ TILTED), SCENE)
    return float(np.arctan2(np.hypot(x, y), z))


def rotations_deg(pose: ndarray, others: ndarray) -> ndarray:
    trace = np.einsum("nij,ij->n", others[:, :3, :3], pose[:3, :3])
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def test_a_rejected_calibration_that_knows_where_the_camera_looks_aims_the_next_image():
    capture, hand_eye = seen()
    assert not hand_eye.is_sound and not hand_eye.observability.observable
    # Of planar rotations the translation along their axis stays open; only the rotation is known here.
    aimed = replace(hand_eye, on_gripper=TILTED, uncertainty=Uncertainty(covariance=np.diag(7 * [1e-6])))
    assert past_scene(next_pose(capture, hand_eye=aimed)) < np.radians(8)
    covariance = np.diag([*3 * [AIMED[0] ** 2], *3 * [0.1], 1e-6])
    unknown = replace(aimed, uncertainty=Uncertainty(covariance=covariance))
    assert np.array_equal(next_pose(capture, hand_eye=unknown), next_pose(capture))


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_each_refused_pose_is_followed_by_one_elsewhere_that_is_rotated_little(is_calibrated: bool):
    capture, hand_eye = seen()
    aimed = replace(hand_eye, on_gripper=TILTED, uncertainty=Uncertainty(covariance=np.diag(7 * [1e-6])))
    refused: tuple[ndarray, ...] = ()
    for _ in range(3):
        new = next_pose(capture, 4, aimed if is_calibrated else None, refused)
        between = [np.linalg.norm((new @ TILTED)[:3, 3] - (old @ TILTED)[:3, 3]) for old in refused]
        assert all(metres > 0.5 * ELSEWHERE_M for metres in between)
        assert not refused or rotations_deg(new, capture.base_from_gripper).min() < 25
        refused = (*refused, new)


def test_a_pose_is_rotated_from_every_image_and_away_from_one_that_did_not_register():
    capture, _ = seen()
    new = next_pose(capture)
    assert rotations_deg(new, capture.base_from_gripper).min() > 15
    images, poses = (*capture.images, "4.png"), np.concatenate([capture.base_from_gripper, new[None]])
    more = replace(capture, images=images, base_from_gripper=poses)
    # An image more at such a pose does not use up what is advised.
    assert rotations_deg(next_pose(more, 5), poses).min() > 15
    assert np.linalg.norm(next_pose(more, 4)[:3, 3] - new[:3, 3]) > 0.99 * ELSEWHERE_M


POSES = transform(
    rotation_exp(np.random.default_rng(0).normal(size=(6, 3))),
    np.random.default_rng(1).uniform(0.2, 0.6, (6, 3)),
)


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("units", ["auto", "mm-deg", "m-rad"])
def test_numbers_of_poses_lead_back(convention: str, units: str):
    numbers = numbers_from_poses(POSES, convention, units)
    assert numbers.shape == (6, len(CONVENTIONS[convention].columns))
    assert np.allclose(poses_from_numbers(numbers, convention, units, "here"), POSES, atol=1e-12)


def test_a_ur_is_named_what_its_pendant_shows_and_a_line_to_run():
    sizes = {"within_95_mm": 1.0, "rotation_95_deg": 0.1, "moved_m": 0.1, "rotation_rad": 0.5}
    new = NextPose(base_from_gripper=POSES[0], expected_std=np.ones(7), like="images/000.png", **sizes)
    about, shown, line = next_lines(Progress(images=(), next_pose=new), Notation("ur"))
    assert about.startswith("100 mm and 29° from images/000.png")
    numbers = [float(text) for text in re.findall(r"-?\d+\.\d+", line.split("]")[0])]
    back = poses_from_numbers(np.array([numbers]), "ur", "auto", "here")[0]
    assert line.startswith("URScript: movel(p[") and np.allclose(back, POSES[0], atol=1e-5)
    assert f"x {1e3 * POSES[0, 0, 3]:.1f}" in shown and "mm" in shown and "rad" in shown


def test_typed_poses_follow_the_pendant():
    numbers = numbers_from_poses(POSES[:1], "kuka")[0]
    said: list[str] = []
    lines = iter([" ".join(f"{value:.4f}" for value in numbers), "0.4 0 0.5 0 0 0", ""])
    (pose,) = typed_poses(lines, said.append, "kuka")
    assert np.allclose(pose, POSES[0], atol=1e-5)
    assert "x y z a b c; mm, deg" in said[0]
    # Metres, typed where the pendant shows millimetres.
    assert any("too near for this convention's millimetres" in text for text in said)


def test_joint_angles_reach_the_pose_in_the_branch_that_the_arm_is_in():
    arm = arm_named("ur5e")
    tool = transform(rotation_exp(np.array([0.0, 0.0, 0.4])), np.array([0.0, 0.02, 0.15]))
    joints = arm.rest + np.random.default_rng(2).uniform(-0.3, 0.3, (4, 6))
    poses = forward_kinematics(arm, joints) @ tool
    found = joints_at(arm, poses[:3], joints[:3], poses[3])
    assert found is not None and np.allclose(found, joints[3], atol=1e-3)
    far = poses[3].copy()
    far[0, 3] += 2.0
    assert joints_at(arm, poses[:3], joints[:3], far) is None
    # Without recorded angles, and the poses those of the flange.
    unrecorded = joints_at(arm, poses[:3] @ inverse(tool), None, poses[3] @ inverse(tool))
    assert unrecorded is not None
    off = inverse(forward_kinematics(arm, unrecorded[None]) @ tool) @ poses[3:]
    assert np.linalg.norm(off[0, :3, 3]) < 1e-4 and rotation_angle(off[:, :3, :3])[0] < 1e-3
