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

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import get_lapack_funcs, solve_triangular

from jcr.distributions import chi2
from jcr.handeye.systematic import REACH, Region
from jcr.records import Budget, RobotNoise

NOISE_FLOOR = (2e-5, np.radians(0.002))
"""m, rad; so that a perfect fit does not claim a perfect robot."""
TYPICAL = np.array([3e-4, np.radians(0.04), np.radians(0.1)])
"""σ_t (m), σ_r (rad), σ_s (rad) of an arm: where their weak priors have their middle."""
FACTOR_STD = np.log([10.0, 10.0, 3.0])
"""By what factor arms differ in these. Data sheets of industrial arms leave 0.03 to 0.1° of systematic error, those of
servo arms 1 to 2°."""
GIVEN_SHARE = 0.3
"""Of a given noise, that a robot has beside it: the middle of the prior."""
LEAST_BESIDE = 0.01
"""Of what is counted anyway, that errors beside it are at least: the logarithm of no error is not finite."""
RATIO_STD = np.log(4.0)
"""Of log(σ_t / (REACH · σ_r)) over robots. Tied more closely, by a factor of 2, three images of a robot whose rotations
are six times better than its positions cover 80 to 90 %."""
LEVELS = tuple(1.5 * np.arange(-4, 5))
"""Standard deviations of the log sizes at which the posterior is evaluated; for a normal one, the error of so coarse a
sum is 3e-4."""
FARTHEST, LESS_FAR = 21.0, 10.0
"""Squared distance from the mode up to which. Rare errors come from rare sizes: up to 7, three images covered 81 %
instead of 95 %, and two of 120 images that had not moved were called moved at p < 0.001."""
MANY, TOO_MANY = 15, 80
"""Poses from which the sizes are known well enough to go less far, and for the mode alone."""
AT_ONCE = 4e6
"""Numbers of one array of the solutions that are found together."""
POSES = 13
"""Unknowns of equation.py; what follows them are intrinsics."""
COVERED = 0.99
"""By the ellipsoid that holds what it says."""
HALVINGS = 40
"""Of the interval in which the size of that ellipsoid lies, to 1e-11 of it: scipy.optimize takes longer to import than
a calibration of a few images."""
JITTER = (0.0, 1e-14, 1e-12, 1e-10)
"""Added to correlations whose least eigenvalue is lost in rounding."""
SETTLED = 1e-4
"""Change of log sizes that no longer matters."""

LogSizes = Float[ndarray, "*k c"]
"""Of σ_t, σ_r and, where there is a systematic part, σ_s."""
Each = Float[ndarray, "*k"] | np.floating


@dataclass(frozen=True)
class Equations:
    """The linearised equations of the used poses; s = 6 times their number, p unknowns."""

    residual: Float[ndarray, " s"]
    """Steps (geometry.retract) from the reported to the predicted poses in turn: m, then rad; both in base axes."""
    jacobian: Float[ndarray, "s p"]
    prior_information: Float[ndarray, "p p"]
    prior_gradient: Float[ndarray, " p"]
    known: Float[ndarray, "s s"] | None
    """Covariance that errors of the cameras give the residuals."""
    systematic: Float[ndarray, "s s"] | None
    """Covariance of the systematic part where σ_s is 1 rad; None: there is none."""
    given: tuple[float, float] | None = None
    """σ_t and σ_r as the user gave them (m, rad): no less is counted."""
    bent: Float[ndarray, "s s"] | None = None
    """Covariance of errors that were found beside (bent.py), whatever the sizes of the others are."""

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

    def variances(self, log_sizes: LogSizes) -> Float[ndarray, "*k c"]:
        """σ_t², σ_r², σ_s²."""
        variances = np.exp(2 * log_sizes)
        variances[..., :2] += self.least**2
        return variances

    def log_sizes_of(self, noise: RobotNoise) -> Float[ndarray, " c"]:
        """The sizes that this noise is made of; of what is counted anyway they are a hundredth at least."""
        sizes = np.array([noise.translation, noise.rotation, noise.systematic])[: self.count]
        beside = np.sqrt(np.maximum(sizes[:2] ** 2 - self.least**2, (LEAST_BESIDE * self.least) ** 2))
        return np.log(np.r_[beside, np.maximum(sizes[2:], LEAST_BESIDE * self.least[1])])

    def random(self, log_sizes: LogSizes) -> Float[ndarray, "*k s"]:
        """Variance of each residual's random part."""
        variances = self.variances(log_sizes)
        return variances[..., :1] * self.of_position + variances[..., 1:2] * (1 - self.of_position)

    def systematic_left(self, log_sizes: LogSizes) -> tuple[float, float]:
        """Root mean square per axis (m, rad) of the systematic part of the residuals."""
        if self.systematic is None:
            return 0.0, 0.0
        variance = self.variances(log_sizes)[2] * np.diag(self.systematic).reshape(-1, 2, 3).mean((0, 2))
        metres, radians = np.sqrt(variance)
        return float(metres), float(radians)

    def covariance(self, log_sizes: LogSizes) -> Float[ndarray, "*k s s"]:
        """V of the residuals."""
        random = self.random(log_sizes)
        covariance = np.zeros((*random.shape, random.shape[-1]))
        if self.systematic is not None:
            covariance += self.variances(log_sizes)[..., 2, None, None] * self.systematic
        for part in (self.known, self.bent):
            if part is not None:
                covariance += part
        diagonal = np.arange(random.shape[-1])
        covariance[..., diagonal, diagonal] += random
        return covariance


@dataclass(frozen=True)
class Solution:
    """The unknowns at one value of the sizes, or at k values."""

    log_posterior: Each
    """Of the sizes, up to a constant."""
    step: Float[ndarray, "*k p"]
    root: Float[ndarray, "*k s s"]
    """Lower Cholesky factor of V."""
    information_root: Float[ndarray, "*k p p"]
    """Lower Cholesky factor of JᵀV⁻¹J + prior."""
    weighed: Float[ndarray, "*k s p"]
    """V⁻¹J."""

    @property
    def gain(self) -> Float[ndarray, "*k p s"]:
        """By which errors of the residuals pass into the unknowns, with the sign reversed: C JᵀV⁻¹."""
        return over(self.information_root, np.swapaxes(self.weighed, -1, -2))

    @property
    def covariance(self) -> Float[ndarray, "*k p p"]:
        """C of the unknowns."""
        return over(self.information_root, np.eye(self.step.shape[-1]))


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
    whitened = lower(root, both)
    jacobian, residual = whitened[..., :-1], whitened[..., -1:]
    transposed = np.swapaxes(jacobian, -1, -2)
    information_root = _cholesky(transposed @ jacobian + equations.prior_information)
    gradient = transposed @ residual + equations.prior_gradient[:, None]
    step = -over(information_root, gradient)
    squares = (residual**2).sum((-1, -2)) + (gradient * step).sum((-1, -2))
    log_likelihood = -_log_diagonal(root) - _log_diagonal(information_root) - squares / 2
    weighed = upper(root, jacobian)
    return Solution(
        log_likelihood + _log_prior(equations, log_sizes), step[..., 0], root, information_root, weighed
    )


def _log_diagonal(root: Float[ndarray, "*k n n"]) -> Each:
    return np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)


def lower(root: Float[ndarray, "*k n n"], right: Float[ndarray, "*#k n r"]) -> Float[ndarray, "*k n r"]:
    """L⁻¹ of a lower triangular factor L, times a matrix."""
    if root.ndim == 2 and right.ndim == 2:
        return solve_triangular(root, right, lower=True, check_finite=False)
    return np.linalg.solve(root, _for_each(root, right))


def upper(root: Float[ndarray, "*k n n"], right: Float[ndarray, "*#k n r"]) -> Float[ndarray, "*k n r"]:
    """L⁻ᵀ of a lower triangular factor L, times a matrix."""
    if root.ndim == 2 and right.ndim == 2:
        return solve_triangular(root, right, lower=True, trans=1, check_finite=False)
    return np.linalg.solve(np.swapaxes(root, -1, -2), _for_each(root, right))


def _for_each(root: Float[ndarray, "*k n n"], right: Float[ndarray, "*#k n r"]) -> Float[ndarray, "*k n r"]:
    """The right side as often as there are factors: NumPy 1 takes a matrix beside a stack for a stack of vectors."""
    return np.broadcast_to(right, (*root.shape[:-2], *right.shape[-2:]))


def over(root: Float[ndarray, "*k n n"], right: Float[ndarray, "*#k n r"]) -> Float[ndarray, "*k n r"]:
    """(L Lᵀ)⁻¹ of a lower triangular factor L, times a matrix."""
    return upper(root, lower(root, right))


def _inverse(root: Float[ndarray, "n n"]) -> Float[ndarray, "n n"]:
    """(L Lᵀ)⁻¹ of a lower triangular factor L."""
    (potri,) = get_lapack_funcs(("potri",), (root,))
    half = np.tril(potri(root, lower=1)[0])
    return half + np.tril(half, -1).T


def _cholesky(matrix: Float[ndarray, "*k n n"]) -> Float[ndarray, "*k n n"]:
    """Lower factor of a matrix that is positive definite but for rounding: of motions that show nothing it is not."""
    size = np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 1e-300))
    scaled = matrix / size[..., :, None] / size[..., None, :]
    for rounding in JITTER:
        try:
            return size[..., None] * np.linalg.cholesky(scaled + rounding * np.eye(matrix.shape[-1]))
        except np.linalg.LinAlgError:
            if matrix.ndim > 2:
                return np.array([_cholesky(each) for each in matrix])
    values, vectors = np.linalg.eigh(scaled)
    r = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, JITTER[-1]))).T, mode="r"))
    return size[:, None] * (r.T * np.sign(np.diag(r)))


def most_likely(
    equations: Equations, start: LogSizes | None = None, settled: float = SETTLED
) -> tuple[LogSizes, Float[ndarray, "c c"]]:
    """Log sizes at the mode of their posterior, and the expected information there, to a last step `settled`.

    By Fisher scoring, with the curvature that the last step showed (BFGS, Nocedal and Wright, "Numerical optimization",
    2006, eq. 6.19): where the expected information is half of it, steps swing about the mode.
    """
    at = np.log(equations.typical) if start is None else start
    value, gradient, information = _score(equations, at)
    curvature = information
    for _ in range(40):
        step = np.linalg.solve(curvature, gradient)
        step /= max(1.0, float(np.abs(step).max()))
        while (scored := _score(equations, at + step))[0] < value and np.abs(step).max() > settled:
            step = step / 2
        if scored[0] < value:
            break
        gained, fell = scored[0] - value, gradient - scored[1]
        at = at + step
        value, gradient, information = scored
        curvature = information
        if step @ fell > 0:
            along = information @ step
            curvature = (
                information - np.outer(along, along) / (step @ along) + np.outer(fell, fell) / (step @ fell)
            )
        if np.abs(step).max() < settled or gained < 1e-9:
            break
    return at, information


def posterior(
    equations: Equations, log_sizes: LogSizes, information: Float[ndarray, "c c"], region: Region | None
) -> Posterior:
    """The unknowns averaged over the sizes about their mode; `region` adds what other poses of it would change."""
    weight, steps, each = [], [], []
    for share, sizes, solution in over_sizes(equations, log_sizes, information):
        weight.append(share)
        steps.append(solution.step)
        each.append(solution.covariance + _elsewhere(equations, solution, sizes, region))
    weight, steps, each = (np.concatenate(parts) for parts in (weight, steps, each))
    step = weight @ steps
    off = steps - step
    covariance = np.einsum("k,kij->ij", weight, each) + np.einsum("k,ki,kj->ij", weight, off, off)
    covariance *= _widening(weight, off[:, :POSES], each[:, :POSES, :POSES], covariance[:POSES, :POSES])
    elsewhere = _elsewhere(equations, solve(equations, log_sizes), log_sizes, region)
    return Posterior(step, covariance, _budget(equations, log_sizes, elsewhere, covariance), log_sizes)


def expected_posterior(equations: Equations, noise: RobotNoise, region: Region | None) -> Posterior:
    """The posterior to expect of a robot with this noise, before there are any residuals: those of `equations` are 0.

    In the density of the sizes the squares of residuals are replaced by their expectations, tr(P V) for the covariance V
    that the noise gives them.
    """
    mode = equations.log_sizes_of(noise)
    root = _cholesky(equations.covariance(mode))

    def density(solution: Solution) -> Each:
        whitened = lower(solution.root, root)
        fitted = lower(solution.information_root, np.swapaxes(solution.weighed, -1, -2) @ root)
        return solution.log_posterior - ((whitened**2).sum((-1, -2)) - (fitted**2).sum((-1, -2))) / 2

    found = over_sizes(equations, mode, _score(equations, mode)[2], density)
    weight = np.concatenate([share for share, _, _ in found])
    each = np.concatenate(
        [solution.covariance + _expected_elsewhere(equations, sizes, region) for _, sizes, solution in found]
    )
    covariance = np.einsum("k,kij->ij", weight, each)
    off = np.zeros((len(weight), len(covariance[:POSES])))
    covariance *= _widening(weight, off, each[:, :POSES, :POSES], covariance[:POSES, :POSES])
    budget = _budget(equations, mode, _expected_elsewhere(equations, mode, region), covariance)
    return Posterior(np.zeros(len(covariance)), covariance, budget, mode)


def expected_covariance_at(
    equations: Equations, noise: RobotNoise, region: Region | None
) -> Float[ndarray, "p p"]:
    """The covariance of the same at the sizes themselves, as if these were known exactly: for comparisons."""
    mode = equations.log_sizes_of(noise)
    return solve(equations, mode).covariance + _expected_elsewhere(equations, mode, region)


def _expected_elsewhere(
    equations: Equations, log_sizes: LogSizes, region: Region | None
) -> Float[ndarray, "*k p p"]:
    """`_elsewhere` before there are residuals: what they will show of the systematic part is as large as it is."""
    if region is None or equations.systematic is None:
        return np.zeros((*log_sizes.shape[:-1], *equations.prior_information.shape))
    return region.spread(
        equations.variances(log_sizes)[..., 2, None, None, None] * _own(equations.systematic)
    )


def restricted_log_likelihood(equations: Equations, log_sizes: LogSizes) -> float:
    """Of the sizes, without their prior; up to a constant that all sizes and all models of these residuals share."""
    return float(solve(equations, log_sizes).log_posterior - _log_prior(equations, log_sizes))


def log_evidence(equations: Equations, solution: Solution, information: Float[ndarray, "c c"]) -> float:
    """Log density of the residuals, averaged over unknowns and sizes: of s residuals but for (2π)^(−s/2), and up to a
    constant that all sets of residuals share.

    By Laplace's method about the mode of the sizes, at which `solution` and `information` are.
    """
    against_prior = (
        equations.prior_gradient
        @ np.linalg.lstsq(equations.prior_information, equations.prior_gradient, rcond=None)[0]
    )
    return float(solution.log_posterior - against_prior / 2 - np.linalg.slogdet(information)[1] / 2)


def over_sizes(
    equations: Equations,
    log_sizes: LogSizes,
    information: Float[ndarray, "c c"],
    density: Callable[[Solution], Each] = lambda solution: solution.log_posterior,
) -> list[tuple[Float[ndarray, " g"], Float[ndarray, "g c"], Solution]]:
    """Posterior weights (their sum is 1) of log sizes about their mode, and the solutions at these, in groups.

    `density` is the logarithm of the sizes' posterior, up to a constant.
    """
    sizes, log_volumes = _grid(equations, log_sizes, information, lambda at: density(solve(equations, at)))
    together = max(1, int(AT_ONCE / len(equations.residual) ** 2))
    groups = [sizes[at : at + together] for at in range(0, len(sizes), together)]
    solutions = [solve(equations, group) for group in groups]
    log_weight = np.concatenate([density(each) for each in solutions]) + log_volumes
    weight = np.exp(log_weight - log_weight.max())
    shares = np.split(weight / weight.sum(), np.cumsum([len(group) for group in groups])[:-1])
    return list(zip(shares, groups, solutions, strict=True))


def _log_prior(equations: Equations, log_sizes: LogSizes) -> Each:
    """Log density of the weak priors of the sizes."""
    z = (log_sizes - np.log(equations.typical)) / FACTOR_STD[: equations.count]
    ratio = (log_sizes[..., 0] - log_sizes[..., 1] - np.log(REACH)) / RATIO_STD
    return -((z**2).sum(-1) + ratio**2) / 2


def _prior_slope(equations: Equations, log_sizes: LogSizes) -> tuple[LogSizes, Float[ndarray, "c c"]]:
    """Its gradient and negative Hessian."""
    std = FACTOR_STD[: equations.count]
    z = (log_sizes - np.log(equations.typical)) / std
    ratio = (log_sizes[0] - log_sizes[1] - np.log(REACH)) / RATIO_STD
    apart = np.zeros(equations.count)
    apart[:2] = 1 / RATIO_STD, -1 / RATIO_STD
    return -z / std - ratio * apart, np.diag(std**-2.0) + np.outer(apart, apart)


def _score(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Float[ndarray, "c c"]]:
    """Log posterior of the sizes, its gradient, and the expected information."""
    solution = solve(equations, log_sizes)
    inverse = _inverse(solution.root)
    projection = inverse - solution.weighed @ solution.gain
    left = inverse @ (equations.residual + equations.jacobian @ solution.step)
    of_position = equations.of_position
    masks = np.stack([of_position, 1 - of_position])
    squares, traces = masks @ left**2, masks @ np.diagonal(projection)
    pairs = masks @ projection**2 @ masks.T
    if equations.systematic is not None:
        by_systematic = projection @ equations.systematic
        beside = masks @ (by_systematic * projection).sum(1)
        own = (by_systematic * by_systematic.T).sum()
        pairs = np.block([[pairs, beside[:, None]], [beside[None], own]])
        squares = np.append(squares, left @ equations.systematic @ left)
        traces = np.append(traces, np.trace(by_systematic))
    growth = np.exp(2 * log_sizes)
    gradient, information = _prior_slope(equations, log_sizes)
    return (
        float(solution.log_posterior),
        gradient + growth * (squares - traces),
        information + 2 * np.outer(growth, growth) * pairs,
    )


def _grid(
    equations: Equations,
    mode: LogSizes,
    information: Float[ndarray, "c c"],
    log_density: Callable[[LogSizes], Each],
) -> tuple[Float[ndarray, "k c"], Float[ndarray, " k"]]:
    """Log sizes about their mode, and the log of the volume that each stands for.

    Along each axis of the information, either way, in steps of the standard deviation that the posterior has there,
    which is skew: what few images show is rather what the sizes are not above than what they are not below.
    """
    poses = len(equations.residual) // 6
    if poses > TOO_MANY:
        return mode[None], np.zeros(1)
    values, vectors = np.linalg.eigh(information)
    axes = vectors / np.sqrt(values)
    top, probe = log_density(mode), 1.5
    beside = mode + probe * np.concatenate([-axes.T, axes.T])
    drop = top - np.array([log_density(at) for at in beside])
    shorter, longer = np.clip(probe / np.sqrt(np.maximum(2 * drop, 1e-3)), 0.3, 3.0).reshape(2, -1)
    z = np.array(list(product(LEVELS, repeat=len(mode))))
    z = z[(z**2).sum(1) < (FARTHEST if poses < MANY else LESS_FAR)]
    lengths = np.where(z < 0, shorter, longer)
    return mode + (lengths * z) @ axes.T, np.log(lengths).sum(1)


def _elsewhere(
    equations: Equations, solution: Solution, log_sizes: LogSizes, region: Region | None
) -> Float[ndarray, "*k p p"]:
    """Covariance of what the systematic part leaves open because the answer is asked for the region, not its poses."""
    if region is None or equations.systematic is None:
        return np.zeros_like(solution.information_root)
    part = equations.variances(log_sizes)[..., 2, None, None] * equations.systematic
    left = equations.residual[:, None] + equations.jacobian @ solution.step[..., None]
    expected = part @ over(solution.root, left)
    shown = lower(solution.root, part)
    fitted = lower(solution.information_root, np.swapaxes(solution.weighed, -1, -2) @ part)
    m, own = len(equations.residual) // 6, _own(part)
    for sign, root in ((-1, shown), (1, fitted)):
        columns = np.moveaxis(root.reshape(*root.shape[:-1], m, 6), -2, -3)
        own = own + sign * np.swapaxes(columns, -1, -2) @ columns
    expected = expected.reshape(*expected.shape[:-2], m, 6)
    return region.spread(own + expected[..., :, None] * expected[..., None, :])


def _own(covariance: Float[ndarray, "*k s s"]) -> Float[ndarray, "*k m 6 6"]:
    """The block of each pose by itself."""
    m = covariance.shape[-1] // 6
    each = np.arange(m)
    return np.moveaxis(covariance.reshape(*covariance.shape[:-2], m, 6, m, 6)[..., each, :, each, :], 0, -3)


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

    normal = float(chi2.ppf(COVERED, size))
    least, most = np.log([1e-3, 1e4 * normal])
    for _ in range(HALVINGS):
        middle = (least + most) / 2
        if weight @ chi2.cdf(np.exp(middle) / unit, mean / unit) < COVERED:
            least = middle
        else:
            most = middle
    return max(1.0, float(np.exp(most)) / normal)


def _between(one: Float[ndarray, "p p"], other: Float[ndarray, "p p"]) -> Float[ndarray, "p p"]:
    """The linear map of least displacement that takes errors of one covariance to those of the other.

    Symmetric, where lengths are counted in standard deviations (Knott and Smith, J. Optim. Theory Appl. 43, 1984).
    """
    std = np.sqrt(np.diag(one))
    values, vectors = np.linalg.eigh(one / np.outer(std, std))
    values = np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
    root, inverse = (vectors * values @ vectors.T, vectors / values @ vectors.T)
    squared, axes = np.linalg.eigh(root @ (other / np.outer(std, std)) @ root)
    by = inverse @ (axes * np.sqrt(np.maximum(squared, 0.0)) @ axes.T) @ inverse
    return std[:, None] * by / std


def _budget(
    equations: Equations,
    log_sizes: LogSizes,
    elsewhere: Float[ndarray, "p p"],
    covariance: Float[ndarray, "p p"],
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
    if exact.bent is not None:
        systematic = systematic + gain @ exact.bent @ gain.T
    # What neither robot nor cameras show.
    images = solution.covariance @ exact.prior_information @ solution.covariance
    if exact.known is not None:
        images = images + gain @ exact.known @ gain.T
    free = solve(equations, log_sizes)
    intrinsics = free.covariance[:POSES, :POSES] - solution.covariance
    systematic = systematic + elsewhere[:POSES, :POSES]
    parts = [part[:7, :7] for part in (random, systematic, intrinsics, images)]
    to_whole = _between(sum(parts[1:], parts[0]), covariance[:7, :7])
    random, systematic, intrinsics, _ = (to_whole @ part @ to_whole.T for part in parts)
    return Budget(
        robot_random=random,
        robot_systematic=systematic,
        intrinsics=intrinsics,
        # What is unobservable is among it, and the rounding of its large numbers.
        images=covariance[:7, :7] - random - systematic - intrinsics,
        faults=np.zeros((7, 7)),
    )
