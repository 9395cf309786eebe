"""Values of a map at points, computed when they are first used."""

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from jcr.scene.chunks import in_chunks
from jcr.scene.seen import CROSSED

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


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
        return self._continuous("color", 0.0, 1.0)

    @cached_property
    def label(self) -> Any:
        """Row (n,) of the map's `label_names`; 0 = none, also in unseen space."""

        def label(x: Tensor) -> tuple[Tensor]:
            if "label" not in self._map.properties:
                return (torch.zeros(len(x), dtype=torch.int64, device=x.device),)
            return (
                torch.where(self._map.seen.at(x) > 0, self._map.fields(x, ("label",))["label"].argmax(1), 0),
            )

        return self._given(in_chunks(label, self._x))[0]

    @cached_property
    def values(self) -> dict[str, Any]:
        """Further continuous properties (n,d) that the map was trained with; NaN outside of the workspace."""
        further = [name for name in self._map.properties if name not in ("occupancy", "color", "label")]
        return {name: self._continuous(name, -np.inf, np.inf) for name in further}

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
            unknown = unknown.index_put((seen,), ~known)
            return occupancy, unknown

        return self._given(in_chunks(occupancy_unknown, self._x))

    @cached_property
    def _distance_gradient(self) -> tuple[Any, ...]:
        """Distance (n,) and gradient (n,3)."""
        grid = self._map.distance_grid("occupied" if self._unknown_as == "occupied" else "free")

        def distance_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
            answer = torch.where(self._map.seen.index(x)[1][:, None], grid.at(x), torch.nan)
            return answer[:, 0], answer[:, 1:]

        return self._given(in_chunks(distance_gradient, self._x))

    def _continuous(self, name: str, low: float, high: float) -> Any:
        """Return a property between two bounds; NaN outside of the workspace."""

        def continuous(x: Tensor) -> tuple[Tensor]:
            value = self._map.fields(x, (name,))[name].clamp(low, high)
            return (torch.where(self._map.seen.index(x)[1][:, None], value, torch.nan),)

        return self._given(in_chunks(continuous, self._x))[0]

    def _given(self, answers: tuple[Tensor, ...]) -> tuple[Any, ...]:
        """Return the answers as tensors or arrays, as the points were."""
        return answers if self._tensors else tuple(answer.cpu().numpy() for answer in answers)
