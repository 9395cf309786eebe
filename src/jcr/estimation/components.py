"""How large the errors of gripper poses are, random and systematic: variance components of a mixed linear model.

Restricted maximum likelihood shows the three sizes (Searle, Casella and McCulloch, "Variance components", 1992, section
6.6), but few images show them badly. An answer is therefore not taken at the best sizes: it is averaged over them with
their posterior weights, on a grid about the mode (Rue, Martino and Chopin, J. R. Statist. Soc. B 71, 2009, section 3).
"""

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.mixed_model import Each, Equations, LinearSolution, LogSizes, solve_equations

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
SETTLED = 1e-4
"""Change of log sizes that no longer matters."""

Information = Float[ndarray, "c c"]
"""Expected, of the log sizes at their mode."""
Weighed = list[tuple[Float[ndarray, " g"], Float[ndarray, "g c"], LinearSolution]]
"""Posterior weights (their sum is 1) of log sizes about their mode, and the solutions at these, in groups."""


def most_likely(
    equations: Equations,
    start: LogSizes | None = None,
    settled: float = SETTLED,
    score: Callable[[LogSizes], tuple[float, LogSizes, Information]] | None = None,
) -> tuple[LogSizes, Information]:
    """Log sizes at the mode of their posterior, and the expected information there, to a last step `settled`.

    By Fisher scoring, with the curvature that the last step showed (BFGS, Nocedal and Wright, "Numerical optimization",
    2006, eq. 6.19): where the expected information is half of it, steps swing about the mode.
    """
    score = score or (lambda at: _score(equations, at))
    at = np.log(equations.typical) if start is None else start
    value, gradient, information = score(at)
    curvature = information
    for _ in range(40):
        step = np.linalg.solve(curvature, gradient)
        step /= max(1.0, float(np.abs(step).max()))
        while (scored := score(at + step))[0] < value and np.abs(step).max() > settled:
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
    """Log density of the residuals, averaged over unknowns and sizes: of s residuals but for (2π)^(−s/2), and up to a
    constant that all sets of residuals share.

    By Laplace's method about the mode of the sizes, at which `log_posterior` and `information` are.
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
    """The log sizes about their mode that stand for all.

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
    """Of the log sizes, their prior included."""
    return _score(equations, log_sizes)[2]


def _score(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Information]:
    """Log posterior of the sizes, its gradient, and the expected information."""
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
