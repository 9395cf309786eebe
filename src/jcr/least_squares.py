"""Damped Gauss-Newton (Levenberg-Marquardt) on any manifold, dense or with unknowns that a caller eliminates.

Unknowns are any object (a pose, a tuple); a step in a tangent space moves them, as geometry.retract moves a pose. Many
independent problems are solved together if the cost is an array: one element per problem, and one row of the unknowns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator of functions that solve many small linear systems: it limits BLAS to one thread. Several threads gain
nothing there; with the other core busy, `solve_hand_eye` of 15 images took 60 times as long."""

Unknowns = TypeVar("Unknowns")
Loss = Literal["linear", "cauchy"]
"""Loss of a squared length s: s or log(1 + s), as in scipy.optimize.least_squares."""
START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e12
"""Initial, smallest and largest damping, as a share of each diagonal element of the normal equations."""
TINY = 1e-300
"""Absolute cost that counts as 0."""
EXACT = 1e-24
"""Share of the initial cost below which a change of the cost is rounding."""
UNSEEN = 1e-12
"""Share of the largest diagonal element that is added to all, so that unobservable unknowns stay where they are."""
System = TypeVar("System")


@dataclass(frozen=True)
class Minimum(Generic[Unknowns]):
    """Result of `minimise`: unknowns at the minimum, their cost, their normal equations, and whether it converged."""

    unknowns: Unknowns
    cost: Any
    """Half the sum of the losses at the minimum; an array for many problems."""
    normal: Float[ndarray, "*b p p"]
    """Matrix JᵀWJ at the minimum, W being the weights of the loss: the inverse covariance if residuals are whitened."""
    settled: bool
    """Whether the last step gained less than the tolerance."""


def damped_gauss_newton(
    linearise: Callable[[Unknowns], System],
    step: Callable[[Unknowns, System, Any], Unknowns],
    cost: Callable[[Unknowns], Any],
    start: Unknowns,
    *,
    enough: Callable[[Any], Any],
    damping: Any = START_DAMPING,
    iterations: int = 100,
) -> tuple[Unknowns, Any, bool]:
    """Minimise a cost from `start`; return the unknowns, their cost, and whether the iteration converged.

    `linearise` returns the system of equations at the unknowns. `step` returns the unknowns after a step, from the
    present ones, this system and the damping (Levenberg-Marquardt). `damping` is its initial value, which grows tenfold
    after a step that increases the cost and shrinks tenfold after any other. The iteration converges when a step
    changes the cost by less than `enough(cost)`; it ends after `iterations` steps at the latest. Costs and dampings are
    arrays, one element per problem, if independent problems are solved together.
    """
    unknowns, least, settled = start, cost(start), False
    system: System | None = None
    for _ in range(iterations):
        system = linearise(unknowns) if system is None else system
        tried = step(unknowns, system, damping)
        tried_cost = cost(tried)
        gained = least - tried_cost
        better, settled = gained >= 0, bool(np.all(np.abs(gained) < enough(least)))
        if np.any(better):
            unknowns, system = _where(better, tried, unknowns), None
        least = np.where(better, tried_cost, least)[()]
        damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 10)[()]
        if settled or np.all(damping > MOST_DAMPING):
            break
    return unknowns, least, settled


def _where(better: Any, tried: Any, before: Any) -> Any:
    """Return `tried` for the problems that are `better`, `before` for the others: arrays, or tuples of arrays.

    `better` has a truth value for each problem; the first axis of the arrays is the problem.
    """
    if np.all(better):
        return tried
    if isinstance(tried, tuple):
        return tuple(_where(better, *pair) for pair in zip(tried, before, strict=True))
    return np.where(better.reshape(-1, *[1] * (tried.ndim - 1)), tried, before)


def minimise(
    linearised: Callable[[Unknowns], tuple[Float[ndarray, "*b k m"], Float[ndarray, "*b k m p"]]],
    start: Unknowns,
    moved: Callable[[Unknowns, Float[ndarray, "*b p"]], Unknowns],
    loss: Loss = "linear",
    tolerance: float = 1e-12,
    iterations: int = 100,
) -> Minimum[Unknowns]:
    """Minimise ½ Σ ρ(|r|²) over k residuals r of m components each; ρ is the loss, applied to the squared length.

    `linearised` returns the residuals and their derivatives by a step of p numbers, at the unknowns; `moved` returns
    the unknowns after a step. `loss` names ρ, as in scipy.optimize.least_squares. The iteration ends when a step
    changes the cost by less than the share `tolerance`, or after `iterations` steps. Leading axes (b) are independent
    problems.
    """

    def step(
        now: tuple[Unknowns, ndarray, ndarray], normal: tuple[ndarray, ndarray], damping: Any
    ) -> tuple[Unknowns, ndarray, ndarray]:
        hessian, gradient = normal
        diagonal = np.diagonal(hessian, axis1=-2, axis2=-1)
        added = np.expand_dims(damping, -1) * diagonal + UNSEEN * diagonal.max(
            -1, initial=1e-300, keepdims=True
        )
        damped = hessian + added[..., None] * np.eye(diagonal.shape[-1])
        tried = moved(now[0], -np.linalg.solve(damped, gradient[..., None])[..., 0])
        return (tried, *linearised(tried))

    begin = (start, *linearised(start))
    exact, damping = EXACT * _cost(loss, begin[1]), np.full(begin[1].shape[:-2], START_DAMPING)[()]
    found, cost, settled = damped_gauss_newton(
        lambda now: _equations(loss, *now[1:]),
        step,
        lambda now: _cost(loss, now[1]),
        begin,
        enough=lambda cost: tolerance * cost + exact + TINY,
        damping=damping,
        iterations=iterations,
    )
    return Minimum(found[0], cost, _equations(loss, *found[1:])[0], settled)


def loss_weight(loss: Loss, squared: Float[ndarray, "*batch"]) -> Float[ndarray, "*batch"]:
    """Return the weights ρ'(s) of residuals: derivatives of the loss ρ at their squared lengths s (`squared`).

    The loss ρ(s) is s for "linear" and log(1 + s) for "cauchy".
    """
    return np.ones_like(squared) if loss == "linear" else 1 / (1 + squared)


def _cost(loss: Loss, residual: Float[ndarray, "*b k m"]) -> Any:
    """Return ½ Σ ρ(|r|²) over the k residuals r (m components each) of each problem b; ρ is the loss."""
    squared = (residual**2).sum(-1)
    return 0.5 * (squared if loss == "linear" else np.log1p(squared)).sum(-1)


def _equations(
    loss: Loss, residual: Float[ndarray, "*b k m"], jacobian: Float[ndarray, "*b k m p"]
) -> tuple[Float[ndarray, "*b p p"], Float[ndarray, "*b p"]]:
    """Return JᵀWJ and JᵀWr of each problem b: J is the Jacobian, r the residuals, W their weights (`loss_weight`)."""
    root = np.sqrt(loss_weight(loss, (residual**2).sum(-1)))[..., None]
    flat = (root[..., None] * jacobian).reshape(*residual.shape[:-2], -1, jacobian.shape[-1])
    transposed = np.swapaxes(flat, -1, -2)
    left = (root * residual).reshape(*residual.shape[:-2], -1, 1)
    return transposed @ flat, (transposed @ left)[..., 0]
