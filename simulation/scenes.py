"""Scenes: a table with objects on it, made from a seed, and the space that they fill."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from jcr.geometry import apply, inverse, transform
from simulation import textures
from simulation.meshes import Mesh, box
from simulation.objects import CATALOGUE, Part, TableObject
from simulation.truth import TrueObject

SceneName = Literal["tabletop", "light8", "light7", "dark", "measuring"]


class Recipe(NamedTuple):
    """Objects of a scene and the table that carries them."""

    objects: tuple[str, ...]
    table: Literal["light", "dark"]
    plain_table: bool
    """Whether the table top has little texture; otherwise it is of wood."""


RECIPES: dict[SceneName, Recipe] = {
    "tabletop": Recipe(("carton", "box", "book", "can", "mug", "tape", "apple", "block"), "light", False),
    "light8": Recipe(("carton", "book", "can", "mug", "bottle", "bowl", "apple", "tape"), "light", True),
    "light7": Recipe(("box", "mug", "can", "tape", "block", "bottle", "book"), "light", True),
    "dark": Recipe(("carton", "bowl", "mug", "can", "apple", "block", "book"), "dark", True),
    "measuring": Recipe(("tape", "box", "mug", "toolbox"), "light", True),
}

_TABLE_SIZE = (0.95, 1.2, 0.04)
_TEXEL_M = 0.0005
_GAP = 0.015
"""Least distance between the bounding circles of neighbours, in metres."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A table and what stands on it, in the robot's base frame."""

    name: str
    table: tuple[Part, ...]
    """The table's surface in a frame at the middle of its top, z up."""
    table_center_in_base: Float[ndarray, "3"]
    """The middle of the group of objects, on the table top, in metres."""
    objects: tuple[TableObject, ...]
    light_in_base: Float[ndarray, "3"]
    """Position of the lamp (m)."""

    @property
    def table_height(self) -> float:
        """z of the table top in the base frame, in metres."""
        return float(self.table_center_in_base[2])

    @property
    def labels(self) -> tuple[str, ...]:
        """Name per label: 0 is what is no part of the scene, 1 the table, then the objects."""
        return ("none", "table", *(thing.name for thing in self.objects))

    @property
    def true_objects(self) -> tuple[TrueObject, ...]:
        """Measurable objects on the table."""
        return tuple(thing.measured(label) for label, thing in enumerate(self.objects, start=2))

    @property
    def workspace_in_base(self) -> Float[ndarray, "2 3"]:
        """Lowest and highest corner of the box a map should cover, in metres."""
        return self.table_center_in_base + np.array([[-0.36, -0.40, -0.03], [0.36, 0.40, 0.30]])


def make_scene(name: SceneName, seed: int) -> Scene:
    """Make the scene of that name and seed."""
    # One stream a matter: a change in the textures must not move the objects.
    layout, looks, lamp = (np.random.default_rng([seed, stream]) for stream in (1, 2, 3))
    recipe = RECIPES[name]
    center = np.array([layout.uniform(0.46, 0.52), layout.uniform(-0.03, 0.03), layout.uniform(-0.05, 0.08)])
    things = [TableObject(thing, CATALOGUE[thing](looks)) for thing in recipe.objects]
    top = _table_top(looks, recipe.table, recipe.plain_table)
    body = Part(box(_TABLE_SIZE, ("+x", "-x", "+y", "-y", "-z")), (0.45, 0.42, 0.38))
    parts = tuple(replace(part, mesh=part.mesh.moved((0.0, 0.0, -_TABLE_SIZE[2]))) for part in (top, body))
    light = center + [lamp.uniform(-0.7, 0.3), lamp.uniform(-0.6, 0.6), lamp.uniform(1.4, 1.8)]
    return Scene(
        name=name,
        table=parts,
        table_center_in_base=center,
        objects=_arranged(layout, things, center),
        light_in_base=light,
    )


def moved(scene: Scene, center_in_base: Float[ndarray, "3"]) -> Scene:
    """Return the scene with the middle of its objects, on the table top, at another place in the base frame (m)."""
    shift = center_in_base - scene.table_center_in_base
    by = transform(np.eye(3), shift)
    objects = tuple(replace(thing, base_from_object=by @ thing.base_from_object) for thing in scene.objects)
    return replace(
        scene, table_center_in_base=center_in_base, objects=objects, light_in_base=scene.light_in_base + shift
    )


def _table_top(rng: np.random.Generator, table: str, plain: bool) -> Part:
    shape = round(_TABLE_SIZE[1] / _TEXEL_M), round(_TABLE_SIZE[0] / _TEXEL_M)
    if plain:
        color = (0.80, 0.79, 0.76) if table == "light" else (0.16, 0.16, 0.17)
        texture = textures.laminate(rng, *shape, color, contrast=0.03 if table == "light" else 0.08)
    else:
        texture = textures.wood(rng, *shape, (0.80, 0.66, 0.48), (0.50, 0.34, 0.20))
    r, g, b = texture.reshape(-1, 3).mean(0) / 255
    return Part(box(_TABLE_SIZE, ("+z",)), (float(r), float(g), float(b)), texture, shine=0.0)


def _arranged(
    rng: np.random.Generator, things: Sequence[TableObject], center_in_base: Float[ndarray, "3"]
) -> tuple[TableObject, ...]:
    """Place the objects, each rotated at random, where no bounding circles overlap."""
    radii = np.array([thing.radius for thing in things])
    spots = np.zeros((len(things), 2))
    order = rng.permutation(len(things))
    for count, k in enumerate(order):
        # The first free spot on the way from the middle outwards, in ever new directions.
        toward = rng.uniform(0, 2 * np.pi, 500)
        tries = np.linspace(0, 0.5, 500)[:, None] * np.column_stack([np.cos(toward), np.sin(toward)])
        others = order[:count]
        clear = np.linalg.norm(tries[:, None] - spots[others], axis=-1) - radii[others] - radii[k]
        spots[k] = tries[(clear > _GAP).all(1).argmax()]
    low, high = (spots - radii[:, None]).min(0), (spots + radii[:, None]).max(0)
    spots -= (low + high) / 2
    placed = []
    for k, thing in enumerate(things):
        rotation = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        middle_in_base = center_in_base + np.append(spots[k], 0.0)
        placed.append(replace(thing, base_from_object=transform(rotation, middle_in_base)))
    return tuple(placed)


def solid_labels(scene: Scene, x_in_base: Float[ndarray, "n 3"]) -> Int[ndarray, "n"]:
    """Return the label of the solid that each point (n,3) m lies within: the table, an object, or 0 for none."""
    table_frame = transform(np.eye(3), scene.table_center_in_base)
    solids = [(table_frame, scene.table), *((thing.base_from_object, thing.parts) for thing in scene.objects)]
    labels = np.zeros(len(x_in_base), np.int64)
    for label, (base_from_solid, parts) in enumerate(solids, start=1):
        x_in_solid = apply(inverse(base_from_solid), x_in_base)
        corners = np.concatenate([part.mesh.vertices for part in parts])
        near = ((x_in_solid >= corners.min(0)) & (x_in_solid <= corners.max(0))).all(1)
        windings = sum(
            (winding_number(part.mesh, x_in_solid[near]) for part in parts), start=np.zeros(near.sum())
        )
        labels[np.flatnonzero(near)[windings > 0.5]] = label
    return labels


def winding_number(mesh: Mesh, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Return how often the surface winds around each point: 1 within a closed one, 0 outside; parts add up.

    The triangles' solid angles (van Oosterom and Strackee 1983, eq. 8) over 4π, as in Jacobson et al. 2013.
    """
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    # With the corners seen from x, a' = a - x, both the volume a'·(b'×c') and a'·b' are polynomials in x.
    normal = np.cross(a, b) + np.cross(b, c) + np.cross(c, a)
    volume = (a * np.cross(b, c)).sum(-1)

    def dot(p: ndarray, q: ndarray, x: ndarray) -> Float[ndarray, "k f"]:
        return (p * q).sum(-1) - x @ (p + q).T + (x * x).sum(-1, keepdims=True)

    windings = np.empty(len(points))
    # In blocks that stay within the cache.
    for start in range(0, len(points), 128):
        x = points[start : start + 128]
        la, lb, lc = cdist(x, mesh.vertices)[:, mesh.faces].transpose(2, 0, 1)
        cosines = la * lb * lc + dot(a, b, x) * lc + dot(b, c, x) * la + dot(c, a, x) * lb
        windings[start : start + 128] = np.arctan2(volume - x @ normal.T, cosines).sum(-1) / (2 * np.pi)
    return windings
