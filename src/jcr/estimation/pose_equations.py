"""Linear mixed model of the reported poses of all arms about a state, with the evidence of images about the rigs."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.estimation.equation import SCALE, pose_by_pose, residuals, residuals_by_camera, weak_prior
from jcr.estimation.image_equations import ImageEvidence
from jcr.estimation.problem import Problem, State, columns_of_arm
from jcr.estimation.robot_noise import Equations
from jcr.estimation.systematic import Region


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseEquations:
    """Equations of all reported poses about a state, and the mixed model of those that are used."""

    residual: Float[ndarray, "n 6"]
    """Steps from the reported to the predicted gripper poses, at the mean of the rigs."""
    jacobian: Float[ndarray, "s p"]
    shared: Float[ndarray, "s s"] | None
    """Covariance of the residuals by the rigs; None where the rigs are exact."""
    systematic: Float[ndarray, "s s"]
    """Covariance of the systematic residuals where the size of systematic errors is 1 rad."""
    region: Region
    """Effective transform of the used poses."""
    used: Bool[ndarray, " n"]
    equations: Equations


def reported_poses(
    problem: Problem, state: State
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 u"], Float[ndarray, "n 6 6"]]:
    """Return the residuals of all reported poses, and their derivatives by the arms' unknowns and by their rigs."""
    each, begin = [], 0
    jacobian = np.zeros((sum(len(arm.rigs) for arm in problem.arms), 6, problem.arm_unknowns))
    for k, arm in enumerate(problem.arms):
        at, rigs = (state.x[k], state.scale, state.z[k]), state.world_from_rig[arm.rigs]
        exchanged = arm.carries == "scene"
        residual, by_unknown = residuals(*at, arm.base_from_gripper, rigs, exchanged)
        # X, then the scale that all arms share, then Z.
        jacobian[begin : begin + len(rigs), :, np.insert(columns_of_arm(k), 6, SCALE.start)] = by_unknown
        each.append((residual, residuals_by_camera(*at, rigs, exchanged)))
        begin += len(rigs)
    residual, by_rig = (np.concatenate(part) for part in zip(*each, strict=True))
    return residual, jacobian, by_rig


def pose_equations(problem: Problem, state: State, images: ImageEvidence | None) -> PoseEquations:
    """Return the equations of the reported poses about a state, with the evidence of the images about the rigs.

    Without observations the rigs are where `Problem.known_rigs` has them, with that covariance.
    """
    residual, by_arms, by_rig = reported_poses(problem, state)
    n, arms, free = len(residual), problem.arm_unknowns, problem.free
    used = np.ones(n, bool) if problem.used is None else problem.used
    rows = np.flatnonzero(np.repeat(used, 6))
    jacobian = by_arms.reshape(6 * n, arms)
    information, gradient = np.zeros((problem.unknowns, problem.unknowns)), np.zeros(problem.unknowns)
    information[:arms, :arms] = weak_prior(len(problem.arms))
    for row, value, std in problem.priors:
        information += np.outer(row, row) / std**2
        gradient += row * (row @ problem.coordinates(state) - value) / std**2
    if images is None:
        assert problem.known_rigs is not None
        covariance = problem.known_rigs.covariance
    else:
        follow, step, covariance = images.rigs
        coupling = images.information[np.ix_(problem.by_arm, free)]
        residual = residual - pose_by_pose(by_rig, step[:, None]).reshape(n, 6)
        jacobian = np.concatenate([jacobian, -pose_by_pose(by_rig, follow)], axis=1)
        of_free = images.information[np.ix_(free, free)] - coupling.T @ follow
        information[arms:, arms:] += (of_free + of_free.T) / 2
        gradient[arms:] += images.gradient[free] - coupling.T @ step
    shared = None
    if covariance is not None:
        shared = pose_by_pose(by_rig, pose_by_pose(by_rig, covariance).T)
        shared = (shared + shared.T) / 2
    by_unknown = np.delete(by_arms.reshape(6 * n, arms), SCALE, axis=1)
    region = Region.of_unknowns(by_unknown[rows], jacobian.shape[1])
    fit = np.zeros((by_unknown.shape[1], 6 * n))
    fit[:, rows] = region.fit
    everywhere = replace(region, by_unknown=by_unknown, fit=fit)
    systematic = everywhere.left(np.asarray(block_diag(*(arm.error_covariance for arm in problem.arms))))
    among = np.ix_(rows, rows)
    confirmed = (
        np.zeros((6 * len(arm.rigs), 0)) if arm.confirmed_errors is None else arm.confirmed_errors
        for arm in problem.arms
    )
    columns = np.asarray(block_diag(*confirmed))[rows]
    return PoseEquations(
        residual=residual,
        jacobian=jacobian,
        shared=shared,
        systematic=systematic,
        region=region,
        used=used,
        equations=Equations(
            residual=residual.ravel()[rows],
            jacobian=jacobian[rows],
            prior_information=information,
            prior_gradient=gradient,
            known=None if shared is None else shared[among],
            systematic=systematic[among],
            given=problem.robot_noise_floor,
            confirmed=region.left(columns @ columns.T) if columns.size else None,
        ),
    )
