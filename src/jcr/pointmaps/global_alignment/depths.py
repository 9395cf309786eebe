"""Depth of every pixel of an image from all pairs, once cameras, focal lengths and pair scales are known."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.pointmaps.global_alignment.normal_equations import depth_equations
from jcr.pointmaps.global_alignment.observations import ImageObservations
from jcr.pointmaps.global_alignment.pointmap_residuals import Noise, State, agreement, residuals

DEPTH_ITERATIONS = 2
"""The initial median is within two per cent of the result."""


def initial_depth(observations: ImageObservations, state: State) -> Float[ndarray, " m"]:
    """Return the median over the pairs of the predicted depth, of first views alone where the image has any."""
    o, n = observations, observations.second_count
    scale = np.exp(o.log_range + state.log_pair_scale[o.pair].astype(np.float32)[:, None])
    if n < len(o.pair):
        return np.maximum(np.median(scale[n:] * o.direction[n:, 2], axis=0), 1e-6)
    camera_axis = state.recon_from_camera[o.image, :3, 2]
    rotation, center = state.recon_from_camera[o.observer, :3, :3], state.recon_from_camera[o.observer, :3, 3]
    forward = (camera_axis @ rotation).astype(np.float32)
    ahead = (center - state.recon_from_camera[o.image, :3, 3]) @ camera_axis
    depths = scale * np.einsum("kc,kcm->km", forward, o.direction) + ahead.astype(np.float32)[:, None]
    return np.maximum(np.median(depths, axis=0), 1e-6)


def fused_depth(
    observations: ImageObservations, state: State, noise: Noise
) -> tuple[Float[ndarray, " m"], Float[ndarray, " m"]]:
    """Estimate the depth of the observed pixels by Gauss-Newton from `initial_depth`, and their mean weight.

    Each pointmap counts by its agreement and its noise.
    """
    log_depth = np.log(initial_depth(observations, state))
    weight = observations.weight
    for _ in range(DEPTH_ITERATIONS):
        r = residuals(observations, state, log_depth)
        weight = observations.weight * agreement(r, noise)
        hessian, gradient = depth_equations(r, noise, weight)
        log_depth -= np.clip(gradient / hessian, -0.3, 0.3)
    share = noise.along**-2 / (noise.along**-2).sum()
    return np.exp(log_depth), share @ weight
