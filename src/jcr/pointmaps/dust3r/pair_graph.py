"""Choice of the image pairs whose pointmaps a network predicts."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import motions
from jcr.features.pairs import NEIGHBOURS, near_pairs

FEW_IMAGES = 12
"""Largest number of images for which every pair is predicted (132 ordered pairs)."""


def pairs_to_predict(base_from_gripper: Float[ndarray, "n 4 4"]) -> Int[ndarray, "e 2"]:
    """Return the pairs of images to predict, in both orders: all pairs of up to FEW_IMAGES images.

    With more images, these are the pairs of near viewpoints, and of successive images, which connect separate groups of
    viewpoints.
    """
    count = len(base_from_gripper)
    if count <= FEW_IMAGES:
        return complete_pairs(count)
    near = np.reshape(near_pairs(motions(base_from_gripper), NEIGHBOURS), (-1, 2))[:, ::-1]
    edges = np.unique(np.concatenate([near, window_pairs(count, 1)[: count - 1]]), axis=0)
    return np.concatenate([edges, edges[:, ::-1]])


def complete_pairs(count: int) -> Int[ndarray, "e 2"]:
    """Return all ordered pairs of `count` images: first (i, j) with i > j, then each reversed, as DUSt3R has them."""
    return window_pairs(count, count)


def window_pairs(count: int, size: int) -> Int[ndarray, "e 2"]:
    """Return the pairs of images at most `size` apart in the capture's order: (i, j) with i > j, then each reversed."""
    edges = np.argwhere(np.tri(count, k=-1, dtype=bool) & ~np.tri(count, k=-size - 1, dtype=bool))
    return np.concatenate([edges, edges[:, ::-1]])
