"""Reading of map files; without torch, reading raises InputError that names the package to install."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from jcr.errors import InputError
from jcr.extras import extra

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap

FILE = "map.safetensors"
PACKAGES = "torch", "safetensors", "skimage"
"""Packages that are needed to train, read and mesh a map."""


def load_map(folder: str | Path, device: str = "cpu") -> "SceneMap":
    """Load the map of a run folder, or a map file, onto a device such as "cpu" or "cuda".

    Raises InputError if the map is missing, damaged or of another version of jcr, or if a package is not installed.
    """
    path = Path(folder)
    path = path / FILE if path.is_dir() else path
    if not path.is_file():
        raise InputError(f"{path}: no map here; make one with jcr run CAPTURE OUT, or jcr map OUT")
    again = "make it again with jcr map OUT"
    require_packages("a map")
    from safetensors import SafetensorError, safe_open

    from jcr.scene.fields import Field, Fields, Lattice
    from jcr.scene.scene_map import FORMAT, SceneMap, digest
    from jcr.scene.seen import SeenGrid
    from jcr.scene.uncertainty import MapUncertainty

    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, no mapping
        if (found := metadata.get("format", "no map of jcr")) != FORMAT:
            raise InputError(f"{path}: holds {found} where this jcr reads {FORMAT}; update jcr, or {again}")
        if metadata.get("digest") != digest(tensors):
            raise ValueError("its numbers changed since it was written")
        about = json.loads(metadata["about"])
        seen = SeenGrid(tensors.pop("lower"), about["cell"], tensors.pop("seen"))
        lattices = [
            Lattice(seen.lower, cell, tuple(shape), tensors[f"fields.lattices.{k}.nodes"])
            for k, (cell, shape) in enumerate(about["lattices"])
        ]
        uncertainty = None
        if (stated := about["uncertainty"]) is not None:
            own = {name: tensors.pop(name) for name in list(tensors) if name.startswith("uncertainty.")}
            arrays = {name.removeprefix("uncertainty."): value.numpy() for name, value in own.items()}
            uncertainty = MapUncertainty(**(stated | {"order": tuple(stated["order"])} | arrays))
        fields = Fields([Field(**of, box=seen.box, lattices=lattices) for of in about["fields"]], lattices)
        fields.load_state_dict({name.removeprefix("fields."): value for name, value in tensors.items()})
        labels = tuple(about["label_names"])
        return SceneMap(fields, seen, labels, about["history"], uncertainty).to(device)
    except InputError:
        raise
    except (SafetensorError, KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise InputError(f"{path}: the map file is damaged ({error}); {again}") from None


def require_packages(what: str, otherwise: str = "") -> None:
    """Raise InputError if one of the `PACKAGES` of the map is not installed.

    In the message, `what` is the part of jcr that needs the package; `otherwise` is added at the end, such as another
    remedy.
    """
    for package in PACKAGES:
        extra(package, "map", what, otherwise)
