"""Query interface of the map: occupancy, signed distance, colour, label and visibility at points in the base frame."""

import copy
import json
import threading
from collections.abc import Callable
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from numpy.typing import ArrayLike
from safetensors.torch import save
from torch import Tensor

from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.geometry import apply, require_rigid
from jcr.scene.distance import DistanceGrid, distance_grid
from jcr.scene.fields import Field, Fields, Lattice, in_chunks
from jcr.scene.robot import JointValues, RobotSpheres, load_robot
from jcr.scene.seen import CROSSED, HIT, SeenGrid, dilate, halve

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
"""Answers to `unknown="report"`."""

Unknown = Literal["occupied", "free", "report"]
FORMAT = "jcr.map/1"
"""Format of the file that `SceneMap.save` writes and map_file.py reads."""


class Sample:
    """Values of the map at n points, each computed when it is first used; arrays or tensors, as the points were."""

    def __init__(
        self, scene: "SceneMap", x_in_base: Float[Tensor, "n 3"], *, unknown: str, tensors: bool
    ) -> None:
        self._map, self._x, self._unknown_as, self._tensors = scene, x_in_base, unknown, tensors

    @property
    def occupancy(self) -> Any:
        """Probability (n,) of solid space; in unseen space one half, or as `unknown` of the query chose."""
        return self._occupancy_unknown[0]

    @property
    def unknown(self) -> Any:
        """Mask (n,) of unseen points: no ray passed and no surface was seen, or outside of the workspace."""
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
        """RGB (n,3) in [0, 1] of the colour field, trained on surfaces; NaN outside of the workspace."""
        return self._answers(lambda x: (self._continuous("color", x).clamp(0.0, 1.0),))[0]

    @cached_property
    def label(self) -> Any:
        """Row (n,) of the map's `label_names`; 0 = none, also in unseen space."""
        scene = self._map

        def label(x: Tensor) -> tuple[Tensor]:
            if "label" not in scene.properties:
                return (torch.zeros(len(x), dtype=torch.int64, device=x.device),)
            return (torch.where(scene.seen.at(x) > 0, scene.fields(x, ("label",))["label"].argmax(1), 0),)

        return self._answers(label)[0]

    @cached_property
    def values(self) -> dict[str, Any]:
        """Further continuous properties (n,d) that the map was trained with; NaN outside of the workspace."""
        further = [name for name in self._map.properties if name not in ("occupancy", "color", "label")]
        answers = self._answers(lambda x: tuple(self._continuous(name, x) for name in further))
        return dict(zip(further, answers, strict=True))

    @cached_property
    def _occupancy_unknown(self) -> tuple[Any, ...]:
        """Occupancy and unknown (n,)."""
        unseen = {"occupied": 1.0, "free": 0.0, "report": 0.5}[self._unknown_as]

        def occupancy_unknown(x: Tensor) -> tuple[Tensor, Tensor]:
            state = self._map.seen.at(x)
            # Most of a workspace is unseen, where the field need not be evaluated.
            unknown = state == 0
            occupancy = torch.where(unknown, unseen, 0.0)
            (seen,) = (~unknown).nonzero(as_tuple=True)
            if len(seen) == 0:
                return occupancy, unknown
            inner = self._map.fields(x[seen], ("occupancy",))["occupancy"][:, 0].sigmoid()
            # A cell that was hit but not crossed lies behind the surface: it can be solid, never free.
            known = ((state[seen] & CROSSED) != 0) | (inner >= 0.5)
            occupancy = occupancy.index_put((seen,), torch.where(known, inner, unseen))
            return occupancy, unknown.index_put((seen,), ~known)

        return self._answers(occupancy_unknown)

    @cached_property
    def _distance_gradient(self) -> tuple[Any, ...]:
        """Distance (n,) and gradient (n,3)."""
        grid = self._map.distance_grid("occupied" if self._unknown_as == "occupied" else "free")

        def distance_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
            answer = torch.where(self._map.seen.index(x)[1][:, None], grid.at(x), torch.nan)
            return answer[:, 0], answer[:, 1:]

        return self._answers(distance_gradient)

    def _continuous(self, name: str, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n d"]:
        """Return a property at points; NaN outside of the workspace."""
        return torch.where(self._map.seen.index(x)[1][:, None], self._map.fields(x, (name,))[name], torch.nan)

    def _answers(self, ask: Callable[[Tensor], tuple[Tensor, ...]]) -> tuple[Any, ...]:
        """Return the answers at all points as tensors or arrays, as the points were."""
        answers = in_chunks(ask, self._x)
        return answers if self._tensors else tuple(answer.cpu().numpy() for answer in answers)


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
        self.fields, self.seen, self.label_names = fields.requires_grad_(False).eval(), seen, label_names
        self.history = history or {}
        """Preset, steps and seconds of the training."""
        self.properties = tuple(name for field in fields.of for name in field.heads)
        """Properties of the fields: occupancy, color, and label or further values where they were given."""
        for field in fields.of:
            if "occupancy" in field.heads and len(field.tables):
                field.expand()
        self._distance: dict[str, DistanceGrid] = {}
        self._lock = threading.Lock()

    @property
    def box(self) -> Float[ndarray, "2 3"]:
        """Lower and upper corner of the workspace in the base frame."""
        return self.seen.box.double().cpu().numpy()

    @property
    def cell(self) -> float:
        """Metres between the nodes of the distance grid, and of the features near surfaces."""
        return 2 * self.seen.cell

    def to(self, device: str) -> "SceneMap":
        """Return a copy of the map on another device, e.g. "cuda"."""
        seen = SeenGrid(self.seen.lower.to(device), self.seen.cell, self.seen.state.to(device))
        return SceneMap(copy.deepcopy(self.fields).to(device), seen, self.label_names, self.history)

    def field(self, x_in_base: Float[ndarray, "n 3"] | Float[Tensor, "n 3"]) -> dict[str, Any]:
        """Return the raw outputs of the networks at points (n,3) m in the base frame: (n,outputs) for each property.

        Occupancy and labels are logits, other properties plain values. Unseen space is not considered.
        """
        x = self._points(x_in_base, "points")
        answers = in_chunks(lambda x: tuple(self.fields(x, self.properties).values()), x)
        if not isinstance(x_in_base, Tensor):
            answers = tuple(answer.cpu().numpy() for answer in answers)
        return dict(zip(self.properties, answers, strict=True))

    def query(self, x_in_base: ArrayLike | Float[Tensor, "n 3"], unknown: Unknown = "report") -> Sample:
        """Query the map at points (n,3) m; tensors are answered with (differentiable) tensors.

        `unknown` is how unseen places count in `occupancy` and `distance`: as solid, as empty,
        or (report) as one half and as no surface. Raises InputError on a wrong shape or a value that is not
        finite.
        """
        x, tensors = self._points(x_in_base, "points", unknown), isinstance(x_in_base, Tensor)
        return Sample(self, x, unknown=unknown, tensors=tensors)

    def check_spheres(
        self,
        centers_in_base: ArrayLike,
        radii: ArrayLike | float,
        unknown: Unknown = "occupied",
    ) -> Bool[ndarray, "*batch"] | UInt8[ndarray, "*batch"]:
        """Test whether spheres at (…,3) with radii (broadcast to …) in metres touch something.

        With `unknown` "occupied" a sphere that reaches unseen space, or out of the workspace,
        touches; with "free" only seen surfaces count; "report" answers FREE, OCCUPIED or UNKNOWN (0, 1, 2).
        Raises InputError on a wrong shape, a value that is not finite or a negative radius.
        """
        centers = np.asarray(centers_in_base)
        if centers.ndim == 0 or centers.shape[-1] != 3:
            raise InputError(f"sphere centres: expected shape (…, 3) in metres, got {centers.shape}")
        batch = centers.shape[:-1]
        x = self._points(centers.reshape(-1, 3), "sphere centres", unknown)
        try:
            radius = np.broadcast_to(np.asarray(radii, np.float32), batch)
        except ValueError:
            raise InputError(f"radii: shape {np.shape(radii)} does not fit centres of {batch}") from None
        if not (np.isfinite(radius) & (radius >= 0)).all():
            raise InputError("radii: one is negative or not finite; give metres")
        reach = torch.tensor(radius.reshape(-1), device=x.device)
        if unknown != "report":
            return self._touches(x, reach, unknown).cpu().numpy().reshape(batch)
        surface, any_ = self._touches(x, reach, "free"), self._touches(x, reach, "occupied")
        state = torch.where(surface, OCCUPIED, torch.where(any_, UNKNOWN, FREE)).to(torch.uint8)
        return state.cpu().numpy().reshape(batch)

    def check_segments(
        self,
        starts_in_base: ArrayLike,
        ends_in_base: ArrayLike,
        radii: ArrayLike | float,
        unknown: Unknown = "occupied",
    ) -> Bool[ndarray, "*batch"] | UInt8[ndarray, "*batch"]:
        """Test whether spheres swept from starts to ends (…,3) touch something; answers and raises as `check_spheres`.

        The sweep is checked at steps of half a cell, so an obstacle's corner may be overlooked by
        r - sqrt(r² - (cell/4)²): 0.2 mm for a radius of 2 cm at the default cell.
        """
        starts, ends = np.asarray(starts_in_base, float), np.asarray(ends_in_base, float)
        if starts.ndim == 0 or starts.shape[-1] != 3 or starts.shape != ends.shape:
            raise InputError(
                f"segments: shapes {starts.shape} and {ends.shape}; both must be (…, 3), the same"
            )
        length = np.linalg.norm(ends - starts, axis=-1)
        longest = float(length.max(initial=0.0))
        if not np.isfinite(longest):
            raise InputError("segments: an end is not finite; remove such segments")
        share = np.linspace(0.0, 1.0, int(np.ceil(longest / self.seen.cell)) + 1)
        centers = starts[..., None, :] + share[:, None] * (ends - starts)[..., None, :]
        along = np.broadcast_to(np.asarray(radii, np.float32)[..., None], centers.shape[:-1])
        return _worst(self.check_spheres(centers, along, unknown), unknown)

    def check_robot(
        self,
        robot: str | Path | RobotSpheres,
        joint_values: JointValues,
        unknown: Unknown = "occupied",
        base_from_robot: ArrayLike | None = None,
        ignore_links: tuple[str, ...] = (),
    ) -> Bool[ndarray, "*batch"] | UInt8[ndarray, "*batch"]:
        """Test whether a robot touches something at joint values (…,dof); answers as `check_spheres`.

        `robot` is a URDF file, which takes seconds to load, or what `jcr.load_robot` made of it: spheres
        that cover the collision shapes. Joint values (rad, m) are in the order of `RobotSpheres.joint_names` (as in
        the URDF), or a mapping from these names. `base_from_robot` maps the URDF's root link to the map's base frame;
        `ignore_links` names links that may touch, e.g. the one that stands on the table. The robot's own
        links are not checked against each other. Raises InputError as `load_robot` and
        `RobotSpheres.centers` do.
        """
        spheres = robot if isinstance(robot, RobotSpheres) else load_robot(robot)
        spheres = spheres.without(tuple(ignore_links))
        centers = spheres.centers(joint_values)
        if base_from_robot is not None:
            centers = apply(require_rigid(np.asarray(base_from_robot, float), "base_from_robot"), centers)
        return _worst(self.check_spheres(centers, spheres.radii, unknown), unknown)

    def _touches(
        self, x: Float[Tensor, "n 3"], radius: Float[Tensor, " n"], unknown: str
    ) -> Bool[Tensor, " n"]:
        """Test spheres with unknown space "occupied" or "free"."""
        grid, (lower, upper) = self.distance_grid(unknown), self.seen.box

        def touches(x: Tensor, radius: Tensor) -> tuple[Tensor]:
            nearest = torch.clamp(x, lower, upper)
            distance, beyond = grid.distance(nearest), (x - nearest).norm(dim=1)
            if unknown == "occupied":
                return ((distance < radius) | (beyond > 0),)
            # The box is convex: from outside, everything in it is at least so far.
            outside = (beyond**2 + distance.clamp(min=0) ** 2).sqrt()
            return (torch.where(beyond > 0, outside, distance) < radius,)

        return in_chunks(touches, x, radius)[0]

    def distance_grid(self, unknown: str) -> DistanceGrid:
        """Return the signed distance on the nodes of the workspace, computed once for each way to count the unknown."""
        with self._lock:
            if unknown not in self._distance:
                self._distance[unknown] = self._transform(unknown)
            return self._distance[unknown]

    def _transform(self, unknown: str) -> DistanceGrid:
        """Return the distance transform of the field, with the unknown as solid or as empty.

        Up to two cells behind a seen surface the field decides in either case, though no ray passed
        there: a surface without thickness would slip through the grid.
        """
        skin = dilate(halve((self.seen.state & HIT) != 0), 2)
        behind = SeenGrid(self.seen.lower, self.cell, skin.to(torch.uint8))

        def is_solid(x: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, " n"]]:
            inside = self.fields(x, ("occupancy",))["occupancy"][:, 0] >= 0
            if unknown == "occupied":
                return (inside | ((self.seen.at(x) & CROSSED) == 0),)
            return (inside & ((self.seen.at(x) | behind.at(x)) != 0),)

        nz, ny, nx = (n // 2 + 1 for n in self.seen.state.shape)
        return distance_grid(
            self.seen.lower,
            self.cell,
            (nz, ny, nx),
            lambda x: in_chunks(is_solid, x)[0],
            closed=unknown == "occupied",
        )

    def _points(self, x: ArrayLike | Tensor, what: str, unknown: str = "free") -> Float[Tensor, "n 3"]:
        """Return points on the map's device; raise InputError for a wrong shape, numbers or choice of `unknown`."""
        if unknown not in get_args(Unknown):
            raise InputError(f"unknown={unknown!r}: choose occupied, free or report")
        x = x if isinstance(x, Tensor) else np.asarray(x)
        if x.ndim != 2 or x.shape[1] != 3:
            raise InputError(f"{what}: expected an array of shape (n, 3) in metres, got {tuple(np.shape(x))}")
        tensor = torch.as_tensor(x, dtype=torch.float32, device=self.seen.lower.device)
        if not torch.isfinite(tensor).all():
            row = int((~torch.isfinite(tensor)).any(1).nonzero()[0, 0])
            raise InputError(f"{what}: row {row} is not finite; remove such rows")
        return tensor

    def save(self, path: Path) -> None:
        """Write the map whole or not at all."""
        about = {
            "fields": [field.about for field in self.fields.of],
            "lattices": [(lattice.cell, lattice.shape) for lattice in self.fields.lattices],
            "label_names": self.label_names,
            "cell": self.seen.cell,
            "history": self.history,
        }
        tensors = {f"fields.{name}": value for name, value in self.fields.state_dict().items()}
        tensors |= {"seen": self.seen.state, "lower": self.seen.lower}
        tensors = {name: value.cpu().contiguous() for name, value in tensors.items()}
        metadata = {"format": FORMAT, "about": json.dumps(about), "digest": digest(tensors)}
        write_bytes(path, save(tensors, metadata=metadata))


def digest(tensors: dict[str, Tensor]) -> str:
    """Return a digest of all numbers of a map, which detects a changed bit in its weights."""
    total = blake2b(digest_size=16)
    for name in sorted(tensors):
        total.update(name.encode() + tensors[name].numpy().tobytes())
    return total.hexdigest()


def map_from_tensors(tensors: dict[str, Tensor], about: dict[str, Any]) -> SceneMap:
    """Return the map that `save` wrote; raise KeyError, ValueError or similar for other content."""
    seen = SeenGrid(tensors.pop("lower"), about["cell"], tensors.pop("seen"))
    lattices = [
        Lattice(seen.lower, cell, tuple(shape), tensors[f"fields.lattices.{k}.nodes"])
        for k, (cell, shape) in enumerate(about["lattices"])
    ]
    fields = Fields([Field(**of, box=seen.box, lattices=lattices) for of in about["fields"]], lattices)
    fields.load_state_dict({name.removeprefix("fields."): value for name, value in tensors.items()})
    return SceneMap(fields, seen, tuple(about["label_names"]), about["history"])


def _worst(states: Bool[ndarray, "*batch k"] | UInt8[ndarray, "*batch k"], unknown: str) -> ndarray:
    """Return the answer for each body from the k answers of its spheres."""
    if unknown != "report":
        return np.asarray(states.any(-1))
    rank = np.array([0, 2, 1], np.uint8)  # of FREE, OCCUPIED, UNKNOWN; its own inverse
    return rank[rank[states].max(-1, initial=0)]
