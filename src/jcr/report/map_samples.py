"""Samples of the trained map for the drawings of it: points of its surface, and slices."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


MAX_CELLS = 700_000
"""Questions that find the surface: well under a second on one core."""
FIRST_DRAWS, DRAWS = 8, 2
"""Per cell that the surface may cross, and per third (along each axis) of one that it was then found in."""


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points sampled where predicted occupancy is high, on the sides of it that some camera has seen."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    point_size: float
    """Side (m) of the squares that are drawn in place of the points."""


def sample_surface(scene: "SceneMap", count: int) -> SurfacePoints:
    """At most `count` points of occupancy over one half, spread evenly over where known free space ends."""
    low, high = scene.box
    pitch = max(scene.cell, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    shape = tuple(map(len, axes))
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    sample = scene.query(centers)
    # What is known to be solid may be thinner than a cell, so that its centre is unknown: draws will find it.
    free = (~sample.unknown & (sample.occupancy < 0.5)).reshape(shape)
    border = ((free & binary_dilation(~free)) | (~free & binary_dilation(free))).ravel()

    rng = np.random.default_rng(0)

    def solid_points(cells: Float[ndarray, "k 3"], side: float, each: int) -> Float[ndarray, "m 3"]:
        """A solid point of each cell of that side in which `each` draws find one."""
        x = cells[:, None] + side * (rng.random((len(cells), each, 3), np.float32) - 0.5)
        drawn = scene.query(x.reshape(-1, 3))
        solid = ((drawn.occupancy >= 0.5) & ~drawn.unknown).reshape(x.shape[:2])
        found = solid.any(1)
        return x[found, solid[found].argmax(1)]

    # Most of the border is where sight ended in thin air; the rest is drawn from again, one point a third of a cell: how
    # thick the solid side is known to be must not decide how dense it looks.
    found = solid_points(centers[border], pitch, FIRST_DRAWS)
    cells = low + pitch * (np.floor((found - low) / pitch) + 0.5)
    thirds = np.stack(np.meshgrid(*[(-pitch / 3, 0.0, pitch / 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = solid_points((cells[:, None] + thirds).reshape(-1, 3), pitch / 3, DRAWS)
    x = x[rng.permutation(len(x))[:count]]
    answer = scene.query(x)
    color = (255 * answer.color + 0.5).clip(0, 255).astype(np.uint8)
    return SurfacePoints(
        points_in_base=x,
        color=color,
        label=answer.label,
        point_size=point_size(x),
    )


def point_size(points: Float[ndarray, "n 3"]) -> float:
    """Side (m) of the squares that, drawn in place of the points, close most gaps between them."""
    if len(points) < 2:
        return 0.01
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # made in a third of the time
    nearest = tree.query(points[:: max(len(points) // 1000, 1)], k=2)[0][:, 1]
    return round(2.2 * float(np.median(nearest)), 5)
