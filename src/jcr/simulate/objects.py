"""Everyday things that stand on a table, made in code to sizes drawn from a seed."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import apply
from jcr.simulate import textures
from jcr.simulate.meshes import Mesh, box, revolved, tube
from jcr.simulate.textures import Color, Image

_WHITE, _STEEL, _PAPER, _BLACK = (
    (0.88, 0.87, 0.84),
    (0.68, 0.69, 0.71),
    (0.78, 0.68, 0.52),
    (0.13, 0.13, 0.14),
)
_PAINTS = (
    (0.72, 0.16, 0.13),
    (0.13, 0.32, 0.60),
    (0.16, 0.46, 0.27),
    (0.86, 0.66, 0.16),
    (0.42, 0.20, 0.45),
    (0.84, 0.42, 0.14),
    (0.16, 0.48, 0.52),
)


@dataclass(frozen=True)
class Part:
    """A piece of an object's surface of one colour, or with one texture laid over it."""

    mesh: Mesh
    color: Color
    texture: Image | None = None
    shine: float = 0.1
    """Strength of the highlight, 0 to 1."""


@dataclass(frozen=True)
class OrientedBox:
    """The smallest upright box around an object."""

    base_from_box: Float[ndarray, "4 4"]
    """Origin at the centre of the box; z up."""
    size: Float[ndarray, "3"]
    """Along the box's x, y, z, in metres."""


@dataclass(frozen=True)
class TableObject:
    """Something rigid that stands on the table."""

    name: str
    parts: tuple[Part, ...]
    """In the object's frame: z up, standing on z = 0."""
    base_from_object: Float[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @property
    def vertices_in_base(self) -> Float[ndarray, "v 3"]:
        """All vertices of its surface (v,3) m."""
        return apply(self.base_from_object, np.concatenate([part.mesh.vertices for part in self.parts]))

    @property
    def height(self) -> float:
        """Of its highest point above the table, in metres."""
        return float(max(part.mesh.vertices[:, 2].max() for part in self.parts))

    @property
    def radius(self) -> float:
        """Of the smallest circle about its origin that holds its footprint, in metres."""
        return float(max(np.linalg.norm(part.mesh.vertices[:, :2], axis=1).max() for part in self.parts))

    @property
    def footprint_in_base(self) -> Float[ndarray, "k 2"]:
        """Convex outline of its shadow on the table from straight above, x and y in metres."""
        return cv2.convexHull(self.vertices_in_base[:, :2].astype(np.float32))[:, 0].astype(np.float64)

    @property
    def oriented_box(self) -> OrientedBox:
        """The upright box of smallest base around it."""
        (x, y), (length, width), angle_deg = cv2.minAreaRect(self.footprint_in_base.astype(np.float32))
        cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        base_from_box = np.eye(4)
        base_from_box[:2, :2] = [[cos, -sin], [sin, cos]]
        base_from_box[:3, 3] = x, y, self.base_from_object[2, 3] + self.height / 2
        return OrientedBox(base_from_box, np.array([length, width, self.height]))


def carton(rng: np.random.Generator) -> TableObject:
    """A printed package, upright."""
    return _package("carton", rng, rng.uniform((0.08, 0.045, 0.10), (0.13, 0.065, 0.17)))


def package(rng: np.random.Generator) -> TableObject:
    """A flat printed package, lying."""
    return _package("box", rng, rng.uniform((0.12, 0.09, 0.05), (0.17, 0.13, 0.08)))


def book(rng: np.random.Generator) -> TableObject:
    """A closed book, lying, whose pages show on three sides."""
    x, y, z = rng.uniform((0.12, 0.17, 0.018), (0.15, 0.21, 0.035))
    color = _paint(rng)
    cover = Part(box((x, y, z), ("+z",)), color, textures.printed(rng, 720, 512, color))
    pages = Part(box((x, y, z), ("+x", "+y", "-y")), (0.85, 0.83, 0.76))
    return TableObject("book", (cover, pages, Part(box((x, y, z), ("-x", "-z")), color)))


def block(rng: np.random.Generator) -> TableObject:
    """A wooden toy block with painted sides."""
    edge = rng.uniform(0.04, 0.055)
    sides = ("+x", "-x", "+y", "-y", "+z", "-z")
    parts = []
    for side in sides:
        color = _paint(rng)
        parts.append(Part(box((edge, edge, edge), (side,)), color, textures.printed(rng, 192, 192, color)))
    return TableObject("block", tuple(parts))


def can(rng: np.random.Generator) -> TableObject:
    """A tin with a printed label."""
    radius, height = rng.uniform((0.031, 0.09), (0.039, 0.12))
    color = _paint(rng)
    rim, lid = 0.94 * radius, height - 0.004
    label = revolved([(radius, 0.008), (radius, height - 0.008)])
    metal = revolved(
        [(0.0, 0.0), (rim, 0.0)],
        [(rim, 0.0), (radius, 0.008)],
        [(radius, height - 0.008), (rim, height)],
        [(rim, height), (rim - 0.002, height), (rim - 0.002, lid)],
        [(rim - 0.002, lid), (0.0, lid)],
    )
    return TableObject(
        "can",
        (Part(label, color, _wrap(textures.printed(rng, 320, 320, color))), Part(metal, _STEEL, shine=0.3)),
    )


def bottle(rng: np.random.Generator) -> TableObject:
    """A bottle with a label and a screw cap."""
    radius, height = rng.uniform((0.028, 0.15), (0.035, 0.19))
    color, glass = _paint(rng), _paint(rng)
    low, high = 0.18 * height, 0.56 * height
    body = revolved(
        [(0.0, 0.0), (0.9 * radius, 0.0)],
        [(0.9 * radius, 0.0), (radius, 0.006), (radius, low)],
        [(radius, high)] + _arc(radius, 0.42 * radius, high, 0.84 * height),
        [(0.42 * radius, 0.84 * height), (0.42 * radius, 0.9 * height)],
    )
    label = revolved([(radius, low), (radius, high)])
    cap = revolved(
        [(0.42 * radius, 0.9 * height), (0.5 * radius, 0.9 * height)],
        [(0.5 * radius, 0.9 * height), (0.5 * radius, height)],
        [(0.5 * radius, height), (0.0, height)],
    )
    return TableObject(
        "bottle",
        (
            Part(body, glass, textures.glaze(rng, 256, 256, glass), shine=0.2),
            Part(label, color, _wrap(textures.printed(rng, 320, 320, color))),
            Part(cap, _WHITE),
        ),
    )


def mug(rng: np.random.Generator) -> TableObject:
    """A mug with a handle and a picture around it."""
    radius, height = rng.uniform((0.038, 0.085), (0.043, 0.105))
    color = _WHITE if rng.random() < 0.5 else _paint(rng)
    inner = radius - 0.004
    outside = revolved([(radius, 0.004), (radius, height - 0.001)])
    rest = revolved(
        [(0.0, 0.0), (0.93 * radius, 0.0), (radius, 0.004)],
        [(radius, height - 0.001), (radius - 0.002, height), (inner, height - 0.001)],
        [(inner, height - 0.001), (inner, 0.01), (0.9 * inner, 0.006)],
        [(0.9 * inner, 0.006), (0.0, 0.006)],
    )
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 20)
    path = np.stack(
        [radius + 0.028 * np.cos(angle), 0 * angle, 0.52 * height + 0.3 * height * np.sin(angle)], -1
    )
    picture = _wrap(textures.printed(rng, 320, 320, color))
    return TableObject(
        "mug",
        (
            Part(outside, color, picture),
            Part(rest, color, shine=0.2),
            Part(tube(path, 0.0055), color, shine=0.2),
        ),
    )


def tape(rng: np.random.Generator) -> TableObject:
    """A roll of tape, lying."""
    inner, thickness, height = rng.uniform((0.032, 0.010, 0.024), (0.038, 0.018, 0.05))
    outer, color = inner + thickness, _paint(rng)
    band = revolved([(outer, 0.0), (outer, height)])
    edges = revolved([(outer, height), (inner + 0.002, height)], [(inner + 0.002, 0.0), (outer, 0.0)])
    core = revolved(
        [(inner, 0.0), (inner + 0.002, 0.0)],
        [(inner + 0.002, height), (inner, height)],
        [(inner, height), (inner, 0.0)],
    )
    return TableObject(
        "tape",
        (
            Part(band, color, _wrap(textures.printed(rng, 128, 256, color))),
            Part(edges, color, textures.glaze(rng, 64, 512, color)),
            Part(core, _PAPER),
        ),
    )


def bowl(rng: np.random.Generator) -> TableObject:
    """A painted bowl on a foot."""
    radius, height = rng.uniform((0.06, 0.045), (0.075, 0.06))
    color, foot, wall = _paint(rng), 0.45 * radius, 0.004
    outside = revolved([(foot, 0.006)] + _quarter(foot, radius, 0.006, height))
    inside = revolved(_quarter(foot - wall, radius - wall, 0.01, height)[::-1] + [(0.0, 0.01)])
    rest = revolved(
        [(0.0, 0.003), (foot - 0.004, 0.003), (foot - 0.004, 0.0)],
        [(foot - 0.004, 0.0), (foot, 0.0)],
        [(foot, 0.0), (foot, 0.006)],
        [(radius, height), (radius - wall, height)],
    )
    return TableObject(
        "bowl",
        (
            Part(outside, color, textures.glaze(rng, 200, 800, color), shine=0.2),
            Part(inside, _WHITE, textures.glaze(rng, 200, 800, _WHITE), shine=0.2),
            Part(rest, color),
        ),
    )


def fruit(rng: np.random.Generator) -> TableObject:
    """An apple: a ball with a dimple and a stalk."""
    radius = rng.uniform(0.033, 0.04)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    r = radius * np.cos(angle) * (1 + 0.08 * np.sin(angle))
    z = 0.92 * radius * (np.sin(angle) - 0.35 * np.exp(-((r / radius / 0.28) ** 2)) * np.sign(angle))
    # The flesh stands on the ring around its lower dimple.
    z -= z.min()
    r[[0, -1]] = 0.0
    color = (0.70, 0.17, 0.13) if rng.random() < 0.5 else (0.55, 0.62, 0.2)
    top = float(z[-1])
    stalk = revolved(
        [(0.0018, top), (0.0018, top + 0.018)], [(0.0018, top + 0.018), (0.0, top + 0.018)], segments=8
    )
    flesh = revolved(list(zip(r, z, strict=True)))
    return TableObject(
        "apple",
        (Part(flesh, color, textures.glaze(rng, 256, 512, color), shine=0.2), Part(stalk, (0.3, 0.2, 0.1))),
    )


def toolbox(rng: np.random.Generator) -> TableObject:
    """A toolbox: body, lid with two latches, handle."""
    x, y, z = rng.uniform((0.26, 0.13, 0.09), (0.30, 0.15, 0.11))
    color = _paint(rng)
    lid_size = (x + 0.008, y + 0.008, 0.035)
    label = textures.printed(rng, 320, 640, color)
    parts = [
        Part(box((x, y, z), ("+y", "-y")), color, label),
        Part(box((x, y, z), ("+x", "-x", "-z")), color),
        Part(box(lid_size).moved((0, 0, z)), _BLACK, textures.printed(rng, 320, 640, _BLACK)),
    ]
    for side in (-1, 1):
        for end in (-1, 1):
            latch = box((0.03, 0.008, 0.04)).moved((end * 0.3 * x, side * (y / 2 + 0.006), z - 0.02))
            parts.append(Part(latch, _STEEL, shine=0.3))
    angle = np.linspace(0, np.pi, 24)
    top = z + lid_size[2]
    path = np.stack([0.25 * x * np.cos(angle), 0 * angle, top + 0.04 * np.sin(angle) ** 0.6], -1)
    parts.append(Part(tube(path, 0.007), color))
    return TableObject("toolbox", tuple(parts))


CATALOGUE: dict[str, Callable[[np.random.Generator], TableObject]] = {
    "carton": carton,
    "box": package,
    "book": book,
    "block": block,
    "can": can,
    "bottle": bottle,
    "mug": mug,
    "tape": tape,
    "bowl": bowl,
    "apple": fruit,
    "toolbox": toolbox,
}


def _package(name: str, rng: np.random.Generator, size: Float[ndarray, "3"]) -> TableObject:
    color = _paint(rng)
    parts = []
    for sides, (width, height) in (
        (("+y", "-y"), size[[0, 2]]),
        (("+x", "-x"), size[[1, 2]]),
        (("+z", "-z"), size[[0, 1]]),
    ):
        texture = textures.printed(rng, round(4000 * height), round(4000 * width), color)
        parts.append(Part(box(tuple(size), sides), color, texture))
    return TableObject(name, tuple(parts))


def _paint(rng: np.random.Generator) -> Color:
    """One of a few paints, a little lighter or darker."""
    r, g, b = np.clip(np.array(_PAINTS[rng.integers(len(_PAINTS))]) * rng.uniform(0.85, 1.15), 0, 1)
    return float(r), float(g), float(b)


def _wrap(label: Image) -> Image:
    """A label twice around a round thing, so that it reads from most sides."""
    return np.concatenate([label, label], axis=1)


def _arc(r0: float, r1: float, z0: float, z1: float) -> list[tuple[float, float]]:
    """Shoulder of a bottle: an S from (r0, z0) to (r1, z1)."""
    t = np.linspace(0, 1, 12)[1:]
    blend = 0.5 - 0.5 * np.cos(np.pi * t)
    return [(float(r0 + (r1 - r0) * b), float(z0 + (z1 - z0) * s)) for b, s in zip(blend, t, strict=True)]


def _quarter(r0: float, r1: float, z0: float, z1: float) -> list[tuple[float, float]]:
    """Wall of a bowl: a quarter of an ellipse from (r0, z0), flat there, to (r1, z1), steep there."""
    angle = np.linspace(0, 0.5 * np.pi, 14)
    return [(float(r0 + (r1 - r0) * np.sin(a)), float(z0 + (z1 - z0) * (1 - np.cos(a)))) for a in angle]
