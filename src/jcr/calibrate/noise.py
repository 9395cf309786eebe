"""The robot's noise, estimated from few residuals: how large, how surely, and what that does to a covariance.

A covariance C that is computed with estimated variances is too small: of few images the residuals may by chance be
small, and the answer is then far off and thought to be near. Where C = σ̂²·Q with ν degrees of freedom behind σ̂², a
squared Mahalanobis distance over m unknowns follows m·F(m, ν) and not χ²(m): tails of Student's t. A covariance cannot
say that, so it is scaled until the ellipsoid that users draw from it for 95 % holds 95 %; those for less then hold
more, those for much more somewhat less.

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
from scipy.linalg import eigh
from scipy.stats import chi2, f

from jcr.records import REACH

NOISE_FLOOR = (2e-5, np.radians(0.002))
"""m, rad; so that a perfect fit does not claim a perfect robot."""
REACH_WEIGHT = 5.0
"""The relation σ_t ≈ REACH · σ_r counts as so many observations. A lens that is slightly off disturbs positions
more than orientations, and few images do not tell the two noises apart: without it, real captures trust
positions too much."""
RATIO_STD = np.log(2.0)
"""Of log(σ_t / (REACH · σ_r)) over robots. The estimate leans on the relation more than this allows; how sure the
estimate is may not, or three images of a robot of another ratio cover 79 % where 95 % are promised."""
COVERED = 0.95


@dataclass(frozen=True)
class NoiseShare:
    """What a covariance owes to the robot's noise, and how surely that noise is known."""

    by_log_variance: Float[ndarray, "2 k k"]
    """Derivatives of the covariance by log σ_t² and log σ_r²: its parts that hang on each."""
    log_variance_covariance: Float[ndarray, "2 2"]
    """Of the estimates of log σ_t² and log σ_r²; zero where the noise was given."""


def robot_noise(
    squares: tuple[float, float], degrees_of_freedom: tuple[float, float], before: tuple[float, float]
) -> tuple[float, float]:
    """σ_t and σ_r from sums of squared residuals (m², rad²), tied to each other by the arm's reach."""
    weight = REACH_WEIGHT
    sigma_t = np.sqrt((squares[0] + weight * (REACH * before[1]) ** 2) / (degrees_of_freedom[0] + weight))
    sigma_r = np.sqrt((squares[1] + weight * (before[0] / REACH) ** 2) / (degrees_of_freedom[1] + weight))
    return max(float(sigma_t), NOISE_FLOOR[0]), max(float(sigma_r), NOISE_FLOOR[1])


def noise_share(
    gain: Float[ndarray, "k r"], told: Float[ndarray, "r r"], robot: tuple[float, float], estimated: bool
) -> NoiseShare:
    """From how errors of the reported poses (r = 6 times their number) pass into k unknowns, and P of the fit.

    P = W - W J H⁻¹ Jᵀ W is `told`; the information of log σ_k² is ½ tr(P V_k P V_l), V_k the part of the residuals'
    covariance that is the robot's (Searle et al., "Variance components", 1992, section 6.6).
    """
    sigma = np.tile(np.repeat(robot, 3), len(told) // 6)
    scaled = (gain * sigma).reshape(len(gain), -1, 2, 3)
    share = np.einsum("kmca,lmca->ckl", scaled, scaled)
    if not estimated:
        return NoiseShare(share, np.zeros((2, 2)))
    squares = (sigma[:, None] * told * sigma) ** 2
    m = len(told) // 6
    information = squares.reshape(m, 2, 3, m, 2, 3).sum((0, 2, 3, 5)) / 2
    # log(σ_t² / σ_r²) has twice the standard deviation of log(σ_t / σ_r).
    information += np.array([[1, -1], [-1, 1]]) / (2 * RATIO_STD) ** 2
    return NoiseShare(share, np.linalg.inv(information))


def degrees_of_freedom(
    share: Float[ndarray, "*k 2"], log_variance_covariance: Float[ndarray, "2 2"]
) -> Float[ndarray, "*k"] | np.floating:
    """Of variances that hang on σ_t² and σ_r² by `share` of them each; infinite where nothing is unknown."""
    variance = np.einsum("...i,ij,...j->...", share, log_variance_covariance, share)
    return 2 / np.maximum(variance, 2e-9)


def widened(covariance: Float[ndarray, "k k"], noise: NoiseShare) -> Float[ndarray, "k k"]:
    """The covariance whose 95 % ellipsoid holds 95 % though the robot's noise in it was estimated."""
    # Independent directions of unit variance, from those that hang on one noise to those that hang on the other.
    axes = eigh(noise.by_log_variance[0] - noise.by_log_variance[1], covariance)[1]
    share = np.einsum("ij,cik,kj->jc", axes, noise.by_log_variance, axes)
    nu = degrees_of_freedom(share, noise.log_variance_covariance)
    k = len(covariance)
    factor = k * f.ppf(COVERED, k, nu) / chi2.ppf(COVERED, k)
    extent = covariance @ axes
    return (extent * factor) @ extent.T
