"""Mixed model of many poses whose systematic errors are smooth over the poses, in the eigenvectors of these errors.

The errors of positions and of rotations are independent and have the same correlation, so one decomposition of a
matrix of 3n rows makes the covariance diagonal for all sizes of the errors. Restricted likelihood and leave-one-out
residuals are the same for the physical unknowns θ, with errors e, as for the effective ones θ − F e (systematic.py).
The posterior of the latter follows from that of θ and e (universal kriging: Cressie, Statistics for Spatial Data,
1993, section 3.4).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.cholesky import cholesky
from jcr.estimation.components import Information, most_likely
from jcr.estimation.covariance import budget_of
from jcr.estimation.equation import SCALE, UNKNOWNS
from jcr.estimation.mixed_model import Equations, LogSizes
from jcr.estimation.pose_equations import prior_of_unknowns, reported_poses
from jcr.estimation.problem import Problem, State
from jcr.estimation.systematic import REACH, Region
from jcr.records import Budget

FEWEST, FEWEST_TO_COMPARE = 80, 15
"""Number of poses above which this is used: for a result, whose sizes of errors are then taken at their mode, and for a
solution to compare, for which they always are."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothModel:
    """Equations of the used poses in the eigenvectors of their systematic errors, s = 6m rows: positions, rotations."""

    equations: Equations
    """Equations of the physical unknowns, rows in the order of the poses."""
    vectors: Float[ndarray, "h h"]
    """Eigenvectors of the errors of rotations, h = 3m."""
    values: Float[ndarray, " s"]
    """Variance of each row where the size of the systematic errors is 1 rad."""
    residual: Float[ndarray, " s"]
    jacobian: Float[ndarray, "s 13"]

    def white(self, log_sizes: LogSizes) -> Float[ndarray, " s"]:
        """Return the variance of the random error of each row."""
        return np.repeat(self.equations.variances(log_sizes)[:2], len(self.vectors))

    def turned(self, rows: Float[ndarray, "s q"]) -> Float[ndarray, "s q"]:
        """Return rows in the order of the poses in the eigenvectors."""
        own = rows.reshape(-1, 2, 3, rows.shape[1]).swapaxes(0, 1).reshape(2, len(self.vectors), -1)
        return (self.vectors.T @ own).reshape(rows.shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class SmoothSolution:
    """Physical unknowns at one value of the sizes."""

    model: SmoothModel
    log_sizes: LogSizes
    weight: Float[ndarray, " s"]
    step: Float[ndarray, "13"]
    covariance: Float[ndarray, "13 13"]
    pull: Float[ndarray, " s"]
    """V⁻¹(r + Jθ)."""
    log_posterior: float

    @property
    def systematic(self) -> Float[ndarray, " s"]:
        """Variance of the systematic error of each row."""
        return self.model.equations.variances(self.log_sizes)[2] * self.model.values


def is_smooth(problem: Problem, averaged: bool) -> bool:
    """Return whether a problem of many exact camera poses has errors of this kind.

    `averaged`: the solution is a result, and not one to compare.
    """
    (arm, *others), known = problem.arms, problem.known_rigs
    count = len(arm.rigs) if problem.used is None else int(problem.used.sum())
    if (
        others
        or known is None
        or known.covariance is not None
        or count <= (FEWEST if averaged else FEWEST_TO_COMPARE)
    ):
        return False
    if arm.confirmed_errors is not None:
        return False
    blocks = arm.error_covariance.reshape(len(arm.rigs), 6, len(arm.rigs), 6)
    apart = not blocks[:, :3, :, 3:].any()
    return apart and np.allclose(blocks[:, :3, :, :3], REACH**2 * blocks[:, 3:, :, 3:], rtol=1e-9, atol=1e-12)


def decomposed(problem: Problem) -> tuple[Float[ndarray, "h h"], Float[ndarray, " h"]]:
    """Return eigenvectors and eigenvalues of the errors of the rotations of the used poses."""
    arm = problem.arms[0]
    n = len(arm.rigs)
    used = np.arange(n) if problem.used is None else np.flatnonzero(problem.used)
    rotations = arm.error_covariance.reshape(n, 6, n, 6)[np.ix_(used, np.arange(3, 6), used, np.arange(3, 6))]
    values, vectors = np.linalg.eigh(rotations.reshape(3 * len(used), -1))
    return vectors, np.maximum(values, 0.0)


def smooth_model(
    problem: Problem, state: State, basis: tuple[Float[ndarray, "h h"], Float[ndarray, " h"]]
) -> SmoothModel:
    """Return the equations about a state."""
    residual, jacobian, _ = reported_poses(problem, state)
    used = slice(None) if problem.used is None else problem.used
    count = int(residual[used].size / 6)
    information, gradient = prior_of_unknowns(problem, state)
    equations = Equations(
        residual=residual[used].ravel(),
        jacobian=jacobian[used].reshape(-1, UNKNOWNS),
        prior_information=information,
        prior_gradient=gradient,
        # Its variances are those of the rows, in `values`.
        systematic=np.broadcast_to(0.0, (6 * count, 6 * count)),
        given=problem.robot_noise_floor,
    )
    vectors, values = basis
    found = SmoothModel(
        equations=equations,
        vectors=vectors,
        values=np.r_[REACH**2 * values, values],
        residual=equations.residual,
        jacobian=equations.jacobian,
    )
    both = found.turned(np.column_stack([equations.residual, equations.jacobian]))
    return replace(found, residual=both[:, 0], jacobian=both[:, 1:])


def solved(model: SmoothModel, log_sizes: LogSizes) -> SmoothSolution:
    """Return generalised least squares at given sizes."""
    equations, j, r = model.equations, model.jacobian, model.residual
    variance = model.white(log_sizes) + equations.variances(log_sizes)[2] * model.values
    information = (j / variance[:, None]).T @ j + equations.prior_information
    gradient = j.T @ (r / variance) + equations.prior_gradient
    covariance = np.linalg.inv(information)
    step = -covariance @ gradient
    squares = float((r**2 / variance).sum() + gradient @ step)
    determinants = float(np.log(variance).sum() + np.linalg.slogdet(information)[1])
    return SmoothSolution(
        model=model,
        log_sizes=log_sizes,
        weight=1 / variance,
        step=step,
        covariance=covariance,
        pull=(r + j @ step) / variance,
        log_posterior=-(determinants + squares) / 2 + float(equations.log_prior(log_sizes)),
    )


def likeliest(
    model: SmoothModel, start: LogSizes | None, settled: float
) -> tuple[SmoothSolution, Information]:
    """Return the solution at the most likely sizes, and the expected information of these."""
    log_sizes, information = most_likely(model.equations, start, settled, lambda at: _score(model, at))
    return solved(model, log_sizes), information


def _score(model: SmoothModel, log_sizes: LogSizes) -> tuple[float, LogSizes, Information]:
    """Return the log posterior of the sizes, its gradient, and the expected information."""
    found, j = solved(model, log_sizes), model.jacobian
    w = found.weight
    own = np.einsum("si,ij,sj->s", j, found.covariance, j)
    half = len(w) // 2
    parts = np.stack(
        [np.r_[np.ones(half), np.zeros(half)], np.r_[np.zeros(half), np.ones(half)], model.values]
    )
    by = [found.covariance @ (j.T @ ((part * w**2)[:, None] * j)) for part in parts]
    pairs = (parts * (w**2 - 2 * w**3 * own)) @ parts.T
    pairs += np.array([[np.sum(a * b.T) for b in by] for a in by])
    slope, prior = model.equations.log_prior_slope(log_sizes)
    growth = np.exp(2 * log_sizes)
    gradient = slope + growth * (parts @ found.pull**2 - parts @ (w - w**2 * own))
    return found.log_posterior, gradient, prior + 2 * np.outer(growth, growth) * pairs


def effective_step(found: SmoothSolution, region: Region) -> Float[ndarray, "13"]:
    """Return the step of the effective unknowns."""
    fit = _padded(found.model.turned(region.fit.T).T)
    return found.step - fit @ (found.systematic * found.pull)


def _padded(fit: Float[ndarray, "12 s"]) -> Float[ndarray, "13 s"]:
    """Return rows of all unknowns from those without the scale."""
    return np.insert(fit, SCALE.start, 0.0, axis=0)


def effective(
    found: SmoothSolution, region: Region
) -> tuple[Float[ndarray, "13"], Float[ndarray, "13 13"], Budget]:
    """Return the step of the effective unknowns, their covariance for other poses of the region, and its causes."""
    model, w, s = found.model, found.weight, found.systematic
    j, c = model.jacobian, found.covariance
    fit = _padded(model.turned(region.fit.T).T)
    moved = (s * w)[:, None] * j @ c
    cross = fit @ moved
    covariance = c - cross - cross.T + (fit * (s - s**2 * w)) @ fit.T + cross @ np.linalg.solve(c, cross.T)
    # Rows of e' = (I − J F) e in the order of the poses, by the errors in the eigenvectors.
    half = len(model.vectors)
    by_error = np.zeros((len(w), len(w)))
    rows = np.arange(len(w)).reshape(-1, 2, 3)
    by_error[rows[:, 0].ravel(), :half] = by_error[rows[:, 1].ravel(), half:] = model.vectors
    by_error -= region.by_unknown @ np.delete(fit, SCALE, axis=0)
    root = by_error * np.sqrt(np.maximum(s - s**2 * w, 0.0))
    joint = by_error @ moved @ cholesky(np.linalg.inv(c))
    expected = (by_error @ (s * found.pull)).reshape(-1, 6)
    blocks = sum(
        (
            one.reshape(len(expected), 6, -1) @ one.reshape(len(expected), 6, -1).swapaxes(1, 2)
            for one in (root, joint)
        ),
        expected[:, :, None] * expected[:, None, :],
    )
    spread = region.spread(blocks)
    gain = c @ (j * w[:, None]).T + fit * (s * w) - cross @ (j * w[:, None]).T
    random = (gain * model.white(found.log_sizes)) @ gain.T
    systematic = ((gain - fit) * s) @ (gain - fit).T + spread
    images = c @ model.equations.prior_information @ c
    nothing = np.zeros_like(c)
    covariance = covariance + spread
    budget = budget_of((random, systematic, nothing, images), covariance)
    return found.step - fit @ (s * found.pull), covariance, budget


def left_out(
    found: SmoothSolution, problem: Problem, state: State
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 6"]]:
    """Return the residual of each pose from a solution without it, and its covariance with the pose's own errors."""
    residual, jacobian, _ = reported_poses(problem, state)
    used = np.ones(len(residual), bool) if problem.used is None else problem.used
    model, n = found.model, len(residual)
    out, covariance = np.empty((n, 6)), np.empty((n, 6, 6))
    half, m = len(model.vectors), int(used.sum())
    q = model.vectors.reshape(m, 3, half)
    weighed = found.weight[:, None] * model.jacobian
    own, pull, gain = np.zeros((m, 6, 6)), np.empty((m, 6)), np.empty((m, 6, UNKNOWNS))
    for axes, rows in ((slice(0, 3), slice(0, half)), (slice(3, 6), slice(half, None))):
        own[:, axes, axes] = (q * found.weight[rows]) @ q.swapaxes(1, 2)
        pull[:, axes], gain[:, axes] = q @ found.pull[rows], q @ weighed[rows]
    own -= gain @ found.covariance @ gain.swapaxes(1, 2)
    without = np.linalg.inv(own)
    out[used], covariance[used] = (without @ pull[..., None])[..., 0], without
    if used.all():
        return out, covariance
    size = model.equations.variances(found.log_sizes)
    alike = size[2] * problem.arms[0].error_covariance.reshape(n, 6, n, 6)
    white = np.diag(np.repeat(size[:2], 3))
    rows = np.flatnonzero(np.repeat(used, 6))
    for i in np.flatnonzero(~used):
        by = model.turned(alike[i].reshape(6, -1)[:, rows].T)
        leverage = jacobian[i] - by.T @ weighed
        out[i] = residual[i] + jacobian[i] @ found.step - by.T @ found.pull
        covariance[i] = alike[i, :, i] - (by.T * found.weight) @ by + white
        covariance[i] += leverage @ found.covariance @ leverage.T
    return out, covariance
