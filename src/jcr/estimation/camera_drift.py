"""Random-walk errors of camera poses that were found one after the other, as visual odometry and SLAM find them.

Errors of the motion from one image to the next add up along the sequence: of position, of rotation, and of the scale.
The sizes of their growth are estimated with those of the robot's errors by restricted maximum likelihood, and the
evidence decides whether there are such errors (Laplace's method; Kass and Raftery, J. Am. Stat. Assoc. 90, 1995).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.estimation.equation import pose_by_pose
from jcr.estimation.pose_equations import pose_equations, reported_poses
from jcr.estimation.robot_noise import growth_scores, log_evidence, most_likely, solve_equations
from jcr.estimation.wrist import Start, pose_problem
from jcr.geometry import Poses, skew

FEWEST, MOST = 8, 50
"""Poses from which such errors are looked for, and poses that decide: of more, this many evenly along the sequence."""
SUSPICIOUS = 2.0
"""Standard deviations of the score test of a growth that make the evidence worth computing."""
CLEAR = 3.0
"""Gain of the log evidence from which such errors are adopted: odds of 20 to 1."""


def drift_covariance(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    fit: Start,
    used: Bool[ndarray, " n"],
    error_covariance: Float[ndarray, "s s"],
    noise_floor: tuple[float, float] | None,
) -> Float[ndarray, "s s"] | None:
    """Return the covariance of the steps of camera poses whose errors add up in their order; None where they do not.

    `fit` is the solution without such errors; poses that are not `used` take no part in the decision.
    """
    rows = np.flatnonzero(used)
    if len(rows) < FEWEST:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST)).round().astype(int))]
    walks = random_walks(recon_from_camera, fit[1])
    some = (6 * rows[:, None] + np.arange(6)).ravel()
    among = np.ix_(some, some)
    problem, state = pose_problem(
        base_from_gripper[rows],
        recon_from_camera[rows],
        fit,
        error_covariance=error_covariance[among],
        noise_floor=noise_floor,
    )
    by_camera = reported_poses(problem, state)[2]
    plain = pose_equations(problem, state, None).equations
    parts = [pose_by_pose(by_camera, pose_by_pose(by_camera, walk[among]).T) for walk in walks]
    before, size_information = most_likely(plain)
    if growth_scores(plain, before, parts).max() < SUSPICIOUS:
        return None
    best, found = log_evidence(plain, solve_equations(plain, before), size_information) + CLEAR, None
    for count in (2, 3):
        free = replace(plain, walks=tuple(parts[:count]))
        sizes, information = most_likely(free)
        evidence = log_evidence(free, solve_equations(free, sizes), information)
        if evidence > best:
            best, found = evidence, np.tensordot(free.variances(sizes)[3:], walks[:count], 1)
    return found


def random_walks(recon_from_camera: Poses, scale: float) -> list[Float[ndarray, "s s"]]:
    """Return covariances of the steps of cameras whose errors grow from one to the next, s = 6n.

    They grow by 1 m of position per image, 1 rad, and 1 of log scale; `scale` is in metres per unit.
    """
    n, position = len(recon_from_camera), recon_from_camera[:, :3, 3]
    later = np.tril(np.ones((n, n)))[:, 1:]
    by_position = np.zeros((n, 6, n - 1, 3))
    by_position[:, :3] = later[:, None, :, None] * np.eye(3)[None, :, None] / scale
    by_rotation = np.zeros((n, 6, n - 1, 3))
    lever = -skew(position[:, None] - position[None, 1:])
    by_rotation[:, :3] = np.swapaxes(later[..., None, None] * lever, 1, 2)
    by_rotation[:, 3:] = later[:, None, :, None] * np.eye(3)[None, :, None]
    by_scale = np.zeros((n, 6, n - 1))
    by_scale[:, :3] = (position[:, None] - position[None, :-1]).swapaxes(1, 2) * later[:, None]
    return [
        half @ half.T for half in (one.reshape(6 * n, -1) for one in (by_position, by_rotation, by_scale))
    ]
