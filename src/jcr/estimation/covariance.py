"""Unknowns averaged over the sizes of the robot's errors, their covariance, and its division by cause.

The covariance is E[C] + Var[θ̂] over the sizes (robot_noise.py), C and θ̂ being covariance and estimate for given sizes.
Such a mixture has longer tails than a normal distribution; the covariance is enlarged until its 99 % ellipsoid contains
99 % of the mixture.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.distributions import chi2
from jcr.estimation.elimination import cholesky, lower, upper
from jcr.estimation.pose_equations import Region
from jcr.estimation.problem import SCALE, columns_of_arm
from jcr.estimation.robot_noise import (
    MOST_FOR_SIZES,
    Each,
    Equations,
    Information,
    LinearSolution,
    LogSizes,
    over_sizes,
    solve_equations,
)
from jcr.records import Budget

COVERED = 0.99
"""Probability of the ellipsoid that the enlarged covariance must contain."""
PRIOR_POSES = 6.0
"""Weight of the prior second moment of a pose's systematic error, as a number of poses: the dimension of the error.

Without this prior, the 95 % regions of eight poses of an arm with known joint angles contain 59 to 76 % of the errors.
"""

Square = Float[ndarray, "p p"]
Stack = Float[ndarray, "*k p p"]


def posterior(
    equations: Equations,
    mode: LogSizes,
    at_mode: LinearSolution,
    information: Information,
    region: Region,
    expected: bool = False,
) -> tuple[Float[ndarray, " p"], Square, Budget]:
    """Return the step of the p unknowns averaged over the error sizes, their covariance (p,p), and its budget by cause.

    The averages are over the posterior of the robot's error sizes σ. `mode` are their most likely logarithms, `at_mode`
    is the solution for them, `information` their information matrix. The sizes of one arm vary while those of the
    others stay at the mode, and the changes by all arms add up; those of more than MOST_FOR_SIZES poses stay at the
    mode. The covariance includes `region.spread`, the effect of systematic errors at other poses. `expected`: for
    predictions, the residuals are 0 and their squares are replaced by expectations under the noise at the mode.
    """

    def density(solution: LinearSolution) -> Each:
        """Return the log posterior of the error sizes for which `solution` was computed."""
        if not expected:
            return solution.log_posterior
        whitened, fitted = _whitened_and_fitted(solution, at_mode.root)
        return solution.log_posterior - ((whitened**2).sum((-1, -2)) - (fitted**2).sum((-1, -2))) / 2

    def elsewhere(solution: LinearSolution, sizes: LogSizes) -> Stack:
        """Return the covariance of the unknowns by systematic robot errors, which differ at other poses."""
        part = equations.systematic_part(sizes)
        each = np.arange(poses := part.shape[-1] // 6)  # the diagonal block (6,6) of each pose
        blocks = part.reshape(*part.shape[:-2], poses, 6, poses, 6)[..., each, :, each, :]
        second_moment = np.moveaxis(blocks, 0, -3)
        if expected:
            return region.spread(second_moment)
        # E[e eᵀ] of each pose's systematic error e, given the residuals of all poses, minus its prior value.
        mean = (part @ solution.weighed_left[..., None]).reshape(*part.shape[:-2], -1, 6)
        learned = mean[..., :, None] * mean[..., None, :]
        for first in range(0, poses, MOST_FOR_SIZES):  # which bounds the memory
            some = slice(first, first + MOST_FOR_SIZES)
            columns = part[..., 6 * some.start : 6 * some.stop]
            for sign, whitened in zip((-1, 1), _whitened_and_fitted(solution, columns), strict=True):
                each_pose = np.moveaxis(whitened.reshape(*whitened.shape[:-1], -1, 6), -2, -3)
                learned[..., some, :, :] += sign * np.swapaxes(each_pose, -1, -2) @ each_pose
        return region.spread(second_moment + poses / (poses + PRIOR_POSES) * learned)

    spread = elsewhere(at_mode, mode)
    step, covariance = at_mode.step, at_mode.covariance + spread
    factor, steps_beyond, beyond = np.ones(len(step)), np.zeros_like(step), np.zeros_like(covariance)
    for arm in range(equations.arms if len(equations.residual) <= 6 * MOST_FOR_SIZES else 0):
        found = over_sizes(equations, mode, information, density, arm)
        groups = [(share, one.step, one.covariance + elsewhere(one, sizes)) for share, sizes, one in found]
        weight, steps, each = (np.concatenate(part) for part in zip(*groups, strict=True))
        mean = weight @ steps
        off = steps - mean
        averaged = np.einsum("k,kij->ij", weight, each) + np.einsum("k,ki,kj->ij", weight, off, off)
        own = np.sort(np.r_[SCALE.start, columns_of_arm(arm)])
        widened = _widening(weight, off[:, own], each[:, own[:, None], own], averaged[np.ix_(own, own)])
        # All unknowns but those of further arms are enlarged as the first arm's.
        factor[slice(None) if arm == 0 else columns_of_arm(arm)] = np.sqrt(widened)
        steps_beyond, beyond = steps_beyond + (mean - step), beyond + (averaged - covariance)
    step, covariance = step + steps_beyond, factor[:, None] * (covariance + beyond) * factor
    return step, covariance, _budget(equations, mode, at_mode, spread, covariance)


def _whitened_and_fitted(
    solution: LinearSolution, matrix: Float[ndarray, "*#k s r"]
) -> tuple[Float[ndarray, "*k s r"], Float[ndarray, "*k p r"]]:
    """Return A (s,r) and B (p,r) with AᵀA − BᵀB = MᵀPM, for M = `matrix` and P = `solution.projection`.

    A is M whitened by the covariance of the residuals; BᵀB is the part that the p unknowns of the fit explain.
    """
    fitted = lower(solution.information_root, np.swapaxes(solution.weighed, -1, -2) @ matrix)
    return lower(solution.root, matrix), fitted


def _widening(
    weight: Float[ndarray, " k"],
    off: Float[ndarray, "k p"],
    each: Float[ndarray, "k p p"],
    covariance: Square,
) -> float:
    """Return the factor ≥ 1 on a mixture's covariance with which its 99 % ellipsoid contains 99 % of the mixture.

    The k normal components have the weights `weight`, means `off` (relative to the mixture's mean) and covariances
    `each`. Squared Mahalanobis distances are approximated by a scaled χ² (Satterthwaite, Biometrics Bulletin 2, 1946).
    """
    std = np.sqrt(np.diag(covariance))
    scaled, shift = covariance / np.outer(std, std), off / std
    relative = np.linalg.solve(scaled, each / np.outer(std, std))
    towards = np.linalg.solve(scaled, shift.T).T
    mean = np.trace(relative, axis1=1, axis2=2) + (shift * towards).sum(1)
    variance = 2 * np.einsum("kij,kji->k", relative, relative)
    variance += 4 * np.einsum("ki,kij,kj->k", shift, relative, towards)
    unit = variance / (2 * mean)

    normal = float(chi2.ppf(COVERED, len(covariance)))
    least, most = np.log([1e-3, 1e4 * normal])
    for _ in range(40):  # bisections, to a relative error of 1e-11
        middle = (least + most) / 2
        if weight @ chi2.cdf(np.exp(middle) / unit, mean / unit) < COVERED:
            least = middle
        else:
            most = middle
    return max(1.0, float(np.exp(most)) / normal)


def _budget(
    equations: Equations,
    log_sizes: LogSizes,
    found: LinearSolution,
    elsewhere: Square,
    covariance: Square,
) -> Budget:
    """Return the covariance of X (hand-eye) and scale by cause: robot random, robot systematic, intrinsics, images.

    `found` is the solution at `log_sizes`; `elsewhere` is the covariance that systematic errors add there for other
    poses of the workspace. X and log scale are in the order translation (m), rotation (rad), log scale. The part of the
    intrinsics is the covariance that exact intrinsics would remove. The parts are scaled so that they add up to
    `covariance`. The part of the images includes unobservable directions and rounding.
    """
    arms = 12 * equations.arms + 1
    exact = replace(
        equations,
        jacobian=equations.jacobian[:, :arms],
        prior_information=equations.prior_information[:arms, :arms],
        prior_gradient=equations.prior_gradient[:arms],
    )
    solution = solve_equations(exact, log_sizes) if len(found.step) > arms else found
    gain = solution.gain
    random = (gain * exact.random(log_sizes)) @ gain.T
    systematic = elsewhere[:arms, :arms]
    systematic = systematic + gain @ exact.systematic_part(log_sizes) @ gain.T
    if exact.confirmed is not None:
        systematic = systematic + gain @ exact.confirmed @ gain.T
    # Covariance from the priors and from errors of the camera poses.
    images = solution.covariance @ exact.prior_information @ solution.covariance
    if exact.known is not None:
        images = images + gain @ exact.known @ gain.T
    intrinsics = found.covariance[:arms, :arms] - solution.covariance
    whole, parts = covariance[:7, :7], [part[:7, :7] for part in (random, systematic, intrinsics, images)]
    # A linear map takes errors with the covariance of all parts to errors with the whole covariance.
    known = sum(parts[1:], parts[0])
    to_whole = upper(cholesky(known), cholesky(whole).T).T
    random, systematic, intrinsics, _ = (to_whole @ part @ to_whole.T for part in parts)
    images = whole - random - systematic - intrinsics
    parts = [positive_part((part + part.T) / 2) for part in (random, systematic, intrinsics, images)]
    names = "robot_random", "robot_systematic", "intrinsics", "images"
    return Budget(**dict(zip(names, parts, strict=True)), faults=np.zeros((7, 7)))


def positive_part(part: Square, whole: Square | None = None) -> Square:
    """Return a symmetric matrix with its negative eigenvalues, which come from rounding, set to 0.

    Before the eigenvalues are computed, rows and columns are divided by the standard deviations of `whole`; None: of
    `part`.
    """
    std = np.sqrt(np.maximum(np.diag(part if whole is None else whole), 0.0))
    values, vectors = np.linalg.eigh(part / np.outer(*[np.where(std > 0, std, np.inf)] * 2))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(std, std)
