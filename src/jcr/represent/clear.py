"""Cells in which the field is sure that nothing is, so that questions there need not ask it."""

import torch

from jcr.represent.fields import Field, GridEncoding
from jcr.represent.seen import CLEAR, CROSSED, HIT, SeenGrid

LEAST_LOGIT = 7.0
"""The occupancy of a clear cell is below 1 / (1 + exp(7)) = 0.0009."""
SLAB = 8
"""Layers of cells worked on at once."""


def with_clear_cells(seen: SeenGrid, occupancy: Field) -> SeenGrid:
    """The seen grid with CLEAR on the cells that were crossed, not hit, and where the field is below 0.0009 all over.

    Between the nodes of the lattices the features are trilinear, and so are the inputs of the hidden units, which
    are thus nowhere in a cell beyond their values at its corners: the logit is below the sum of the largest terms.
    A field on another encoding marks no cell.
    """
    if not isinstance(occupancy.encoding, GridEncoding):
        return seen
    cell = 2 * seen.cell
    nz, ny, nx = (n // 2 + 1 for n in seen.state.shape)
    head = occupancy.heads["occupancy"]
    weight, bias = head.weight[0], head.bias  # pyright: ignore[reportIndexIssue]
    clear = []
    for low in range(0, nz - 1, SLAB):
        layers = torch.arange(low, min(low + SLAB, nz - 1) + 1)
        node = torch.stack(
            torch.meshgrid(layers, torch.arange(ny), torch.arange(nx), indexing="ij")[::-1], -1
        )
        with torch.inference_mode():
            inputs = occupancy.before_relu(seen.lower + cell * node.view(-1, 3).to(seen.lower))
            most = (inputs.relu_() * weight[:, None]).view(-1, *node.shape[:3])  # pyright: ignore
            for axis in (1, 2, 3):
                n = most.shape[axis] - 1
                most = torch.maximum(most.narrow(axis, 0, n), most.narrow(axis, 1, n))
            clear.append(most.sum(0) + bias < -LEAST_LOGIT)  # pyright: ignore[reportOperatorIssue]
    fine = torch.cat(clear).repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
    fine &= (seen.state & (CROSSED | HIT)) == CROSSED
    return SeenGrid(seen.lower, seen.cell, seen.state | fine.to(torch.uint8) * CLEAR)
