"""Graph of the pairs of images that a network sees."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import motions
from jcr.features.pairs import NEIGHBOURS, near_pairs

PairGraph = Literal["auto", "complete", "window", "robot"]
"""complete: all pairs; window: images near each other in the capture's order; robot: the nearest neighbours of every
image by the gripper poses, and successive images, which join neighbourhoods that share no pair; auto: complete up to
FEW_IMAGES images, robot beyond."""
FEW_IMAGES = 12
"""Number of images up to which every pair is predicted (132)."""
WINDOW = 3
"""Distance in the capture's order up to which two images make a pair of the window graph."""


def pairs_of_graph(graph: PairGraph, base_from_gripper: Float[ndarray, "n 4 4"]) -> Int[ndarray, "e 2"]:
    """Return the pairs of a graph in both orders."""
    count = len(base_from_gripper)
    if graph == "complete" or (graph == "auto" and count <= FEW_IMAGES):
        return complete_pairs(count)
    if graph == "window":
        return window_pairs(count, WINDOW)
    near = np.reshape(near_pairs(motions(base_from_gripper), NEIGHBOURS), (-1, 2))[:, ::-1]
    successive = window_pairs(count, 1)[: count - 1]
    edges = np.unique(np.concatenate([near, successive]), axis=0)
    return np.concatenate([edges, edges[:, ::-1]])


def complete_pairs(count: int) -> Int[ndarray, "e 2"]:
    """Return every pair in both orders: (i, j) with i > j first, then each reversed, as published."""
    return window_pairs(count, count)


def window_pairs(count: int, size: int) -> Int[ndarray, "e 2"]:
    """Return the pairs of images at most `size` apart in the order of the capture, in both orders."""
    edges = np.argwhere(np.tri(count, k=-1, dtype=bool) & ~np.tri(count, k=-size - 1, dtype=bool))
    return np.concatenate([edges, edges[:, ::-1]])
