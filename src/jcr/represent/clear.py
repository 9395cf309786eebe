"""Cells in which the field is sure that nothing is, so that questions there need not ask it."""

from typing import no_type_check

import numpy as np
import torch

from jcr.compiled import compiled
from jcr.represent.fields import Field, GridEncoding
from jcr.represent.seen import CLEAR, CROSSED, HIT, SeenGrid, halve

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
    nz, ny, nx = (n // 2 for n in seen.state.shape)
    asked = halve((seen.state & (CROSSED | HIT)) == CROSSED).cpu().numpy()
    head = occupancy.heads["occupancy"]
    weight, bias = head.weight[0], head.bias  # pyright: ignore[reportIndexIssue]
    clear = np.zeros((nz, ny, nx), bool)
    for low in range(0, nz, SLAB):
        high = min(low + SLAB, nz)
        axes = torch.arange(low, high + 1), torch.arange(ny + 1), torch.arange(nx + 1)
        node = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)
        with torch.inference_mode():
            inputs = occupancy.before_relu(seen.lower + cell * node.view(-1, 3).to(seen.lower))
            terms = (inputs.relu_() * weight[:, None]).T.contiguous()  # pyright: ignore
            limit = -LEAST_LOGIT - float(bias)  # pyright: ignore[reportArgumentType]
        _mark_below(clear[low:high], asked[low:high], terms.view(*node.shape[:3], -1).cpu().numpy(), limit)
    fine = torch.as_tensor(clear.repeat(2, 0).repeat(2, 1).repeat(2, 2), device=seen.state.device)
    fine &= (seen.state & (CROSSED | HIT)) == CROSSED
    return SeenGrid(seen.lower, seen.cell, seen.state | fine.to(torch.uint8) * CLEAR)


@compiled
@no_type_check
def _mark_below(clear, asked, terms, limit):
    """Mark the cells (z,y,x) asked where the largest terms at the corners (z+1,y+1,x+1,k) have a sum below the limit."""
    largest = np.empty(terms.shape[3], np.float32)
    for z, y, x in np.ndindex(clear.shape):
        if asked[z, y, x]:
            for k in range(len(largest)):
                largest[k] = terms[z, y, x, k]
            for corner in range(1, 8):
                for k in range(len(largest)):
                    one = terms[z + corner // 4, y + corner // 2 % 2, x + corner % 2, k]
                    largest[k] = max(largest[k], one)
            total = np.float32(0)
            for k in range(len(largest)):
                total += largest[k]
            clear[z, y, x] = total < limit
