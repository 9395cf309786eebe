"""Tests of additional parameters of the gripper poses: Rao's score test ranks, Wald's test confirms.

The score test uses the error sizes of the solution, which were estimated with the effect inside and absorb part of it
(Rao 1948; with 8 images no slip reaches a threshold of 1e-4). The confirmation estimates the sizes again with the
columns free and averages F tests over them (Seber and Lee, Linear Regression Analysis, 2003, chapter 4).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.distributions import f as f_distribution
from jcr.estimation.equation import UNKNOWNS
from jcr.estimation.robot_noise import Equations, LogSizes, most_likely, over_sizes, solve_equations
from jcr.findings import FindingKind
from jcr.records import RobotNoise

CONFIRMED_AT_MOST = 3
"""Kinds of effects that are confirmed: those with the largest gains of the score test."""
ORDERS = 200
"""Orders of the images that a permutation test draws."""
BY_CHANCE = 0.02
"""Share of other orders that may explain as much."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Columns that one effect adds to the equations of the gripper poses."""

    kind: FindingKind
    columns: Float[ndarray, "s d"]
    """Derivative of the residuals (m, rad, base axes) by the d parameters of the effect."""
    place: int = 0
    """Image before which a change happens; 0 for an effect without a place."""
    prior_std: float = 0.1
    """Standard deviation of the parameters once the effect is adopted: so large that the poses decide."""


@dataclass(frozen=True, kw_only=True)
class Test:
    """Result of one confirmed row."""

    row: Row
    estimate: Float[ndarray, " d"]
    covariance: Float[ndarray, "d d"]
    log_p: float
    """Logarithm of the probability of this estimate or a larger one without the effect, times the places tested."""
    shift: Float[ndarray, " p"]
    """Step of the unknowns that comes with the effect."""
    noise: RobotNoise
    """Robot pose noise that the effect leaves."""

    def is_within(self, limits: tuple[float, float]) -> bool:
        """Return whether the estimate is within limits (m and rad of a motion, else the norm of the parameters)."""
        if self.row.columns.shape[1] != 6:
            return bool(np.linalg.norm(self.estimate) <= limits[0])
        return bool((np.linalg.norm(self.estimate.reshape(2, 3), axis=1) <= limits).all())


def gains(equations: Equations, log_sizes: LogSizes, rows: Sequence[Row]) -> Float[ndarray, " r"]:
    """Return the gain of the score test of each row, minus the penalty d · log(s) (Schwarz 1978).

    The gain is gᵀS⁻¹g with g = Aᵀ V⁻¹(r + Jθ) and S = Aᵀ P A, where P is the projection of the solution.
    """
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left
    out = np.empty(len(rows))
    for k, row in enumerate(rows):
        information = row.columns.T @ projection @ row.columns
        pull = row.columns.T @ left
        gain = pull @ np.linalg.lstsq(information, pull, rcond=1e-9)[0]
        out[k] = gain - row.columns.shape[1] * np.log(len(left))
    return out


def best_tests(equations: Equations, log_sizes: LogSizes, rows: Sequence[Row]) -> list[Test]:
    """Return confirmed tests of the best rows, one of a kind, the most significant first.

    The probability of a kind is multiplied by the number of its rows, the places that were searched.
    """
    if not rows:
        return []
    gain = gains(equations, log_sizes, rows)
    best: dict[FindingKind, int] = {}
    for k in np.argsort(-gain).tolist():
        best.setdefault(rows[k].kind, k)
    chosen = list(best.values())[:CONFIRMED_AT_MOST]
    places = {kind: sum(row.kind is kind for row in rows) for kind in best}
    tests = (confirm(equations, rows[k], places[rows[k].kind]) for k in chosen)
    return sorted(tests, key=lambda test: test.log_p)


def confirm(equations: Equations, row: Row, places: int = 1, freedom: float | None = None) -> Test:
    """Return Wald's test of a row, with the sizes of the errors estimated again while its columns are free.

    The chance is averaged over the sizes. `freedom` is that of the sizes at each point of the average; None: of all
    residuals, which counts their uncertainty twice and is on the safe side.
    """
    free = with_columns(equations, row.columns)
    count, d = equations.jacobian.shape[1], row.columns.shape[1]
    likeliest, information = most_likely(free)
    found = solve_equations(free, likeliest)
    without = solve_equations(equations, likeliest)
    under = float(max(len(equations.residual) - UNKNOWNS - d, 1)) if freedom is None else freedom
    log_shares = []
    # With few poses the sizes are hardly known, and larger ones leave more to chance.
    for weight, _, each in over_sizes(free, likeliest, information):
        size, covariance = each.step[:, count:], each.covariance[:, count:, count:]
        ratio = (size * np.linalg.solve(covariance, size[..., None])[..., 0]).sum(1) / d
        log_tail = np.array([f_distribution.logsf(float(one), d, under) for one in ratio])
        log_shares.append(np.log(np.maximum(weight, 1e-300)) + log_tail)
    return Test(
        row=row,
        estimate=found.step[count:],
        covariance=found.covariance[count:, count:],
        log_p=float(np.logaddexp.reduce(np.concatenate(log_shares)) + np.log(places)),
        shift=found.step[:count] - without.step,
        noise=free.noise(likeliest),
    )


def explains_by_order(
    equations: Equations,
    log_sizes: LogSizes,
    by_motion: Float[ndarray, "n 6 6"],
    share: Float[ndarray, " n"],
    own: slice,
) -> bool:
    """Return whether a motion with these shares in the images explains more than in nearly all other orders
    of the images `own`.

    A permutation test of the score gain: the errors of real arms have heavy tails, and one wrong pose is no motion.
    """
    rng = np.random.default_rng(0)
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left

    def gain(of_image: Float[ndarray, " n"]) -> float:
        columns = (by_motion * of_image[:, None, None]).reshape(-1, 6)
        pull = columns.T @ left
        return float(pull @ np.linalg.lstsq(columns.T @ projection @ columns, pull, rcond=1e-9)[0])

    found, shuffled, centred = gain(share), share.copy(), share[own] - share[own].mean()
    as_much = others = 0
    for _ in range(ORDERS):
        order = rng.permutation(centred)
        # The hand-eye transform takes up a constant, and the sign is free: such an order is the same one.
        if np.allclose(order, centred) or np.allclose(order, -centred):
            continue
        others += 1
        shuffled[own] = order
        as_much += gain(shuffled) >= found - 1e-9
    return as_much <= BY_CHANCE * others


def with_columns(equations: Equations, columns: Float[ndarray, "s d"]) -> Equations:
    """Return the equations with further unknowns that have no prior."""
    count, d = equations.jacobian.shape[1], columns.shape[1]
    prior = np.zeros((count + d, count + d))
    prior[:count, :count] = equations.prior_information
    return replace(
        equations,
        jacobian=np.concatenate([equations.jacobian, columns], axis=1),
        prior_information=prior,
        prior_gradient=np.r_[equations.prior_gradient, np.zeros(d)],
    )
