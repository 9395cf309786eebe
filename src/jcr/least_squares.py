"""Damped Gauss-Newton (Levenberg-Marquardt) on any manifold, dense or with unknowns that a caller eliminates.

Unknowns are any object (a pose, a tuple); they move by steps in a tangent space, as geometry.retract moves poses.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from threadpoolctl import threadpool_limits

one_blas_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorates what solves many small systems. BLAS threads gain nothing on these, and wait for each other as soon as the
machine has other work: of 15 images with the other core taken, `solve_hand_eye` took 60 times as long."""

Unknowns = TypeVar("Unknowns")
Loss = Literal["linear", "soft_l1", "cauchy"]
"""Loss of a squared length s: s, 2(√(1 + s) − 1) or log(1 + s), as in scipy.optimize.least_squares."""
START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-12, 1e12
TINY = 1e-300
"""Cost of exact data, below which nothing can be gained."""
EXACT = 1e-24
"""Share of the initial cost below which a cost is rounding."""
UNSEEN = 1e-12
"""Share of the largest diagonal element that keeps an unobservable direction fixed."""
System = TypeVar("System")


@dataclass(frozen=True)
class Minimum(Generic[Unknowns]):
    """The minimum of a sum of losses."""

    unknowns: Unknowns
    cost: float
    """Half the sum of the losses."""
    normal: Float[ndarray, "p p"]
    """Jᵀ W J there, W the weights of the loss: the inverse covariance where residuals are whitened."""
    settled: bool
    """Whether the last step gained less than the tolerance."""


def damped_gauss_newton(
    linearise: Callable[[Unknowns], System],
    step: Callable[[Unknowns, System, float], Unknowns],
    cost: Callable[[Unknowns], float],
    start: Unknowns,
    *,
    enough: Callable[[float], float],
    damping: float = START_DAMPING,
    iterations: int = 100,
) -> tuple[Unknowns, float, float, bool]:
    """Minimise a cost from `start`; return the unknowns, their cost, the damping, and whether the steps settled.

    `step` takes the unknowns, their linearisation and the relative damping of its diagonal. The iteration ends where a
    step changes the cost by less than `enough` of it.
    """
    unknowns, least, settled = start, cost(start), False
    system: System | None = None
    for _ in range(iterations):
        system = linearise(unknowns) if system is None else system
        tried = step(unknowns, system, damping)
        tried_cost = cost(tried)
        gained = least - tried_cost
        if gained >= 0:
            unknowns, least, system = tried, tried_cost, None
            damping = max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
        settled = bool(abs(gained) < enough(least))
        if settled or damping > MOST_DAMPING:
            break
    return unknowns, least, damping, settled


def minimise(
    linearised: Callable[[Unknowns], tuple[Float[ndarray, "k m"], Float[ndarray, "k m p"]]],
    start: Unknowns,
    moved: Callable[[Unknowns, Float[ndarray, " p"]], Unknowns],
    loss: Loss = "linear",
    tolerance: float = 1e-12,
    iterations: int = 100,
) -> Minimum[Unknowns]:
    """Minimise ½ Σ ρ(|r|²) over k residuals r of m components each, ρ being the loss.

    `linearised` returns the residuals and their derivatives by a step (p,), `moved` takes the step. The iteration ends
    where a step lowers the cost by less than `tolerance` of it.
    """

    def step(
        now: tuple[Unknowns, ndarray, ndarray], normal: tuple[ndarray, ndarray], damping: float
    ) -> tuple[Unknowns, ndarray, ndarray]:
        hessian, gradient = normal
        diagonal = hessian.diagonal()
        damped = hessian + np.diag(damping * diagonal + UNSEEN * diagonal.max(initial=1e-300))
        tried = moved(now[0], -np.linalg.solve(damped, gradient))
        return (tried, *linearised(tried))

    begin = (start, *linearised(start))
    exact = EXACT * _cost(loss, begin[1])
    found, cost, _, settled = damped_gauss_newton(
        lambda now: _equations(loss, *now[1:]),
        step,
        lambda now: _cost(loss, now[1]),
        begin,
        enough=lambda cost: tolerance * cost + exact + TINY,
        iterations=iterations,
    )
    return Minimum(found[0], cost, _equations(loss, *found[1:])[0], settled)


def loss_weight(loss: Loss, squared: Float[ndarray, "*batch"]) -> Float[ndarray, "*batch"]:
    """Return ρ'(s), the weight of residuals of squared length s in the equations."""
    if loss == "linear":
        return np.ones_like(squared)
    return 1 / np.sqrt(1 + squared) if loss == "soft_l1" else 1 / (1 + squared)


def _cost(loss: Loss, residual: Float[ndarray, "k m"]) -> float:
    squared = (residual**2).sum(1)
    if loss == "soft_l1":
        squared = 2 * (np.sqrt(1 + squared) - 1)
    elif loss == "cauchy":
        squared = np.log1p(squared)
    return 0.5 * float(squared.sum())


def _equations(
    loss: Loss, residual: Float[ndarray, "k m"], jacobian: Float[ndarray, "k m p"]
) -> tuple[Float[ndarray, "p p"], Float[ndarray, " p"]]:
    root = np.sqrt(loss_weight(loss, (residual**2).sum(1)))[:, None]
    flat = (root[:, :, None] * jacobian).reshape(-1, jacobian.shape[2])
    return flat.T @ flat, flat.T @ (root * residual).ravel()
