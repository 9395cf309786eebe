"""Grid of seen space: every cell of the workspace is crossed by a ray, hit by one, both, or unseen.

Each point is a ray from its camera: all before it is free, the point is surface, all behind it is unseen. Of a point
that rests on a prior only the surface counts, because no ray showed free space before it. A field
alone cannot represent this: trained on surfaces, it calls the inside of every object free.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

CROSSED, HIT = 1, 2
"""Bits of a cell's state; 0 = unseen."""


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
        """Return the states at points (n,3); outside of the box everything is unseen."""
        index, inside = self.index(x_in_base)
        return torch.where(inside, self.state.view(-1)[index], 0)

    def index(self, x_in_base: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
        """Return flat indices of the cells that hold the points, and whether they lie in the box (else index 0)."""
        nz, ny, nx = self.state.shape
        # A point beyond int32, or NaN, must not wrap into the box.
        at = ((x_in_base - self.lower) * (1.0 / self.cell)).nan_to_num(-1.0).clamp(-1.0, 1e6).floor().int()
        x, y, z = at.unbind(-1)
        inside = (x >= 0) & (y >= 0) & (z >= 0) & (x < nx) & (y < ny) & (z < nz)
        return torch.where(inside, (z * ny + y) * nx + x, 0), inside


def without_doubts(seen: SeenGrid) -> SeenGrid:
    """Return the seen grid without cells that its rays leave open: a ray shows its line, not the whole cell.

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


def dilate(mask: Bool[Tensor, "nz ny nx"], cells: int) -> Bool[Tensor, "nz ny nx"]:
    """Return the mask grown by this many cells along every axis."""
    for axis in range(3):
        grown, n = mask.clone(), mask.shape[axis]
        for step in range(1, min(cells, n - 1) + 1):
            grown.narrow(axis, step, n - step).logical_or_(mask.narrow(axis, 0, n - step))
            grown.narrow(axis, 0, n - step).logical_or_(mask.narrow(axis, step, n - step))
        mask = grown
    return mask


def halve(mask: Bool[Tensor, "nz ny nx"]) -> Bool[Tensor, "z y x"]:
    """Return the mask at half the resolution: set where any of eight cells is."""
    z, y, x = (n // 2 * 2 for n in mask.shape)
    for axis, n in enumerate((z, y, x)):
        mask = mask.narrow(axis, 0, n).unflatten(axis, (n // 2, 2))
        mask = mask.select(axis + 1, 0) | mask.select(axis + 1, 1)
    return mask
