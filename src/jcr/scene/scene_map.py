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
from scipy.special import ndtr, ndtri
from torch import Tensor

from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.scene.fields import Fields, in_chunks, interpolate_grid
from jcr.scene.seen_space import CROSSED, HIT, SeenGrid, dilate, halve
from jcr.scene.signed_distance import DistanceGrid, distance_grid
from jcr.scene.uncertainty import MapUncertainty

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
"""Results of the checks with `unknown="report"`."""

Unknown = Literal["occupied", "free", "report"]
"""Treatment of unseen space in a query: as solid, as empty, or reported as unknown."""
FORMAT = "jcr.map/2"
"""Format of the file that `SceneMap.save` writes and map_file.py reads."""


class Sample:
    """Result of a query of the map at n points; each property is computed at its first use.

    Properties are numpy arrays if the points of the query were arrays, else tensors.
    """

    def __init__(
        self, scene: "SceneMap", x_in_base: Float[Tensor, "n 3"], *, unknown: str, tensors: bool
    ) -> None:
        """Prepare a query of the map `scene` at n points (m, base frame).

        `unknown` sets whether unseen space counts as "occupied" or "free", or is reported ("report"). The results are
        tensors if `tensors` is true, else arrays.
        """
        self._map, self._x, self._unknown_as, self._tensors = scene, x_in_base, unknown, tensors

    def __repr__(self) -> str:
        count, unseen = len(self._x), int((self._map.seen.at(self._x) == 0).sum())
        return f"<Sample of {count} point{'s' * (count != 1)}, {unseen} unseen>"

    @property
    def occupancy(self) -> Any:
        """Probability (n,) of solid space; in unseen space 1, 0 or 0.5 for unknown = "occupied", "free", "report".

        Published networks give their own output everywhere.
        """
        return self._occupancy_unknown[0]

    @property
    def unknown(self) -> Any:
        """Mask (n,) of unseen points: no ray crossed their cell and no surface was seen, or outside of the workspace."""
        return self._occupancy_unknown[1]

    @property
    def distance(self) -> Any:
        """Signed distance (n,) m to the nearest surface, negative inside solids; NaN outside of the workspace.

        Unseen space is solid if the query has unknown = "occupied", otherwise empty.
        """
        return self._nearest[:, 0]

    @property
    def gradient(self) -> Any:
        """Gradient (n,3) of the distance in the base frame, away from the nearest surface; NaN outside the workspace."""
        return self._nearest[:, 1:]

    @cached_property
    def std(self) -> Any:
        """Standard deviation (n,) m of the nearest surface's position along `gradient`, by calibration and depth.

        NaN outside of the workspace, and for a map whose calibration states no uncertainty.
        """
        return self._of_grid(slice(4, 5))[:, 0]

    @cached_property
    def color(self) -> Any:
        """RGB (n,3) in [0, 1] of the colour field, valid at surfaces; NaN outside of the workspace."""
        fields = self._map.fields
        return self._inside(
            lambda x: fields(x, ("color",))["color"].clamp(0.0, 1.0), everywhere=self._map.is_published
        )

    @cached_property
    def label(self) -> Any:
        """Label (n,) as index into the map's `label_names`; 0 = none, in unseen space, and in free air.

        Labels are known at surfaces, to two cells of the grid of seen space from a cell with a surface point.
        """
        scene = self._map

        def label(x: Tensor) -> tuple[Tensor]:
            """Return the label of each point (n,), 0 far from surfaces."""
            if "label" not in scene.properties:
                return (torch.zeros(len(x), dtype=torch.int64, device=x.device),)
            found = scene.fields(x, ("label",))["label"].argmax(1)
            return (found if scene.is_published else torch.where(scene.near_surfaces.at(x) > 0, found, 0),)

        return self._answers(label)[0]

    @cached_property
    def _occupancy_unknown(self) -> tuple[Any, ...]:
        """Values of `occupancy` (n,) and `unknown` (n,), which are computed together."""
        unseen = {"occupied": 1.0, "free": 0.0, "report": 0.5}[self._unknown_as]

        def occupancy_unknown(x: Tensor) -> tuple[Tensor, Tensor]:
            """Return occupancy (n,), and the mask (n,) of unknown points."""
            state = self._map.seen.at(x)
            if self._map.is_published:
                occupancy = self._map.fields(x, ("occupancy",))["occupancy"][:, 0].sigmoid()
                return occupancy, ((state & CROSSED) == 0) & ((state == 0) | (occupancy < 0.5))
            # The field is evaluated at seen points only, because most of a workspace is unseen.
            unknown = state == 0
            occupancy = torch.where(unknown, unseen, 0.0)
            (seen,) = (~unknown).nonzero(as_tuple=True)
            if len(seen) == 0:
                return occupancy, unknown
            inner = self._map.fields(x[seen], ("occupancy",))["occupancy"][:, 0].sigmoid()
            # A cell that was hit but not crossed lies behind a surface: it can be solid or unknown, but not free.
            known = ((state[seen] & CROSSED) != 0) | (inner >= 0.5)
            occupancy = occupancy.index_put((seen,), torch.where(known, inner, unseen))
            return occupancy, unknown.index_put((seen,), ~known)

        return self._answers(occupancy_unknown)

    @cached_property
    def _nearest(self) -> Any:
        """Values (n,4) of `distance` and `gradient`, which are interpolated together."""
        return self._of_grid(slice(0, 4))

    def _of_grid(self, columns: slice) -> Any:
        """Return columns of the distance grid's values at the query's points, NaN outside of the workspace."""
        grid = self._map.distance_grid("occupied" if self._unknown_as == "occupied" else "free")
        return self._inside(lambda x: grid.at(x, columns))

    def _inside(self, ask: Callable[[Tensor], Tensor], everywhere: bool = False) -> Any:
        """Return the result (n,d) of `ask` at the query's points, NaN outside of the workspace unless `everywhere`."""
        inside = self._map.seen.index
        if everywhere:
            return self._answers(lambda x: (ask(x),))[0]
        return self._answers(lambda x: (torch.where(inside(x)[1][:, None], ask(x), torch.nan),))[0]

    def _answers(self, ask: Callable[[Tensor], tuple[Tensor, ...]]) -> tuple[Any, ...]:
        """Return the results of the function `ask` at the query's points, as tensors or arrays like the query.

        `ask` maps points (n,3) m to tensors with n rows.
        """
        answers = in_chunks(ask, self._x)
        return answers if self._tensors else tuple(answer.cpu().numpy() for answer in answers)


class SceneMap:
    """Map of a scene in the base frame: trained fields of its properties, and the grid of seen space.

    All queries take many points at once, and may come from several threads at the same time.
    """

    def __init__(
        self,
        fields: Fields,
        seen: SeenGrid,
        label_names: tuple[str, ...],
        history: dict[str, str] | None = None,
        uncertainty: MapUncertainty | None = None,
    ) -> None:
        """Create a map from trained networks (`fields`) and the grid of seen space.

        `label_names` are the names of the labels, 0 = none; `history` are notes on how the map was made. `uncertainty`
        is None for a map whose calibration states none.
        """
        self.uncertainty = uncertainty
        """Covariance of the calibration and standard deviation of the depth; None: unknown."""
        self.fields, self.seen, self.label_names = fields.requires_grad_(False).eval(), seen, label_names
        self.history = history or {}
        """Facts about the training, as texts: preset, steps and seconds."""
        self.properties = tuple(name for field in fields.of for name in field.heads)
        """Names of the properties: occupancy, color, and label if the map was trained with labels."""
        for field in fields.of:
            if "occupancy" in field.heads and len(field.tables):
                field.expand()
        self._distance: dict[str, DistanceGrid] = {}
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        lower, upper = (" ".join(f"{one:.2f}" for one in corner) for corner in self.box)
        unseen = f"{100 * (self.seen.state == 0).double().mean().item():.0f} % unseen"
        return f"<SceneMap from {lower} to {upper} m, {unseen}; {', '.join(self.properties)}>"

    @property
    def is_published(self) -> bool:
        """Whether the networks are the published ones, whose queries are the networks' outputs everywhere."""
        return any(len(field.frequency) for field in self.fields.of)

    @cached_property
    def margin_95(self) -> float:
        """Distance (m) by which 95 % of the surface's errors towards free space are exceeded at most; NaN if unknown.

        It is 1.645 times the 95 % quantile of the standard deviation over the nodes within a cell of seen surfaces.
        """
        grid = self.distance_grid("free")
        std = grid.values[4][grid.nodes.abs() < self.cell].cpu().numpy()
        return float(ndtri(0.95) * np.quantile(std, 0.95)) if len(std) else 0.0

    @property
    def box(self) -> Float[ndarray, "2 3"]:
        """Lower and upper corner (m) of the workspace in the base frame."""
        return self.seen.box.double().cpu().numpy()

    @property
    def cell(self) -> float:
        """Spacing (m) of the nodes of the distance grid, and of the features near surfaces.

        Cells of the grid of seen space have half this side.
        """
        return 2 * self.seen.cell

    def to(self, device: str) -> "SceneMap":
        """Return a copy of the map on a device, e.g. "cuda", which then computes the queries."""
        seen = SeenGrid(self.seen.lower.to(device), self.seen.cell, self.seen.state.to(device))
        fields = copy.deepcopy(self.fields).to(device)
        return SceneMap(fields, seen, self.label_names, self.history, self.uncertainty)

    def set_uncertainty(self, uncertainty: MapUncertainty) -> None:
        """Set the uncertainty of calibration and depth, which is computed from queries of the map itself."""
        self.uncertainty = uncertainty
        self._distance.clear()

    def query(self, x_in_base: ArrayLike | Float[Tensor, "n 3"], unknown: Unknown = "report") -> Sample:
        """Query the map at points (n,3) m of the base frame; for tensors the results are differentiable tensors.

        `unknown` selects how unseen space counts in `occupancy` and `distance`: "occupied" as solid, "free" as empty,
        and "report" as occupancy 0.5 and, in the distance, as empty. Raises InputError for a wrong shape or a value
        that is not finite.
        """
        x, tensors = self._points(x_in_base, "points", unknown), isinstance(x_in_base, Tensor)
        return Sample(self, x, unknown=unknown, tensors=tensors)

    def check_spheres(
        self,
        centers_in_base: ArrayLike,
        radii: ArrayLike | float,
        unknown: Unknown = "occupied",
        *,
        confidence: float | None = None,
        probability: bool = False,
        center_std: float = 0.0,
    ) -> Bool[ndarray, "*batch"] | UInt8[ndarray, "*batch"] | Float[ndarray, "*batch"]:
        """Test whether spheres collide: centres (…,3) m in the base frame, radii (m) that broadcast to (…).

        A sphere collides if the signed distance of its centre is less than its radius. With `unknown` "occupied", a
        sphere that reaches unseen space, or whose centre leaves the workspace, collides; with "free", only seen
        surfaces count. With "report", the result is FREE, OCCUPIED or UNKNOWN (0, 1, 2) instead of booleans.

        With `confidence`, such as 0.95, a sphere collides unless it is free with that probability: the distance is
        reduced by a quantile of the surface's error along the gradient (`Sample.std`). `probability` returns the
        probability of a collision instead. `center_std` is the standard deviation (m) of the spheres' own positions,
        such as `uncertainty.look_std_m` for something that the robot located by another image. Raises InputError for a
        wrong shape, a value that is not finite, a negative radius, and if the map has no uncertainty.
        """
        x, radius, batch = self._spheres(centers_in_base, radii, unknown)
        uses_std, quantile = probability or confidence is not None, 0.0
        if uses_std and self.uncertainty is None:
            raise InputError("confidence: the map has no uncertainty, since its calibration states none")
        if confidence is not None:
            if not 0 < confidence < 1:
                raise InputError(f"confidence {confidence}: give a probability between 0 and 1, such as 0.95")
            quantile = float(ndtri(confidence))
        if probability and unknown == "report":
            raise InputError("probability: give unknown as occupied or free, which decide what collides")

        def collides(counted: str) -> ndarray:
            """Return for each sphere whether it collides, or the probability; unseen space counts as `counted` says."""
            clearance, *more = self._clearance(x, radius, counted, uses_std)
            std = np.hypot(more[0], max(center_std, 1e-9)) if more else 0.0
            return (ndtr(-clearance / std) if probability else clearance < quantile * std).reshape(batch)

        if unknown != "report":
            return collides(unknown)
        surface, any_ = collides("free"), collides("occupied")
        return np.where(surface, OCCUPIED, np.where(any_, UNKNOWN, FREE)).astype(np.uint8)

    def _spheres(
        self, centers_in_base: ArrayLike, radii: ArrayLike | float, unknown: str
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], tuple[int, ...]]:
        """Return centres and radii (m) as tensors, and the shape of the result; raise InputError as `check_spheres`."""
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
        return x, torch.tensor(radius.reshape(-1), device=x.device), batch

    def _clearance(
        self, x: Float[Tensor, "n 3"], radius: Float[Tensor, " n"], unknown: str, with_std: bool
    ) -> tuple[Float[ndarray, " n"], ...]:
        """Return the distance (m) from each sphere to the nearest surface, and its standard deviation (m) if `with_std`.

        `unknown` is "occupied" or "free", `x` are the centres (m, base frame) and `radius` the radii (m). If it is
        "occupied", the distance of spheres whose centre is outside of the workspace is minus infinity.
        """
        grid, (lower, upper) = self.distance_grid(unknown), self.seen.box
        nodes = torch.stack([grid.nodes, grid.values[4]]) if with_std else grid.nodes[None]

        def clearance(x: Tensor, radius: Tensor) -> tuple[Tensor, ...]:
            """Return the distance (n,) of some spheres, and its standard deviation (n,)."""
            nearest = torch.clamp(x, lower, upper)
            beyond = (x - nearest).norm(dim=1)
            distance, *std = interpolate_grid(nodes, grid.lower, grid.cell, nearest)
            if unknown == "occupied":
                outside = torch.full_like(distance, -torch.inf)
            else:
                # A lower bound of the distance from outside to surfaces in the box, which is convex.
                outside = (beyond**2 + distance.clamp(min=0) ** 2).sqrt()
            return torch.where(beyond > 0, outside, distance) - radius, *std

        return tuple(column.cpu().numpy() for column in in_chunks(clearance, x, radius))

    @cached_property
    def near_surfaces(self) -> SeenGrid:
        """Grid of the cells up to two cells from a cell with a surface point."""
        near = dilate((self.seen.state & HIT) != 0, 2)
        return SeenGrid(self.seen.lower, self.seen.cell, near.to(torch.uint8))

    def distance_grid(self, unknown: str) -> DistanceGrid:
        """Return the grid of signed distances to the surfaces of occupancy 0.5, computed at the first call.

        Unseen space counts as `unknown` says, "occupied" or "free". Within two map cells behind a seen surface the
        field is used in both cases, although no ray crossed these cells. Otherwise the surface would have no thickness,
        and the nodes of the grid could miss it. Of published networks the field is used everywhere.
        """
        with self._lock:
            if (known := self._distance.get(unknown)) is not None:
                return known
            skin = dilate(halve((self.seen.state & HIT) != 0), 2)
            behind = SeenGrid(self.seen.lower, self.cell, skin.to(torch.uint8))

            def is_solid(x: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, " n"]]:
                inside = self.fields(x, ("occupancy",))["occupancy"][:, 0] >= 0
                if self.is_published:
                    return (inside,)
                if unknown == "occupied":
                    return (inside | ((self.seen.at(x) & CROSSED) == 0),)
                return (inside & ((self.seen.at(x) | behind.at(x)) != 0),)

            nz, ny, nx = (n // 2 + 1 for n in self.seen.state.shape)
            space = self.seen.lower, self.cell, (nz, ny, nx), lambda x: in_chunks(is_solid, x)[0]
            std = None if self.uncertainty is None else self.uncertainty.surface_std
            self._distance[unknown] = distance_grid(*space, closed=unknown == "occupied", surface_std=std)
            return self._distance[unknown]

    def _points(self, x: ArrayLike | Tensor, what: str, unknown: str = "free") -> Float[Tensor, "n 3"]:
        """Return points (n,3) m as a tensor on the map's device.

        Raises InputError for another shape, values that are not finite, or an invalid `unknown`; `what` is the name of
        the points in the message.
        """
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
        """Write the map to a safetensors file; after an error there is no incomplete file."""
        about = {
            "networks": [field.about for field in self.fields.of],
            "lattices": [(lattice.cell, lattice.shape) for lattice in self.fields.lattices],
            "label_names": self.label_names,
            "cell": self.seen.cell,
            "history": self.history,
            "uncertainty": None,
        }
        tensors = {f"fields.{name}": value for name, value in self.fields.state_dict().items()}
        tensors |= {"seen": self.seen.state, "lower": self.seen.lower}
        if self.uncertainty is not None:
            own = vars(self.uncertainty)
            about["uncertainty"] = {k: v for k, v in own.items() if not isinstance(v, ndarray)}
            tensors |= {f"uncertainty.{k}": torch.tensor(v) for k, v in own.items() if isinstance(v, ndarray)}
        tensors = {name: value.cpu().contiguous() for name, value in tensors.items()}
        text = json.dumps(about)
        write_bytes(
            path, save(tensors, metadata={"format": FORMAT, "about": text, "digest": digest(tensors, text)})
        )


def digest(tensors: dict[str, Tensor], about: str) -> str:
    """Return a checksum (hexadecimal) over all that a map's file holds, to detect a damaged file.

    It covers the names, types, shapes and values of the tensors and the text `about`, with cell sizes and label names.
    """
    total = blake2b(f"{len(about)} {about}".encode(), digest_size=16)
    for name in sorted(tensors):
        tensor = tensors[name]
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)} ".encode() + tensor.numpy().tobytes())
    return total.hexdigest()
