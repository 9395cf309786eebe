"""Poses in the notation of an arm: the written numbers lead back to the pose."""

import re

import numpy as np
import pytest

from jcr.capture.controllers import CONVENTIONS, numbers_from_poses, poses_from_numbers
from jcr.estimation.arms import arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.geometry import inverse, rotation_angle, rotation_exp, transform
from jcr.live.next_pose import joints_at
from jcr.live.progress import Notation, pose_lines
from jcr.live.robot import typed_poses

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
    shown, line = pose_lines(POSES[0], Notation("ur"))
    numbers = [float(text) for text in re.findall(r"-?\d+\.\d+", line.split("]")[0])]
    back = poses_from_numbers(np.array([numbers]), "ur", "auto", "here")[0]
    assert line.startswith("URScript: movel(p[") and np.allclose(back, POSES[0], atol=1e-5)
    assert f"x {1e3 * POSES[0, 0, 3]:.1f}" in shown and "mm" in shown and "rad" in shown


def test_a_franka_is_named_columns_and_others_by_name():
    (line,) = pose_lines(POSES[0], Notation("franka"))
    numbers = np.array([float(text) for text in re.findall(r"-?\d+\.\d+", line)])
    assert np.allclose(numbers.reshape(4, 4).T, POSES[0], atol=1e-5)
    (line,) = pose_lines(POSES[0], Notation("kuka"))
    assert re.search(r"x \d+\.\d y \d+\.\d z \d+\.\d mm, a -?\d+\.\d+ b -?\d+\.\d+ c -?\d+\.\d+ °", line)


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
