"""Samples of a trained map for drawings: points of its surface, and level slices."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap, Unknown

MAX_CELLS = 700_000
"""Points queried to find the surface: well under a second on one core."""
FIRST_DRAWS, DRAWS = 8, 2
"""Draws per cell that the surface may cross, and per third of a cell in which it was then found."""
SLICE_PIXELS = 240
"""Pixels along the longer side of a slice."""


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points where predicted occupancy is at least one half, on the sides that some camera has seen."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    point_size: float
    """Side (m) of the squares that are drawn in place of the points."""


@dataclass(frozen=True, kw_only=True)
class Slice:
    """Map at one height: columns along the base's x axis, rows along its y axis, downwards in y."""

    occupancy: Float[ndarray, "h w"]
    distance: Float[ndarray, "h w"]
    """Signed distance (m); NaN outside of the workspace."""
    unknown: Bool[ndarray, "h w"]


def sample_surface(scene: "SceneMap", count: int) -> SurfacePoints:
    """Return at most `count` points of occupancy over one half, spread evenly over the border of known free space."""
    low, high = scene.box
    pitch = max(scene.cell, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    shape = tuple(map(len, axes))
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    sample = scene.query(centers)
    # Known solid space may be thinner than a cell, so that the cell's centre is unknown: the draws below find it.
    free = (~sample.unknown & (sample.occupancy < 0.5)).reshape(shape)
    border = ((free & binary_dilation(~free)) | (~free & binary_dilation(free))).ravel()

    rng = np.random.default_rng(0)

    def solid_points(cells: Float[ndarray, "k 3"], side: float, each: int) -> Float[ndarray, "m 3"]:
        """Return one solid point of each cell of that side in which `each` draws find one."""
        x = cells[:, None] + side * (rng.random((len(cells), each, 3), np.float32) - 0.5)
        drawn = scene.query(x.reshape(-1, 3))
        solid = ((drawn.occupancy >= 0.5) & ~drawn.unknown).reshape(x.shape[:2])
        found = solid.any(1)
        return x[found, solid[found].argmax(1)]

    # Most of the border is where sight ended in free space; from the rest one point per third of a cell is drawn, so
    # that the known thickness of the solid side does not decide how dense the surface looks.
    found = solid_points(centers[border], pitch, FIRST_DRAWS)
    cells = low + pitch * (np.floor((found - low) / pitch) + 0.5)
    thirds = np.stack(np.meshgrid(*[(-pitch / 3, 0.0, pitch / 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = solid_points((cells[:, None] + thirds).reshape(-1, 3), pitch / 3, DRAWS)
    x = x[rng.permutation(len(x))[:count]]
    answer = scene.query(x)
    color = (255 * answer.color + 0.5).clip(0, 255).astype(np.uint8)
    return SurfacePoints(points_in_base=x, color=color, label=answer.label, point_size=point_size(x))


def level_slice(scene: "SceneMap", height: float, unknown: "Unknown") -> Slice:
    """Return the map at z = height (m), with unknown space counted as given."""
    low, high = scene.box
    pitch = float((high - low)[:2].max() / SLICE_PIXELS)
    a, b = (np.arange(low[k] + pitch / 2, high[k], pitch) for k in (0, 1))
    x = np.full((len(b), len(a), 3), height)
    x[..., 0], x[..., 1] = np.meshgrid(a, b[::-1])
    answer, shape = scene.query(x.reshape(-1, 3), unknown), x.shape[:2]
    return Slice(
        occupancy=answer.occupancy.reshape(shape),
        distance=answer.distance.reshape(shape),
        unknown=answer.unknown.reshape(shape),
    )


def point_size(points: Float[ndarray, "n 3"]) -> float:
    """Return the side (m) of squares that, drawn in place of the points, close most gaps between them."""
    if len(points) < 2:
        return 0.01
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # built in a third of the time
    nearest = tree.query(points[:: max(len(points) // 1000, 1)], k=2)[0][:, 1]
    return round(2.2 * float(np.median(nearest)), 5)
