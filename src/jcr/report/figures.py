"""Figures of the report and the live page as records, which macros.html writes as SVG in the colours of the page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

WIDTH = 440.0
"""Width of a figure (px), small enough that its text can be read on a phone."""
COURSE_HEIGHT = 240.0
"""Height of a course figure (px)."""


@dataclass(frozen=True)
class Shape:
    """SVG element."""

    tag: str
    attributes: Mapping[str, object]
    text: str = ""
    children: tuple["Shape", ...] = ()


@dataclass(frozen=True)
class Figure:
    """Drawing with the label that a screen reader reads instead."""

    label: str
    shapes: Sequence[Shape]
    height: float
    width: float = field(default=WIDTH, kw_only=True)


def caption(x: float, y: float, words: str, kind: str) -> Shape:
    """Return a text whose baseline begins at x, y; with class "end" or "middle" it ends or is centred there."""
    return Shape("text", {"x": f"{x:.1f}", "y": f"{y:.1f}", "class": kind}, words)


def line(ends: Sequence[Sequence[float] | ndarray] | Float[ndarray, "k 2"], kind: str) -> Shape:
    """Return a polyline through points."""
    return Shape("polyline", {"class": kind, "points": " ".join(f"{x:.1f},{y:.1f}" for x, y in ends)})


def rectangle(box: tuple[float, float, float, float], kind: str) -> Shape:
    """Return a rectangle of left, top, width and height."""
    sides = {name: f"{value:.1f}" for name, value in zip(("x", "y", "width", "height"), box, strict=True)}
    return Shape("rect", {**sides, "class": kind})


def course_figure(title: str, count: Sequence[int], value: Sequence[float], goal: float, unit: str) -> Figure:
    """Return a value by number of images on a logarithmic axis, with the required value; `unit` follows the numbers."""
    left, top, right, bottom = 46.0, 30.0, 12.0, 40.0
    low, high = 0.8 * min(*value, goal), 1.25 * max(*value, goal)
    wide, tall = WIDTH - left - right, COURSE_HEIGHT - top - bottom
    first, last = count[0], max(count[-1], count[0] + 1)

    def at(images: int, y: float) -> tuple[float, float]:
        down = float(np.log(high / y) / np.log(high / low))
        return left + wide * (images - first) / (last - first), top + tall * down

    reached = at(first, goal)[1]
    shapes = [
        caption(12.0, 18.0, title, "title"),
        rectangle((left, reached, wide, top + tall - reached), "reached"),
        line([(left, reached), (left + wide, reached)], "goal"),
        caption(left + wide - 4, reached - 5, f"required: {goal:g}{unit}", "small end"),
    ]
    marks = [step * 10.0**power for power in range(-6, 6) for step in (1, 2, 5)]
    for mark in (mark for mark in marks if low <= mark <= high):
        y = at(first, mark)[1]
        shapes += [
            line([(left - 4, y), (left, y)], "frame"),
            caption(left - 7, y + 4, f"{mark:g}", "small end"),
        ]
    shapes.append(rectangle((left, top, wide, tall), "frame"))
    for images in range(first, last + 1, max(1, (last - first) // 8)):
        shapes.append(caption(at(images, goal)[0], top + tall + 16, str(images), "small middle"))
    points_px = [at(images, y) for images, y in zip(count, value, strict=True)]
    shapes.append(line(points_px, "course"))
    for (x, y), images, number in zip(points_px, count, value, strict=True):
        title_of = Shape("title", {}, f"{images} images: {number:.3g}{unit}")
        dot = {"class": "course-point", "cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": 4}
        shapes.append(Shape("circle", dot, children=(title_of,)))
    shapes.append(caption(left + wide / 2, COURSE_HEIGHT - 8, "images", "small middle"))
    return Figure(title, shapes, COURSE_HEIGHT)
