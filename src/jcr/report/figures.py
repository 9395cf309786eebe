"""The report's figures: cameras and grippers, a grid over the frame, a histogram, a slice of the map."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import unproject, without_distortion
from jcr.geometry import apply
from jcr.records import Intrinsics
from jcr.report.map_samples import Slice
from jcr.report.raster import image_url
from jcr.report.svg import (
    HEIGHT,
    WIDTH,
    Figure,
    Shape,
    View,
    base_axes,
    line,
    points,
    rectangle,
    round_length,
    text,
    ticks,
    view_of,
)

CAMERA_LENGTH = 0.07
"""Length of a drawn pyramid, as a share of the figure's contents."""
COURSE_HEIGHT = 240.0
"""px."""


def camera_figure(
    title: str,
    base_from_gripper: Float[ndarray, "n 4 4"],
    base_from_camera: Float[ndarray, "m 4 4"],
    gripper_of_camera: Int[ndarray, " m"] | None,
    intrinsics: Intrinsics,
    direction: tuple[float, float],
) -> Figure:
    """Gripper positions as crosses and cameras as pyramids (paper, Fig. 2), seen from far away along `direction`.

    `gripper_of_camera` joins each camera to the gripper it sits on by a line; None draws no lines.
    """
    grippers, centers = base_from_gripper[:, :3, 3], base_from_camera[:, :3, 3]
    contents = np.vstack([grippers, centers, np.zeros((1, 3))])
    size = float(np.ptp(contents, axis=0).max())
    shape = pyramid(intrinsics, CAMERA_LENGTH * size)
    pyramids = np.stack([apply(camera, shape) for camera in base_from_camera])
    tips = 0.12 * size * np.eye(3)
    place = view_of(np.vstack([contents, pyramids.reshape(-1, 3), tips]), direction, (50.0, 90.0))
    shapes = [text(12.0, 20.0, title, "title"), *base_axes(place, 0.12 * size)]
    if gripper_of_camera is not None:
        ends = zip(place(grippers[gripper_of_camera]), place(centers), strict=True)
        shapes += [line(pair, "joint") for pair in ends]
    # Far cameras first, so that near ones cover them.
    towards_eye = np.cross(place.axes[0], place.axes[1])
    for k in np.argsort(centers @ towards_eye):
        shapes += pyramid_shapes(place(pyramids[k]), "cone")
    shapes += [
        Shape("path", {"class": "cross", "d": f"M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8"})
        for x, y in place(grippers)
    ]
    return Figure(title, [*shapes, *_scale_bar(place)])


def pyramid_shapes(corners_px: Float[ndarray, "5 2"], kind: str) -> Iterator[Shape]:
    """The faces of a pyramid, its tip first."""
    tip, *corners = corners_px
    for side in [*([tip, corners[i], corners[(i + 1) % 4]] for i in range(4)), corners]:
        yield Shape("polygon", {"class": kind, "points": points(side)})


def pyramid(intrinsics: Intrinsics, depth: float) -> Float[ndarray, "5 3"]:
    """Centre and image corners of a camera, in its own frame, with the image plane at `depth`."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [intrinsics.width, intrinsics.height] - 0.5
    return depth * np.vstack([np.zeros(3), unproject(without_distortion(intrinsics), corners)])


def _scale_bar(place: View) -> list[Shape]:
    length = round_length(0.3 * WIDTH / place.zoom)
    ends = [(12.0, HEIGHT - 14), (12.0 + length * place.zoom, HEIGHT - 14)]
    return [line(ends, "scale"), text(12.0, HEIGHT - 20, f"{length:g} m", "small")]


def grid_figure(title: str, count: Int[ndarray, "rows columns"], what: str) -> Figure:
    """Cells of an image, the fuller the darker; empty ones are hatched. The legend names what they are full of."""
    rows, columns = count.shape
    side = WIDTH / columns
    full = max(float(np.percentile(count[count > 0], 95)), 1.0) if (count > 0).any() else 1.0

    def fill(number: float) -> dict[str, str]:
        share = 0.15 + 0.85 * min(number / full, 1)
        return {"class_": "cell", "fill_opacity": f"{share:.2f}"} if number else {"class_": "unknown"}

    shapes = [text(0.0, 16.0, title, "title")]
    for (row, column), number in np.ndenumerate(count):
        box = (column * side, 26 + row * side, side - 1, side - 1)
        shapes.append(rectangle(box, f"{number} features", **fill(float(number))))
    below = 26 + rows * side + 8
    legend = [("0", 0.0), ("1", 1e-9), (f"{full:.0f} or more {what}", full)]
    for k, (words, number) in enumerate(legend):
        shapes.append(rectangle((60.0 * k, below, 12.0, 12.0), **fill(number)))
        shapes.append(text(60.0 * k + 17, below + 11, words, "small"))
    return Figure(title, shapes, below + 16)


def bars_figure(
    title: str, count: Int[ndarray, " b"], edge: Float[ndarray, " c"], what: str, unit: str
) -> Figure:
    """A histogram, its first and last edge and its highest bar named."""
    high, width = HEIGHT - 78, WIDTH / len(count)
    shapes = [text(0.0, 16.0, title, "title")]
    shapes.append(text(WIDTH, 28.0, f"highest: {int(count.max())} {what}", "small end"))
    for k, number in enumerate(count.tolist()):
        tall = high * number / max(int(count.max()), 1)
        box = (k * width, 30 + high - tall, width - 1.5, tall)
        shapes.append(rectangle(box, f"{edge[k]:.2f} to {edge[k + 1]:.2f}: {number} {what}", class_="cell"))
    shapes.append(line([(0.0, 30 + high), (WIDTH, 30 + high)], "frame"))
    for share, kind in ((0.0, "small"), *((k / 4, "small middle") for k in (1, 2, 3)), (1.0, "small end")):
        more = " and more" if share == 1 else ""
        shapes.append(text(share * WIDTH, HEIGHT - 32, f"{share * float(edge[-1]):.2g}{more}", kind))
    return Figure(title, [*shapes, text(WIDTH / 2, HEIGHT - 14, unit, "small middle")])


def course_figure(title: str, count: Sequence[int], value: Sequence[float], goal: float, unit: str) -> Figure:
    """A value by number of images, on a logarithmic axis, and the value that is required; `unit` follows the numbers."""
    left, top, right, bottom = 46.0, 30.0, 12.0, 40.0
    low, high = 0.8 * min(*value, goal), 1.25 * max(*value, goal)
    wide, tall = WIDTH - left - right, COURSE_HEIGHT - top - bottom
    first, last = count[0], max(count[-1], count[0] + 1)

    def at(images: int, y: float) -> tuple[float, float]:
        down = float(np.log(high / y) / np.log(high / low))
        return left + wide * (images - first) / (last - first), top + tall * down

    reached = at(first, goal)[1]
    shapes = [
        text(12.0, 18.0, title, "title"),
        rectangle((left, reached, wide, top + tall - reached), class_="reached"),
        line([(left, reached), (left + wide, reached)], "goal"),
        text(left + wide - 4, reached - 5, f"required: {goal:g}{unit}", "small end"),
    ]
    marks = [step * 10.0**power for power in range(-6, 6) for step in (1, 2, 5)]
    for mark in (mark for mark in marks if low <= mark <= high):
        y = at(first, mark)[1]
        shapes += [line([(left - 4, y), (left, y)], "frame"), text(left - 7, y + 4, f"{mark:g}", "small end")]
    shapes.append(rectangle((left, top, wide, tall), class_="frame"))
    for images in range(first, last + 1, max(1, (last - first) // 8)):
        shapes.append(text(at(images, goal)[0], top + tall + 16, str(images), "small middle"))
    points_px = [at(images, y) for images, y in zip(count, value, strict=True)]
    shapes.append(line(points_px, "course"))
    for (x, y), images, number in zip(points_px, count, value, strict=True):
        title_of = Shape("title", {}, f"{images} images: {number:.3g}{unit}")
        dot = {"class": "course-point", "cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": 4}
        shapes.append(Shape("circle", dot, children=(title_of,)))
    shapes.append(text(left + wide / 2, COURSE_HEIGHT - 8, "images", "small middle"))
    return Figure(title, shapes, COURSE_HEIGHT)


def slice_figure(title: str, cut: Slice, marked: float, mark: str) -> Figure:
    """A slice of the map with axes in metres; `marked` is where the other slice cuts, on the second axis."""
    low, high = cut.extent
    left, top, right, bottom = 46.0, 48.0, 12.0, 40.0
    zoom = min((WIDTH - left - right) / (high[0] - low[0]), 1.3 * HEIGHT / (high[1] - low[1]))
    width, height = zoom * (high - low)
    box = (left, top, float(width), float(height))
    axes = "".join("xyz"[k] for k in cut.axes)
    shapes = [text(12.0, 20.0, title, "title"), *_slice_layers(cut, box, axes)]
    for tick in ticks(low[0], high[0]):
        x = left + zoom * (tick - low[0])
        shapes.append(line([(x, top + height), (x, top + height + 4)], "frame"))
        shapes.append(text(x, top + height + 16, f"{tick:g}", "small middle"))
    for tick in ticks(low[1], high[1]):
        y = top + height - zoom * (tick - low[1])
        shapes.append(line([(left - 4, y), (left, y)], "frame"))
        shapes.append(text(left - 7, y + 4, f"{tick:g}", "small end"))
    below = top + height + 32
    shapes.append(text(left + width / 2, below, f"{axes[0]} in the base frame (m)", "small middle"))
    shapes.append(text(left - 30, top - 9, f"{axes[1]} in the base frame (m)", "small"))
    if low[1] < marked < high[1]:
        y = top + height - zoom * (marked - low[1])
        shapes.append(line([(left, y), (left + width, y)], "mark"))
        shapes.append(text(left + width - 4, y - 4, mark, "small end mark-text"))
    return Figure(title, shapes, top + height + bottom)


def _slice_layers(cut: Slice, box: tuple[float, float, float, float], axes: str) -> Iterator[Shape]:
    """Free, unknown and occupied space, as masks over the page's own colours, which differ between light and dark."""
    unknown = np.where(cut.unknown, np.uint8(255), np.uint8(0))
    occupied = np.where(cut.unknown, 0, 255 * cut.occupancy.clip(0, 1)).astype(np.uint8)
    yield rectangle(box, class_="free")
    for name, shares in (("unknown", unknown), ("occupied", occupied)):
        mask = f"{name}-{axes}"
        sides = rectangle(box).attributes
        image = {**sides, "preserveAspectRatio": "none", "href": image_url(shares[::-1], "PNG")}
        yield Shape("mask", {"id": mask}, children=(Shape("image", image),))
        yield rectangle(box, class_=name, mask=f"url(#{mask})")
    yield rectangle(box, class_="frame")
