"""Variance components of the errors of gripper poses, random and systematic, in a mixed linear model.

Restricted maximum likelihood estimates the three sizes (Searle, Casella and McCulloch, "Variance components", 1992,
section 6.6), but few images determine them badly. A result is therefore averaged over the sizes with their posterior
weights, on a grid about the mode (Rue, Martino and Chopin, J. R. Statist. Soc. B 71, 2009, section 3).
"""

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.mixed_model import Each, Equations, LinearSolution, LogSizes, solve_equations

LEVELS = tuple(1.5 * np.arange(-4, 5))
"""Distances from the mode at which the posterior is evaluated, in standard deviations of the log sizes; for a normal
posterior the error of this sum is 3e-4."""
FARTHEST, LESS_FAR = 21.0, 10.0
"""Largest squared distance from the mode. Rare errors come from rare sizes: with 7 as the limit, three images covered
81 % instead of 95 %, and two of 120 images that had not moved were called moved at p < 0.001."""
MANY, TOO_MANY = 15, 80
"""Numbers of poses from which the smaller limit is enough, and from which the mode alone is used."""
AT_ONCE = 4e6
"""Largest number of elements of an array of solutions that are computed together."""
SETTLED = 1e-4
"""Change of log sizes that no longer matters."""

Information = Float[ndarray, "c c"]
"""Expected information of the log sizes at their mode."""
Weighed = list[tuple[Float[ndarray, " g"], Float[ndarray, "g c"], LinearSolution]]
"""Posterior weights (their sum is 1) of log sizes about their mode, and the solutions at these, in groups."""


def most_likely(
    equations: Equations,
    start: LogSizes | None = None,
    settled: float = SETTLED,
) -> tuple[LogSizes, Information]:
    """Return the log sizes at the mode of their posterior, to a last step `settled`, and their expected information.

    Fisher scoring uses the curvature that the last step showed (BFGS, Nocedal and Wright, "Numerical optimization",
    2006, eq. 6.19): where the expected information is half of the curvature, steps swing about the mode.
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
            shown = np.outer(fell, fell) / (step @ fell)
            curvature = information - np.outer(along, along) / (step @ along) + shown
        if np.abs(step).max() < settled or gained < 1e-9:
            break
    return at, information


def log_evidence(equations: Equations, log_posterior: float, information: Information) -> float:
    """Return the log density of the residuals, averaged over unknowns and sizes, up to a common constant.

    Laplace's method is used about the mode of the sizes, at which `log_posterior` and `information` are. The factor
    (2π)^(−s/2) of s residuals is left out.
    """
    gradient = equations.prior_gradient
    against_prior = gradient @ np.linalg.lstsq(equations.prior_information, gradient, rcond=None)[0]
    return log_posterior - float(against_prior) / 2 - float(np.linalg.slogdet(information)[1]) / 2


def growth_scores(
    equations: Equations, log_sizes: LogSizes, parts: Sequence[Float[ndarray, "s s"]]
) -> Float[ndarray, " k"]:
    """Return the score test of further components at size 0, in standard deviations (Rao 1948)."""
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left
    by = [projection @ part for part in parts]
    pull = np.array([left @ part @ left - np.trace(one) for part, one in zip(parts, by, strict=True)])
    return pull / np.sqrt([2 * (one * one.T).sum() for one in by])


def over_sizes(
    equations: Equations,
    log_sizes: LogSizes,
    information: Information,
    density: Callable[[LinearSolution], Each] = lambda solution: solution.log_posterior,
) -> Weighed:
    """Return a grid of log sizes about their mode with posterior weights and solutions.

    `density` is the logarithm of the sizes' posterior, up to a constant.
    """
    sizes, log_volumes = _grid(
        equations, log_sizes, information, lambda at: density(solve_equations(equations, at))
    )
    together = max(1, int(AT_ONCE / len(equations.residual) ** 2))
    groups = [sizes[at : at + together] for at in range(0, len(sizes), together)]
    solutions = [solve_equations(equations, group) for group in groups]
    log_weight = np.concatenate([density(each) for each in solutions]) + log_volumes
    weight = np.exp(log_weight - log_weight.max())
    shares = np.split(weight / weight.sum(), np.cumsum([len(group) for group in groups])[:-1])
    return list(zip(shares, groups, solutions, strict=True))


def expected_information(equations: Equations, log_sizes: LogSizes) -> Information:
    """Return the expected information of the log sizes, including their prior."""
    return _score(equations, log_sizes)[2]


def _score(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Information]:
    """Return the log posterior of the sizes, its gradient, and the expected information."""
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left
    masks = np.stack([equations.of_position, 1 - equations.of_position])
    squares, traces = masks @ left**2, masks @ np.diagonal(projection)
    pairs = masks @ projection**2 @ masks.T
    if parts := equations.components:
        by = [projection @ part for part in parts]
        beside = np.stack([masks @ (one * projection).sum(1) for one in by], axis=1)
        own = np.array([[(one * other.T).sum() for other in by] for one in by])
        pairs = np.block([[pairs, beside], [beside.T, own]])
        squares = np.r_[squares, [left @ part @ left for part in parts]]
        traces = np.r_[traces, [np.trace(one) for one in by]]
    growth = np.exp(2 * log_sizes)
    gradient, information = equations.log_prior_slope(log_sizes)
    return (
        float(solution.log_posterior),
        gradient + growth * (squares - traces),
        information + 2 * np.outer(growth, growth) * pairs,
    )


def _grid(
    equations: Equations, mode: LogSizes, information: Information, log_density: Callable[[LogSizes], Each]
) -> tuple[Float[ndarray, "k c"], Float[ndarray, " k"]]:
    """Return log sizes about their mode, and the log volume of each.

    The steps along both directions of each axis of the information are the standard deviation of the posterior there,
    which is skew: few images bound the sizes from above rather than from below.
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
