"""The robot's noise, estimated from few residuals: how large, how surely, and what that does to a covariance.

A covariance C that is computed with estimated variances is too small: of few images the residuals may by chance be
small, and the answer is then far off and thought to be near. Where C = σ̂²·Q with ν degrees of freedom behind σ̂², a
squared Mahalanobis distance over m unknowns follows m·F(m, ν) and not χ²(m): tails of Student's t. A covariance cannot
say that, so it is scaled until the ellipsoid drawn from it for 99 % holds 99 %; smaller ones then hold more than they
say. The tail is what counts: a trusted answer that is several standard deviations off is the worst fault.

Here there are two variances, σ_t² of positions and σ_r² of orientations, known unequally well, and errors of cameras or
features besides, which are known. Directions of the unknowns hang on the three by different shares, and each direction
has degrees of freedom of its own (Satterthwaite, Biometrics Bulletin 2, 1946; for variances from restricted maximum
likelihood Fai and Cornelius, J. Statist. Comput. Simul. 54, 1996): ν = 2 / var(log of the direction's variance). An
exact robot's noise may be unknown by any factor, and widens nothing where no variance hangs on it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import chi2, f

REACH = 0.45
"""m. A joint's error shows in the gripper's position as in its orientation (rad) times the reach behind it."""
NOISE_FLOOR = (2e-5, np.radians(0.002))
"""m, rad; so that a perfect fit does not claim a perfect robot."""
REACH_WEIGHT = 5.0
"""The relation σ_t ≈ REACH · σ_r counts as so many observations. A lens that is slightly off disturbs positions
more than orientations, and few images do not tell the two noises apart: without it, real captures trust
positions too much."""
RATIO_STD = np.log(2.0)
"""Of log(σ_t / (REACH · σ_r)) over robots. The estimate leans on the relation more than this allows; how sure the
estimate is may not, or robots of another ratio are farther off than is promised."""
COVERED = 0.99
"""By the ellipsoid that holds what it says. With 0.95 instead, of 11790 trusted simulated calibrations from three to
six images 5 were off by more than five standard deviations on an axis, and with this none of 10901."""
MISFIT = 0.05
"""Chance that the residuals of a robot whose noise was given truly are called larger than that."""
MANY, FEWEST = 1e9, 1.0
"""Degrees of freedom where the noise was given, and where next to nothing tells it."""
RELATIVE_ROUNDING = 1e-9


@dataclass(frozen=True)
class NoiseShare:
    """What a covariance owes to the robot's noise, and how surely that noise is known."""

    by_log_variance: Float[ndarray, "2 k k"]
    """Derivatives of the covariance by log σ_t² and log σ_r²: its parts that hang on each."""
    log_variance_covariance: Float[ndarray, "2 2"]
    """Of the estimates of log σ_t² and log σ_r²; zero where a given noise explains the residuals."""


def robot_noise(
    squares: tuple[float, float],
    degrees_of_freedom: tuple[float, float],
    before: tuple[float, float],
    given: tuple[float, float] | None = None,
) -> tuple[float, float]:
    """σ_t and σ_r from sums of squared residuals (m², rad²), tied to each other by the arm's reach.

    Where a noise is given, no less than that, but more where the residuals say so: in them are errors of cameras and
    of wrong poses besides the robot's, and a covariance that left these out would be too small.
    """
    weight = REACH_WEIGHT
    sigma_t = np.sqrt((squares[0] + weight * (REACH * before[1]) ** 2) / (degrees_of_freedom[0] + weight))
    sigma_r = np.sqrt((squares[1] + weight * (before[0] / REACH) ** 2) / (degrees_of_freedom[1] + weight))
    least = NOISE_FLOOR if given is None else given
    return max(float(sigma_t), least[0]), max(float(sigma_r), least[1])


def noise_share(
    gain: Float[ndarray, "k r"],
    told: Float[ndarray, "r r"],
    robot: tuple[float, float],
    given: tuple[float, float] | None,
) -> NoiseShare:
    """From how errors of the reported poses (r = 6 times their number) pass into k unknowns, and P of the fit.

    P = W - W J H⁻¹ Jᵀ W is `told`; the information of log σ_k² is ½ tr(P V_k P V_l), V_k the part of the residuals'
    covariance that is the robot's (Searle et al., "Variance components", 1992, section 6.6). A given noise that
    explains the residuals (χ² test at MISFIT) is known.
    """
    m = len(told) // 6
    sigma = np.tile(np.repeat(robot, 3), m)
    scaled = (gain * sigma).reshape(len(gain), m, 2, 3)
    share = np.einsum("kmca,lmca->ckl", scaled, scaled)
    told = sigma[:, None] * told * sigma
    degrees = np.diag(told).reshape(m, 2, 3).sum((0, 2))
    if given is not None and chi2.sf(degrees @ (np.divide(robot, given) ** 2), degrees.sum()) > MISFIT:
        return NoiseShare(share, np.zeros((2, 2)))
    information = (told**2).reshape(m, 2, 3, m, 2, 3).sum((0, 2, 3, 5)) / 2
    # log(σ_t² / σ_r²) has twice the standard deviation of log(σ_t / σ_r).
    information += np.array([[1, -1], [-1, 1]]) / (2 * RATIO_STD) ** 2 + RELATIVE_ROUNDING * np.eye(2)
    return NoiseShare(share, np.linalg.inv(information))


def directions(
    covariance: Float[ndarray, "k k"], noise: NoiseShare
) -> tuple[Float[ndarray, "k k"], Float[ndarray, " k"]]:
    """Independent directions (columns; their outer products sum to the covariance), and the degrees of freedom of each.

    From those that hang on one of the robot's noises to those that hang on the other.
    """
    # Of motions that show too little, rounding leaves no positive definite matrix.
    std = np.sqrt(np.abs(np.diag(covariance)))
    values, vectors = np.linalg.eigh(covariance / std[:, None] / std)
    root = vectors * np.sqrt(np.maximum(values, RELATIVE_ROUNDING))
    to_unit = np.linalg.inv(root) / std
    relative = to_unit @ noise.by_log_variance @ to_unit.T
    axes = np.linalg.eigh(relative[0] - relative[1])[1]
    share = np.clip(np.einsum("ij,cik,kj->jc", axes, relative, axes), 0, 1)
    of_log = np.einsum("jc,cd,jd->j", share, noise.log_variance_covariance, share)
    return std[:, None] * root @ axes, 2 / np.clip(of_log, 2 / MANY, 2 / FEWEST)


def widened(covariance: Float[ndarray, "k k"], noise: NoiseShare) -> Float[ndarray, "k k"]:
    """The covariance whose 99 % ellipsoid holds 99 % though the robot's noise in it was estimated."""
    axes, nu = directions(covariance, noise)
    k = len(covariance)
    factor = k * f.ppf(COVERED, k, nu) / chi2.ppf(COVERED, k)
    return (axes * factor) @ axes.T
