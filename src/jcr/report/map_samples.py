"""Samples of the trained map for the drawings of it: points of its surface, and slices."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap


MAX_CELLS = 700_000
"""Questions that find the surface: well under a second on one core."""
FIRST_DRAWS, DRAWS = 8, 2
"""Per cell that the surface may cross, and per third (along each axis) of one that it was then found in."""
LAYER = 0.005
"""Metres; thickness of the layers among which the support surface is looked for."""
CLEARANCE = 0.02
"""Metres above the support surface at which the horizontal slice lies: in the surface itself all is solid."""


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points sampled where predicted occupancy is high, on the sides of it that some camera has seen."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    unknown_share: float
    """Share of the workspace that no camera has seen."""
    point_size: float
    """Side (m) of the squares that are drawn in place of the points."""


@dataclass(frozen=True, kw_only=True)
class Slice:
    """Occupancy on an axis-aligned rectangle of the base frame; rows run along the second axis, upwards."""

    axes: tuple[int, int]
    """Which base axes (0 x, 1 y, 2 z) run to the right and upwards."""
    at: float
    """Where the plane cuts the remaining axis, in metres."""
    extent: Float[ndarray, "2 2"]
    """Lower and upper corner along `axes`, in metres."""
    occupancy: Float[ndarray, "h w"]
    unknown: Bool[ndarray, "h w"]


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
        unknown_share=float(sample.unknown.mean()),
        point_size=point_size(x),
    )


def slices(scene: "SceneMap", surface: SurfacePoints) -> tuple[Slice, Slice]:
    """A horizontal slice just above the support surface, and a vertical one through what stands on it."""
    x = surface.points_in_base if len(surface.points_in_base) else scene.box.mean(0, keepdims=True)
    height = _fullest(x[:, 2], LAYER) + CLEARANCE
    standing = x[x[:, 2] > height]
    across = _fullest((standing if len(standing) else x)[:, 1], 0.02)
    return _slice(scene, (0, 1), height), _slice(scene, (0, 2), across)


def point_size(points: Float[ndarray, "n 3"]) -> float:
    """Side (m) of the squares that, drawn in place of the points, close most gaps between them."""
    if len(points) < 2:
        return 0.01
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # made in a third of the time
    nearest = tree.query(points[:: max(len(points) // 1000, 1)], k=2)[0][:, 1]
    return round(2.2 * float(np.median(nearest)), 5)


def _slice(scene: "SceneMap", axes: tuple[int, int], at: float) -> Slice:
    extent = scene.box[:, axes]
    sides = extent[1] - extent[0]
    pitch = max(scene.cell / 2, float(sides.max()) / 320)
    a, b = (np.arange(extent[0, k] + pitch / 2, extent[1, k], pitch) for k in (0, 1))
    x = np.full((len(b), len(a), 3), at)
    x[..., axes[0]], x[..., axes[1]] = np.meshgrid(a, b)
    sample = scene.query(x.reshape(-1, 3))
    occupancy, unknown = (values.reshape(x.shape[:2]) for values in (sample.occupancy, sample.unknown))
    return Slice(axes=axes, at=at, extent=extent, occupancy=occupancy, unknown=unknown)


def _fullest(values: Float[ndarray, " n"], width: float) -> float:
    """Middle of the bin of that width which holds most values."""
    bins = np.floor(values / width).astype(np.int64)
    numbers, counts = np.unique(bins, return_counts=True)
    return float((numbers[counts.argmax()] + 0.5) * width)
