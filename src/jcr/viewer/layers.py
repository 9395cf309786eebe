"""What the viewer draws of a map: points by occupancy, the edge of the unknown, and level slices."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import matplotlib
import numpy as np
from jaxtyping import Float, Int, Integer, UInt8
from numpy import ndarray
from scipy.ndimage import binary_dilation
from skimage.measure import marching_cubes

from jcr.report.render import render
from jcr.scene.scene_map import SceneMap, Unknown
from jcr.scene.seen import HIT

LEAST = 0.02
"""Occupancy of the most doubtful points that a threshold can bring to sight."""
PACKAGE = "jcr.viewer"
"""The package of the templates."""
MAP_POINTS = 150_000
UNKNOWN_CELLS = 300_000
"""Asked to find the edge of the unknown."""
SLICE_PIXELS = 240
FAR = 0.2
"""Metres of distance at which a slice's colours end."""

SliceOf = Literal["distance", "occupancy", "unknown"]


@dataclass(frozen=True)
class MapPoints:
    """Points near seen surfaces with the values of the map there; none in unseen space."""

    points_in_base: Float[ndarray, "n 3"]
    occupancy: Float[ndarray, " n"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]


def map_points(scene: SceneMap) -> MapPoints:
    """Points drawn evenly in the cells that rays ended in and beside these, of occupancy LEAST or more."""
    hit = binary_dilation((scene.seen.state.cpu().numpy() & HIT) != 0)
    cell, draw = scene.seen.cell, np.random.default_rng(0)
    zyx = np.argwhere(hit)
    if len(zyx):
        zyx = zyx[draw.integers(len(zyx), size=2 * MAP_POINTS)]
    x = scene.box[0] + cell * (zyx[:, ::-1] + draw.random(zyx.shape))
    answer = scene.query(x)
    known = np.flatnonzero(~answer.unknown & (answer.occupancy >= LEAST))[:MAP_POINTS]
    color = (255 * answer.color[known]).clip(0, 255).astype(np.uint8)
    return MapPoints(x[known], answer.occupancy[known], color, answer.label[known])


def unknown_edge(scene: SceneMap) -> tuple[Float[ndarray, "v 3"], Integer[ndarray, "f 3"]]:
    """Vertices (v,3) m and triangles (f,3) of the surface where sight ends; none where all or nothing was seen."""
    low, high = scene.box
    pitch = float(np.prod(high - low) / UNKNOWN_CELLS) ** (1 / 3)
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    unknown = scene.query(x.reshape(-1, 3)).unknown.reshape(x.shape[:3])
    if unknown.all() or not unknown.any():
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    vertices, faces, _, _ = marching_cubes(unknown.astype(np.float32), 0.5)
    return low + pitch * (vertices + 0.5), faces


def colour_bar(colors: Sequence[Sequence[int]], low: str, high: str) -> str:
    """A bar of RGB colours from left to right, named at both ends, as HTML."""
    return render("bar.html", {"colors": colors, "low": low, "high": high}, PACKAGE)


SLICE_LEGENDS: dict[str, str] = {
    "distance": colour_bar(
        matplotlib.colormaps["plasma"](np.linspace(1, 0, 9), bytes=True)[:, :3].tolist(),
        "surface (solid: red)",
        f"{100 * FAR:.0f} cm and more",
    ),
    "occupancy": colour_bar([(255, 255, 255), (37, 99, 235)], "free", "occupied (unknown: grey)"),
    "unknown": colour_bar([(110, 110, 110)] * 2, "grey: nobody has looked there", ""),
}
"""What the colours of `level_slice` mean."""


def level_slice(scene: SceneMap, height: float, of: SliceOf, unknown: Unknown) -> UInt8[ndarray, "h w 4"]:
    """RGBA of the map at z = height (m): columns along the base's x axis, rows along its y axis, downwards in y.

    Distance runs from yellow (touching) to violet (FAR and beyond), red where solid; occupancy is blue, and places
    that nobody has seen are grey.
    """
    low, high = scene.box
    pitch = float((high - low)[:2].max() / SLICE_PIXELS)
    a, b = (np.arange(low[k] + pitch / 2, high[k], pitch) for k in (0, 1))
    x = np.full((len(b), len(a), 3), height)
    x[..., 0], x[..., 1] = np.meshgrid(a, b[::-1])
    answer = scene.query(x.reshape(-1, 3), unknown)
    rgba = np.zeros((x.shape[0] * x.shape[1], 4), np.uint8)
    if of == "distance":
        known = np.isfinite(answer.distance)
        share = 1 - (answer.distance[known] / FAR).clip(0, 1)
        rgba[known] = matplotlib.colormaps["plasma"](share, alpha=0.85, bytes=True)
        rgba[known & (answer.distance <= 0)] = (200, 30, 30, 230)
    elif of == "occupancy":
        rgba[:] = (37, 99, 235, 0)
        rgba[:, 3] = 255 * (0.1 + 0.9 * answer.occupancy.clip(0, 1))
    if of != "distance":
        rgba[answer.unknown] = (110, 110, 110, 160)
    return rgba.reshape(*x.shape[:2], 4)
