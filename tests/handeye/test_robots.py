"""Arms against other published forms, error Jacobians against finite differences, and inverse kinematics."""

import numpy as np
import pytest

from jcr.geometry import rotation_angle, rotation_log
from jcr.handeye.arms import arm_named
from jcr.handeye.inverse_kinematics import inverse_kinematics
from jcr.handeye.robots import (
    ErrorSizes,
    bent_kinematics,
    error_jacobian,
    error_names,
    error_std,
    forward_kinematics,
)

ALL = ("joint", "link", "sag", "gear")


def postures(arm, count, seed=0, spread=0.6):
    rng = np.random.default_rng(seed)
    return np.clip(arm.rest + spread * rng.normal(size=(count, arm.dof)), *arm.limits.T)


@pytest.mark.parametrize("name", ["ur5e", "panda"])
def test_error_jacobian_is_the_derivative_of_the_bent_arm(name):
    arm = arm_named(name)
    joints = postures(arm, 10)
    reported = forward_kinematics(arm, joints)
    jacobian = error_jacobian(arm, joints, ALL)
    names, std = error_names(arm, ALL), error_std(arm, ErrorSizes(1.0, 1.0, 1.0, 1.0), ALL)
    assert jacobian.shape == (10, 6, len(names)) and len(names) == len(std) == 8 * arm.dof
    step = 1e-6
    for k in range(len(names)):
        error = np.zeros(len(names))
        error[k] = step
        ends = [bent_kinematics(arm, joints, sign * error, ALL) for sign in (1, -1)]
        position = (ends[0] - ends[1])[:, :3, 3]
        # R_true = R_reported · exp(δ), as in equation.residuals.
        turn = [rotation_log(np.swapaxes(reported[:, :3, :3], 1, 2) @ end[:, :3, :3]) for end in ends]
        numeric = np.concatenate([position, turn[0] - turn[1]], axis=1) / (2 * step)
        np.testing.assert_allclose(jacobian[:, :, k], numeric, atol=2e-9, err_msg=names[k])


@pytest.mark.parametrize("name", ["ur3e", "ur5e", "ur10e", "panda", "fr3"])
def test_angles_are_found_again(name):
    arm = arm_named(name)
    joints = postures(arm, 12)
    poses = forward_kinematics(arm, joints)
    found = inverse_kinematics(arm, poses)
    assert found.fits
    np.testing.assert_allclose(forward_kinematics(arm, found.joints), poses, atol=1e-6)
    assert (found.joints >= arm.limits[:, 0]).all() and (found.joints <= arm.limits[:, 1]).all()
    if arm.dof == 6:
        assert (np.abs(found.joints - joints).max(1) < 1e-4).mean() > 0.8
    assert rotation_angle(poses[0, :3, :3].T @ poses[1, :3, :3]) > 0.1
