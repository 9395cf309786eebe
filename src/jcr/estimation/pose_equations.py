"""Equations of reported gripper poses, and their linear mixed model with the evidence of images about the rigs.

Each image gives `base_from_gripper · X = Z · S_λ(world_from_rig)`. The first 13 unknowns are steps
(geometry.retract): of X (6), of log λ (1), of Z (6). Each further arm adds 12.
The *effective* hand-eye transform (X, Z) predicts the camera from the reported poses with the least squared error over
the workspace of the capture; 1 mm and 2 mrad weigh the same. It absorbs part of a systematic error e of the poses and
leaves e' = (I − J A) e, A = (JᵀWJ)⁻¹JᵀW.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.estimation.image_equations import ImageEvidence
from jcr.estimation.problem import (
    BASE_ROTATION,
    BASE_TRANSLATION,
    ROTATION,
    SCALE,
    TRANSLATION,
    UNKNOWNS,
    Problem,
    State,
    columns_of_arm,
)
from jcr.estimation.robot_noise import Equations, LinearSolution
from jcr.geometry import (
    Poses,
    Transform,
    Transforms,
    by_inverse,
    inverse,
    retract,
    scale_translation,
    skew,
    step_between,
)
from jcr.least_squares import minimise

EFFECTIVE_WEIGHT = np.repeat([1 / 1e-3, 1 / 2e-3], 3)
"""Weights (1/m, 1/rad) of position and rotation errors in the fit of the effective hand-eye transform."""
LEAST_FREE = 0.4
"""Lower bound of one minus the leverage of a pose; with three or four images the leverage is nearly 1."""


@dataclass(frozen=True)
class Region:
    """Linear fit of the effective hand-eye transform to n pose errors (s = 6n numbers).

    The effective transform is the gripper_from_camera X and base_from_recon Z that fit best in spite of systematic
    robot errors; the scale is not fitted.
    """

    basis: Float[ndarray, "s r"]
    """B: residuals (m, then rad, pose by pose) of the r independent changes of X and Z, orthonormal when weighted."""
    coordinates: Float[ndarray, "r s"]
    """C: those r coordinates of the fit to an error of the poses, so that J A = B C; zero for unused poses.

    J is the derivative of the residuals by the u unknowns X and Z, 12 for each arm. Motions that hardly determine an
    unknown give a large A, whose rounding errors the products B C do not have.
    """
    fit: Float[ndarray, "u s"]
    """A = (JᵀWJ)⁻¹JᵀW: change of X and Z per error of the poses, W being EFFECTIVE_WEIGHT²; zero for unused poses."""
    unknowns: int
    """Number p of all unknowns of the problem, which begin with X, log λ and Z."""

    def left(self, systematic: Float[ndarray, "s s"]) -> Float[ndarray, "s s"]:
        """Return the covariance of (I − J A) e, the part of a systematic error e that X and Z do not absorb.

        `systematic` (s,s) is the covariance of e; J A e is the change of the residuals by the change A e of X and Z.
        """
        # (I − J A) S (I − J A)ᵀ = S − J M − (J M)ᵀ, without a product of two matrices of the residuals' size.
        shift = self.coordinates @ systematic
        shift -= (shift @ self.coordinates.T / 2) @ self.basis.T
        left = np.hstack([self.basis, shift.T]) @ np.vstack([shift, self.basis.T])
        return np.subtract(systematic, left, out=left)

    def spread(self, second_moment: Float[ndarray, "*k m 6 6"]) -> Float[ndarray, "*k p p"]:
        """Return the covariance of all p unknowns that is due to the choice of the m poses; 0 except for X and Z.

        The poses are a sample of the workspace; other poses would give another effective transform. `second_moment` is
        E[e'e'ᵀ] (m,6,6) of the error e' of each pose that X and Z do not absorb (m, then rad). It is corrected for each
        pose's leverage (MacKinnon and White, J. Econometrics 29, 1985, "HC3").
        """
        m, (r, u) = second_moment.shape[-3], (len(self.coordinates), len(self.fit))
        own, coordinates = (one.reshape(-1, m, 6).swapaxes(0, 1) for one in (self.fit, self.coordinates))
        # The derivative of X and Z by each pose's residual is divided by one minus the pose's leverage.
        leverage = EFFECTIVE_WEIGHT[:, None] * (self.basis.reshape(m, 6, r) @ coordinates) / EFFECTIVE_WEIGHT
        values, vectors = np.linalg.eigh((leverage + leverage.swapaxes(1, 2)) / 2)
        vectors = vectors / EFFECTIVE_WEIGHT[:, None]
        own = own @ (vectors / np.maximum(1 - values, LEAST_FREE)[:, None] @ np.linalg.inv(vectors))
        spread = (m - 1) / m * (own @ second_moment @ own.swapaxes(1, 2)).sum(-3)
        out = np.zeros((*spread.shape[:-2], self.unknowns, self.unknowns))
        rows = np.delete(np.arange(1 + u), SCALE)
        out[..., rows[:, None], rows] = spread
        return out


PRIOR_STD = np.array([1.0] * 3 + [np.pi] * 3 + [5.0])
"""Standard deviations of X (m, rad) and log scale in a weak prior, which keeps unobservable directions finite."""
LARGEST_ROTATION = 0.5
"""Largest component of a rotation step (rad), and largest step of the log scale."""
ASSUMED_NOISE = (5e-4, np.radians(0.1))
"""Assumed random errors (m, rad) of the gripper poses of a robot without an estimate."""


def predicted_gripper_poses(
    x: Transforms,
    scale: Float[ndarray, "*batch"] | np.floating | float,
    z: Transforms,
    recon_from_camera: Poses,
) -> Float[ndarray, "*batch n 4 4"]:
    """Return predicted base_from_gripper (...,n,4,4): Z · S_λ(recon_from_camera) · X⁻¹, for one or many (X, λ, Z).

    X is gripper_from_camera, Z base_from_recon; S_λ multiplies translations by the scale λ (metres per recon unit).
    """
    scaled = scale_translation(recon_from_camera, np.asarray(scale)[..., None])
    return z[..., None, :, :] @ scaled @ inverse(x)[..., None, :, :]


def pose_residuals(
    x: Transform,
    scale: float,
    z: Transform,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 13"]]:
    """Return steps (m, rad; base axes) from reported to predicted gripper poses, and derivatives by X, log scale, Z.

    Six components of a step are translation, then rotation vector; the 13 columns are steps of X (6), log scale, Z (6).
    X is gripper_from_camera, Z is base_from_recon.
    """
    predicted = predicted_gripper_poses(x, scale, z, recon_from_camera)
    rotation = predicted[:, :3, :3]
    arm = scale * recon_from_camera[:, :3, 3] @ z[:3, :3].T
    j = np.zeros((len(predicted), 6, UNKNOWNS))
    j[:, :3, TRANSLATION] = -rotation
    j[:, :3, ROTATION] = -rotation @ skew(x[:3, 3])
    j[:, :3, 6] = arm
    j[:, :3, BASE_TRANSLATION] = np.eye(3)
    j[:, :3, BASE_ROTATION] = -skew(arm - rotation @ x[:3, 3])
    j[:, 3:, ROTATION] = -rotation
    j[:, 3:, BASE_ROTATION] = np.eye(3)
    return step_between(base_from_gripper, predicted), j


def pose_by_pose(blocks: Float[ndarray, "n 6 6"], matrix: Float[ndarray, "r c"]) -> Float[ndarray, "r c"]:
    """Return the product of a block-diagonal matrix with n blocks (6,6) and a matrix of r = 6n rows."""
    return (blocks @ matrix.reshape(len(blocks), 6, -1)).reshape(matrix.shape)


def weak_prior(arms: int = 1) -> Float[ndarray, "u u"]:
    """Return the diagonal information matrix of a weak prior (PRIOR_STD) on each arm's X and on log scale; zero for Z.

    X is gripper_from_camera, Z base_from_recon. The u = 12 · arms + 1 unknowns are X, log scale and Z of the first arm,
    then X and Z of further arms. X and Z have six each: translation (m), then rotation (rad).
    """
    std = np.full(12 * arms + 1, np.inf)
    for arm in range(arms):
        std[columns_of_arm(arm)[:6]] = PRIOR_STD[:6]
    std[SCALE] = PRIOR_STD[SCALE]
    return np.diag(std**-2.0)


def share_within_limits(step: Float[ndarray, " u"]) -> float:
    """Return the largest factor ≤ 1 that keeps a step's rotations and log scale within ±LARGEST_ROTATION.

    `step` (u,) has the order of `weak_prior`; the limit applies to each component times the factor.
    """
    arms = range((len(step) - 1) // 12)
    rotations = np.r_[SCALE, *(columns_of_arm(arm)[[3, 4, 5, 9, 10, 11]] for arm in arms)]
    return min(1.0, LARGEST_ROTATION / max(float(np.abs(step[rotations]).max()), 1e-300))


def expected_covariance(hessian: Float[ndarray, "*batch 13 13"]) -> Float[ndarray, "*batch 7 7"]:
    """Return the covariance (7,7) of gripper_from_camera X (m, rad) and log scale with the prior `weak_prior`.

    `hessian` (13,13) is the information matrix of X (6), log scale and base_from_recon (6) without a prior.
    """
    return np.linalg.inv(hessian + weak_prior())[..., :7, :7]


def paper_residuals(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    gripper_from_camera: Transform,
    scale: float,
    used: Bool[ndarray, " n"],
) -> tuple[float, float]:
    """Return the residuals δ_t (m) and δ_R of AX = XB: mean norms of A·X − X·B(λ) over consecutive used images.

    A and B are the motions of gripper and camera from one used image to the next; X is gripper_from_camera. B(λ) has its
    translation multiplied by `scale`. δ_R is the Frobenius norm of the rotation part (method paper, eq. 16).
    """
    a, b = (inverse(of[used][:-1]) @ of[used][1:] for of in (base_from_gripper, recon_from_camera))
    gap = a @ gripper_from_camera - gripper_from_camera @ scale_translation(b, scale)
    translation = np.linalg.norm(gap[:, :3, 3], axis=1).mean()
    return float(translation), float(np.linalg.norm(gap[:, :3, :3], axis=(1, 2)).mean())


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """Linearised equations of the reported poses of all arms about a state."""

    every: Equations
    """Equations of all poses, used or not; the rigs are at their mean given the images."""
    region: Region
    """Fit of the effective hand-eye transform to the used poses."""
    used: Bool[ndarray, " n"]
    """Mask of the used poses among the reported poses of all arms."""
    by_rig: Float[ndarray, "n 6 6"]
    """Derivative of the residual of each pose by a step of its rig."""
    rigs: tuple[Float[ndarray, "s e"], Float[ndarray, " s"], Float[ndarray, "s s"] | None]
    """Distribution of the steps of the rigs without the reported poses, as ImageEvidence.rigs; None: they are exact."""

    def rig_step(self, solution: LinearSolution) -> Float[ndarray, " s"]:
        """Return the steps of the arms' rigs to their mean given the reported poses too, after the step of `solution`.

        `solution` is that of `equations`. The steps are those of geometry.retract, pose by pose.
        """
        follow, to_mean, covariance = self.rigs
        step = -to_mean - follow @ solution.step[len(solution.step) - follow.shape[1] :]
        if covariance is None:
            return step
        left = np.zeros((len(self.used), 6))
        left[self.used] = solution.weighed_left.reshape(-1, 6)
        pull = pose_by_pose(np.swapaxes(self.by_rig, 1, 2), left.reshape(-1, 1))[:, 0]
        return step - covariance @ pull

    @cached_property
    def equations(self) -> Equations:
        """Equations of the used poses only, in the order of `every`."""
        return self.every if self.used.all() else self.every.of_poses(np.flatnonzero(self.used))


def reported_poses(
    problem: Problem, state: State
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 u"], Float[ndarray, "n 6 6"]]:
    """Return the residuals of the n reported poses of all arms, and their derivatives.

    Poses are arm after arm. Residuals are steps (m, then rad; base axes) from reported to predicted poses. The first
    derivatives are by the u unknowns of the arms (X, log scale and Z, as in `weak_prior`). The second are by a step of
    the rig (camera pose) that belongs to each pose.
    """
    each, begin, of_x, of_z = [], 0, slice(0, 6), slice(7, 13)
    jacobian = np.zeros((sum(len(arm.rigs) for arm in problem.arms), 6, problem.arm_unknowns))
    for k, arm in enumerate(problem.arms):
        x, z, rigs = state.x[k], state.z[k], state.world_from_rig[arm.rigs]
        # X, then the scale that all arms share, then Z.
        columns, is_carried = np.insert(columns_of_arm(k), 6, SCALE.start), arm.carries == "scene"
        if is_carried:
            # base_from_gripper · Z = X · S_λ(world_from_rig⁻¹): X and Z exchange their roles.
            x, z, rigs = z, x, inverse(rigs)
            columns = np.r_[columns[of_z], SCALE.start, columns[of_x]]
        residual, by_unknown = pose_residuals(x, state.scale, z, arm.base_from_gripper, rigs)
        jacobian[begin : begin + len(rigs), :, columns] = by_unknown
        # Derivative of the residuals by a step of each rig.
        by_pose = np.zeros((len(rigs), 6, 6))
        by_pose[:, :3, :3] = state.scale * z[:3, :3]
        by_pose[:, :3, 3:] = z[:3, :3] @ skew(rigs[:, :3, :3] @ x[:3, :3].T @ x[:3, 3])
        by_pose[:, 3:, 3:] = z[:3, :3]
        if is_carried:
            by_pose = by_pose @ by_inverse(state.world_from_rig[arm.rigs])
        each.append((residual, by_pose))
        begin += len(rigs)
    residual, by_rig = (np.concatenate(part) for part in zip(*each, strict=True))
    return residual, jacobian, by_rig


def pose_equations(problem: Problem, state: State, images: ImageEvidence | None) -> PoseEquations:
    """Return the equations of the reported poses about a state, after the rigs (camera poses) are integrated out.

    The distribution of the rigs is that of `images`; None: that of `Problem.known_rigs`. Unknowns are those of the
    arms, then the columns `Problem.free`. Prior information includes the weak prior, the linear priors and that of
    `images`.
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
        given, covariance = problem.known_rigs
        follow, to_mean = np.zeros((6 * n, 0)), step_between(given, state.world_from_rig).ravel()
    else:
        follow, to_mean, covariance = images.rigs
        coupling = images.information[np.ix_(problem.by_arm, free)]
        jacobian = np.concatenate([jacobian, -pose_by_pose(by_rig, follow)], axis=1)
        of_free = images.information[np.ix_(free, free)] - coupling.T @ follow
        information[arms:, arms:] += (of_free + of_free.T) / 2
        gradient[arms:] += images.gradient[free] - coupling.T @ to_mean
    residual = residual - pose_by_pose(by_rig, to_mean[:, None]).reshape(n, 6)
    shared = None
    if covariance is not None:
        shared = pose_by_pose(by_rig, pose_by_pose(by_rig, covariance).T)
        shared = (shared + shared.T) / 2
    by_unknown = np.delete(by_arms.reshape(6 * n, arms), SCALE, axis=1)
    root, u = np.tile(EFFECTIVE_WEIGHT, len(rows) // 6), by_unknown.shape[1]
    # A known coordinate of the camera determines the effective transform along a direction that the motions do not.
    known = [np.delete(one.row[:arms], SCALE) / one.std for one in problem.priors]
    weighted = np.concatenate([root[:, None] * by_unknown[rows], np.reshape(known, (-1, u))])
    left, size, right = np.linalg.svd(weighted, full_matrices=False)
    kept = size > 1e-9 * size.max()
    to_unknown, coordinates = right[kept].T / size[kept], left[: len(rows), kept].T * root
    basis, everywhere = by_unknown @ to_unknown, np.zeros((len(to_unknown.T), 6 * n))
    basis[rows], everywhere[:, rows] = left[: len(rows), kept] / root[:, None], coordinates
    region = Region(basis[rows], coordinates, to_unknown @ coordinates, problem.unknowns)
    every_region = Region(basis, everywhere, to_unknown @ everywhere, problem.unknowns)
    systematic, *others = (arm.error_covariance for arm in problem.arms)
    systematic = np.asarray(block_diag(systematic, *others)) if others else systematic
    bent, of_arm = problem.bent, [len(one.rigs) for one in problem.arms]
    every = Equations(
        residual=residual.ravel(),
        jacobian=jacobian,
        prior_information=information,
        prior_gradient=gradient,
        known=shared,
        systematic=every_region.left(systematic),
        given=problem.robot_noise_floor,
        confirmed=every_region.left(bent @ bent.T) if bent.size else None,
        arm=np.repeat(np.arange(len(of_arm)), of_arm) if len(of_arm) > 1 else None,
    )
    return PoseEquations(every, region, used, by_rig, (follow, to_mean, covariance))


class Fit(NamedTuple):
    """Fit of X and Z with base_from_gripper · X ≈ Z · recon_from_camera: gripper_from_camera X, base_from_recon Z."""

    gripper_from_camera: Transform
    base_from_recon: Transform
    residual: Float[ndarray, "n 6"]
    """Residuals of `pose_residuals` (m, rad) at the fit."""


def fit_known_scale(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Transform, Transform],
    noise: tuple[float, float],
) -> Fit:
    """Return the least-squares fit of X and Z from the initial estimate `start` (X, Z), for camera poses in metres.

    The inverse of `noise` (m, rad) weighs position and rotation residuals. Directions that the motions do not determine
    stay as in `start`.
    """
    weight, columns = 1 / np.repeat(noise, 3), columns_of_arm(0)

    def linearised(at: tuple[Transform, Transform]) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 12"]]:
        residual, jacobian = pose_residuals(at[0], 1.0, at[1], base_from_gripper, recon_from_camera)
        return weight * residual, weight[:, None] * jacobian[:, :, columns]

    def moved(at: tuple[Transform, Transform], step: Float[ndarray, "12"]) -> tuple[Transform, Transform]:
        return retract(at[0], step[:6]), retract(at[1], step[6:])

    x, z = minimise(linearised, start, moved).unknowns
    return Fit(x, z, pose_residuals(x, 1.0, z, base_from_gripper, recon_from_camera)[0])
