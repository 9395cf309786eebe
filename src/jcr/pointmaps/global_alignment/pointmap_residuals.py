"""Residuals of pairwise pointmaps against a reconstruction, and their weights.

A predicted point errs differently *across* its line of sight (where in the observer's image it appears) and
*along* it (how far it is): networks know directions several times better than distances, and their errors in
distance are smooth, so that a thousand pixels do not average them out. Each residual is therefore split,

    across = n − (n·x̂) x̂        along = log|x| − log|q| − log σ_e

(x the modelled point seen from the observer, x̂ its direction; q the predicted point, n its direction, both
rotated into the recon axes), and the two parts are weighted by variances measured on the residuals themselves:
per pointmap by their median, and per kind of view by how far neighbouring residuals go together. Pairs that
contradict the others get large variances and so little weight.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import retract, step_axes
from jcr.pointmaps.global_alignment.observations import CELL_SIDE, ImageObservations

ROBUST_WIDTH = 3.0
"""Standard deviations at which a residual's weight has fallen to a quarter (Geman-McClure)."""
LEAST_NOISE = np.float32(1e-4)
"""Least standard deviation; far below it the rounding of float32 sums would count as evidence."""


@dataclass(frozen=True, kw_only=True)
class State:
    """Unknowns of the alignment."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    log_focal: float
    """Log of fx, px."""
    log_pair_scale: Float[ndarray, " e"]
    pair_error: Float[ndarray, "e 6"]
    """Twist (v, ω), in the axes of a pair's first camera, by which the network misplaced its second view."""
    log_depth: list[Float[ndarray, " _"]]
    """Log depths of the observed pixels of each image."""


@dataclass(frozen=True)
class Noise:
    """Spread of the residuals of some pointmaps, `across` (rad per axis) and `along` (relative) the sight."""

    across: Float[ndarray, " k"]
    along: Float[ndarray, " k"]
    across_inflation: Float[ndarray, " k"]
    """Factor by which neighbouring residuals going together widen the variance of their mean, at least 1."""
    along_inflation: Float[ndarray, " k"]


@dataclass(frozen=True, kw_only=True)
class Residuals:
    """The two parts of the residuals of one image's pointmaps, and the geometry they hang on (recon axes)."""

    x_in_recon: Float[ndarray, "3 m"]
    depth_arm: Float[ndarray, "3 m"]
    """Change of the modelled points per change of log depth: from the image's camera centre to them."""
    focal_arm: Float[ndarray, "3 m"]
    """Change of the modelled points per change of log focal: toward the optical axis at constant depth."""
    toward: Float[ndarray, "k 3 m"]
    """Unit vectors from the observer to the modelled points, x̂."""
    distance: Float[ndarray, "k m"]
    across: Float[ndarray, "k 3 m"]
    across_squared: Float[ndarray, "k m"]
    """Squared chord between the directions: grows up to a rotation by 180°, as |across| does not."""
    along: Float[ndarray, "k m"]


def residuals(observations: ImageObservations, state: State, log_depth: Float[ndarray, " m"]) -> Residuals:
    """Model one image's points at `log_depth` and compare them with every pointmap that shows them."""
    o = observations
    camera = state.recon_from_camera[o.image]
    error = np.where(o.second[:, None], state.pair_error[o.pair], 0.0)
    observer = state.recon_from_camera[o.observer]
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


def agreement(r: Residuals, noise: Noise) -> Float[ndarray, "k m"]:
    """Return the Geman-McClure weights of the residuals, in (0, 1]."""
    u = r.across_squared / noise.across[:, None] ** 2 + r.along**2 / noise.along[:, None] ** 2
    return (1.0 + u * np.float32(ROBUST_WIDTH**-2)) ** -2


def measure_noise(images: list[ImageObservations], misfit: list[Residuals]) -> list[Noise]:
    """Estimate the noise of every pointmap, per image: its own spreads and the inflations of its kind of view.

    A spread is at least a third of the usual one of its kind, so that no pair outweighs all others by a lucky fit.
    """
    own = [_own_noise(o, r) for o, r in zip(images, misfit, strict=True)]
    second = np.concatenate([o.second for o in images])
    usual = np.ones((2, len(fields(Noise))), np.float32)
    for column, part in enumerate(fields(Noise)):
        values = np.concatenate([getattr(noise, part.name) for noise in own])
        for kind in (0, 1):
            if (second == kind).any():
                usual[kind, column] = np.median(values[second == kind])
    result = []
    for o, noise in zip(images, own, strict=True):
        across, along, across_inflation, along_inflation = usual[o.second.astype(int)].T
        result.append(
            Noise(
                np.maximum(noise.across, across / 3),
                np.maximum(noise.along, along / 3),
                across_inflation,
                along_inflation,
            )
        )
    return result


def _own_noise(observations: ImageObservations, r: Residuals) -> Noise:
    """Estimate the spread per pointmap from medians, and the inflation from the agreement within cells."""
    across = np.maximum(np.sqrt(np.median(r.across_squared, axis=1) / 1.386), LEAST_NOISE)
    along = np.maximum(1.4826 * np.median(np.abs(r.along), axis=1), LEAST_NOISE)
    weight = observations.weight * agreement(r, Noise(across, along, across, along))
    across_inflation = _inflation(observations, weight, r.across)
    return Noise(across, along, across_inflation, _inflation(observations, weight, r.along[:, None]))


def _inflation(
    o: ImageObservations, weight: Float[ndarray, "k m"], parts: Float[ndarray, "k c m"]
) -> Float[ndarray, " k"]:
    """Return the variance of the residuals' cell means over that of independent residuals (the design effect)."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    cell_total = weight @ o.cell
    weighted = weight[:, None] * parts
    variance = np.einsum("kcm,kcm->k", weighted, parts) / total
    means = (weighted @ o.cell) / np.maximum(cell_total, 1e-12)[:, None]
    variance_of_means = np.einsum("kcg,kcg,kg->k", means, means, cell_total) / total
    per_cell = weight.shape[1] / CELL_SIDE**2
    return np.maximum(1.0, per_cell * variance_of_means / np.maximum(variance, 1e-30))
