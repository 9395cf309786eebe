"""What the trained map says, asked where an image of it needs an answer."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap


MAX_CELLS = 700_000
"""Questions that find the surface: well under a second on one core."""
FIRST_DRAWS, DRAWS = 10, 100
"""Per cell that the surface may cross, and per cell that it was then found in."""
LAYER = 0.005
"""Metres; thickness of the layers among which the support surface is looked for."""
CLEARANCE = 0.02
"""Metres above the support surface at which the horizontal slice lies: in the surface itself all is solid."""


@dataclass(frozen=True)
class SurfacePoints:
    """Points sampled where predicted occupancy is high, on the sides of it that somebody has seen."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    unknown_share: float
    """Share of the workspace that nobody has seen."""


@dataclass(frozen=True)
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


def sample_surface(scene: "SceneMap", count: int, seed: int = 0) -> SurfacePoints:
    """At most `count` points of occupancy over one half, spread evenly over where known free space ends."""
    low, high = scene.box
    pitch = max(scene.cell, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    shape = tuple(map(len, axes))
    centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    sample = scene.query(centers)
    # What is known to be solid may be thinner than a cell, so that its centre is unknown: draws will find it.
    free = (~sample.unknown & (sample.occupancy < 0.5)).reshape(shape)
    border = ((free & _beside(~free)) | (~free & _beside(free))).ravel()

    rng = np.random.default_rng(seed)

    def draw(cells: Float[ndarray, "k 3"], each: int) -> tuple[Float[ndarray, "k d 3"], Bool[ndarray, "k d"]]:
        x = cells[:, None] + rng.uniform(-pitch / 2, pitch / 2, (len(cells), each, 3))
        drawn = scene.query(x.reshape(-1, 3))
        return x, ((drawn.occupancy >= 0.5) & ~drawn.unknown).reshape(x.shape[:2])

    # Most of the border is where sight ended in thin air; the rest is drawn from again.
    cells = centers[border]
    cells = cells[draw(cells, FIRST_DRAWS)[1].any(1)]
    x, solid = draw(cells, DRAWS)
    x = x[solid]
    # One a third of a cell: how thick the solid side is known to be must not decide how dense it looks.
    third = np.floor((x - low) / (pitch / 3)).astype(np.int64)
    thirds = np.ravel_multi_index(tuple(third.T), [3 * side for side in shape], mode="clip")
    _, one = np.unique(thirds, return_index=True)
    x = x[rng.permutation(one)[:count]]
    answer = scene.query(x)
    color = (255 * answer.color + 0.5).clip(0, 255).astype(np.uint8)
    return SurfacePoints(x, color, answer.label, float(sample.unknown.mean()))


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
    return Slice(axes, at, extent, sample.occupancy.reshape(x.shape[:2]), sample.unknown.reshape(x.shape[:2]))


def _fullest(values: Float[ndarray, " n"], width: float) -> float:
    """Middle of the bin of that width which holds most values."""
    bins = np.floor(values / width).astype(np.int64)
    numbers, counts = np.unique(bins, return_counts=True)
    return float((numbers[counts.argmax()] + 0.5) * width)


def _beside(mask: Bool[ndarray, "x y z"]) -> Bool[ndarray, "x y z"]:
    """Cells that share a face with a cell of the mask."""
    beside = np.zeros_like(mask)
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        beside[tuple(behind)] |= mask[tuple(ahead)]
        beside[tuple(ahead)] |= mask[tuple(behind)]
    return beside
