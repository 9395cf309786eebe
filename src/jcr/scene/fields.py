"""Neural fields of the map: an encoding of the position, one hidden layer, and one linear head per property.

Positions are in metres of the base frame; the encodings scale them.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F


class Lattice(nn.Module):
    """Regular grid over the workspace whose selected nodes, such as those near surfaces, have trainable features.

    The features are rows of a table outside of this class: one row for each selected node; all others share row 0.
    """

    lower: Tensor
    row: Tensor
    nodes: Tensor

    def __init__(
        self, lower: Float[Tensor, "3"], cell: float, shape: tuple[int, int, int], nodes: Int[Tensor, " k"]
    ) -> None:
        """Create a grid of `shape` (nz,ny,nx) nodes, `cell` m apart, from the corner `lower` (m, base frame) on.

        `nodes` are the indices of the selected nodes in the flattened grid, in which x changes fastest.
        """
        super().__init__()
        self.cell, self.shape = cell, shape
        row = torch.zeros(math.prod(shape), dtype=torch.int32, device=lower.device)
        row[nodes] = torch.arange(1, len(nodes) + 1, dtype=torch.int32, device=lower.device)
        self.register_buffer("lower", lower, persistent=False)
        self.register_buffer("row", row, persistent=False)
        self.register_buffer("nodes", nodes)

    @classmethod
    def around(cls, near: Bool[Tensor, "z y x"], lower: Float[Tensor, "3"], cell: float) -> "Lattice":
        """Return the grid whose selected nodes are the corners of the cells that are True in `near`.

        `lower` is the lower corner (m, base frame) of the first cell, `cell` the side (m) of a cell.
        """
        corner = F.pad(near, (1, 1, 1, 1, 1, 1))
        for axis, n in enumerate(corner.shape):
            corner = corner.narrow(axis, 0, n - 1) | corner.narrow(axis, 1, n - 1)
        nz, ny, nx = corner.shape
        return cls(lower, cell, (nz, ny, nx), corner.view(-1).nonzero()[:, 0].int())

    def corners(self, x_in_base: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n 8"], Float[Tensor, "n 8"]]:
        """Return the 8 nodes around each of n points (m), as rows of the table of features, and trilinear weights.

        The order of the 8 columns is that of the cell's corners with x changing fastest, z slowest. Row 0 stands for a
        node that is not selected. A point outside of the grid is moved to the border.
        """
        nz, ny, nx = self.shape
        at = (x_in_base - self.lower) * (1.0 / self.cell)
        last = torch.tensor([nx - 2, ny - 2, nz - 2], dtype=torch.int32, device=at.device)
        low = torch.minimum(at.detach().int().clamp_(min=0), last)
        share = (at - low).clamp(0.0, 1.0)
        x, y, z = low.unbind(1)
        first = (z * ny + y) * nx + x
        steps = torch.tensor([0, 1, nx, nx + 1], dtype=torch.int32, device=at.device)
        index = first[:, None] + torch.cat([steps, steps + ny * nx])
        (ax, ay, az), (bx, by, bz) = (1 - share).unbind(1), share.unbind(1)
        plane = torch.stack([ay * ax, ay * bx, by * ax, by * bx], 1)
        weight = torch.cat([plane * az[:, None], plane * bz[:, None]], 1)
        return self.row.index_select(0, index.view(-1)).view(-1, 8), weight  # a third of the time of `take`


def interpolate_grid(
    table: Float[Tensor, "k nz ny nx"],
    lower: Float[Tensor, "3"],
    cell: float,
    x_in_base: Float[Tensor, "n 3"],
) -> Float[Tensor, "k n"]:
    """Return k quantities of a regular grid, interpolated trilinearly at n points (m), shape (k,n).

    `table` (k,nz,ny,nx) has the k quantities at each node. `lower` is the position (m) of the first node in the frame
    of the points; `cell` is the spacing (m). Points outside have the values of the border.
    """
    cells = torch.tensor(table.shape[:0:-1], device=x_in_base.device) - 1
    at = ((x_in_base - lower) * (2.0 / (cell * cells)) - 1.0).view(1, 1, 1, -1, 3)
    return F.grid_sample(table[None], at, padding_mode="border", align_corners=True).view(len(table), -1)


def linear(inputs: int, outputs: int, generator: torch.Generator | None) -> nn.Linear:
    """Return a linear layer whose initial weights are drawn from `generator`, uniformly from ±1/√inputs.

    torch.nn.Linear has the same distribution. If `generator` is None, torch's own generator is used.
    """
    # torch.nn.utils.skip_init would import SymPy, which takes 0.3 s; the caller's random numbers must not advance.
    with torch.random.fork_rng([]):
        layer, bound = nn.Linear(inputs, outputs), inputs**-0.5
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


class Field(nn.Module):
    """Neural network from a position (m, base frame) to properties: logits of occupancy and label, values of others."""

    frequency: Tensor
    center: Tensor
    tables: nn.ParameterList
    """Trainable features: for each grid a table with a row per selected node, after a row 0 for all others."""

    def __init__(
        self,
        heads: Mapping[str, int],
        hidden: int,
        box: Float[Tensor, "2 3"],
        lattices: Sequence[Lattice] = (),
        frequencies: int = 0,
        grids: Sequence[Sequence[int]] = (),
        generator: torch.Generator | None = None,
    ) -> None:
        """Initialise the layers from `generator`; `heads` maps the name of each property to its number of outputs.

        `hidden` is the number of hidden units; `box` are lower and upper corner (m, base frame) of the workspace. A
        position is encoded by sinusoids of `frequencies` octaves, or, if this is 0, by features of `lattices` (grids of
        nodes). Each entry of `grids` is the index of a lattice and its number of features per node.
        """
        super().__init__()
        self.about = {"heads": heads, "hidden": hidden, "frequencies": frequencies, "grids": grids}
        # One scale for all axes: the longest side of the box spans [-1, 1].
        scale = 2.0 / (box[1] - box[0]).max()
        frequency = scale * math.pi * 2.0 ** torch.arange(frequencies, device=box.device)
        self.register_buffer("frequency", frequency, persistent=False)
        self.register_buffer("center", box.mean(0), persistent=False)
        self._lattices = [lattices[k] for k, _ in grids]
        tables = (
            torch.zeros(len(lattices[k].nodes) + 1, n, device=lattices[k].lower.device) for k, n in grids
        )
        self.tables = nn.ParameterList(tables)
        self._dense: list[Tensor] | None = None
        self.hidden = linear(sum((n for _, n in grids), 6 * frequencies), hidden, generator)
        self.heads = nn.ModuleDict({name: linear(hidden, n, generator) for name, n in heads.items()})

    def expand(self) -> None:
        """Copy the trained features to dense grids; queries then need more memory, and a third of the time."""
        self._dense = [
            table.detach()[lattice.row.long()].T.unflatten(1, lattice.shape)
            for table, lattice in zip(self.tables, self._lattices, strict=True)
        ]

    def encode(self, x_in_base: Float[Tensor, "n 3"]) -> Float[Tensor, "f n"]:
        """Return the f inputs of the network's first layer for n points (m): interpolated features, or sinusoids.

        The sinusoids are sin and cos of 2^k·π·x, k = 0, 1, … (Mildenhall 2020, eq. 4). The coordinates x are scaled so
        that the longest side of the workspace is [-1, 1].
        """
        if len(self.frequency):
            angle = (self.frequency[:, None, None] * (x_in_base - self.center).T).flatten(0, 1)
            return torch.cat([angle.sin(), angle.cos()])
        if self._dense is None:
            near = [lattice.corners(x_in_base) for lattice in self._lattices]
            # torch's embedding_bag, which does the same, takes twice the training's time.
            parts = zip(self.tables, near, strict=True)
            return torch.cat(
                [torch.einsum("nkf,nk->fn", table[rows.long()], w) for table, (rows, w) in parts]
            )
        parts = zip(self._dense, self._lattices, strict=True)
        return torch.cat([interpolate_grid(t, one.lower, one.cell, x_in_base) for t, one in parts])

    def forward(self, x_in_base: Float[Tensor, "n 3"]) -> dict[str, Tensor]:
        """Return the network's outputs (n, outputs) at points (n,3) m of the base frame, by name of the property.

        Occupancy and label are logits; other properties are plain values.
        """
        # Arrays are (features, n): with few features this product and its gradient take half the time of (n, features).
        hidden = F.relu(torch.addmm(self.hidden.bias[:, None], self.hidden.weight, self.encode(x_in_base)))
        return {
            name: torch.addmm(head.bias[:, None], head.weight, hidden).T  # pyright: ignore[reportArgumentType, reportIndexIssue]
            for name, head in self.heads.items()
        }


class Fields(nn.Module):
    """All networks of a map, each for one or several properties, and the grids of features that they share."""

    of: Iterable[Field]
    """Fields of the map."""

    def __init__(self, fields: Sequence[Field], lattices: Sequence[Lattice] = ()) -> None:
        """Combine networks and the grids of features (`lattices`) that are their inputs."""
        super().__init__()
        self.lattices, self.of = nn.ModuleList(lattices), cast(Any, nn.ModuleList(fields))

    def forward(self, x_in_base: Float[Tensor, "n 3"], names: Collection[str]) -> dict[str, Tensor]:
        """Return the networks' outputs (n, outputs) at points (n,3) m, base frame, for each property in `names`.

        Occupancy and label are logits; other properties are plain values.
        """
        out: dict[str, Tensor] = {}
        for field in self.of:
            if not field.heads.keys().isdisjoint(names):
                out |= field(x_in_base)
        return {name: out[name] for name in names}


CHUNK = {"cpu": 1 << 15, "cuda": 1 << 22}
"""Number of rows in a piece of `in_chunks`, by type of device."""


def in_chunks(ask: Callable[..., tuple[Tensor, ...]], *columns: Tensor) -> tuple[Tensor, ...]:
    """Return the tensors of `ask(*columns)`, computed for at most CHUNK rows at a time.

    The columns have equally many rows (first axis), and `ask` must treat each row alone. Gradients are kept if a column
    requires them; otherwise the calls are divided among the cores.
    """
    wanted = any(column.requires_grad for column in columns)

    def answer(piece: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Return the results of `ask` for one piece: the same rows of each column."""
        with torch.inference_mode(not wanted):
            return ask(*piece)

    device = columns[0].device.type
    pieces = list(zip(*(column.split(CHUNK[device]) for column in columns), strict=True))
    if wanted or len(pieces) == 1 or device != "cpu":
        answers = [answer(piece) for piece in pieces]
    else:
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            answers = list(pool.map(answer, pieces))
    with torch.inference_mode(not wanted):
        return tuple(torch.cat(column) for column in zip(*answers, strict=True))
