"""Everyday things that stand on a table, made in code to sizes drawn from a seed."""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import apply, rotation_exp, transform
from simulation import textures
from simulation.meshes import Mesh, box, revolved, tube
from simulation.textures import Color, Image
from simulation.truth import TrueObject

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


Parts = tuple[Part, ...]
"""Parts of an object in its frame: z up, standing on z = 0."""


@dataclass(frozen=True)
class TableObject:
    """Something rigid that stands on the table."""

    name: str
    parts: Parts
    base_from_object: Float[ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @property
    def radius(self) -> float:
        """Radius (m) of the smallest circle about the origin that holds the footprint."""
        return float(np.linalg.norm(self._vertices[:, :2], axis=1).max())

    def measured(self, label: int) -> TrueObject:
        """Return its height, footprint and the smallest upright box around it."""
        x_in_base = apply(self.base_from_object, self._vertices)
        height = float(self._vertices[:, 2].max())
        # OpenCV's planar geometry takes single precision: about the object's origin that is exact to 1e-8 m.
        origin = self.base_from_object[:3, 3]
        outline = cv2.convexHull((x_in_base - origin)[:, :2].astype(np.float32))[:, 0]
        (x, y), (length, width), angle_deg = cv2.minAreaRect(outline)
        rotation = rotation_exp(np.radians([0.0, 0.0, angle_deg]))
        return TrueObject(
            name=self.name,
            label=label,
            height=height,
            footprint_in_base=outline + origin[:2],
            base_from_box=transform(rotation, origin + [x, y, height / 2]),
            box_size=np.array([length, width, height]),
        )

    @property
    def _vertices(self) -> Float[ndarray, "v 3"]:
        return np.concatenate([part.mesh.vertices for part in self.parts])


def carton(rng: np.random.Generator) -> Parts:
    """Make a printed package, upright."""
    return _package(rng, rng.uniform((0.08, 0.045, 0.10), (0.13, 0.065, 0.17)))


def package(rng: np.random.Generator) -> Parts:
    """Make a flat printed package, lying."""
    return _package(rng, rng.uniform((0.12, 0.09, 0.05), (0.17, 0.13, 0.08)))


def book(rng: np.random.Generator) -> Parts:
    """Make a closed book, lying, whose pages show on three sides."""
    x, y, z = rng.uniform((0.12, 0.17, 0.018), (0.15, 0.21, 0.035))
    color = _paint(rng)
    cover = Part(box((x, y, z), ("+z",)), color, textures.printed(rng, 720, 512, color))
    pages = Part(box((x, y, z), ("+x", "+y", "-y")), (0.85, 0.83, 0.76))
    return cover, pages, Part(box((x, y, z), ("-x", "-z")), color)


def block(rng: np.random.Generator) -> Parts:
    """Make a wooden toy block with painted sides."""
    edge = rng.uniform(0.04, 0.055)
    sides = ("+x", "-x", "+y", "-y", "+z", "-z")
    parts = []
    for side in sides:
        color = _paint(rng)
        parts.append(Part(box((edge, edge, edge), (side,)), color, textures.printed(rng, 192, 192, color)))
    return tuple(parts)


def can(rng: np.random.Generator) -> Parts:
    """Make a tin with a printed label."""
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
    return (Part(label, color, _wrap(textures.printed(rng, 320, 320, color))), Part(metal, _STEEL, shine=0.3))


def bottle(rng: np.random.Generator) -> Parts:
    """Make a bottle with a label and a screw cap."""
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
    return (
        Part(body, glass, textures.glaze(rng, 256, 256, glass), shine=0.2),
        Part(label, color, _wrap(textures.printed(rng, 320, 320, color))),
        Part(cap, _WHITE),
    )


def mug(rng: np.random.Generator) -> Parts:
    """Make a mug with a handle and an image around it."""
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
        [radius - 0.002 + 0.03 * np.cos(angle), 0 * angle, 0.52 * height + 0.3 * height * np.sin(angle)], -1
    )
    print_around = _wrap(textures.printed(rng, 320, 320, color))
    return (
        Part(outside, color, print_around),
        Part(rest, color, shine=0.2),
        Part(tube(path, 0.0055), color, shine=0.2),
    )


def tape(rng: np.random.Generator) -> Parts:
    """Make a roll of tape, lying."""
    # Packing tape: a 76 mm core, about 48 mm wide.
    inner, thickness, height = rng.uniform((0.0378, 0.008, 0.046), (0.0382, 0.018, 0.05))
    outer, color = inner + thickness, _paint(rng)
    band = revolved([(outer, 0.0), (outer, height)])
    edges = revolved([(outer, height), (inner + 0.002, height)], [(inner + 0.002, 0.0), (outer, 0.0)])
    core = revolved(
        [(inner, 0.0), (inner + 0.002, 0.0)],
        [(inner + 0.002, height), (inner, height)],
        [(inner, height), (inner, 0.0)],
    )
    return (
        Part(band, color, _wrap(textures.printed(rng, 128, 256, color))),
        Part(edges, color, textures.glaze(rng, 64, 512, color)),
        Part(core, _PAPER),
    )


def bowl(rng: np.random.Generator) -> Parts:
    """Make a painted bowl on a foot."""
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
    return (
        Part(outside, color, textures.glaze(rng, 200, 800, color), shine=0.2),
        Part(inside, _WHITE, textures.glaze(rng, 200, 800, _WHITE), shine=0.2),
        Part(rest, color),
    )


def fruit(rng: np.random.Generator) -> Parts:
    """Make an apple: a ball with a dimple and a stalk."""
    radius = rng.uniform(0.033, 0.04)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)
    r = radius * np.cos(angle) * (1 + 0.08 * np.sin(angle))
    z = 0.92 * radius * (np.sin(angle) - 0.35 * np.exp(-((r / radius / 0.28) ** 2)) * np.sign(angle))
    # The flesh stands on the ring around its lower dimple.
    z -= z.min()
    r[[0, -1]] = 0.0
    color = (0.70, 0.17, 0.13) if rng.random() < 0.5 else (0.55, 0.62, 0.2)
    # It ends below the rim of its dimple: the height of an apple is that of its flesh.
    foot, tip = float(z[-1]), float(z[-1]) + 0.2 * radius
    stalk = revolved([(0.002, foot), (0.002, tip)], [(0.002, tip), (0.0, tip)], segments=8)
    flesh = revolved(list(zip(r.tolist(), z.tolist(), strict=True)))
    return (Part(flesh, color, textures.glaze(rng, 256, 512, color), shine=0.2), Part(stalk, (0.3, 0.2, 0.1)))


def toolbox(rng: np.random.Generator) -> Parts:
    """Make a toolbox: body, lid with a sticker and a grip, latches."""
    x, y, z = rng.uniform((0.24, 0.12, 0.08), (0.28, 0.14, 0.10))
    color, sticker = _paint(rng), _paint(rng)
    lid = (x + 0.008, y + 0.008, 0.03)
    top = z + lid[2]
    parts = [
        Part(box((x, y, z), ("+x", "-x", "+z", "-z")), color, textures.glaze(rng, 256, 512, color)),
        Part(box((x, y, z), ("+y", "-y")), color, textures.printed(rng, 320, 800, color)),
        Part(box(lid).moved((0.0, 0.0, z)), _BLACK, textures.glaze(rng, 400, 800, _BLACK)),
        Part(
            box((0.45 * x, 0.026, 0.024)).moved((0.0, 0.0, top)), color, textures.glaze(rng, 64, 256, color)
        ),
    ]
    for side in (-1, 1):
        label = box((0.6 * x, 0.24 * y, 0.0005)).moved((0.0, side * 0.3 * y, top))
        parts.append(Part(label, sticker, textures.printed(rng, 96, 512, sticker)))
        for end in (-1, 1):
            latch = box((0.03, 0.006, 0.04)).moved((end * 0.3 * x, side * (y / 2 + 0.006), z - 0.02))
            parts.append(Part(latch, _STEEL, shine=0.3))
    return tuple(parts)


CATALOGUE: dict[str, Callable[[np.random.Generator], Parts]] = {
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


def _package(rng: np.random.Generator, size: Float[ndarray, "3"]) -> Parts:
    color = _paint(rng)
    parts = []
    for sides, (width, height) in (
        (("+y", "-y"), size[[0, 2]]),
        (("+x", "-x"), size[[1, 2]]),
        (("+z", "-z"), size[[0, 1]]),
    ):
        texture = textures.printed(rng, round(4000 * height), round(4000 * width), color)
        parts.append(Part(box(tuple(size), sides), color, texture))
    return tuple(parts)


def _paint(rng: np.random.Generator) -> Color:
    """Draw one of a few paints, a little lighter or darker."""
    r, g, b = np.clip(np.array(_PAINTS[rng.integers(len(_PAINTS))]) * rng.uniform(0.85, 1.15), 0, 1)
    return float(r), float(g), float(b)


def _wrap(label: Image) -> Image:
    """Put a label twice around a round object, so that it reads from most sides."""
    return np.concatenate([label, label], axis=1)


def _arc(r0: float, r1: float, z0: float, z1: float) -> list[tuple[float, float]]:
    """Return the shoulder of a bottle: an S from (r0, z0) to (r1, z1)."""
    t = np.linspace(0, 1, 12)[1:]
    blend = 0.5 - 0.5 * np.cos(np.pi * t)
    return [(float(r0 + (r1 - r0) * b), float(z0 + (z1 - z0) * s)) for b, s in zip(blend, t, strict=True)]


def _quarter(r0: float, r1: float, z0: float, z1: float) -> list[tuple[float, float]]:
    """Return the wall of a bowl: a quarter of an ellipse from (r0, z0), flat there, to (r1, z1), steep there."""
    angle = np.linspace(0, 0.5 * np.pi, 14)
    return [(float(r0 + (r1 - r0) * np.sin(a)), float(z0 + (z1 - z0) * (1 - np.cos(a)))) for a in angle]
