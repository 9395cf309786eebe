"""Drawings of the live page: gripper poses in the base frame, and how the expected error shrinks."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import apply
from jcr.report.figures import pyramid_shapes
from jcr.report.svg import HEIGHT, WIDTH, Figure, Shape, View, base_axes, line, rectangle, text, view_of

DIRECTION = (-50.0, 30.0)
"""Azimuth and elevation (degrees) of the eye."""
SIGHT_M = 0.12
"""Depth of a drawn pyramid; half of that for its half width."""
PYRAMID = SIGHT_M * np.array([[0, 0, 0], [0.5, 0.4, 1], [-0.5, 0.4, 1], [-0.5, -0.4, 1], [0.5, -0.4, 1]])
GRID_M = 0.1
AXIS_M = 0.15
LEFT, RIGHT, TOP, BOTTOM = 52.0, 14.0, 16.0, 42.0
"""Margins of the chart (px)."""


def pose_figure(
    poses: Sequence[Float[ndarray, "4 4"]], next_pose: Float[ndarray, "4 4"] | None, like: int
) -> Figure:
    """Gripper poses as pyramids along z, the newest emphasised, over a grid in the base's plane z = 0.

    The next one is dashed, with a line from pose number `like`, which is nearest to it.
    """
    kinds = ["taken"] * (len(poses) - 1) + ["newest"] + ["ghost"] * (next_pose is not None)
    drawn = [*poses, *([] if next_pose is None else [next_pose])]
    pyramids = np.stack([apply(pose, PYRAMID) for pose in drawn])
    contents = np.vstack([pyramids.reshape(-1, 3), np.zeros((1, 3))])
    low = np.floor(contents.min(0)[:2] / GRID_M) * GRID_M
    high = np.ceil(contents.max(0)[:2] / GRID_M) * GRID_M
    floor = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    place = view_of(np.vstack([contents, floor]), DIRECTION, (60.0, 50.0))
    shapes = [*_grid(place, low, high), *base_axes(place, AXIS_M)]
    for k, (body, kind) in enumerate(zip(pyramids, kinds, strict=True)):
        corners = place(body)
        shapes += pyramid_shapes(corners, f"cone {kind}")
        if kind != "ghost":
            shapes.append(text(corners[0, 0] + 5, corners[0, 1] - 5, str(k + 1), "small"))
    if next_pose is not None:
        shapes.append(line(place(np.stack([poses[like][:3, 3], next_pose[:3, 3]])), "way"))
    return Figure("Gripper poses of the images, and the next one", shapes)


def _grid(place: View, low: Float[ndarray, "2"], high: Float[ndarray, "2"]) -> Iterator[Shape]:
    for x in np.arange(low[0], high[0] + 1e-9, GRID_M):
        yield line(place(np.array([[x, low[1], 0], [x, high[1], 0]])), "grid")
    for y in np.arange(low[1], high[1] + 1e-9, GRID_M):
        yield line(place(np.array([[low[0], y, 0], [high[0], y, 0]])), "grid")


def chart_figure(label: str, shares: dict[str, Float[ndarray, " n"]], first: int) -> Figure:
    """Curves of errors as multiples of what is wanted, logarithmic, against the number of images from `first` on."""
    low = min(0.5, *(float(values.min()) for values in shares.values()))
    high = max(2.0, *(float(values.max()) for values in shares.values()))
    count = max(map(len, shares.values()))
    wide, tall = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def at(k: int, share: float) -> tuple[float, float]:
        down = float(np.log(high / np.clip(share, low, high)) / np.log(high / low))
        return LEFT + wide * (k / max(count - 1, 1)), TOP + tall * down

    goal = at(0, 1.0)[1]
    shapes = [
        rectangle((LEFT, goal, wide, HEIGHT - BOTTOM - goal), class_="reached"),
        line([(LEFT, goal), (WIDTH - RIGHT, goal)], "goal"),
        text(WIDTH - RIGHT - 4, goal - 6, "wanted", "end"),
    ]
    powers = range(int(np.ceil(np.log2(low))), int(np.floor(np.log2(high))) + 1)
    for power in powers[:: max(1, len(powers) // 6)]:
        shapes.append(text(LEFT - 6, at(0, 2.0**power)[1] + 4, f"{2.0**power:g}×", "end"))
    for name, values in shares.items():
        ends = [at(k, float(share)) for k, share in enumerate(values)]
        shapes.append(line(ends, f"line {name}"))
        shapes += [
            Shape("circle", {"cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": 3.5, "class": name}) for x, y in ends
        ]
    for k in range(0, count, max(1, count // 8)):
        shapes.append(text(at(k, 1.0)[0], HEIGHT - BOTTOM + 18, str(first + k), "middle"))
    return Figure(label, [*shapes, text(WIDTH / 2, HEIGHT - 6, "images", "middle")])
