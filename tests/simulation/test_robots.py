"""Bent arms: what they report, where they are, and the hand-eye transform that is asked for."""

import json

import numpy as np
import pytest

import jcr
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.estimation.pose_equations import fit_known_scale
from jcr.geometry import apply, inverse, rotation_angle, rotation_log
from simulation.arms import hand_eye_on, table_center, views
from simulation.capture import SimulateOptions, simulate
from simulation.problems import bent_problem
from simulation.truth import read_truth, true_depth, true_labels


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_every_arm_sees_its_table_from_varied_sides(name):
    arm, rng = arm_named(name), np.random.default_rng(5)
    gripper_from_camera = hand_eye_on(arm, rng)
    joints = views(arm, 30, gripper_from_camera, rng)
    assert joints.shape == (30, arm.dof)
    assert (joints >= arm.limits[:, 0]).all() and (joints <= arm.limits[:, 1]).all()
    cameras = forward_kinematics(arm, joints) @ gripper_from_camera
    target = table_center(arm)
    if arm.dof == 6 or arm.dof == 7:
        to_target = target - cameras[:, :3, 3]
        angle = np.arccos((to_target * cameras[:, :3, 2]).sum(1) / np.linalg.norm(to_target, axis=1))
        assert np.degrees(angle).max() < 25
    assert (cameras[:, 2, 3] > target[2] + 0.08).all() and (cameras[:, 2, 2] < -0.4).all()
    # Relative rotations about all axes: what a hand-eye calibration lives on.
    rotations = rotation_log(cameras[:1, :3, :3].swapaxes(1, 2) @ cameras[1:, :3, :3])
    assert np.linalg.svd(rotations, compute_uv=False)[2] / np.sqrt(len(rotations)) > np.radians(5)


@pytest.mark.slow
def test_effective_hand_eye_predicts_the_camera_better_than_the_physical_one():
    noise = (1e-3, 2e-3)
    better = []
    for seed in range(6):
        problem = bent_problem(arm_named("panda"), "poor", 8, seed, (0.0, 0.0))
        physical, others = problem.physical_gripper_from_camera, np.random.default_rng(99)
        joints = np.concatenate([views(problem.bent.arm, 8, physical, others) for _ in range(8)])
        reported = problem.bent.reported(joints)
        cameras = problem.bent.true(joints) @ problem.physical_gripper_from_camera
        costs = []
        for x in (problem.gripper_from_camera, problem.physical_gripper_from_camera):
            # The base that suits each; then what is left.
            base = fit_known_scale(cameras, reported @ x, (np.eye(4), np.eye(4)), noise).base_from_recon
            gap = inverse(base @ reported @ x) @ cameras
            rotated = rotation_angle(gap[:, :3, :3])
            costs.append(((gap[:, :3, 3] / 1e-3) ** 2).sum() + ((rotated / 2e-3) ** 2).sum())
        better.append(costs[0] <= costs[1] * 1.001)
    assert all(better)


@pytest.mark.gl
@pytest.mark.usefixtures("opengl")
def test_a_capture_of_a_bent_arm(tmp_path):
    options = SimulateOptions(
        images=4,
        seed=3,
        robot="z1",
        joint_offsets=0.3,
        link_errors=1.0,
        sag=0.2,
        gear_errors=0.1,
        intrinsics_error=0.5,
    )
    folder = simulate(tmp_path / "bent", options)
    capture, truth = jcr.read_capture(folder), read_truth(folder)
    reference = json.loads((folder / "reference.json").read_text())
    arm = arm_named("z1")
    assert capture.robot == "z1" and capture.joints is not None
    np.testing.assert_allclose(forward_kinematics(arm, capture.joints), capture.base_from_gripper, atol=1e-9)
    assert {"joint 3", "link 2 tilt 1", "joint 4 sag", "joint 5 gear sine"} <= reference["errors"].keys()
    # The images are taken from where the bent arm is: the table's depth lies on the table.
    physical = np.array(reference["physical_gripper_from_camera"])
    np.testing.assert_allclose(truth.base_from_camera, truth.base_from_gripper @ physical, atol=1e-12)
    off = np.linalg.norm((truth.base_from_gripper - capture.base_from_gripper)[:, :3, 3], axis=1)
    assert 2e-4 < off.mean() < 0.02
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    camera = truth.intrinsics
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(x.shape)], -1)
    points = apply(truth.base_from_camera[0], true_depth(truth, 0)[..., None] * rays)
    table = points[true_labels(truth, 0) == 1]
    assert len(table) > 1000
    np.testing.assert_allclose(table[:, 2], truth.table_height, atol=2e-4)
    # What is asked for is neither where the camera is bolted, nor the true intrinsics.
    effective = np.array(reference["gripper_from_camera"])
    assert 1e-5 < np.abs(effective - physical).max() < 0.05
    assert capture.intrinsics is not None and capture.intrinsics.fx != camera.fx
    assert abs(capture.intrinsics.fx / camera.fx - 1) < 0.02 and capture.intrinsics.cx != camera.cx
