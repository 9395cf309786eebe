"""The damped, robust Gauss-Newton method for small dense problems, on any manifold: Levenberg and Marquardt's.

Unknowns are whatever the caller has (a pose, a tuple); they move by steps in a tangent space, as geometry.retract moves
poses. The loops that eliminate points or depths by a Schur complement, or that estimate variances between their steps,
are problems of their own and stand where those are: estimation/fit.py, estimation/together.py, calibration/drift.py,
photometric/ and reconstruct/global_alignment/.
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
"""Of the squared length s of a residual: s, 2(√(1 + s) − 1) or log(1 + s), as scipy.optimize.least_squares has them."""
START_DAMPING, MOST_DAMPING = 1e-4, 1e12
EXACT = 1e-24
"""Of the cost at the start: what is left of data without noise is rounding."""
UNSEEN = 1e-12
"""Of the largest diagonal element: keeps a direction that no residual sees where it is."""


@dataclass(frozen=True)
class Minimum(Generic[Unknowns]):
    """Where the sum is least, and how sharply."""

    unknowns: Unknowns
    cost: float
    """Half the sum of the losses."""
    normal: Float[ndarray, "p p"]
    """Jᵀ W J there, W the weights that the loss gives: of whitened residuals the inverse covariance."""
    settled: bool
    """No step promised more than the tolerance."""


def minimise(
    linearised: Callable[[Unknowns], tuple[Float[ndarray, "k m"], Float[ndarray, "k m p"]]],
    start: Unknowns,
    moved: Callable[[Unknowns, Float[ndarray, " p"]], Unknowns],
    loss: Loss = "linear",
    tolerance: float = 1e-12,
    iterations: int = 100,
) -> Minimum[Unknowns]:
    """Minimise ½ Σ ρ(|r|²) over k residuals r of m components each, whose lengths the loss ρ tames.

    `linearised` gives the residuals and their derivatives by a step (p,), `moved` takes the step. It ends where a step
    promises to lower the cost by less than `tolerance` of it.
    """
    unknowns, damping, settled = start, START_DAMPING, False
    residual, jacobian = linearised(unknowns)
    cost = _cost(loss, residual)
    exact = EXACT * cost
    for _ in range(iterations):
        normal, gradient = _equations(loss, residual, jacobian)
        diagonal = normal.diagonal()
        while True:
            damped = normal + np.diag(damping * diagonal + UNSEEN * diagonal.max(initial=1e-300))
            step = -np.linalg.solve(damped, gradient)
            promised = -float(step @ gradient) - 0.5 * float(step @ normal @ step)
            tried = moved(unknowns, step)
            tried_residual, tried_jacobian = linearised(tried)
            tried_cost = _cost(loss, tried_residual)
            settled = promised <= tolerance * cost + exact
            if tried_cost <= cost or settled or damping > MOST_DAMPING:
                break
            damping *= 10
        if tried_cost <= cost:
            unknowns, residual, jacobian, cost = tried, tried_residual, tried_jacobian, tried_cost
            damping = max(damping / 10, 1e-12)
        if settled or damping > MOST_DAMPING:
            break
    return Minimum(unknowns, cost, _equations(loss, residual, jacobian)[0], settled)


def loss_weight(loss: Loss, squared: Float[ndarray, "*batch"]) -> Float[ndarray, "*batch"]:
    """ρ'(s): the weight of residuals of squared length s in the equations."""
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
