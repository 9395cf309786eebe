"""Reading of map files; without torch, reading raises InputError that names the package to install."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from jcr.errors import InputError, first_fault
from jcr.extras import extra
from jcr.files import as_path
from jcr.records.json_fields import Positive

if TYPE_CHECKING:
    from torch import Tensor

    from jcr.scene.fields import Lattice
    from jcr.scene.scene_map import SceneMap
    from jcr.scene.seen_space import SeenGrid

MAP_FILE = "map.safetensors"
SLACK = 1e-3
"""Largest relative error of a lattice's size by rounding to float32."""
REASON = 200
"""Largest number of characters of a library's message that an error quotes."""
MAP_PACKAGES = "torch", "safetensors", "skimage"
"""Packages that are needed to train, read and mesh a map."""


Units = Annotated[int, Field(ge=1, le=1024)]
"""Number of outputs or hidden units of a network; a map has at most 1024 labels, the published networks 256 units."""
Features = Annotated[int, Field(ge=1, le=16)]
"""Number of features of a node; those of jcr have 4. They are copied to every node of a dense grid."""
Nodes = Annotated[int, Field(ge=2, le=100_000)]
"""Number of nodes of a grid along an axis."""


MOST_PARTS = 8
"""Largest number of networks, of their grids, and of all grids; maps of jcr have up to four. It bounds the memory that a
header of few bytes takes."""


class NetworkHeader(BaseModel):
    """Arguments of one network of the map (scene.fields.Field)."""

    model_config = ConfigDict(extra="forbid")
    heads: Annotated[dict[str, Units], Field(max_length=MOST_PARTS)]
    hidden: Units
    frequencies: Annotated[int, Field(ge=0, le=64)]
    grids: Annotated[list[tuple[Annotated[int, Field(ge=0)], Features]], Field(max_length=MOST_PARTS)]

    @model_validator(mode="after")
    def _has_one_input(self) -> "NetworkHeader":
        """Return the header; raise ValueError unless the network has either sinusoids or grids as its input."""
        if bool(self.frequencies) is bool(self.grids):
            raise ValueError("a network has either frequencies or grids")
        return self


class MapHeader(BaseModel):
    """Header of a map file, in JSON: its networks and grids, label names, cell size (m), and how it was made."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    networks: Annotated[list[NetworkHeader], Field(max_length=MOST_PARTS)]
    lattices: Annotated[list[tuple[Positive, tuple[Nodes, Nodes, Nodes]]], Field(max_length=MOST_PARTS)]
    """Spacing (m) and number of nodes along z, y and x of each grid of features."""
    label_names: tuple[str, ...]
    cell: Positive
    history: dict[str, str]
    uncertainty: dict[str, float | tuple[str, ...]] | None
    """Fields of the map's uncertainty (scene.uncertainty.MapUncertainty) that are no arrays; None: unknown."""


def load_map(folder: str | Path, device: str = "cpu") -> "SceneMap":
    """Load the map of a run folder, or a map file, onto a device such as "cpu" or "cuda".

    Raises InputError if the map is missing, damaged or of another version of jcr, or if a package is not installed.
    """
    path = as_path(folder, "folder")
    path = path / MAP_FILE if path.is_dir() else path
    if not path.is_file():
        raise InputError(f"{path}: no map here; make one with jcr run CAPTURE OUT, or jcr map OUT")
    again = "make it again with jcr map OUT"
    require_packages("a map")
    from safetensors import SafetensorError, safe_open

    from jcr.scene.scene_map import FORMAT, digest

    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            if (found := metadata.get("format", "no map of jcr")) == FORMAT:
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, no mapping
                if metadata.get("digest") != digest(tensors, metadata["about"]):
                    raise ValueError("its numbers changed since it was written")
                header = MapHeader.model_validate_json(metadata["about"], strict=True)
                return _scene_of(header, tensors).to(device)
    except (SafetensorError, KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        text = f"about: {first_fault(error)}" if isinstance(error, ValidationError) else str(error)
        reason = " ".join(text.split())[:REASON]
        raise InputError(f"{path}: the map file is damaged ({reason}); {again}") from None
    raise InputError(f"{path}: holds {found} where this jcr reads {FORMAT}; update jcr, or {again}")


def _scene_of(about: "MapHeader", tensors: "dict[str, Tensor]") -> "SceneMap":
    """Return the map with the header and tensors of a file; raise ValueError or RuntimeError if they do not agree."""
    import torch

    from jcr.scene.fields import Field, Fields
    from jcr.scene.scene_map import SceneMap
    from jcr.scene.seen_space import SeenGrid
    from jcr.scene.uncertainty import MapUncertainty

    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise ValueError(f"{name} holds NaN or infinity")
    seen = SeenGrid(tensors["lower"], about.cell, tensors["seen"])
    if any(count % 2 for count in seen.state.shape):
        raise ValueError("an odd number of cells of seen space; two are the side of a map cell")
    heads = {name: count for field in about.networks for name, count in field.heads.items()}
    if heads.get("occupancy") != 1 or heads.get("color") != 3:
        raise ValueError("its networks are not those of a map")
    if heads.get("label", len(about.label_names)) != len(about.label_names) or not about.label_names:
        raise ValueError(f"{heads.get('label')} labels with {len(about.label_names)} names")
    lattices = _lattices_of(about, seen, tensors)
    fields = Fields([Field(**dict(of), box=seen.box, lattices=lattices) for of in about.networks], lattices)

    def part(prefix: str) -> dict[str, Any]:
        """Return the tensors whose names begin with a prefix, by the rest of their names."""
        return {name.removeprefix(prefix): at for name, at in tensors.items() if name.startswith(prefix)}

    fields.load_state_dict(part("fields."))
    uncertainty = None
    if about.uncertainty is not None:
        arrays = {name: value.numpy() for name, value in part("uncertainty.").items()}
        uncertainty = MapUncertainty(**cast(Any, about.uncertainty), **arrays)
    return SceneMap(fields, seen, about.label_names, about.history, uncertainty)


def _lattices_of(about: "MapHeader", seen: "SeenGrid", tensors: "dict[str, Tensor]") -> "list[Lattice]":
    """Return the grids of features of a map file; raise ValueError if one does not span the grid of seen space."""
    import torch

    from jcr.scene.fields import Lattice

    lattices = []
    for k, (cell, shape) in enumerate(about.lattices):
        # There is a node at each corner of the cells, the last of which may extend beyond the box.
        if cell < (1 - SLACK) * seen.cell:
            raise ValueError(f"lattice {k} has more nodes than the workspace has cells")
        for count, side in zip(shape[::-1], seen.size.tolist(), strict=True):
            if not (1 - SLACK) * side <= cell * (count - 1) <= (1 + SLACK) * (side + cell):
                raise ValueError(f"lattice {k} does not span the workspace")
        nodes = tensors[f"fields.lattices.{k}.nodes"]
        if nodes.dtype != torch.int32 or nodes.ndim != 1:
            raise ValueError(f"lattice {k} has no list of nodes")
        if len(nodes) and not 0 <= int(nodes.min()) <= int(nodes.max()) < math.prod(shape):
            raise ValueError(f"lattice {k} has nodes that are not there")
        lattices.append(Lattice(seen.lower, cell, shape, nodes))
    return lattices


def require_packages(what: str, otherwise: str = "") -> None:
    """Raise InputError if one of the `MAP_PACKAGES` of the map is not installed.

    In the message, `what` is the part of jcr that needs the package; `otherwise` is added at the end, such as another
    remedy.
    """
    for package in MAP_PACKAGES:
        extra(package, "map", what, otherwise)
