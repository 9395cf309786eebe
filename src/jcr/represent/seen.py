"""What the rays saw: every cell of the workspace is crossed by a ray, hit by one, both, or unseen.

Each point is a ray from its camera: all before it is free, the point is surface, all behind it is unseen. Of a point
that rests on a prior only the surface counts: nobody has seen that the way to it is free. A field
alone cannot know this: trained on surfaces, it calls the inside of every object free.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

CROSSED, HIT, CLEAR = 1, 2, 4
"""Bits of a cell's state; 0 = unseen. CLEAR: crossed, and the map's field is sure that the whole cell is free."""

NEAR = 0.06
"""Metres before each point in which its own ray is followed; farther off, the camera's depth image is asked."""

CROSSINGS = 4
"""Samples of such rays, two to a cell's side, that make a cell crossed: one ray through a corner does not show that
the cell is empty, and one ray that ends too deep is no reason to call the inside of an object free."""


@dataclass(frozen=True)
class SeenGrid:
    """The state of each cell of the workspace box."""

    lower: Float[Tensor, "3"]
    """Corner of the box in the base frame."""
    cell: float
    """Side of a cell in metres."""
    state: UInt8[Tensor, "nz ny nx"]

    @property
    def size(self) -> Float[Tensor, "3"]:
        """Sides of the box in metres."""
        return torch.tensor(self.state.shape[::-1], device=self.lower.device) * self.cell

    @property
    def box(self) -> Float[Tensor, "2 3"]:
        """Lower and upper corner in the base frame."""
        return torch.stack([self.lower, self.lower + self.size])

    def at(self, x_in_base: Float[Tensor, "n 3"]) -> UInt8[Tensor, " n"]:
        """The states at points (n,3); outside of the box everything is unseen."""
        index, inside = self.index(x_in_base)
        return torch.where(inside, self.state.view(-1)[index], 0)

    def index(self, x_in_base: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
        """Flat indices of the cells that hold the points, and whether they lie in the box (else the index is 0)."""
        nz, ny, nx = self.state.shape
        # A point beyond int32, or NaN, must not wrap into the box.
        at = ((x_in_base - self.lower) * (1.0 / self.cell)).nan_to_num(-1.0).clamp(-1.0, 1e6).floor().int()
        x, y, z = at.unbind(-1)
        inside = (x >= 0) & (y >= 0) & (z >= 0) & (x < nx) & (y < ny) & (z < nz)
        return torch.where(inside, (z * ny + y) * nx + x, 0), inside


def carve(
    points_in_base: Float[Tensor, "n 3"],
    image: Int[Tensor, " n"],
    camera_centers_in_base: Float[Tensor, "m 3"],
    box: Float[Tensor, "2 3"],
    cell: float,
    measured: Bool[Tensor, " n"] | None = None,
) -> SeenGrid:
    """The seen grid of the rays from each point's camera to the point; the box is whole pairs of cells.

    Rays of points that are not `measured` (None: all are) cross nothing, and end the crossing of those beside them.

    Far from surfaces two cells at a time are judged at once, by their centre's depth before the nearest point in
    its direction; the last centimetres of each ray are followed one by one, which keeps the grid sharp where it matters.
    """
    blocks = ((box[1] - box[0]) / (2 * cell)).round().int().tolist()
    crossed = torch.zeros(blocks[::-1], dtype=torch.bool, device=box.device)
    if measured is None:
        measured = torch.ones(len(points_in_base), dtype=torch.bool, device=box.device)
    for i, center in enumerate(camera_centers_in_base):
        rows = image == i
        if measured[rows].any():
            of_image = points_in_base[rows] - center
            crossed |= _before_nearest(of_image, measured[rows], center, box[0], 2 * cell, blocks)
    fine = crossed.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    seen = SeenGrid(box[0], cell, fine.to(torch.uint8) * CROSSED)

    ray = camera_centers_in_base[image] - points_in_base
    reach = ray.norm(dim=1, keepdim=True)
    ray /= reach
    flat = seen.state.view(-1)
    samples = torch.zeros(len(flat), dtype=torch.int16, device=flat.device)
    for step in torch.arange(cell / 2, NEAR, cell / 2).tolist():
        index, inside = seen.index(points_in_base + step * ray)
        index = index[inside & (reach[:, 0] > step) & measured]
        samples.scatter_add_(0, index.long(), samples.new_ones(1).expand(len(index)))
    flat[samples >= CROSSINGS] |= CROSSED
    # Half a cell behind the point as well: a surface that lies just on a cell's far side has some thickness too.
    for step in (0.0, -cell / 2):
        index, inside = seen.index(points_in_base + step * ray)
        flat[index[inside]] = flat[index[inside]] | HIT
    return seen


def without_doubts(seen: SeenGrid) -> SeenGrid:
    """The seen grid without what its rays leave open: a ray shows its line, not the whole of a cell.

    Next to the unseen, the rest of a crossed cell may belong to a thing that gave no points there, unless a surface
    was found in this very cell. And where a surface ends beside such a cell, the thing that it belongs to goes on:
    its cells there can be solid, not free. (Otherwise thirteen times as much of the inside of things is called
    free, all of it past the ends of what gave points.)
    """
    hit, state = (seen.state & HIT) != 0, seen.state.clone()
    unsure = dilate(state == 0, 1) & ((state & CROSSED) != 0) & ~hit
    state[unsure] = 0
    state[dilate(unsure, 1) & hit] = HIT
    return SeenGrid(seen.lower, seen.cell, state)


def _before_nearest(
    points: Float[Tensor, "n 3"],
    measured: Bool[Tensor, " n"],
    center: Float[Tensor, "3"],
    lower: Float[Tensor, "3"],
    block: float,
    blocks: list[int],
) -> Bool[Tensor, "nz ny nx"]:
    """Blocks that lie wholly before the nearest of a camera's points in their direction.

    The measured points are binned in a pinhole image about their mean direction, about two to a bin; an empty bin frees
    nothing, and points that are not measured only end what others free.
    """
    points, assumed = points[measured], points[~measured]
    axis = F.normalize(F.normalize(points, dim=1).mean(0), dim=0)
    across = torch.linalg.cross(axis, torch.eye(3, device=axis.device)[axis.abs().argmin()])
    across = F.normalize(across, dim=0)
    rotation = torch.stack([across, torch.linalg.cross(axis, across), axis])
    u, v, depth = (points @ rotation.T).unbind(-1)
    ahead = depth > 0.1 * points.norm(dim=1)
    u, v, depth = u[ahead] / depth[ahead], v[ahead] / depth[ahead], depth[ahead]
    u0, v0 = u.min(), v.min()
    width, height = float(u.max() - u0) + 1e-6, float(v.max() - v0) + 1e-6
    pitch = (2.0 * width * height / max(len(u), 1)) ** 0.5
    columns, rows = int(width / pitch) + 1, int(height / pitch) + 1
    bins = ((v - v0) / pitch).long() * columns + ((u - u0) / pitch).long()
    nearest = torch.zeros(rows * columns, device=u.device)
    nearest.scatter_reduce_(0, bins, depth, "amin", include_self=False)
    u, v, depth = (assumed @ rotation.T).unbind(-1)
    column, row = ((u / depth - u0) / pitch).floor(), ((v / depth - v0) / pitch).floor()
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    bins = (row * columns + column)[inside].long()
    nearest.scatter_reduce_(0, bins, depth[inside], "amin")

    # The centres of the blocks in the rotated frame are an outer sum, one term an axis.
    def along(row: int) -> Tensor:
        start = rotation[row] @ (lower + block / 2 - center)
        x, y, z = (rotation[row, a] * block * torch.arange(n, device=u.device) for a, n in enumerate(blocks))
        return start + x + y[:, None] + z[:, None, None]

    depth = along(2)
    column, row = ((along(0) / depth - u0) / pitch).floor(), ((along(1) / depth - v0) / pitch).floor()
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    at = torch.where(inside, row * columns + column, 0.0).long()
    return inside & (depth + block < nearest[at])


def dilate(mask: Bool[Tensor, "nz ny nx"], cells: int) -> Bool[Tensor, "nz ny nx"]:
    """The mask grown by this many cells along every axis."""
    for axis in range(3):
        grown, n = mask.clone(), mask.shape[axis]
        for step in range(1, min(cells, n - 1) + 1):
            grown.narrow(axis, step, n - step).logical_or_(mask.narrow(axis, 0, n - step))
            grown.narrow(axis, 0, n - step).logical_or_(mask.narrow(axis, step, n - step))
        mask = grown
    return mask


def halve(mask: Bool[Tensor, "nz ny nx"]) -> Bool[Tensor, "z y x"]:
    """The mask at half the resolution: set where any of eight cells is."""
    z, y, x = (n // 2 * 2 for n in mask.shape)
    for axis, n in enumerate((z, y, x)):
        mask = mask.narrow(axis, 0, n).unflatten(axis, (n // 2, 2))
        mask = mask.select(axis + 1, 0) | mask.select(axis + 1, 1)
    return mask
