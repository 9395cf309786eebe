"""Figures as shapes: the records that macros.html draws as SVG in the colours of the page, in the report and live."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

WIDTH, HEIGHT = 440.0, 330.0
"""Of the panels (px); small enough that their text is still read when a phone shrinks them."""
OBLIQUE, ABOVE = (-50.0, 28.0), (-90.0, 90.0)
"""Azimuth of the eye about the base's z axis and its elevation in degrees; the second has x to the right."""
AXIS_LABEL_PX = 6.0
"""Shortest drawn axis that gets its name."""


@dataclass(frozen=True)
class Shape:
    """An SVG element."""

    tag: str
    attributes: Mapping[str, object]
    text: str = ""
    children: tuple["Shape", ...] = ()


@dataclass(frozen=True)
class Figure:
    """A drawing, and what a screen reader reads in its place."""

    label: str
    shapes: Sequence[Shape]
    height: float = HEIGHT
    width: float = field(default=WIDTH, kw_only=True)


def text(x: float, y: float, words: str, kind: str) -> Shape:
    """Words whose baseline begins at x, y (or ends or is centred there: classes end and middle)."""
    return Shape("text", {"x": f"{x:.1f}", "y": f"{y:.1f}", "class": kind}, words)


def line(ends: Sequence[Sequence[float] | ndarray] | Float[ndarray, "k 2"], kind: str) -> Shape:
    """A line through points."""
    return Shape("polyline", {"class": kind, "points": points(ends)})


def rectangle(box: tuple[float, float, float, float], title: str = "", **attributes: object) -> Shape:
    """A rectangle of left, top, width and height; the title shows under the pointer."""
    sides = {name: f"{value:.1f}" for name, value in zip(("x", "y", "width", "height"), box, strict=True)}
    named = {name.replace("_", "-").strip("-"): value for name, value in attributes.items()}
    return Shape("rect", sides | named, children=(Shape("title", {}, title),) if title else ())


def points(corners: Sequence[Sequence[float] | ndarray] | Float[ndarray, "k 2"]) -> str:
    """Points as SVG writes them."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)


@dataclass(frozen=True)
class View:
    """A parallel projection of the base frame onto a panel."""

    axes: Float[ndarray, "2 3"]
    """Right and up of the panel, in the base frame."""
    middle: Float[ndarray, "2"]
    """Coordinates along these axes (m) of what is drawn at `centre`."""
    centre: Float[ndarray, "2"]
    """px."""
    zoom: float
    """Pixels per metre."""

    def __call__(self, x_in_base: Float[ndarray, "k 3"]) -> Float[ndarray, "k 2"]:
        """Pixels of points."""
        return (x_in_base @ self.axes.T - self.middle) * [self.zoom, -self.zoom] + self.centre


def view_of(
    x_in_base: Float[ndarray, "n 3"], direction: tuple[float, float], margin: tuple[float, float]
) -> View:
    """The projection along azimuth and elevation (degrees) that shows all points, with margins (px) in all."""
    azimuth, elevation = np.radians(direction)
    right = [-np.sin(azimuth), np.cos(azimuth), 0.0]
    up = [-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)]
    axes = np.array([right, up])
    flat = x_in_base @ axes.T
    low, high = flat.min(0), flat.max(0)
    zoom = float(((np.array([WIDTH, HEIGHT]) - margin) / (high - low)).min())
    return View(axes, (low + high) / 2, np.array([WIDTH / 2, HEIGHT / 2 + 6]), zoom)


def base_axes(place: Callable[[Float[ndarray, "k 3"]], Float[ndarray, "k 2"]], length: float) -> list[Shape]:
    """The axes of the base frame, `length` metres long, with their names."""
    origin, *tips = place(np.vstack([np.zeros(3), length * np.eye(3)]))
    shapes = []
    for name, tip in zip("xyz", tips, strict=True):
        if np.linalg.norm(tip - origin) > AXIS_LABEL_PX:
            x, y = origin + 1.25 * (tip - origin)
            shapes += [line([origin, tip], f"axis-{name}"), text(x, y + 4, name, "small middle")]
    return shapes


def round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than `most`."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(next(step * power for step in (5, 2, 1) if step * power <= most))


def ticks(low: float, high: float) -> list[float]:
    """Three to eight round numbers from low to high."""
    step = round_length((high - low) / 3)
    # Adding 0 makes 0 of -0.
    return (step * np.arange(np.ceil(low / step), np.floor(high / step) + 1) + 0.0).round(9).tolist()
