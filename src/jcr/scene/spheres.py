"""Greedy cover of solid space by spheres that reach at most a given length beyond it."""

import numpy as np
from jaxtyping import Bool, Float, Integer
from numpy import ndarray


def cover_with_spheres(
    distance: Float[ndarray, "x y z"], step: float, excess: float
) -> tuple[Integer[ndarray, "k 3"], Float[ndarray, " k"]]:
    """Return grid indices of centres and radii (m) of spheres that hold every voxel that may touch solid space.

    `distance` is the signed distance (m) from solid space at the voxels' centres, `step` the voxels' side. A sphere
    about c of radius excess - d(c) reaches at most `excess` beyond solid space, because d changes by no more than
    the way gone; solid space lies in voxels with d at most half their diagonal. The deepest voxel that is not
    covered becomes the next centre; a voxel is covered where its whole cube is.
    """
    half = 0.5 * np.sqrt(3.0) * step
    left = distance <= half
    candidates = np.argwhere(left)
    candidates = candidates[np.argsort(distance[left], kind="stable")]
    radii = excess - distance
    chosen = []
    for at in candidates:
        if left[tuple(at)]:
            _uncover(left, at, float(radii[tuple(at)] - half) / step)
            chosen.append(at)
    index = np.array(chosen, dtype=int).reshape(-1, 3)
    return index, radii[tuple(index.T)].astype(np.float64)


def _uncover(left: Bool[ndarray, "x y z"], at: Integer[ndarray, "3"], reach: float) -> None:
    """Clear the voxels within `reach` steps of the voxel `at`."""
    low = np.maximum(at - int(reach), 0)
    high = np.minimum(at + int(reach) + 1, left.shape)
    x, y, z = np.ogrid[tuple(slice(a, b) for a, b in zip(low - at, high - at, strict=True))]
    left[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] &= x * x + y * y + z * z > reach * reach
