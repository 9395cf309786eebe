"""Mixed linear model of gripper poses at one value of the unknowns, and its solution at given sizes of the errors.

The residuals of n poses are r = −J θ + e + ε. The random part ε has σ_t² per axis of position and σ_r² per axis of
rotation, the systematic part e has covariance σ_s² G (systematic.py), and what the cameras add is known.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.cholesky import cholesky, inverse_of, log_root_determinant, lower, over, upper
from jcr.estimation.systematic import REACH
from jcr.records import RobotNoise

NOISE_FLOOR = (2e-5, np.radians(0.002))
"""Least noise (m, rad) beside the estimated one, so that a perfect fit does not claim a perfect robot."""
TYPICAL = np.array([3e-4, np.radians(0.04), np.radians(0.1)])
"""Middle of the weak priors of σ_t (m), σ_r (rad) and σ_s (rad) of an arm."""
FACTOR_STD = np.log([10.0, 10.0, 3.0])
"""Logarithms of the factors by which arms differ in these. Data sheets of industrial arms state 0.03 to 0.1° of
systematic error, those of servo arms 1 to 2°."""
TYPICAL_WALKS, WALK_FACTOR_STD = np.array([3e-4, 1e-3, 1e-3]), np.log(30.0)
"""Growth of the errors of camera poses from one image to the next (m, rad, relative scale), and the factor by which it
differs between sequences."""
_FACTORS = np.r_[FACTOR_STD, np.full(3, WALK_FACTOR_STD)]
GIVEN_SHARE = 0.3
"""Middle of the prior of a robot's noise beside a given one, as a share of the given one."""
SHOWN = 1.1
"""Factor on a given noise beyond which the noise counts as estimated from the residuals."""
LEAST_BESIDE = 0.01
"""Least errors beside the given noise, as a share of it: the logarithm of no error is not finite."""
RATIO_STD = np.log(4.0)
"""Standard deviation of log(σ_t / (REACH · σ_r)) over robots. With log 2 instead, three images of a robot whose
rotations are six times better than its positions cover 80 to 90 %."""

LogSizes = Float[ndarray, "*k c"]
"""Logarithms of σ_t, σ_r and, where there is a systematic part, σ_s."""
Each = Float[ndarray, "*k"] | np.floating
Residuals = Float[ndarray, " s"]
Covariance = Float[ndarray, "s s"]


@dataclass(frozen=True, kw_only=True)
class Equations:
    """Linearised equations of the used poses; s = 6 times their number, p unknowns."""

    residual: Residuals
    """Steps (geometry.retract) from the reported to the predicted poses in turn: m, then rad; both in base axes."""
    jacobian: Float[ndarray, "s p"]
    prior_information: Float[ndarray, "p p"]
    prior_gradient: Float[ndarray, " p"]
    known: Covariance | None = None
    """Covariance of the residuals by errors of the cameras."""
    systematic: Covariance | None = None
    """Covariance of the systematic part where σ_s is 1 rad; None: there is none."""
    given: tuple[float, float] | None = None
    """Lower bounds of σ_t and σ_r that the user gave (m, rad)."""
    walks: tuple[Covariance, ...] = ()
    """Covariances of errors of the camera poses that add up along the sequence, where their sizes are 1."""
    confirmed: Covariance | None = None
    """Covariance of errors that were confirmed, whatever the sizes of the others are."""

    @property
    def least(self) -> Float[ndarray, "2"]:
        """Noise σ_t and σ_r that counts beside the estimated one."""
        return np.array(self.given or NOISE_FLOOR)

    @property
    def typical(self) -> Float[ndarray, " c"]:
        """Middle of the priors of what is estimated."""
        typical = np.r_[TYPICAL, TYPICAL_WALKS][: self.count]
        if self.given is not None:
            typical[:2] = GIVEN_SHARE * self.least
        return typical

    @property
    def count(self) -> int:
        """Number of sizes to be estimated."""
        return len(self.components) + 2

    @property
    def components(self) -> tuple[Covariance, ...]:
        """Covariances whose sizes are estimated beside those of the random errors."""
        return (() if self.systematic is None else (self.systematic,)) + self.walks

    @cached_property
    def of_position(self) -> Residuals:
        """1 for residuals of position, 0 for those of rotation."""
        return np.tile(np.repeat([1.0, 0.0], 3), len(self.residual) // 6)

    def variances(self, log_sizes: LogSizes) -> Float[ndarray, "*k c"]:
        """Return σ_t², σ_r², σ_s² and the squared growth of the camera errors."""
        variances = np.exp(2 * log_sizes)
        variances[..., :2] += self.least**2
        return variances

    def log_sizes_of(self, noise: RobotNoise) -> Float[ndarray, " c"]:
        """Return the log sizes of a noise, at least LEAST_BESIDE of the noise that counts in any case."""
        sizes = np.array([noise.translation, noise.rotation, noise.systematic])[: self.count]
        beside = np.sqrt(np.maximum(sizes[:2] ** 2 - self.least**2, (LEAST_BESIDE * self.least) ** 2))
        return np.log(np.r_[beside, np.maximum(sizes[2:], LEAST_BESIDE * self.least[1])])

    def random(self, log_sizes: LogSizes) -> Float[ndarray, "*k s"]:
        """Return the variance of each residual's random part."""
        variances = self.variances(log_sizes)
        return variances[..., :1] * self.of_position + variances[..., 1:2] * (1 - self.of_position)

    def noise(self, log_sizes: LogSizes) -> RobotNoise:
        """Return the errors of the poses at these sizes, where there is a systematic part."""
        assert self.systematic is not None
        metres, radians, systematic = np.sqrt(self.variances(log_sizes)[:3]).tolist()
        left = systematic * np.sqrt(np.diag(self.systematic).reshape(-1, 2, 3).mean((0, 2)))
        shown = SHOWN * np.array(self.given or (0.0, 0.0))
        return RobotNoise(
            translation=metres,
            rotation=radians,
            estimated=bool((shown < (metres, radians)).any()),
            given=self.given,
            systematic=systematic,
            systematic_left=(float(left[0]), float(left[1])),
        )

    def covariance(self, log_sizes: LogSizes) -> Float[ndarray, "*k s s"]:
        """Return the covariance V of the residuals."""
        random = self.random(log_sizes)
        covariance = np.zeros((*random.shape, random.shape[-1]))
        variances = self.variances(log_sizes)[..., 2:]
        for k, part in enumerate(self.components):
            covariance += variances[..., k, None, None] * part
        for part in (self.known, self.confirmed):
            if part is not None:
                covariance += part
        diagonal = np.arange(random.shape[-1])
        covariance[..., diagonal, diagonal] += random
        return covariance

    def log_prior(self, log_sizes: LogSizes) -> Each:
        """Return the log density of the weak priors of the sizes, up to a constant."""
        z = (log_sizes - np.log(self.typical)) / _FACTORS[: self.count]
        ratio = (log_sizes[..., 0] - log_sizes[..., 1] - np.log(REACH)) / RATIO_STD
        return -((z**2).sum(-1) + ratio**2) / 2

    @property
    def log_prior_volume(self) -> float:
        """Logarithm of the volume of the priors of the sizes, up to a constant that models of equal sizes share."""
        return float(np.log(_FACTORS[: self.count]).sum())

    def log_prior_slope(self, log_sizes: LogSizes) -> tuple[LogSizes, Float[ndarray, "c c"]]:
        """Return the gradient and the negative Hessian of `log_prior`."""
        std = _FACTORS[: self.count]
        z = (log_sizes - np.log(self.typical)) / std
        ratio = (log_sizes[0] - log_sizes[1] - np.log(REACH)) / RATIO_STD
        apart = np.zeros(self.count)
        apart[:2] = 1 / RATIO_STD, -1 / RATIO_STD
        return -z / std - ratio * apart, np.diag(std**-2.0) + np.outer(apart, apart)


@dataclass(frozen=True, kw_only=True)
class LinearSolution:
    """Unknowns at one value of the sizes, or at k values."""

    log_likelihood: Each
    """Restricted, of the sizes; up to a constant that all sizes and all models of the same residuals share."""
    log_posterior: Each
    """Log likelihood with the prior of the sizes."""
    step: Float[ndarray, "*k p"]
    root: Float[ndarray, "*k s s"]
    """Lower Cholesky factor of V."""
    information_root: Float[ndarray, "*k p p"]
    """Lower Cholesky factor of JᵀV⁻¹J + prior."""
    weighed: Float[ndarray, "*k s p"]
    """V⁻¹J."""
    weighed_left: Float[ndarray, "*k s"]
    """Weighed remaining residuals V⁻¹(r + Jθ)."""

    @property
    def gain(self) -> Float[ndarray, "*k p s"]:
        """Gain with which errors of the residuals pass into the unknowns, with the sign reversed: C JᵀV⁻¹."""
        return over(self.information_root, np.swapaxes(self.weighed, -1, -2))

    @property
    def covariance(self) -> Float[ndarray, "*k p p"]:
        """C of the unknowns."""
        return over(self.information_root, np.eye(self.step.shape[-1]))

    @cached_property
    def weight(self) -> Covariance:
        """V⁻¹, at one value of the sizes."""
        return inverse_of(self.root)

    @property
    def projection(self) -> Covariance:
        """P = V⁻¹ − V⁻¹J C JᵀV⁻¹, at one value of the sizes."""
        return self.weight - self.weighed @ self.gain


def solve_equations(equations: Equations, log_sizes: LogSizes) -> LinearSolution:
    """Return the generalised least-squares solution at given sizes."""
    root = cholesky(equations.covariance(log_sizes))
    whitened = lower(root, np.column_stack([equations.jacobian, equations.residual]))
    jacobian, residual = whitened[..., :-1], whitened[..., -1:]
    transposed = np.swapaxes(jacobian, -1, -2)
    information_root = cholesky(transposed @ jacobian + equations.prior_information)
    gradient = transposed @ residual + equations.prior_gradient[:, None]
    step = -over(information_root, gradient)
    squares = (residual**2).sum((-1, -2)) + (gradient * step).sum((-1, -2))
    determinants = log_root_determinant(root) + log_root_determinant(information_root)
    log_likelihood = -determinants - squares / 2
    weighed = upper(root, whitened)
    return LinearSolution(
        log_likelihood=log_likelihood,
        log_posterior=log_likelihood + equations.log_prior(log_sizes),
        step=step[..., 0],
        root=root,
        information_root=information_root,
        weighed=weighed[..., :-1],
        weighed_left=weighed[..., -1] + (weighed[..., :-1] @ step)[..., 0],
    )


def left_out(
    solution: LinearSolution, noise: tuple[float, float]
) -> tuple[Float[ndarray, "m 6"], Float[ndarray, "m 6 6"]]:
    """Return each pose's residual from a fit without it, P_ii⁻¹ (P r)_i, and its covariance P_ii⁻¹.

    `noise` (m, rad) sets the units in which the matrices are inverted.
    """
    sigma, m = np.repeat(noise, 3), len(solution.root) // 6
    own = solution.projection.reshape(m, 6, m, 6)[range(m), :, range(m)]
    without = np.linalg.inv(sigma[:, None] * own * sigma + 1e-9 * np.eye(6))
    found = sigma * np.einsum("mij,mj->mi", without, sigma * solution.weighed_left.reshape(m, 6))
    return found, sigma[:, None] * without * sigma
