"""Global alignment by Gauss-Newton on a few thousand pixels per image, the depths eliminated.

It minimises what eq. 1 of the paper does, with three changes. Residuals are weighted by what they prove to
be worth (`pointmap_residuals`). The first view of a pair stands in its camera's own frame, as it was predicted,
so that its rays give the focal length. And a pair's pose P_e, free in eq. 1, is its first camera's but for an
error whose spread is measured over all pairs: where the network places second views well, pairs tie cameras
firmly.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import csr_array

from jcr.errors import RejectedError
from jcr.geometry import adjoint, inverse, retract, twist_from_step
from jcr.least_squares import one_blas_thread
from jcr.pointmaps.global_alignment.alignment import Alignment
from jcr.pointmaps.global_alignment.depths import fused_depth
from jcr.pointmaps.global_alignment.initial_estimate import initial_state
from jcr.pointmaps.global_alignment.normal_equations import (
    ImageEquations,
    Layout,
    PairTies,
    ReducedEquations,
    image_equations,
)
from jcr.pointmaps.global_alignment.observations import ImageObservations, Problem, observe
from jcr.pointmaps.global_alignment.pointmap_residuals import Noise, State, measure_noise, residuals
from jcr.pointmaps.pairs import PairPredictions
from jcr.progress import Progress

COARSE_PIXELS = 300
"""Pixels per image of the first stage, which comes within the noise at a seventh of the cost."""
COARSE_TOLERANCE = 1e-3
FINE_TOLERANCE = 1e-4
"""Largest last step (rad, or relative), a tenth of the noise that predictions leave."""
ITERATIONS = 30
START_SPREAD = 0.01
"""Initial spread of the pairs' errors, relative to the depth and in radians."""
LEAST_SPREAD = 1e-5
GAUGE_WEIGHT = 1e3
"""Weight of the fixed sum of the log pair scales, over the information of the pointmaps on one of them."""
NORMAL_SQUARE_MEDIAN = 0.455
"""Median of the square of a unit normal."""
DEPTH_CHUNK = 4096
"""Pixels at a time, so that the arrays of a chunk stay in the cache."""
CONTRADICTION = 4.0
"""A pair whose residual is this many times the median one is named to the user."""
USELESS = 0.2
"""Residual of the middle pair, relative to the distance, of pairs that do not belong together."""

UNDETERMINED = "the pointmaps of the pairs have too little in common to be aligned"


@dataclass(frozen=True, kw_only=True)
class Solution:
    """The result of Gauss-Newton."""

    state: State
    covariance: Float[ndarray, "r r"]
    """Covariance of the cameras' steps, r = 6n, from the equations of the last step; zero for the first camera."""
    images: list[ImageObservations]
    noise: list[Noise]
    """Noise of the pointmaps of each image."""
    pair_spread: Float[ndarray, "6"]
    """Standard deviation per axis of the pairs' errors: translation, rotation."""
    settled: bool
    """Whether the last step was small enough."""


def solve(problem: Problem, pixels: int) -> Solution:
    """Estimate cameras, focal length, pair scales and the depths of about `pixels` pixels per image."""
    images, edges = problem.observe_all(min(COARSE_PIXELS, pixels)), problem.predictions.edges
    state, layout = initial_state(images, edges), Layout(len(images), len(edges))
    pair_spread = START_SPREAD * np.repeat([np.exp(np.median(np.concatenate(state.log_depth))), 1.0], 3)
    coarse = gauss_newton(images, state, layout, pair_spread, COARSE_TOLERANCE)
    images = problem.observe_all(pixels)
    depth = [fused_depth(o, coarse.state, noise)[0] for o, noise in zip(images, coarse.noise, strict=True)]
    state = replace(coarse.state, log_depth=[np.log(z) for z in depth])
    return gauss_newton(images, state, layout, coarse.pair_spread, FINE_TOLERANCE)


@one_blas_thread
def gauss_newton(
    images: list[ImageObservations],
    state: State,
    layout: Layout,
    pair_spread: Float[ndarray, "6"],
    tolerance: float,
) -> Solution:
    """Iterate until no unknown moves by more than `tolerance` (rad, or relative).

    The weights, and the spread of the pairs' errors, are measured again in each iteration, and depths and pairs' errors
    eliminated: neither is a problem for least_squares.py. Raises RejectedError where the pointmaps do not determine
    the unknowns.
    """
    for iteration in range(1, ITERATIONS + 1):
        noise, linearised = _linearised(images, state, layout, pair_spread)
        step, normal = _step(linearised, layout)
        state, variance = _after_step(images, state, layout, linearised, step)
        pair_spread = _spread(state.pair_error, variance, pair_spread)
        settled = bool(np.abs(step).max() < tolerance)
        if settled or iteration == ITERATIONS:
            return Solution(
                state=state,
                covariance=_camera_covariance(normal, layout),
                images=images,
                noise=noise,
                pair_spread=pair_spread,
                settled=settled,
            )
        del linearised  # or they would stay until the next ones are complete
    raise AssertionError


@dataclass(frozen=True)
class _Linearised:
    """The normal equations of one image's pointmaps at a state."""

    equations: ImageEquations
    ties: PairTies
    reduced: ReducedEquations
    selection: csr_array
    """Matrix from a step of all unknowns to the local unknowns of these equations."""


def _linearised(
    images: list[ImageObservations], state: State, layout: Layout, pair_spread: Float[ndarray, "6"]
) -> tuple[list[Noise], list[_Linearised]]:
    """Return the noise of every image's pointmaps and the equations weighted by it.

    Raises RejectedError where the equations are singular.
    """
    misfit = [residuals(o, state, log_depth) for o, log_depth in zip(images, state.log_depth, strict=True)]
    noise = measure_noise(images, misfit)
    observer_axes = adjoint(inverse(state.recon_from_camera))
    to_twist = twist_from_step(state.recon_from_camera)
    found = []
    for o, own in zip(images, noise, strict=True):
        # The residuals of an image, which are most of the memory, go as its equations come.
        equations = image_equations(o, misfit.pop(0), own)
        ties = PairTies(observer_axes[o.observers], state.pair_error[o.second_pairs], pair_spread)
        try:
            reduced = equations.reduced(ties)
        except np.linalg.LinAlgError:
            raise RejectedError(UNDETERMINED) from None
        found.append(_Linearised(equations, ties, reduced, _selection(o, layout, to_twist)))
    return noise, found


def _step(
    linearised: list[_Linearised], layout: Layout
) -> tuple[Float[ndarray, " p"], Float[ndarray, "q q"]]:
    """Solve for the step of all unknowns that are not eliminated, and return it with the normal matrix.

    The first camera and the product of the pair scales are fixed (gauge): the matrix lacks the first camera, q = p - 6.
    Raises RejectedError where the equations are singular.
    """
    hessian, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    for image in linearised:
        hessian += image.selection.T @ (image.selection.T @ image.reduced.hessian).T
        gradient += image.selection.T @ image.reduced.gradient
    # A pair without weight keeps its scale.
    scales = layout.scales
    hessian[scales, scales] += 1e-9 * hessian.diagonal()[scales].max()
    hessian[np.ix_(scales, scales)] += GAUGE_WEIGHT * hessian.diagonal()[scales].mean()
    normal, step = hessian[6:, 6:], np.zeros(layout.size)
    try:
        step[6:] = -np.linalg.solve(normal, gradient[6:])
    except np.linalg.LinAlgError:
        raise RejectedError(UNDETERMINED) from None
    if not np.isfinite(step).all():
        raise RejectedError(UNDETERMINED)
    return step, normal


def _camera_covariance(normal: Float[ndarray, "q q"], layout: Layout) -> Float[ndarray, "r r"]:
    """Return the covariance of the cameras' steps, r = 6n, zero for the first camera."""
    size = 6 * layout.images
    covariance = np.zeros((size, size))
    covariance[6:, 6:] = np.linalg.inv(normal)[: size - 6, : size - 6]
    return covariance


def _after_step(
    images: list[ImageObservations],
    state: State,
    layout: Layout,
    linearised: list[_Linearised],
    step: Float[ndarray, " p"],
) -> tuple[State, Float[ndarray, "e 6"]]:
    """Return the state after a step of the unknowns that are not eliminated, and the variances of the pairs' errors."""
    log_depth, pair_error = [], np.zeros_like(state.pair_error)
    variance = np.zeros_like(state.pair_error)
    for o, before, image in zip(images, state.log_depth, linearised, strict=True):
        local_step = image.selection @ step
        pair_step = image.reduced.pair_step(local_step)
        # An error of a pair moves its view as a step of its observer does.
        local_step[: pair_step.size] -= pair_step.ravel()
        # A far step of a pixel without parallax must not take it behind or beyond the scene.
        log_depth.append(before + np.clip(image.equations.depth_step(local_step), -0.5, 0.5))
        ties = image.ties
        pair_error[o.second_pairs] = ties.error + np.einsum("kij,kj->ki", ties.axes, pair_step)
        variance[o.second_pairs] = image.reduced.error_variance
    after = State(
        recon_from_camera=retract(state.recon_from_camera, step[: 6 * layout.images].reshape(-1, 6)),
        log_focal=state.log_focal + float(step[layout.focal]),
        log_pair_scale=state.log_pair_scale + step[layout.scales],
        pair_error=pair_error,
        log_depth=log_depth,
    )
    return after, variance


def _spread(
    error: Float[ndarray, "e 6"], variance: Float[ndarray, "e 6"], before: Float[ndarray, "6"]
) -> Float[ndarray, "6"]:
    """Estimate the spread of the pairs' translations and rotations from the errors under the spread `before`.

    The evidence fixed point σ² = Σ x² / Σ (1 − var(x)/σ²) (MacKay, "Bayesian interpolation", 1992, eq. 30),
    with medians in place of the sums: pairs that are altogether wrong do not count.
    """
    determined = 1.0 - np.median((variance / before**2).reshape(-1, 2, 3), axis=(0, 2))
    squared = np.median((error**2).reshape(-1, 2, 3), axis=(0, 2)) / NORMAL_SQUARE_MEDIAN
    return np.repeat(np.maximum(np.sqrt(squared / np.maximum(determined, 0.01)), LEAST_SPREAD), 3)


def dense_alignment(problem: Problem, solution: Solution, progress: Progress | None = None) -> Alignment:
    """Return the alignment of a solution in its own recon frame, with the depth of every pixel."""
    predictions, state = problem.predictions, solution.state
    count, (height, width) = predictions.image_count, predictions.conf.shape[1:]
    depth = np.empty((count, height * width), np.float32)
    confidence = np.empty_like(depth)

    def settle(k: int) -> None:
        for start in range(0, height * width, DEPTH_CHUNK):
            chunk = slice(start, start + DEPTH_CHUNK)
            depth[k, chunk], confidence[k, chunk] = fused_depth(
                observe(problem, k, chunk), state, solution.noise[k]
            )

    # numpy lets go of the interpreter during its loops, so threads share the cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, _ in enumerate(pool.map(settle, range(count)), start=1):
            if progress is not None:
                progress("align pairs", done / count)
    focal = float(np.exp(state.log_focal))
    residual = _pair_residuals(predictions, solution)
    return Alignment(
        recon_from_camera=state.recon_from_camera,
        focal_px=(focal, focal * problem.aspect),
        principal_point_px=problem.principal_point_px,
        depth=depth.reshape(count, height, width),
        confidence=(np.exp(confidence) if problem.log_weight else confidence).reshape(count, height, width),
        pair_scale=np.exp(state.log_pair_scale),
        pair_residual=residual,
        covariance=solution.covariance,
        notes=_notes(predictions, residual),
        warnings=_warnings(residual, solution.settled),
    )


def _pair_residuals(predictions: PairPredictions, solution: Solution) -> Float[ndarray, " e"]:
    """Return the residual of each pair, the larger of its two views'."""
    residual = np.zeros(len(predictions.edges))
    for o, noise in zip(solution.images, solution.noise, strict=True):
        np.maximum.at(residual, o.pair, np.sqrt(2 * noise.across**2 + noise.along**2))
    return residual


def _warnings(residual: Float[ndarray, " e"], settled: bool) -> tuple[str, ...]:
    """Return warnings on an alignment that did not settle or whose pairs disagree."""
    warnings, middle = [], float(np.median(residual))
    if not settled:
        warnings.append(f"the alignment had not settled after {ITERATIONS} iterations and may be wrong")
    if middle > USELESS:
        warnings.append(
            f"the pairs disagree by {100 * middle:.0f} % of the distance; nothing can be built on them"
        )
    return tuple(warnings)


def _notes(predictions: PairPredictions, residual: Float[ndarray, " e"]) -> tuple[str, ...]:
    """Return a note that names the pairs that contradict the others."""
    bad = np.flatnonzero(residual > CONTRADICTION * float(np.median(residual)))
    if not len(bad):
        return ()
    names = predictions.names
    pairs = ", ".join(f"{names[n]}-{names[m]}" for n, m in predictions.edges[bad[:5]])
    more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
    return (f"{len(bad)} of {len(residual)} pairs contradict the others and count little: {pairs}{more}",)


def _selection(o: ImageObservations, layout: Layout, to_twist: Float[ndarray, "n 6 6"]) -> csr_array:
    """Return the matrix from a step of all unknowns to the local unknowns of an image's equations."""
    n, maps = o.second_count, len(o.pair)
    twists, scales = np.arange(6 * n).reshape(n, 6, 1), 6 * n + np.arange(maps)
    blocks, block = (n, 6, 6), np.arange(6)
    own, observers = 6 * o.image + block, 6 * o.observers[:, None, None] + block
    rows = [np.broadcast_to(twists, blocks).ravel()] * 2 + [scales, [6 * n + maps]]
    columns = [np.broadcast_to(of, blocks).ravel() for of in (own, observers)]
    columns += [layout.scales[o.pair], [layout.focal]]
    signs = [np.tile(to_twist[o.image].ravel(), n), -to_twist[o.observers].ravel(), np.ones(maps + 1)]
    entries = np.concatenate(signs), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(entries, shape=(6 * n + maps + 1, layout.size))
