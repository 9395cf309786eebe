"""Arms against other published forms, error Jacobians against finite differences, and inverse kinematics."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jcr.calibration.arm_of_capture import errors_of
from jcr.capture.urdf_chain import read_chain
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.estimation.inverse_kinematics import LengthError, inverse_kinematics, mounted_arm
from jcr.estimation.kinematics import error_jacobian, error_std, forward_kinematics, with_tool
from jcr.estimation.robot_noise import smooth_errors
from jcr.geometry import inverse, rotation_exp, step_between, transform
from refusal import refused
from simulation.arms import BentArm

Z = (0, 0, 1)

# Joint origins (x, y, z in m; roll, pitch, yaw in degrees) and axis (x or y; else z) as in the makers' URDF files, where
# arms.py has DH parameters; last the origin of the gripper frame.
URDF_TEXTS = {
    "ur3e": (
        "0 0 0.15185 0 0 0; 0 0 0 90 0 0; -0.24355 0 0 0 0 0; -0.2132 0 0.13105 0 0 0; 0 -0.08535 0 90 0 0; "
        "0 0.0921 0 90 180 180; 0 0 0 0 0 0"
    ),
    "ur5e": (
        "0 0 0.1625 0 0 0; 0 0 0 90 0 0; -0.425 0 0 0 0 0; -0.3922 0 0.1333 0 0 0; 0 -0.0997 0 90 0 0; "
        "0 0.0996 0 90 180 180; 0 0 0 0 0 0"
    ),
    "panda": (
        "0 0 0.333 0 0 0; 0 0 0 -90 0 0; 0 -0.316 0 90 0 0; 0.0825 0 0 90 0 0; -0.0825 0.384 0 -90 0 0; "
        "0 0 0 90 0 0; 0.088 0 0 90 0 0; 0 0 0.107 0 0 0"
    ),
    "iiwa7": (
        "0 0 0.15 0 0 0; 0 0 0.19 90 0 180; 0 0.21 0 90 0 180; 0 0 0.19 90 0 0; 0 0.21 0 -90 180 0; "
        "0 0.0607 0.19 90 0 0; 0 0.081 0.0607 -90 180 0; 0 0 0.045 180 180 180"
    ),
    "iiwa14": (
        "0 0 0.1575 0 0 0; 0 0 0.2025 90 0 180; 0 0.2045 0 90 0 180; 0 0 0.2155 90 0 0; 0 0.1845 0 -90 180 0; "
        "0 0 0.2155 90 0 0; 0 0.081 0 -90 180 0; 0 0 0.045 180 180 180"
    ),
    "z1": (
        "0 0 0.0585 0 0 0; 0 0 0.045 0 0 0 y; -0.35 0 0 0 0 0 y; 0.218 0 0.057 0 0 0 y; 0.07 0 0 0 0 0; "
        "0.0492 0 0 0 0 0 x; 0.051 0 0 0 0 0"
    ),
}
URDF_TEXTS["fr3"] = URDF_TEXTS["panda"]


def urdf_form(name):
    """Return the origin of each joint (m, rad) and its axis, None for the gripper frame."""
    rows = [row.split() for row in URDF_TEXTS[name].split(";")]
    axes = [dict(x=(1, 0, 0), y=(0, 1, 0)).get(row[-1], Z) for row in rows[:-1]]
    origins = [(*map(float, row[:3]), *np.radians(np.array(row[3:6], float))) for row in rows]
    return list(zip(origins, [*axes, None], strict=True))


# Body positions, quaternions (w, x, y, z) and joint axes of MuJoCo models: so101_new_calib.xml beside the URDF, and
# ur10e.xml of mujoco_menagerie, which rounds to millimetres and has a base of its own.
MUJOCO_FORMS = {
    "so101": [
        ((0.0388353, 0, 0.0624), (0, 0, -1, 0), Z),
        ((-0.0303992, -0.0182778, -0.0542), (0.5, -0.5, -0.5, -0.5), Z),
        ((-0.11257, -0.028, 0), (0.707107, 0, 0, 0.707107), Z),
        ((-0.1349, 0.0052, 0), (0.707107, 0, 0, -0.707107), Z),
        ((0, -0.0611, 0.0181), (0.0172091, -0.0172091, 0.706897, 0.706897), Z),
        # The site's quaternion has another roll than gripper_frame_link of the URDF: 180° about y there.
        ((-0.0079, -0.000218121, -0.0981274), (0, 0, 1, 0), None),
    ],
    "ur10e": [
        ((0, 0, 0.181), (1, 0, 0, 0), Z),
        ((0, 0.176, 0), (1, 0, 1, 0), (0, 1, 0)),
        ((0, -0.137, 0.613), (1, 0, 0, 0), (0, 1, 0)),
        ((0, 0, 0.571), (1, 0, 1, 0), (0, 1, 0)),
        ((0, 0.135, 0), (1, 0, 0, 0), Z),
        ((0, 0, 0.12), (1, 0, 0, 0), (0, 1, 0)),
        # Its site for tools lies at 0.1 m, before the flange, which is not checked here.
        ((0, 0.117, 0), (-1, 1, 0, 0), None),
    ],
}


def postures(arm, count, seed=0, spread=0.6):
    rng = np.random.default_rng(seed)
    return np.clip(arm.rest + spread * rng.normal(size=(count, arm.dof)), *arm.limits.T)


def urdf_text(form, limits):
    text = ['<robot name="r"><link name="base"/>']
    for k, (origin, axis) in enumerate(form):
        x, y, z, *rpy = origin
        kind = "fixed" if axis is None else "revolute"
        child, parent = f"l{k}", f"l{k - 1}" if k else "base"
        text.append(f'<link name="{child}"/><joint name="j{k}" type="{kind}">')
        text.append(f'<parent link="{parent}"/><child link="{child}"/>')
        text.append(f'<origin xyz="{x} {y} {z}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"/>')
        if axis is not None:
            text.append(f'<axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>')
            text.append(f'<limit lower="{limits[k][0]}" upper="{limits[k][1]}" effort="1" velocity="1"/>')
        text.append("</joint>")
    return "".join(text) + "</robot>"


@pytest.mark.parametrize("name", URDF_TEXTS)
def test_arm_agrees_with_its_urdf(name, tmp_path):
    import yourdfpy

    arm, form = arm_named(name), urdf_form(name)
    file = tmp_path / "arm.urdf"
    file.write_text(urdf_text(form, arm.limits))
    joints = postures(arm, 5, spread=1.0)
    urdf = yourdfpy.URDF.load(file, load_meshes=False)
    chain = read_chain(file, arm.dof)
    for row, pose in zip(joints, forward_kinematics(arm, joints), strict=True):
        urdf.update_cfg(row)
        np.testing.assert_allclose(urdf.get_transform(f"l{len(form) - 1}", "base"), pose, atol=1e-9)
    np.testing.assert_allclose(chain.limits, arm.limits)
    # Its gripper is the link behind the last joint that moves: what is fixed behind that is a tool.
    tool = inverse(forward_kinematics(chain, joints)) @ forward_kinematics(arm, joints)
    np.testing.assert_allclose(tool, np.broadcast_to(tool[0], tool.shape), atol=1e-9)


@pytest.mark.parametrize(("name", "atol"), [("so101", 5e-6), ("ur10e", 3e-3)])
def test_arm_agrees_with_its_mujoco_model(name, atol):
    arm = arm_named(name)
    joints = postures(arm, 5, spread=1.0)
    other = []
    for row in joints:
        pose, angles = np.eye(4), iter(row)
        for position, quat_wxyz, axis in MUJOCO_FORMS[name]:
            body = Rotation.from_quat(np.roll(quat_wxyz, -1)).as_matrix()
            rotation = np.zeros(3) if axis is None else next(angles) * np.array(axis, float)
            pose = pose @ transform(body @ rotation_exp(rotation), np.array(position, float))
        other.append(pose)
    poses = forward_kinematics(arm, joints)
    # Bases differ by a rotation about z at most.
    base = other[0] @ inverse(poses[0])
    np.testing.assert_allclose(base[[0, 1, 2, 2, 2], [3, 3, 3, 0, 1]], 0, atol=2 * atol)
    np.testing.assert_allclose(np.stack(other), base @ poses, atol=2 * atol)


@pytest.mark.parametrize("name", ["ur5e", "panda", "z1"])
def test_error_jacobian_is_the_derivative_of_the_bent_arm(name):
    rng = np.random.default_rng(1)
    tool = transform(rotation_exp(rng.normal(size=3)), 0.1 * rng.normal(size=3))
    arm = with_tool(arm_named(name), tool)
    joints = postures(arm, 10)
    reported = forward_kinematics(arm, joints)
    jacobian = error_jacobian(arm, joints)
    assert jacobian.shape == (10, 6, len(error_std(arm, 1.0, 1.0))) == (10, 6, 5 * arm.dof)
    step = 1e-6
    for k in range(jacobian.shape[2]):
        error = np.zeros(jacobian.shape[2])
        error[k] = step
        ends = [BentArm(arm, sign * error).true(joints) for sign in (1, -1)]
        there, back = (step_between(reported, end) for end in ends)
        numeric = (there - back) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=2e-9, err_msg=str(k))


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_angles_are_found_again(name):
    arm = arm_named(name)
    joints = postures(arm, 12, spread=0.4)
    poses = forward_kinematics(arm, joints)
    found = inverse_kinematics(arm, poses)
    assert found.fits
    np.testing.assert_allclose(forward_kinematics(arm, found.joints), poses, atol=1e-5)
    assert (found.joints >= arm.limits[:, 0]).all() and (found.joints <= arm.limits[:, 1]).all()
    if arm.dof <= 6:
        assert (np.abs(found.joints - joints).max(1) < 1e-3).mean() > 0.7


@pytest.mark.slow
def test_poses_of_another_arm_are_refused_in_one_line():
    large = arm_named("ur10e")
    poses = forward_kinematics(large, postures(large, 8, spread=0.3))
    with refused(r"poses do not fit a so101: \d+ mm, .*° off; name another robot"):
        errors_of(poses, arm_named("so101"))
    with refused("robot ur55: not known; did you mean ur5e[?]"):
        arm_named("ur55")
    with refused("robot arm.urdf: not known; .* another arm's urdf and joints in capture.json"):
        arm_named("arm.urdf")
    with refused("robot ur6: not known; choose one of ur3e, .*so101"):
        arm_named("ur6")


@pytest.mark.parametrize("name", ["ur5e", "panda", "so101"])
def test_base_and_tool_follow_from_joints_and_poses(name):
    arm = arm_named(name)
    joints = postures(arm, 8)
    rng = np.random.default_rng(2)
    base = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    tool = transform(rotation_exp(rng.normal(size=3)), 0.1 * rng.normal(size=3))
    poses = base @ forward_kinematics(arm, joints) @ tool
    np.testing.assert_allclose(forward_kinematics(mounted_arm(arm, joints, poses), joints), poses, atol=1e-9)
    # Two poses determine neither base nor tool, and still are explained.
    few = mounted_arm(arm, joints[:2], poses[:2])
    np.testing.assert_allclose(forward_kinematics(few, joints[:2]), poses[:2], atol=1e-9)
    with refused(f"joint angles and gripper poses disagree on a {name}"):
        mounted_arm(arm, joints[:, ::-1].copy(), poses)


@pytest.mark.parametrize("name", ["ur5e", "panda", "so101"])
def test_joint_angles_contradict_positions_that_are_all_too_long(name):
    """No image shows it, for the scale comes from the robot."""
    arm = arm_named(name)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        joints = postures(arm, 12, spread=0.3, seed=seed)
        # As a controller whose kinematics was calibrated at the factory: a few mm from the nominal arm.
        bent = forward_kinematics(arm, joints + rng.normal(0, 1e-3, joints.shape[1]))
        bent[:, :3, 3] += rng.normal(0, 5e-4, (12, 3))
        mounted_arm(arm, joints, bent)
        # The last are so far off that without the factor nothing agrees.
        said = [rf"[45]\.\d ± [01]\.\d % too {way} " for way in ("long", "short")]
        for factor, words in ((1.05, said[0]), (1 / 1.05, said[1]), (0.3048, ""), (1.25, ""), (2.54, "")):
            poses = bent.copy()
            poses[:, :3, 3] *= factor
            with pytest.raises(LengthError, match=f"{words}for a {name}"):
                mounted_arm(arm, joints, poses)


@pytest.mark.parametrize("about_one_axis", [True, False])
def test_smooth_errors_have_a_covariance_at_all_rotations(about_one_axis: bool):
    """With the angle of the rotation in place of its chord, eigenvalues were down to -0.010."""
    turns = np.linspace(0, 2 * np.pi, 60, endpoint=False)[:, None] * np.array([0.0, 0.6, 0.8])
    rotations = rotation_exp(turns)
    if not about_one_axis:
        rotations = Rotation.from_quat(np.random.default_rng(0).normal(size=(60, 4))).as_matrix()
    covariance = smooth_errors(transform(rotations, np.zeros((60, 3))))
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
    assert np.diag(covariance).reshape(60, 2, 3) == pytest.approx(np.tile([[0.45**2], [1.0]], (60, 1, 3)))
