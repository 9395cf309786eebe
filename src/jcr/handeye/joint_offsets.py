"""Which joints of an arm seem off: the systematic part of the residuals, separated by the arm's own geometry."""

import numpy as np
from scipy.linalg import cho_solve

from jcr.distributions import chi2
from jcr.handeye.components import Equations, most_likely, restricted_log_likelihood, solve
from jcr.handeye.equation import PRIOR_STD, Poses, residuals
from jcr.handeye.robots import Arm, Joints, error_jacobian
from jcr.handeye.systematic import Region
from jcr.records import HandEye, JointOffsets


def systematic_p_value(
    solved: HandEye, base_from_gripper: Poses, recon_from_camera: Poses, systematic: np.ndarray
) -> float:
    """Chance of residuals like these where errors are random alone, from the used poses of a fit to poses.

    A likelihood ratio of the size of the systematic part, which is not negative: half the tail of χ²(1) (Self and Liang,
    J. Am. Stat. Assoc. 82, 1987). `systematic` is the covariance (6n,6n) of the systematic errors of these poses.
    """
    both = _equations(solved, base_from_gripper, recon_from_camera, systematic)[0]
    random = _equations(solved, base_from_gripper, recon_from_camera, None)[0]
    likely = [restricted_log_likelihood(equations, most_likely(equations)[0]) for equations in (both, random)]
    return float(chi2.sf(max(2 * (likely[0] - likely[1]), 0.0), 1) / 2)


def joint_offsets(
    solved: HandEye,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    systematic: np.ndarray,
    arm: Arm,
    joints: Joints,
) -> JointOffsets:
    """By how much each joint is off (rad), true angle less reported one, and how surely; from the used poses.

    Best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at the sizes of the errors that the
    fit found. What no pose shows, as an offset of the first joint, keeps the standard deviation of any joint.
    """
    equations, region = _equations(solved, base_from_gripper, recon_from_camera, systematic)
    sizes = most_likely(equations)[0]
    solution = solve(equations, sizes)
    size = float(np.sqrt(equations.variances(sizes)[2]))
    columns = error_jacobian(arm, joints, ("joint",)).reshape(-1, arm.dof)
    columns = columns - region.by_unknown @ (region.fit @ columns)
    inverse = cho_solve((solution.root, True), np.eye(len(columns)))
    projection = inverse - solution.weighed @ solution.gain
    offset = size**2 * columns.T @ (projection @ equations.residual)
    known = np.diag(columns.T @ projection @ columns)
    std = size * np.sqrt(np.maximum(1 - size**2 * known, 0.0))
    return JointOffsets(offset, std, size)


def _equations(
    solved: HandEye, base_from_gripper: Poses, recon_from_camera: Poses, systematic: np.ndarray | None
) -> tuple[Equations, Region]:
    residual, jacobian = residuals(
        solved.gripper_from_camera, solved.scale, solved.base_from_recon, base_from_gripper, recon_from_camera
    )
    stacked = jacobian.reshape(-1, 13)
    region = Region.of_poses(stacked)
    equations = Equations(
        residual.ravel(),
        stacked,
        np.diag(np.r_[PRIOR_STD**-2.0, np.zeros(6)]),
        np.zeros(13),
        None,
        None if systematic is None else region.left(systematic),
        solved.robot_noise.given,
    )
    return equations, region
