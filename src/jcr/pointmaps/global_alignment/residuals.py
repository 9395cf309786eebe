"""Residuals of pairwise pointmaps against a reconstruction, their weights, and the depth fitted to each pixel.

Networks predict directions several times better than distances, so that each residual has two parts,

    across = n − (n·x̂) x̂        along = log|x| − log|q| − log σ_e

Here x is the modelled point relative to the observer and x̂ its direction; q is the predicted point, n its direction,
and σ_e the pair's scale. The variances are estimated from the residuals: per pointmap by their median, per kind of view
by the correlation of neighbouring residuals.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import retract, step_axes
from jcr.pointmaps.global_alignment.observations import CELL_SIDE, ImageObservations

ROBUST_WIDTH = 3.0
"""Standard deviations at which a residual's weight has fallen to a quarter (Geman-McClure)."""
LEAST_NOISE = np.float32(1e-4)
"""Least standard deviation; far below it, rounding of float32 sums would count as information."""
DEPTH_ITERATIONS = 2
"""Number of iterations of the depth fit; the initial median is within two per cent of the result."""


@dataclass(frozen=True, kw_only=True)
class AlignmentState:
    """Unknowns of the alignment: camera poses, log focal length, log scale and error (twist) of pairs, log depths."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    log_focal: float
    """Log of fx in px."""
    log_pair_scale: Float[ndarray, " e"]
    pair_error: Float[ndarray, "e 6"]
    """Twist (v, ω) by which the network misplaced a pair's second view, in axes of the pair's first camera."""
    log_depth: list[Float[ndarray, " _"]]
    """Log depths of the observed pixels of each image, recon units."""


@dataclass(frozen=True)
class ResidualSpread:
    """Standard deviations of the residuals of k pointmaps, across the line of sight (rad) and along it (relative)."""

    across: Float[ndarray, " k"]
    along: Float[ndarray, " k"]
    across_inflation: Float[ndarray, " k"]
    """Factor, at least 1, by which the correlation of neighbouring residuals increases the variance of their mean."""
    along_inflation: Float[ndarray, " k"]


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """Residuals of one image's m points in k pointmaps, across and along the line of sight, and their derivatives."""

    x_in_recon: Float[ndarray, "3 m"]
    depth_arm: Float[ndarray, "3 m"]
    """Derivative of the modelled points by log depth: the vector from the image's camera centre to the point."""
    focal_arm: Float[ndarray, "3 m"]
    """Derivative of the modelled points by log focal length: towards the optical axis at constant depth."""
    toward: Float[ndarray, "k 3 m"]
    """Unit vectors x̂ from the observer to the modelled points."""
    distance: Float[ndarray, "k m"]
    across: Float[ndarray, "k 3 m"]
    across_squared: Float[ndarray, "k m"]
    """Squared chord between predicted and modelled direction; unlike |across|, it grows up to an angle of 180°."""
    along: Float[ndarray, "k m"]


def depth_residuals(
    o: ImageObservations, state: AlignmentState, log_depth: Float[ndarray, " m"]
) -> Residuals:
    """Return the residuals of one image's m points in the k pointmaps that contain the image, for given log depths.

    `log_depth` is the log of the points' z in the image's camera frame, recon units; the depths in `state` are not
    used. The residual across is the part of the predicted direction that is perpendicular to the modelled one, in recon
    axes. The residual along is modelled minus predicted log distance.
    """
    camera, observer = state.recon_from_camera[o.image], state.recon_from_camera[o.observer]
    error = state.pair_error[o.pair]
    error[o.second_count :] = 0
    observer = retract(observer, (step_axes(observer[:, :3, :3]) @ error[..., None])[..., 0])

    depth = np.exp(log_depth).astype(np.float32)
    ray = np.ones((3, len(depth)), np.float32)
    ray[:2] = o.pixel_offset * np.float32(np.exp(-state.log_focal))
    depth_arm = camera[:3, :3].astype(np.float32) @ (ray * depth)
    focal_arm = camera[:3, 2:3].astype(np.float32) * depth - depth_arm

    sight = depth_arm + (camera[:3, 3] - observer[:, :3, 3]).astype(np.float32)[:, :, None]
    distance = np.sqrt(np.einsum("kcm,kcm->km", sight, sight))
    toward = sight / distance[:, None]
    seen = observer[:, :3, :3].astype(np.float32) @ o.direction
    cosine = np.einsum("kcm,kcm->km", seen, toward)
    across = seen - cosine[:, None] * toward
    return Residuals(
        x_in_recon=depth_arm + camera[:3, 3:].astype(np.float32),
        depth_arm=depth_arm,
        focal_arm=focal_arm,
        toward=toward,
        distance=distance,
        across=across,
        across_squared=np.einsum("kcm,kcm->km", across, across) + (1.0 - cosine) ** 2,
        along=np.log(distance) - o.log_range - state.log_pair_scale[o.pair].astype(np.float32)[:, None],
    )


def geman_mcclure_weights(r: Residuals, noise: ResidualSpread) -> Float[ndarray, "k m"]:
    """Return the Geman-McClure weight, in (0, 1], of each of m points in each of k pointmaps.

    The weight is (1 + u/ROBUST_WIDTH²)^−2. Here u is the sum of the squared residuals across and along the line of
    sight, each over its variance in `noise`.
    """
    u = r.across_squared / noise.across[:, None] ** 2 + r.along**2 / noise.along[:, None] ** 2
    return (1.0 + u * np.float32(ROBUST_WIDTH**-2)) ** -2


def residual_weights(
    o: ImageObservations, r: Residuals, noise: ResidualSpread
) -> tuple[Float[ndarray, "k m"], Float[ndarray, "k m"]]:
    """Return two arrays: the least-squares weights of the squared residuals across and along the line of sight.

    A weight is the confidence, scaled to mean 1, times the Geman-McClure weight, over the variance and its inflation in
    `noise`. So the weights are the information of the pointmaps.
    """
    robust = o.weight / np.maximum(o.weight.mean(), np.float32(1e-12)) * geman_mcclure_weights(r, noise)
    across, along = (
        robust / (std**2 * inflation)[:, None]
        for std, inflation in ((noise.across, noise.across_inflation), (noise.along, noise.along_inflation))
    )
    return across, along


def measure_noise(images: list[ImageObservations], misfit: list[Residuals]) -> list[ResidualSpread]:
    """Estimate the spread of the residuals (`misfit`) of every pointmap of each image.

    Pointmaps are of two kinds: of the first image of a pair, or of the second. The standard deviations come from the
    median of the pointmap's own residuals. They are at least a third of the median of the kind, so that no pair
    dominates by a lucky fit. The inflations are the median of the kind.
    """
    own = []
    for o, r in zip(images, misfit, strict=True):
        across = np.maximum(np.sqrt(np.median(r.across_squared, axis=1) / 1.386), LEAST_NOISE)
        along = np.maximum(1.4826 * np.median(np.abs(r.along), axis=1), LEAST_NOISE)
        weight = o.weight * geman_mcclure_weights(r, ResidualSpread(across, along, across, along))
        inflations = _inflation(o, weight, r.across), _inflation(o, weight, r.along[:, None])
        own.append(np.stack([across, along, *inflations]))
    is_second = [np.arange(len(o.pair)) < o.second_count for o in images]
    values, second = np.concatenate(own, axis=1), np.concatenate(is_second)
    usual = {kind: np.median(values[:, second == kind], axis=1) for kind in set(second.tolist())}
    result = []
    for noise, kinds in zip(own, is_second, strict=True):
        of_kind = np.stack([usual[kind] for kind in kinds.tolist()], axis=1)
        result.append(ResidualSpread(*np.maximum(noise[:2], of_kind[:2] / 3), *of_kind[2:]))
    return result


def _inflation(
    o: ImageObservations, weight: Float[ndarray, "k m"], parts: Float[ndarray, "k c m"]
) -> Float[ndarray, " k"]:
    """Return the variance of the mean residuals of coarse cells, over their variance if residuals were independent.

    The result (design effect) is at least 1, for each of k pointmaps.
    """
    total = np.maximum(weight.sum(axis=1), 1e-12)
    cell_total = weight @ o.cell
    weighted = weight[:, None] * parts
    variance = np.einsum("kcm,kcm->k", weighted, parts) / total
    means = (weighted @ o.cell) / np.maximum(cell_total, 1e-12)[:, None]
    variance_of_means = np.einsum("kcg,kcg,kg->k", means, means, cell_total) / total
    return np.maximum(1.0, weight.shape[1] / CELL_SIDE**2 * variance_of_means / np.maximum(variance, 1e-30))


def initial_depth(o: ImageObservations, state: AlignmentState) -> Float[ndarray, " m"]:
    """Return each pixel's median depth over the pointmaps in the image's own frame, or over all if there is none.

    The depth is z in the image's camera frame, recon units, at least 1e-6. Pointmaps are scaled and placed by `state`.
    """
    n, camera = o.second_count, state.recon_from_camera[o.image]
    scale = np.exp(o.log_range + state.log_pair_scale[o.pair].astype(np.float32)[:, None])
    if n < len(o.pair):
        return np.maximum(np.median(scale[n:] * o.direction[n:, 2], axis=0), 1e-6)
    observer = state.recon_from_camera[o.observer]
    forward = (camera[:3, 2] @ observer[:, :3, :3]).astype(np.float32)
    ahead = ((observer[:, :3, 3] - camera[:3, 3]) @ camera[:3, 2]).astype(np.float32)
    depths = scale * np.einsum("kc,kcm->km", forward, o.direction) + ahead[:, None]
    return np.maximum(np.median(depths, axis=0), 1e-6)


def fitted_depth(
    o: ImageObservations, state: AlignmentState, noise: ResidualSpread
) -> tuple[Float[ndarray, " m"], Float[ndarray, " m"]]:
    """Estimate the depth (z in the image's camera frame, recon units) of the m observed pixels with fixed cameras.

    The method is Gauss-Newton. The pointmaps count as independent, weighted by confidence, Geman-McClure weight and
    `noise`. Returns the depths and each pixel's weight. This weight is confidence times Geman-McClure weight, averaged
    over the pointmaps by their inverse variance along the line of sight.
    """
    log_depth, weight = np.log(initial_depth(o, state)), o.weight
    for _ in range(DEPTH_ITERATIONS):
        r = depth_residuals(o, state, log_depth)
        weight = o.weight * geman_mcclure_weights(r, noise)
        over_distance = weight / r.distance
        w_across, w_along = (over_distance / of[:, None] ** 2 for of in (noise.across, noise.along))
        along_arm = np.einsum("kcm,cm->km", r.toward, r.depth_arm)
        hessian = (w_along - w_across) / r.distance * along_arm**2
        hessian += w_across / r.distance * (r.depth_arm**2).sum(axis=0)
        gradient = w_along * r.along * along_arm - w_across * np.einsum("kcm,cm->km", r.across, r.depth_arm)
        total = hessian.sum(axis=0)
        total += np.float32(1e-6) * total.max() + np.float32(1e-30)
        log_depth -= np.clip(gradient.sum(axis=0) / total, -0.3, 0.3)
    share = noise.along**-2 / (noise.along**-2).sum()
    return np.exp(log_depth), share @ weight
