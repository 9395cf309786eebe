"""Grid of seen space: every cell of the workspace is crossed by a ray, hit by one, both, or unseen.

Each point is a ray from its camera: all before it is free, the point is surface, all behind it is unseen. Of a point
that rests on a prior only the surface counts, because no ray showed free space before it. A field
alone cannot represent this: trained on surfaces, it calls the inside of every object free.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Integer, UInt8
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from jcr.compiled import compiled

CROSSED, HIT = 1, 2
"""Bits of a cell's state; 0 = unseen."""
RAY_END_M = 0.06
"""Metres before each point in which its own ray is followed; farther off, the camera's depth image is asked."""
CROSSINGS = 4
"""Samples of such rays, two to a cell's side, that make a cell crossed: one ray through a corner does not show that
the cell is empty, and one ray that ends too deep is no reason to call the inside of an object free."""
PER_BIN = 2.0
"""Points of an image in a bin of the depth image that is made of them."""


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
    return F.max_pool3d(mask[None].float(), 2)[0] > 0


def carve(
    points_in_base: Float[ndarray, "n 3"],
    image: Integer[ndarray, " n"],
    camera_centers_in_base: Float[ndarray, "m 3"],
    box: Float[ndarray, "2 3"],
    cell: float,
    measured: Bool[ndarray, " n"],
    device: str = "cpu",
) -> SeenGrid:
    """Return the seen grid of the rays from each point's camera to the point; the box is whole pairs of cells.

    Rays of points that are not `measured` cross nothing, and end the crossing of those beside them.

    Far from surfaces two cells at a time are judged at once, by their centre's depth before the nearest point in
    its direction; the last centimetres of each ray are followed one by one, which keeps the grid sharp where it matters.
    """
    lower, block = box[0].astype(np.float32), np.float32(2 * cell)
    crossed = np.zeros(np.rint((box[1] - box[0]) / (2 * cell)).astype(int)[::-1], bool)
    for i, center in enumerate(camera_centers_in_base):
        of_image = image == i
        if measured[of_image].any():
            seen_from = points_in_base[of_image] - center
            nearest, rotation, corner, pitch = _depth_image(seen_from, measured[of_image])
            start = rotation @ (lower + block / 2 - center)
            _mark_before(
                crossed, nearest, rotation.astype(np.float32), start.astype(np.float32), block, corner, pitch
            )
    state = crossed.repeat(2, 0).repeat(2, 1).repeat(2, 2).astype(np.uint8) * CROSSED
    toward = camera_centers_in_base[image] - points_in_base
    reach = np.linalg.norm(toward, axis=1)
    numbers = (points_in_base - box[0], toward / reach[:, None], reach)
    _follow(state, *(array.astype(np.float32) for array in numbers), measured, np.float32(cell))
    lower, state = (torch.as_tensor(array, device=device) for array in (lower, state))
    return SeenGrid(lower, cell, state)


def _depth_image(
    points: Float[ndarray, "n 3"], measured: Bool[ndarray, " n"]
) -> tuple[Float[ndarray, "r c"], Float[ndarray, "3 3"], tuple[float, float], float]:
    """Return the nearest depth in each bin of a pinhole image about the mean direction of a camera's measured points.

    `points` are relative to the camera; with it the rotation to the image's frame, the image's corner and the bins'
    side, both as tangents. An empty bin has depth 0 and frees nothing; points that are not measured only end what
    others free.
    """
    points, assumed = points[measured], points[~measured]
    axis = (points / np.linalg.norm(points, axis=1, keepdims=True)).mean(0)
    axis /= np.linalg.norm(axis)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    rotation = np.stack([across, np.cross(across, axis), axis])
    x = points @ rotation.T
    x = x[x[:, 2] > 0.1 * np.linalg.norm(points, axis=1)]
    tangent = x[:, :2] / x[:, 2:]
    corner = tangent.min(0)
    width, height = tangent.max(0) - corner + 1e-6
    pitch = float(np.sqrt(PER_BIN * width * height / max(len(x), 1)))
    nearest = np.full((int(height / pitch) + 1, int(width / pitch) + 1), np.inf)
    column, row = ((tangent - corner) / pitch).astype(int).T
    np.minimum.at(nearest, (row, column), x[:, 2])
    nearest[np.isinf(nearest)] = 0.0
    x = assumed @ rotation.T
    x = x[x[:, 2] > 0]
    column, row = np.floor((x[:, :2] / x[:, 2:] - corner) / pitch).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < nearest.shape[1]) & (row < nearest.shape[0])
    np.minimum.at(nearest, (row[inside], column[inside]), x[inside, 2])
    return nearest.astype(np.float32), rotation, (float(corner[0]), float(corner[1])), pitch


@compiled
@no_type_check
def _mark_before(crossed, nearest, rotation, start, block, corner, pitch):
    """Mark the blocks (z,y,x) that lie wholly before the nearest point there; `start` is the first block's centre."""
    per_pitch, u0, v0 = np.float32(1 / pitch), np.float32(corner[0]), np.float32(corner[1])
    rows, columns = nearest.shape
    for z in range(crossed.shape[0]):
        for y in range(crossed.shape[1]):
            for x in range(crossed.shape[2]):
                a, b, c = block * np.float32(x), block * np.float32(y), block * np.float32(z)
                depth = start[2] + rotation[2, 0] * a + rotation[2, 1] * b + rotation[2, 2] * c
                if depth <= 0 or crossed[z, y, x]:
                    continue
                u = (start[0] + rotation[0, 0] * a + rotation[0, 1] * b + rotation[0, 2] * c) / depth
                v = (start[1] + rotation[1, 0] * a + rotation[1, 1] * b + rotation[1, 2] * c) / depth
                u, v = (u - u0) * per_pitch, (v - v0) * per_pitch
                if u >= 0 and v >= 0 and u < columns and v < rows:
                    crossed[z, y, x] = depth + block < nearest[int(v), int(u)]


@compiled
@no_type_check
def _follow(state, points, towards, reach, measured, cell):
    """Mark the cells that enough rays cross shortly before their points, and those that points hit.

    `points` are relative to the grid's lower corner, `towards` unit vectors to their cameras. Half a cell behind a point
    is hit as well: a surface that lies just on a cell's far side has some thickness too.
    """
    samples = np.zeros(state.shape, np.uint8)
    nz, ny, nx = state.shape
    step, per_cell = cell / np.float32(2), np.float32(1) / cell
    last = int(np.ceil(np.float32(RAY_END_M) / step)) - 1
    for n in range(len(points)):
        for k in range(-1, last + 1):
            far = step * np.float32(k)
            if k > 0 and (far >= reach[n] or not measured[n]):
                break
            x = (points[n, 0] + far * towards[n, 0]) * per_cell
            y = (points[n, 1] + far * towards[n, 1]) * per_cell
            z = (points[n, 2] + far * towards[n, 2]) * per_cell
            if not (x >= 0 and y >= 0 and z >= 0 and x < nx and y < ny and z < nz):
                continue
            i, j, m = int(z), int(y), int(x)
            if k <= 0:
                state[i, j, m] |= HIT
            elif samples[i, j, m] < CROSSINGS:
                samples[i, j, m] += np.uint8(1)
                if samples[i, j, m] == CROSSINGS:
                    state[i, j, m] |= CROSSED
