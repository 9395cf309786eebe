"""The map a planner asks: is this place free, how far is the nearest surface, what is there, and has anyone looked."""

import json
import threading
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.represent.distance import DistanceGrid, distance_grid
from jcr.represent.fields import Fields, FieldShape, Lattice
from jcr.represent.seen import CROSSED, HIT, SeenGrid, dilate, halve

FORMAT = "jcr.map/1"
FILE = "map.safetensors"
CHUNK = 1 << 15
"""Points evaluated at once: their activations stay in the processor's cache."""
FREE, OCCUPIED, UNKNOWN = 0, 1, 2
"""What is answered to `unknown="report"`."""

Unknown = Literal["occupied", "free", "report"]


class SceneMap:
    """Fields of a scene and what was seen of it, in the base frame.

    All queries are batched and may come from several threads at once.
    """

    def __init__(
        self,
        fields: Fields,
        seen: SeenGrid,
        label_names: tuple[str, ...],
        history: dict[str, str] | None = None,
    ) -> None:
        self.fields, self.seen, self.label_names = fields.requires_grad_(False), seen, label_names
        self.history = history or {}
        """How the map was trained: preset, steps, seconds."""
        self.properties = tuple(name for shape in fields.shapes for name in shape.heads)
        """What the fields know: occupancy, color, and label or further values where they were given."""
        self._distance: dict[str, DistanceGrid] = {}
        self._lock = threading.Lock()

    @property
    def box(self) -> Float[ndarray, "2 3"]:
        """Lower and upper corner of the workspace in the base frame."""
        return self.seen.box.double().cpu().numpy()

    @property
    def cell(self) -> float:
        """Metres between the nodes of the finest features and of the distance grid."""
        return 2 * self.seen.cell

    def to(self, device: str) -> "SceneMap":
        """The same map on another device, e.g. "cuda"."""
        seen = SeenGrid(self.seen.lower.to(device), self.seen.cell, self.seen.state.to(device))
        return SceneMap(self.fields.to(device), seen, self.label_names, self.history)

    def query(
        self, x_in_base: Float[ndarray, "n 3"] | Float[Tensor, "n 3"], unknown: Unknown = "report"
    ) -> "Sample":
        """Everything the map knows at points (n,3) in metres; tensors are answered with (differentiable) tensors.

        `unknown` says how places that nobody has seen count in `occupancy` and `distance`: as solid, as empty, or
        (report) as one half, and as no surface to keep a distance from. Raises InputError on a wrong shape, a value
        that is not finite or an unknown `unknown`.
        """
        _check_choice(unknown)
        return Sample(self, self._points(x_in_base, "points"), unknown, isinstance(x_in_base, Tensor))

    def check_spheres(
        self,
        centers_in_base: Float[ndarray, "*batch 3"],
        radii: Float[ndarray, "..."] | float,
        unknown: Unknown = "occupied",
    ) -> Bool[ndarray, "*batch"] | UInt8[ndarray, "*batch"]:
        """Whether spheres (…,3) with radii (broadcast to …) in metres touch something.

        With `unknown` "occupied" a sphere that reaches where nobody has looked, or out of the workspace, touches;
        with "free" only seen surfaces count; "report" answers FREE, OCCUPIED or UNKNOWN (0, 1, 2).
        Raises InputError on a wrong shape, a value that is not finite or a negative radius.
        """
        _check_choice(unknown)
        centers = np.asarray(centers_in_base)
        batch = centers.shape[:-1]
        x = self._points(centers.reshape(-1, centers.shape[-1] if centers.ndim else 0), "sphere centres")
        try:
            radius = np.broadcast_to(np.asarray(radii, np.float32), batch).copy()
        except ValueError:
            raise InputError(
                f"radii of shape {np.shape(radii)} do not fit centres of shape {centers.shape}"
            ) from None
        if not np.all(radius >= 0) or not np.isfinite(radius).all():
            raise InputError("sphere radii: a radius is negative or not finite; give metres")
        reach = torch.as_tensor(radius.reshape(-1), device=x.device)
        if unknown != "report":
            return self._touches(x, reach, unknown).cpu().numpy().reshape(batch)
        state = torch.where(
            self._touches(x, reach, "free"),
            OCCUPIED,
            torch.where(self._touches(x, reach, "occupied"), UNKNOWN, FREE),
        )
        return state.to(torch.uint8).cpu().numpy().reshape(batch)

    def _touches(
        self, x: Float[Tensor, "n 3"], radius: Float[Tensor, " n"], unknown: str
    ) -> Bool[Tensor, " n"]:
        grid = self.distance_grid(unknown)

        def touches(x: Tensor, radius: Tensor) -> Tensor:
            nearest = torch.clamp(x, self.seen.lower, self.seen.lower + self.seen.size)
            beyond = (x - nearest).norm(dim=1)
            distance = grid.distance(nearest)
            if unknown == "occupied":
                return (distance < radius) | (beyond > 0)
            # The box is convex: what lies in it is at least so far from a point outside.
            return torch.where(beyond > 0, (beyond**2 + distance.clamp(min=0) ** 2).sqrt(), distance) < radius

        with torch.inference_mode():
            return torch.cat(
                [touches(*part) for part in zip(x.split(CHUNK), radius.split(CHUNK), strict=True)]
            )

    def distance_grid(self, unknown: str) -> DistanceGrid:
        """Signed distance on the nodes of the workspace, computed once for each way to count the unknown."""
        with self._lock:
            if unknown not in self._distance:
                self._distance[unknown] = self._transform(unknown)
            return self._distance[unknown]

    def _transform(self, unknown: str) -> DistanceGrid:
        """The distance transform of the field, with the unknown as solid or as empty.

        Up to two cells behind a seen surface the field's word is taken in either case, though no ray passed
        there: a surface without thickness would slip through the grid.
        """
        skin = dilate(halve((self.seen.state & HIT) != 0), 2)
        behind = SeenGrid(self.seen.lower, self.cell, skin.to(torch.uint8))

        def is_solid(x: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
            inside = self.fields(x, ("occupancy",))["occupancy"][:, 0] >= 0
            if unknown == "occupied":
                return inside | ((self.seen.at(x) & CROSSED) == 0)
            return inside & ((self.seen.at(x) | behind.at(x)) != 0)

        nz, ny, nx = (n // 2 + 1 for n in self.seen.state.shape)
        with torch.no_grad():
            return distance_grid(
                self.seen.lower,
                self.cell,
                (nz, ny, nx),
                lambda x: torch.cat([is_solid(part) for part in x.split(CHUNK)]),
                closed=unknown == "occupied",
            )

    def _points(self, x: Any, what: str) -> Float[Tensor, "n 3"]:
        if x.ndim != 2 or x.shape[1] != 3:
            raise InputError(f"{what}: expected an array of shape (n, 3) in metres, got {tuple(x.shape)}")
        tensor = torch.as_tensor(x, dtype=torch.float32, device=self.seen.lower.device)
        if not torch.isfinite(tensor).all():
            row = int((~torch.isfinite(tensor)).any(1).nonzero()[0, 0])
            raise InputError(f"{what}: row {row} is not finite; remove such rows")
        return tensor

    def save(self, path: Path) -> None:
        """Write the map whole or not at all."""
        about = {
            "fields": [asdict(shape) for shape in self.fields.shapes],
            "lattices": [(lattice.cell, lattice.shape) for lattice in self.fields.lattices],
            "label_names": self.label_names,
            "cell": self.cell,
            "history": self.history,
        }
        tensors = {f"fields.{name}": value for name, value in self.fields.state_dict().items()}
        tensors |= {"seen": self.seen.state, "lower": self.seen.lower}
        tensors = {name: value.cpu().contiguous() for name, value in tensors.items()}
        write_bytes(path, save(tensors, metadata={"format": FORMAT, "about": json.dumps(about)}))


class Sample:
    """Answers at n points, each worked out when first asked for; arrays or tensors, as the points were."""

    def __init__(
        self, scene: SceneMap, x_in_base: Float[Tensor, "n 3"], unknown: Unknown, tensors: bool
    ) -> None:
        self._scene, self._x, self._unknown_as, self._tensors = scene, x_in_base, unknown, tensors

    @property
    def occupancy(self) -> Any:
        """Probability (n,) that the place is solid; one half where nobody has looked (unless told otherwise)."""
        return self._occupancy_unknown[0]

    @property
    def unknown(self) -> Any:
        """Whether (n,) nobody has looked there: no ray passed and no surface was seen; all outside of the workspace."""
        return self._occupancy_unknown[1]

    @property
    def distance(self) -> Any:
        """Metres (n,) to the nearest surface, negative inside; NaN outside of the workspace."""
        return self._distance_gradient[0]

    @property
    def gradient(self) -> Any:
        """Gradient (n,3) of the distance: points away from the nearest surface; NaN outside of the workspace."""
        return self._distance_gradient[1]

    @cached_property
    def color(self) -> Any:
        """RGB (n,3) in [0, 1] of the nearest surface as the field continues it; NaN outside of the workspace."""
        return self._continuous("color", 0.0, 1.0)

    @cached_property
    def label(self) -> Any:
        """Segment (n,), 0 = none and where nobody has looked; names are the map's `label_names`."""

        def label(x: Tensor) -> Tensor:
            if "label" not in self._scene.properties:
                return torch.zeros(len(x), dtype=torch.int64, device=x.device)
            return torch.where(
                self._scene.seen.at(x) > 0, self._scene.fields(x, ("label",))["label"].argmax(1), 0
            )

        return self._answer(label)[0]

    @cached_property
    def values(self) -> dict[str, Any]:
        """Further continuous properties (n,d) that the map was trained with; NaN outside of the workspace."""
        further = [name for name in self._scene.properties if name not in ("occupancy", "color", "label")]
        return {name: self._continuous(name, -np.inf, np.inf) for name in further}

    @cached_property
    def _occupancy_unknown(self) -> tuple[Any, ...]:
        unseen = {"occupied": 1.0, "free": 0.0, "report": 0.5}[self._unknown_as]

        def occupancy_unknown(x: Tensor) -> tuple[Tensor, Tensor]:
            state = self._scene.seen.at(x)
            occupancy = self._scene.fields(x, ("occupancy",))["occupancy"][:, 0].sigmoid()
            # A cell that was hit but not crossed lies behind the surface: it can be solid, never free.
            known = ((state & CROSSED) != 0) | (((state & HIT) != 0) & (occupancy >= 0.5))
            return torch.where(known, occupancy, unseen), ~known

        return self._answer(occupancy_unknown)

    @cached_property
    def _distance_gradient(self) -> tuple[Any, ...]:
        grid = self._scene.distance_grid("occupied" if self._unknown_as == "occupied" else "free")

        def distance_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
            answer = torch.where(self._scene.seen.index(x)[1][:, None], grid.at(x), torch.nan)
            return answer[:, 0], answer[:, 1:]

        return self._answer(distance_gradient)

    def _continuous(self, name: str, low: float, high: float) -> Any:
        def continuous(x: Tensor) -> Tensor:
            inside = self._scene.seen.index(x)[1][:, None]
            return torch.where(inside, self._scene.fields(x, (name,))[name].clamp(low, high), torch.nan)

        return self._answer(continuous)[0]

    def _answer(self, ask: Callable[[Tensor], Tensor | tuple[Tensor, ...]]) -> tuple[Any, ...]:
        """Ask chunk by chunk, and give what came out joined, in the kind of array the points came in."""
        with torch.inference_mode(not self._x.requires_grad):
            parts = [ask(part) for part in self._x.split(CHUNK)]
            rows = zip(*(part if isinstance(part, tuple) else (part,) for part in parts), strict=True)
            joined = [torch.cat(row) for row in rows]
        return tuple(joined) if self._tensors else tuple(answer.cpu().numpy() for answer in joined)


def load_map(folder: str | Path, device: str = "cpu") -> SceneMap:
    """The map of a run folder (or a map file itself).

    Raises InputError where there is none, where it is damaged, or where a newer jcr wrote it.
    """
    path = Path(folder)
    path = path / FILE if path.is_dir() else path
    if not path.is_file():
        raise InputError(f"{path}: no map here; make one with jcr run CAPTURE OUT, or jcr map OUT")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118, no mapping
    except SafetensorError as error:
        raise InputError(
            f"{path}: the map file is damaged ({error}); make it again with jcr map OUT"
        ) from None
    if metadata.get("format") != FORMAT:
        raise InputError(
            f"{path}: is {metadata.get('format', 'no map of jcr')}, and this jcr reads {FORMAT}; "
            "update jcr, or make the map again with jcr map OUT"
        )
    try:
        about = json.loads(metadata["about"])
        seen = SeenGrid(tensors.pop("lower"), about["cell"] / 2, tensors.pop("seen"))
        lattices = [
            Lattice(seen.lower, cell, tuple(shape), tensors[f"fields.lattices.{k}.nodes"])
            for k, (cell, shape) in enumerate(about["lattices"])
        ]
        shapes = [FieldShape(**shape) for shape in about["fields"]]
        fields = Fields(shapes, seen.box, lattices)
        fields.load_state_dict({name.removeprefix("fields."): value for name, value in tensors.items()})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: the map file is damaged ({error}); make it again with jcr map OUT"
        ) from None
    return SceneMap(fields.eval(), seen, tuple(about["label_names"]), about["history"]).to(device)


def _check_choice(unknown: str) -> None:
    if unknown not in ("occupied", "free", "report"):
        raise InputError(f"unknown={unknown!r}: choose occupied, free or report")
