"""Which joints of an arm seem off: the systematic part of the residuals, separated by the arm's own geometry."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.components import most_likely
from jcr.estimation.equation import Poses
from jcr.estimation.kinematics import Arm, Joints, error_jacobian
from jcr.estimation.mixed_model import solve_equations
from jcr.estimation.pose_equations import PoseEquations, pose_equations
from jcr.estimation.wrist import pose_problem
from jcr.records import HandEye, JointOffsets

Systematic = Float[ndarray, "s s"]
"""Covariance of the systematic errors of the used poses at 1 rad."""


def joint_offsets(
    solved: HandEye,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    systematic: Systematic,
    arm: Arm,
    joints: Joints,
) -> JointOffsets:
    """By how much each joint is off (rad), true angle less reported one, and how surely; from the used poses.

    Best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at the sizes of the errors that the
    fit found. What no pose shows, as an offset of the first joint, keeps the standard deviation of any joint.
    """
    linear = _linearised(solved, base_from_gripper, recon_from_camera, systematic)
    sizes = most_likely(linear.equations)[0]
    solution = solve_equations(linear.equations, sizes)
    size = float(np.sqrt(linear.equations.variances(sizes)[2]))
    columns = error_jacobian(arm, joints)[:, :, : arm.dof].reshape(-1, arm.dof)
    columns = columns - linear.region.by_unknown @ (linear.region.fit @ columns)
    offset = size**2 * columns.T @ solution.weighed_left
    known = np.diag(columns.T @ solution.projection @ columns)
    return JointOffsets(offset, size * np.sqrt(np.maximum(1 - size**2 * known, 0.0)), size)


def _linearised(
    solved: HandEye, base_from_gripper: Poses, recon_from_camera: Poses, systematic: Systematic
) -> PoseEquations:
    start = solved.gripper_from_camera, solved.scale, solved.base_from_recon
    problem, state = pose_problem(
        base_from_gripper,
        recon_from_camera,
        start,
        error_covariance=systematic,
        noise_floor=solved.robot_noise.given,
    )
    return pose_equations(problem, state, None)
