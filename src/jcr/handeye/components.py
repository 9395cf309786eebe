"""How large the errors of gripper poses are, random and systematic, and what they leave unknown: a mixed linear model.

At one value of the unknowns the residuals of n poses are r = −J θ + e + ε. The random part ε has σ_t² per axis of
position and σ_r² per axis of rotation, the systematic part e has covariance σ_s² G (systematic.py), and what the
cameras add is known. Restricted maximum likelihood tells the three sizes (Searle, Casella and McCulloch, "Variance
components", 1992, section 6.6), but few images tell them badly. The answer is therefore not taken at the best sizes:
it is averaged over them with their posterior weights, on a grid about the mode (Rue, Martino and Chopin, J. R.
Statist. Soc. B 71, 2009, section 3), so that Cov = E[C] + Var[θ̂]. A mixture has longer tails than a normal
distribution of its covariance: the covariance is scaled until its 99 % ellipsoid holds 99 %, for a trusted answer
that is many standard deviations off is the worst fault.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import root_scalar
from scipy.stats import chi2

from jcr.handeye.systematic import REACH, Region
from jcr.records import Budget

NOISE_FLOOR = (2e-5, np.radians(0.002))
"""m, rad; so that a perfect fit does not claim a perfect robot."""
TYPICAL = np.array([3e-4, np.radians(0.04), np.radians(0.1)])
"""σ_t (m), σ_r (rad), σ_s (rad) of an arm: where their weak priors have their middle."""
FACTOR_STD = np.log([10.0, 10.0, 3.0])
"""By what factor arms differ in these. Data sheets of industrial arms leave 0.03 to 0.1° of systematic error, those of
servo arms 1 to 2°."""
GIVEN_SHARE = 0.3
"""Of a given noise, that a robot has beside it: the middle of the prior."""
RATIO_STD = np.log(4.0)
"""Of log(σ_t / (REACH · σ_r)) over robots. Tied more closely, by a factor of 2, three images of a robot whose rotations
are six times better than its positions cover 80 to 90 %."""
LEVELS, FARTHEST = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0), 18.0
"""Standard deviations of the log sizes at which the posterior is evaluated, up to this squared distance from the
mode. Rare errors come from rare sizes: up to a squared distance of 7, three images covered 81 % instead of 95 %, and two
of 120 images that had not moved were called moved at p < 0.001."""
FEW_LEVELS = (-3.2, -1.6, 0.0, 1.6, 3.2)
MANY, TOO_MANY = 15, 80
"""Poses from which the sizes are known well enough for fewer levels, and for the mode alone."""
POSES = 13
"""Unknowns of equation.py; what follows them are intrinsics."""
COVERED = 0.99
"""By the ellipsoid that holds what it says."""
JITTER = (0.0, 1e-14, 1e-12, 1e-10)
"""Added to correlations whose least eigenvalue is lost in rounding."""
SETTLED = 1e-4
"""Change of log sizes that no longer matters."""

LogSizes = Float[ndarray, " c"]


@dataclass(frozen=True)
class Equations:
    """The linearised equations of the used poses; s = 6 times their number, p unknowns."""

    residual: Float[ndarray, " s"]
    """Predicted minus reported: position (m, base axes) and rotation vector (rad, gripper axes) of each pose in turn."""
    jacobian: Float[ndarray, "s p"]
    prior_information: Float[ndarray, "p p"]
    prior_gradient: Float[ndarray, " p"]
    known: Float[ndarray, "s s"] | None
    """Covariance that errors of the cameras give the residuals."""
    systematic: Float[ndarray, "s s"] | None
    """Covariance of the systematic part where σ_s is 1 rad; None: there is none."""
    given: tuple[float, float] | None = None
    """σ_t and σ_r as the user gave them (m, rad): no less is counted."""

    @property
    def least(self) -> Float[ndarray, "2"]:
        """σ_t and σ_r that are counted beside what is estimated."""
        return np.array(self.given or NOISE_FLOOR)

    @property
    def typical(self) -> Float[ndarray, " c"]:
        """Middle of the priors of what is estimated."""
        typical = TYPICAL[: self.count].copy()
        if self.given is not None:
            typical[:2] = GIVEN_SHARE * self.least
        return typical

    @property
    def count(self) -> int:
        """Of sizes to be found."""
        return 2 if self.systematic is None else 3

    @cached_property
    def of_position(self) -> Float[ndarray, " s"]:
        """1 for residuals of position, 0 for those of rotation."""
        return np.tile(np.repeat([1.0, 0.0], 3), len(self.residual) // 6)

    def variances(self, log_sizes: LogSizes) -> Float[ndarray, " c"]:
        """σ_t², σ_r², σ_s²."""
        variances = np.exp(2 * log_sizes)
        variances[:2] += self.least**2
        return variances

    def random(self, log_sizes: LogSizes) -> Float[ndarray, " s"]:
        """Variance of each residual's random part."""
        translation, rotation = self.variances(log_sizes)[:2]
        return translation * self.of_position + rotation * (1 - self.of_position)

    def systematic_left(self, log_sizes: LogSizes) -> tuple[float, float]:
        """Root mean square per axis (m, rad) of the systematic part of the residuals."""
        if self.systematic is None:
            return 0.0, 0.0
        variance = self.variances(log_sizes)[2] * np.diag(self.systematic).reshape(-1, 2, 3).mean((0, 2))
        metres, radians = np.sqrt(variance)
        return float(metres), float(radians)

    def covariance(self, log_sizes: LogSizes) -> Float[ndarray, "s s"]:
        """V of the residuals."""
        covariance = np.diag(self.random(log_sizes))
        if self.systematic is not None:
            covariance += self.variances(log_sizes)[2] * self.systematic
        return covariance if self.known is None else covariance + self.known


@dataclass(frozen=True)
class Solution:
    """The unknowns at one value of the sizes."""

    log_posterior: float
    """Of the sizes, up to a constant."""
    step: Float[ndarray, " p"]
    root: Float[ndarray, "s s"]
    """Lower Cholesky factor of V."""
    information_root: Float[ndarray, "p p"]
    """Lower Cholesky factor of JᵀV⁻¹J + prior."""
    gain: Float[ndarray, "p s"]
    """By which errors of the residuals pass into the unknowns, with the sign turned: C JᵀV⁻¹."""

    @property
    def covariance(self) -> Float[ndarray, "p p"]:
        """C of the unknowns."""
        return cho_solve((self.information_root, True), np.eye(len(self.step)))


@dataclass(frozen=True)
class Posterior:
    """The unknowns averaged over the sizes."""

    step: Float[ndarray, " p"]
    covariance: Float[ndarray, "p p"]
    """Scaled so that its 99 % ellipsoid holds 99 %."""
    budget: Budget
    log_sizes: LogSizes
    """At the mode."""


def solve(equations: Equations, log_sizes: LogSizes) -> Solution:
    """Generalised least squares at given sizes."""
    root = _cholesky(equations.covariance(log_sizes))
    both = np.column_stack([equations.jacobian, equations.residual])
    whitened = solve_triangular(root, both, lower=True, check_finite=False)
    jacobian, residual = whitened[:, :-1], whitened[:, -1]
    information_root = _cholesky(jacobian.T @ jacobian + equations.prior_information)
    gradient = jacobian.T @ residual + equations.prior_gradient
    step = -cho_solve((information_root, True), gradient, check_finite=False)
    likelihood = (
        -np.log(np.diag(root)).sum()
        - np.log(np.diag(information_root)).sum()
        - (residual @ residual + gradient @ step) / 2
    )
    weighed = solve_triangular(root, jacobian, lower=True, trans=1, check_finite=False)
    gain = cho_solve((information_root, True), weighed.T, check_finite=False)
    prior = _prior(equations, log_sizes)[0]
    return Solution(float(likelihood) + prior, step, root, information_root, gain)


def _cholesky(matrix: Float[ndarray, "k k"]) -> Float[ndarray, "k k"]:
    """Lower factor of a matrix that is positive definite but for rounding: of motions that show nothing it is not."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / size[:, None] / size
    for rounding in JITTER:
        try:
            return size[:, None] * np.linalg.cholesky(scaled + rounding * np.eye(len(matrix)))
        except np.linalg.LinAlgError:
            continue
    values, vectors = np.linalg.eigh(scaled)
    r = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, JITTER[-1]))).T, mode="r"))
    return size[:, None] * (r.T * np.sign(np.diag(r)))


def most_likely(
    equations: Equations, start: LogSizes | None = None
) -> tuple[LogSizes, Float[ndarray, "c c"]]:
    """Log sizes at the mode of their posterior, and the information there (Fisher scoring)."""
    at = np.log(equations.typical) if start is None else start
    value, gradient, information = _score(equations, at)
    for _ in range(40):
        step = np.linalg.solve(information, gradient)
        step /= max(1.0, float(np.abs(step).max()))
        while (scored := _score(equations, at + step))[0] < value and np.abs(step).max() > SETTLED:
            step = step / 2
        if scored[0] < value:
            break
        gained = scored[0] - value
        at = at + step
        value, gradient, information = scored
        if np.abs(step).max() < SETTLED or gained < 1e-9:
            break
    return at, information


def posterior(
    equations: Equations, log_sizes: LogSizes, information: Float[ndarray, "c c"], region: Region | None
) -> Posterior:
    """The unknowns averaged over the sizes about their mode; `region` adds what other poses of it would change."""
    weight, sizes, solutions = over_sizes(equations, log_sizes, information)
    steps = np.array([solution.step for solution in solutions])
    each = np.array(
        [
            solution.covariance + _elsewhere(equations, solution, at, region)
            for at, solution in zip(sizes, solutions, strict=True)
        ]
    )
    step = weight @ steps
    off = steps - step
    covariance = np.einsum("k,kij->ij", weight, each) + np.einsum("k,ki,kj->ij", weight, off, off)
    covariance *= _widening(weight, off[:, :POSES], each[:, :POSES, :POSES], covariance[:POSES, :POSES])
    return Posterior(step, covariance, _budget(equations, log_sizes, region, covariance), log_sizes)


def over_sizes(
    equations: Equations, log_sizes: LogSizes, information: Float[ndarray, "c c"]
) -> tuple[Float[ndarray, " k"], list[LogSizes], list[Solution]]:
    """Posterior weights (their sum is 1) of log sizes about their mode, and the solution at each."""
    weights, sizes, solutions = [], [], []
    for at, log_volume in _grid(equations, log_sizes, information):
        solutions.append(solve(equations, at))
        sizes.append(at)
        weights.append(solutions[-1].log_posterior + log_volume)
    weight = np.exp(np.array(weights) - max(weights))
    return weight / weight.sum(), sizes, solutions


def _prior(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Float[ndarray, "c c"]]:
    """Log density, gradient and negative Hessian of the weak priors of the sizes."""
    std = FACTOR_STD[: len(log_sizes)]
    z = (log_sizes - np.log(equations.typical)) / std
    ratio = (log_sizes[0] - log_sizes[1] - np.log(REACH)) / RATIO_STD
    apart = np.zeros(len(log_sizes))
    apart[:2] = 1 / RATIO_STD, -1 / RATIO_STD
    return -float(z @ z + ratio**2) / 2, -z / std - ratio * apart, np.diag(std**-2.0) + np.outer(apart, apart)


def _score(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Float[ndarray, "c c"]]:
    """Log posterior of the sizes, its gradient, and the expected information."""
    solution = solve(equations, log_sizes)
    inverse = cho_solve((solution.root, True), np.eye(len(equations.residual)), check_finite=False)
    projection = inverse - inverse @ equations.jacobian @ solution.gain
    left = inverse @ (equations.residual + equations.jacobian @ solution.step)
    masks = (equations.of_position, 1 - equations.of_position)
    products = [projection * mask for mask in masks]
    squares = [left @ (mask * left) for mask in masks]
    if equations.systematic is not None:
        products.append(projection @ equations.systematic)
        squares.append(left @ equations.systematic @ left)
    growth = np.exp(2 * log_sizes)
    traces = np.array([np.trace(product) for product in products])
    _, gradient, information = _prior(equations, log_sizes)
    pairs = np.array([[(one * other.T).sum() for other in products] for one in products])
    return (
        solution.log_posterior,
        gradient + growth * (np.array(squares) - traces),
        information + 2 * np.outer(growth, growth) * pairs,
    )


def _grid(
    equations: Equations, mode: LogSizes, information: Float[ndarray, "c c"]
) -> list[tuple[LogSizes, float]]:
    """Log sizes about their mode, and the log of the volume that each stands for.

    Along each axis of the information, either way, in steps of the standard deviation that the posterior has there,
    which is skew: what few images show is rather what the sizes are not above than what they are not below.
    """
    poses = len(equations.residual) // 6
    if poses > TOO_MANY:
        return [(mode, 0.0)]
    values, vectors = np.linalg.eigh(information)
    axes = vectors / np.sqrt(values)
    top, probe = solve(equations, mode).log_posterior, 1.5
    stretch = np.ones((len(mode), 2))
    for k, axis in enumerate(axes.T):
        for side, sign in enumerate((-1, 1)):
            drop = top - solve(equations, mode + sign * probe * axis).log_posterior
            stretch[k, side] = np.clip(probe / np.sqrt(max(2 * drop, 1e-3)), 0.3, 3.0)
    levels = LEVELS if poses < MANY else FEW_LEVELS
    grid = []
    for z in product(levels, repeat=len(mode)):
        if np.dot(z, z) > FARTHEST:
            continue
        lengths = np.where(np.array(z) < 0, *stretch.T)
        grid.append((mode + axes @ (lengths * z), float(np.log(lengths).sum())))
    return grid


def _elsewhere(
    equations: Equations, solution: Solution, log_sizes: LogSizes, region: Region | None
) -> Float[ndarray, "p p"]:
    """Covariance of what the systematic part leaves open because the answer is asked for the region, not its poses."""
    if region is None or equations.systematic is None:
        return np.zeros_like(solution.information_root)
    part = equations.variances(log_sizes)[2] * equations.systematic
    left = equations.residual + equations.jacobian @ solution.step
    expected = part @ cho_solve((solution.root, True), left, check_finite=False)
    shown = solve_triangular(solution.root, part, lower=True, check_finite=False)
    fitted = equations.jacobian.T @ cho_solve((solution.root, True), part, check_finite=False)
    fitted = solve_triangular(solution.information_root, fitted, lower=True, check_finite=False)
    m = len(left) // 6
    blocks = np.arange(m)
    own = part.reshape(m, 6, m, 6)[blocks, :, blocks]
    own = own - np.einsum("kma,kmb->mab", shown.reshape(-1, m, 6), shown.reshape(-1, m, 6))
    own = own + np.einsum("kma,kmb->mab", fitted.reshape(-1, m, 6), fitted.reshape(-1, m, 6))
    expected = expected.reshape(m, 6)
    return region.spread(own + expected[:, :, None] * expected[:, None])


def _widening(
    weight: Float[ndarray, " k"],
    off: Float[ndarray, "k p"],
    each: Float[ndarray, "k p p"],
    covariance: Float[ndarray, "p p"],
) -> float:
    """Factor on the covariance of a mixture of normal distributions, after which its 99 % ellipsoid holds 99 %.

    Squared Mahalanobis distances under each are matched by a scaled χ² of the same mean and variance (Satterthwaite,
    Biometrics Bulletin 2, 1946).
    """
    size = len(covariance)
    std = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(std, std)
    relative = np.linalg.solve(scaled, each / np.outer(std, std))
    shift = off / std
    towards = np.linalg.solve(scaled, shift.T).T
    mean = np.trace(relative, axis1=1, axis2=2) + (shift * towards).sum(1)
    variance = 2 * np.einsum("kij,kji->k", relative, relative) + 4 * np.einsum(
        "ki,kij,kj->k", shift, relative, towards
    )
    unit = variance / (2 * mean)

    def beyond(distance: float) -> float:
        return float(weight @ chi2.cdf(distance / unit, mean / unit)) - COVERED

    normal = float(chi2.ppf(COVERED, size))
    found = root_scalar(beyond, bracket=(1e-3, 1e4 * normal)).root
    return max(1.0, float(found) / normal)


def _budget(
    equations: Equations, log_sizes: LogSizes, region: Region | None, covariance: Float[ndarray, "p p"]
) -> Budget:
    """The covariance of X and scale by its causes, which share what the averaging over sizes added.

    What intrinsics add is what would go if they were known; the rest is divided as if they were.
    """
    exact = replace(
        equations,
        jacobian=equations.jacobian[:, :POSES],
        prior_information=equations.prior_information[:POSES, :POSES],
        prior_gradient=equations.prior_gradient[:POSES],
    )
    solution = solve(exact, log_sizes)
    gain = solution.gain
    random = (gain * exact.random(log_sizes)) @ gain.T
    systematic = np.zeros_like(random)
    if exact.systematic is not None:
        systematic = exact.variances(log_sizes)[2] * gain @ exact.systematic @ gain.T
    # What neither robot nor cameras show.
    images = solution.covariance @ exact.prior_information @ solution.covariance
    if exact.known is not None:
        images = images + gain @ exact.known @ gain.T
    free = solve(equations, log_sizes)
    intrinsics = free.covariance[:POSES, :POSES] - solution.covariance
    systematic = systematic + _elsewhere(equations, free, log_sizes, region)[:POSES, :POSES]
    variance = np.diag(random + systematic + intrinsics + images)
    whole = np.sqrt(np.diag(covariance)[:POSES] / variance)
    share = np.outer(whole, whole)
    return Budget(*((share * part)[:7, :7] for part in (random, systematic, intrinsics, images)))
