"""Global alignment by Gauss-Newton on a few thousand pixels per image (paper, eq. 1).

A pair's first view lies in its camera's own frame. Its second view is displaced by an error of the network, the pair's
error, whose standard deviation is estimated over all pairs. Depths and pair errors are eliminated (Schur complement;
Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6). The remaining unknowns are steps of camera
poses, log focal length and log pair scales.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import csr_array

from jcr.errors import RejectedError
from jcr.geometry import adjoint, inverse, retract, skew, twist_from_step
from jcr.least_squares import damped_gauss_newton, one_blas_thread
from jcr.pointmaps.global_alignment.initial_estimate import initial_state
from jcr.pointmaps.global_alignment.observations import AlignmentProblem, ImageObservations
from jcr.pointmaps.global_alignment.residuals import (
    AlignmentState,
    Residuals,
    ResidualSpread,
    depth_residuals,
    measure_noise,
    residual_weights,
)

STEP_TOLERANCE = 1e-4
"""Largest last step (rad, or relative), a tenth of the noise of the predictions."""
WEIGHT_ROUNDS, STEPS = 30, 10
"""Largest number of estimates of the weights, and of Gauss-Newton steps with the same weights."""
REWEIGHTED_BELOW = 0.1
"""Relative change of the cost below which the weights are estimated again."""
START_SPREAD = 0.01
"""Initial standard deviation of the pairs' errors, relative to the depth and in radians."""
LEAST_SPREAD = 1e-5
GAUGE_WEIGHT = 1e3
"""Weight that fixes the sum of the log pair scales, as a multiple of the mean information on one of them."""
NORMAL_SQUARE_MEDIAN = 0.455
"""Median of the square of a standard normal variable."""


@dataclass(frozen=True, kw_only=True)
class AlignmentSolution:
    """Result of the alignment by Gauss-Newton: unknowns, covariance of the camera poses, and noise of the pointmaps."""

    state: AlignmentState
    covariance: Float[ndarray, "r r"]
    """Covariance of the camera poses' steps, r = 6n, at the last step; zero for the first camera."""
    images: list[ImageObservations]
    noise: list[ResidualSpread]
    """Spread of the residuals of each image's pointmaps."""
    settled: bool


@dataclass(frozen=True, kw_only=True)
class ImageEquations:
    """Gauss-Newton equations of one image with its pixel depths and pair errors eliminated.

    The c remaining unknowns are one twist for each of n second views (motion of the image's camera relative to the
    camera in whose frame the view is), the log scales of the pairs, and the log focal length. The other fields give the
    steps of the eliminated t = 6n pair errors and m log depths. Twists are those of geometry.twist_from_step.
    """

    hessian: Float[ndarray, "c c"]
    gradient: Float[ndarray, " c"]
    selection: csr_array
    """Matrix from a step of all unknowns to a step of the local unknowns."""
    gain: Float[ndarray, "t c"]
    offset: Float[ndarray, " t"]
    """Constant term: the pairs' errors step by gain · (local step) + offset, in recon axes."""
    axes: Float[ndarray, "n 6 6"]
    """Adjoint of each observer: maps twists in recon axes to twists in the observer's axes."""
    error_variance: Float[ndarray, "n 6"]
    """Variances of the pairs' errors given the cameras, in the observers' axes."""
    depth_hessian: Float[ndarray, " m"]
    depth_gradient: Float[ndarray, " m"]
    coupling: Float[ndarray, "c m"]


Iterate = tuple[AlignmentState, list[Residuals]]
"""State, and the residuals of each image at the state."""


@one_blas_thread
def solve(problem: AlignmentProblem, pixels: int) -> AlignmentSolution:
    """Estimate cameras, focal length, pair scales and depths by iteratively reweighted least squares.

    About `pixels` pixels per image are used. Each round estimates the weights, and at its end the standard deviations
    of the pairs' errors (translation in recon units, rotation in rad). The rounds end when no entry of a camera pose,
    log focal length or log pair scale changes by more than STEP_TOLERANCE. The first camera and the product of the pair
    scales are fixed. Raises RejectedError where the pointmaps do not determine the unknowns.
    """
    images = problem.observe_all(pixels)
    state = initial_state(images, problem.predictions.edges)
    pair_spread = START_SPREAD * np.repeat([np.exp(np.median(np.concatenate(state.log_depth))), 1.0], 3)
    at: Iterate = (state, _residuals(images, state))
    noise, equations, settled = list[ResidualSpread](), list[ImageEquations](), False
    for _ in range(WEIGHT_ROUNDS):
        before, noise = at[0], measure_noise(images, at[1])
        at, equations = _least_squares(images, at, noise, pair_spread)
        # σ² = Σ x² / Σ (1 − var(x)/σ²) (MacKay, "Bayesian interpolation", 1992, eq. 30), with medians in place of the
        # sums, so that entirely wrong pairs do not count; one value for translations, and one for rotations.
        variance, error = np.concatenate([e.error_variance for e in equations]), at[0].pair_error
        determined, squared = (
            np.median(values.reshape(-1, 2, 3), axis=(0, 2))
            for values in (1 - variance / pair_spread**2, error**2)
        )
        spread = np.sqrt(squared / NORMAL_SQUARE_MEDIAN / np.maximum(determined, 0.01))
        pair_spread = np.repeat(np.maximum(spread, LEAST_SPREAD), 3)
        settled = all(
            np.abs(getattr(at[0], name) - getattr(before, name)).max() < STEP_TOLERANCE
            for name in ("recon_from_camera", "log_focal", "log_pair_scale")
        )
        if settled:
            break
    covariance, cameras = np.zeros((6 * len(images),) * 2), 6 * len(images) - 6
    covariance[6:, 6:] = np.linalg.inv(_normal_equations(equations)[0])[:cameras, :cameras]
    return AlignmentSolution(
        state=at[0],
        covariance=covariance,
        images=images,
        noise=noise,
        settled=settled,
    )


def _residuals(images: list[ImageObservations], state: AlignmentState) -> list[Residuals]:
    """Return the residuals of each image at the poses, focal length, pair scales, pair errors and depths of `state`."""
    return [depth_residuals(o, state, own) for o, own in zip(images, state.log_depth, strict=True)]


def _least_squares(
    images: list[ImageObservations],
    begin: Iterate,
    noise: list[ResidualSpread],
    pair_spread: Float[ndarray, "6"],
) -> tuple[Iterate, list[ImageEquations]]:
    """Minimise the weighted squares of residuals and pairs' errors; return the result and the last equations.

    The weights are those at `begin`. Raises RejectedError where the equations are singular.
    """
    latest: list[ImageEquations] = []
    weights = [residual_weights(*of) for of in zip(images, begin[1], noise, strict=True)]

    def linearise(at: Iterate) -> list[ImageEquations]:
        latest[:] = (
            image_equations(o, r, w, at[0], pair_spread)
            for o, r, w in zip(images, at[1], weights, strict=True)
        )
        return latest

    def step(at: Iterate, equations: list[ImageEquations], damping: float) -> Iterate:
        normal, gradient = _normal_equations(equations)
        normal += damping * np.diag(normal.diagonal())
        along = np.concatenate([np.zeros(6), -np.linalg.solve(normal, gradient)])
        if not np.isfinite(along).all():
            raise np.linalg.LinAlgError
        tried = _after_step(images, at[0], equations, along)
        return tried, _residuals(images, tried)

    def cost(at: Iterate) -> float:
        squares = ((at[0].pair_error / pair_spread) ** 2).sum()
        for r, (w_across, w_along) in zip(at[1], weights, strict=True):
            squares += np.vdot(w_across, r.across_squared) + np.vdot(w_along, r.along**2)
        return 0.5 * float(squares)

    try:
        at, _, _ = damped_gauss_newton(
            linearise, step, cost, begin, enough=lambda best: REWEIGHTED_BELOW * best, iterations=STEPS
        )
    except np.linalg.LinAlgError:
        raise RejectedError("the pointmaps of the pairs have too little in common to be aligned") from None
    return at, latest


def _normal_equations(equations: list[ImageEquations]) -> tuple[Float[ndarray, "q q"], Float[ndarray, " q"]]:
    """Return matrix and gradient of the equations of all images, without the rows of the first camera, which is fixed.

    The q unknowns are the steps of the other cameras (six each), the log focal length and the log pair scales. A
    camera's step is its translation, then its rotation vector, in recon axes.
    """
    hessian = np.sum([e.selection.T @ (e.selection.T @ e.hessian).T for e in equations], axis=0)
    gradient = np.sum([e.selection.T @ e.gradient for e in equations], axis=0)
    # A pair without weight keeps its scale.
    scales = np.arange(6 * len(equations) + 1, len(gradient))
    hessian[scales, scales] += 1e-9 * hessian.diagonal()[scales].max()
    hessian[np.ix_(scales, scales)] += GAUGE_WEIGHT * hessian.diagonal()[scales].mean()
    return hessian[6:, 6:], gradient[6:]


def _after_step(
    images: list[ImageObservations],
    state: AlignmentState,
    equations: list[ImageEquations],
    step: Float[ndarray, " p"],
) -> AlignmentState:
    """Return the state after `step`: six numbers per camera, the log focal length and the log pair scales.

    A camera's six numbers are translation and rotation vector in recon axes (geometry.retract). The steps of depths and
    pair errors follow from `step` by the image's `equations`.
    """
    log_depth, pair_error = [], state.pair_error.copy()
    for o, before, e in zip(images, state.log_depth, equations, strict=True):
        local_step = e.selection @ step
        pair_step = e.gain @ local_step + e.offset
        # An error of a pair moves its second view as a step of its observer does.
        local_step[: pair_step.size] -= pair_step
        # Clip the step: a pixel without parallax must not move far off the scene.
        depth_step = -(e.depth_gradient + local_step.astype(np.float32) @ e.coupling) / e.depth_hessian
        log_depth.append(before + np.clip(depth_step, -0.5, 0.5))
        pair_error[o.pair[: o.second_count]] += np.einsum("kij,kj->ki", e.axes, pair_step.reshape(-1, 6))
    focal = 6 * len(images)
    return AlignmentState(
        recon_from_camera=retract(state.recon_from_camera, step[:focal].reshape(-1, 6)),
        log_focal=state.log_focal + float(step[focal]),
        log_pair_scale=state.log_pair_scale + step[focal + 1 :],
        pair_error=pair_error,
        log_depth=log_depth,
    )


def image_equations(
    o: ImageObservations,
    r: Residuals,
    weights: tuple[Float[ndarray, "k m"], Float[ndarray, "k m"]],
    state: AlignmentState,
    pair_spread: Float[ndarray, "6"],
) -> ImageEquations:
    """Return the Gauss-Newton equations of the pointmaps of image `o`, with residuals `r` and their `weights`.

    A modelled point lies at distance |x| along the unit vector x̂. If it moves by v, the weighted squares of the
    residuals' changes sum to vᵀ (α I + β x̂ x̂ᵀ) v. Here α = w_across/|x|² and β = w_along/|x|² − α, with the weights
    of the residuals across and along x̂. Raises LinAlgError where the pairs' errors cannot be eliminated.
    """
    n, count, maps = o.second_count, 6 * o.second_count, len(o.pair)
    w_across, w_along = weights
    alpha = w_across / r.distance**2
    beta = w_along / r.distance**2 - alpha
    # Derivatives of a point by the twist (I, −[X]), the log focal length and its log depth.
    v = np.zeros((8, *r.x_in_recon.shape), np.float32)
    v[(0, 1, 2), (0, 1, 2)] = 1.0
    v[3:6] = skew(np.eye(3)) @ r.x_in_recon
    v[6], v[7] = r.focal_arm, r.depth_arm
    products, along = np.einsum("icm,jcm->ijm", v, v), np.einsum("kcm,jcm->kjm", r.toward, v)
    by_pair = (alpha @ products.reshape(64, -1).T).reshape(maps, 8, 8)
    by_pair += (along * beta[:, None]) @ along.transpose(0, 2, 1)
    by_depth = alpha[:, None] * products[7] + (beta * along[:, 7])[:, None] * along
    scale_pull = -w_along / r.distance
    by_scale = np.einsum("km,kjm->kj", scale_pull, along)
    force = -(scale_pull * r.along)[:, None] * r.toward - (w_across / r.distance)[:, None] * r.across
    gradients = np.einsum("kcm,jcm->kj", force, v)

    twists, scales = np.arange(count).reshape(n, 6), count + np.arange(maps)
    hessian = np.zeros((count + maps + 1,) * 2)
    hessian[twists[:, :, None], twists[:, None, :]] = by_pair[:n, :6, :6]
    hessian[twists, scales[:n, None]] = hessian[scales[:n, None], twists] = by_scale[:n, :6]
    hessian[twists, -1], hessian[scales, -1] = by_pair[:n, :6, 6], by_scale[:, 6]
    hessian[-1, :-1] = hessian[:-1, -1]
    hessian[scales, scales], hessian[-1, -1] = w_along.sum(axis=1), by_pair[:, 6, 6].sum()
    of_scales = -(w_along * r.along).sum(axis=1)
    gradient = np.r_[gradients[:n, :6].ravel(), of_scales, gradients[:, 6].sum()].astype(np.float64)
    twist_and_scale = by_depth[:n, :6].reshape(count, alpha.shape[1]), scale_pull * along[:, 7]
    coupling = np.concatenate([*twist_and_scale, by_depth[:, 6].sum(axis=0)[None]])
    depth_gradient = (force.sum(axis=0) * r.depth_arm).sum(axis=0)
    depth_hessian = by_depth[:, 7].sum(axis=0)
    # A pixel without weight keeps its depth.
    depth_hessian += np.float32(1e-6) * depth_hessian.max() + np.float32(1e-30)
    scaled = coupling / depth_hessian
    hessian -= (scaled @ coupling.T).astype(np.float64)
    gradient -= (scaled @ depth_gradient).astype(np.float64)
    of_pairs = _eliminated(hessian, gradient, o, state, pair_spread)
    depths = {"depth_hessian": depth_hessian, "depth_gradient": depth_gradient, "coupling": coupling}
    return ImageEquations(**of_pairs, **depths, selection=_selection(o, state))


def _eliminated(
    hessian: Float[ndarray, "c c"],
    gradient: Float[ndarray, " c"],
    o: ImageObservations,
    state: AlignmentState,
    pair_spread: Float[ndarray, "6"],
) -> dict[str, ndarray]:
    """Return the fields of ImageEquations, by name, that follow from the elimination of the pairs' errors.

    The c rows of `hessian` and `gradient` are six per second view (twists), then the log pair scales and the log focal
    length.
    """
    n, count = o.second_count, 6 * o.second_count
    axes = adjoint(inverse(state.recon_from_camera[o.observer[:n]]))
    twists = np.arange(count).reshape(n, 6)
    blocks = twists[:, :, None], twists[:, None, :]
    tied = hessian[:count, :count].copy()
    tied[blocks] += axes.transpose(0, 2, 1) @ (axes / pair_spread[:, None] ** 2)
    covariance = np.linalg.inv(tied)
    pull = np.einsum("kji,kj->ki", axes, state.pair_error[o.pair[:n]] / pair_spread**2)
    gain, offset = covariance @ hessian[:count], covariance @ (gradient[:count] - pull.ravel())
    return {
        "hessian": hessian - hessian[:, :count] @ gain,
        "gradient": gradient - hessian[:, :count] @ offset,
        "gain": gain,
        "offset": offset,
        "axes": axes,
        "error_variance": np.einsum("kij,kjl,kil->ki", axes, covariance[blocks], axes),
    }


def _selection(o: ImageObservations, state: AlignmentState) -> csr_array:
    """Return the matrix that maps a step of all unknowns to a step of the c unknowns of one image's ImageEquations.

    A step has six numbers per camera, the log focal length and the log pair scales, as in `_after_step`.
    """
    n, maps, focal = o.second_count, len(o.pair), 6 * len(state.recon_from_camera)
    observers, to_twist = o.observer[:n], twist_from_step(state.recon_from_camera)
    twists, scales = np.arange(6 * n).reshape(n, 6, 1), 6 * n + np.arange(maps)
    own, theirs = 6 * o.image + np.arange(6), 6 * observers[:, None, None] + np.arange(6)
    rows = [np.broadcast_to(twists, (n, 6, 6)).ravel()] * 2 + [scales, [6 * n + maps]]
    columns = [np.broadcast_to(of, (n, 6, 6)).ravel() for of in (own, theirs)]
    columns += [focal + 1 + o.pair, [focal]]
    signs = [np.tile(to_twist[o.image].ravel(), n), -to_twist[observers].ravel(), np.ones(maps + 1)]
    entries = np.concatenate(signs), (np.concatenate(rows), np.concatenate(columns))
    return csr_array(entries, shape=(6 * n + maps + 1, focal + 1 + len(state.log_pair_scale)))
