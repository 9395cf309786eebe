"""The report's figures, as SVG that follows the page's colours and as embedded images."""

import base64
import colorsys
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image
from PIL import WebPImagePlugin as _  # noqa: F401  (else Pillow loads all its formats to find this one, in 0.1 s)

from jcr.camera import project, unproject, without_distortion
from jcr.capture.images import encode_png
from jcr.geometry import apply
from jcr.records import Intrinsics
from jcr.report.map_samples import Slice

WIDTH, HEIGHT = 440.0, 330.0
"""Of the panels; small enough that their text is still read when a phone shrinks them."""
OBLIQUE, ABOVE = (-50.0, 28.0), (-90.0, 90.0)
"""Azimuth of the eye about the base's z axis and its elevation in degrees; the second has x to the right."""
TRACK_COLOR = (229, 40, 40)
CAMERA_LENGTH = 0.07
"""Of a drawn pyramid, as a share of the figure's contents."""


def camera_figure(
    title: str,
    base_from_gripper: Float[ndarray, "n 4 4"],
    base_from_camera: Float[ndarray, "m 4 4"],
    gripper_of_camera: Int[ndarray, " m"] | None,
    lens: Intrinsics,
    view: tuple[float, float],
) -> str:
    """Gripper positions as crosses and cameras as pyramids (paper, Fig. 2), seen from far away along `view`.

    `gripper_of_camera` joins each camera to the gripper it sits on by a line; None draws no lines.
    """
    grippers, centers = base_from_gripper[:, :3, 3], base_from_camera[:, :3, 3]
    contents = np.vstack([grippers, centers, np.zeros((1, 3))])
    size = float(np.ptp(contents, axis=0).max())
    pyramids = np.stack([apply(camera, pyramid(lens, CAMERA_LENGTH * size)) for camera in base_from_camera])
    axes = np.vstack([np.zeros(3), 0.12 * size * np.eye(3)])

    to_view = _view_axes(*view)
    flat = np.vstack([contents, pyramids.reshape(-1, 3), axes]) @ to_view.T
    low, high = flat.min(0), flat.max(0)
    zoom = min((WIDTH - 50) / (high[0] - low[0]), (HEIGHT - 90) / (high[1] - low[1]))
    middle = (low + high) / 2

    def place(x_in_base: Float[ndarray, "k 3"]) -> Float[ndarray, "k 2"]:
        return (x_in_base @ to_view.T - middle) * [zoom, -zoom] + [WIDTH / 2, HEIGHT / 2 + 6]

    parts = [_text(12.0, 20.0, title, "title")]
    origin, *tips = place(axes)
    for name, tip in zip("xyz", tips, strict=True):
        if np.linalg.norm(tip - origin) > 6:
            parts.append(_line([origin, tip], f"axis-{name}"))
            x, y = origin + 1.25 * (tip - origin)
            parts.append(_text(x, y + 4, name, "small middle"))
    if gripper_of_camera is not None:
        ends = zip(place(grippers[gripper_of_camera]), place(centers), strict=True)
        parts += [_line(pair, "joint") for pair in ends]
    # Far cameras first, so that near ones cover them.
    towards_eye = np.cross(to_view[0], to_view[1])
    for k in np.argsort(centers @ towards_eye):
        tip, *corners = place(pyramids[k])
        sides = [[tip, corners[i], corners[(i + 1) % 4]] for i in range(4)]
        parts += [f'<polygon class="cone" points="{_points(side)}"/>' for side in [*sides, corners]]
    for x, y in place(grippers):
        parts.append(f'<path class="cross" d="M{x - 4:.1f} {y - 4:.1f}l8 8m0 -8l-8 8"/>')
    length = _round_length(0.3 * WIDTH / zoom)
    parts.append(_line([(12.0, HEIGHT - 14), (12.0 + length * zoom, HEIGHT - 14)], "scale"))
    parts.append(_text(12.0, HEIGHT - 20, f"{length:g} m", "small"))
    return _svg(parts, title)


def grid_figure(title: str, count: Int[ndarray, "rows columns"], what: str) -> str:
    """Cells of an image, the fuller the darker; empty ones are hatched. The legend says of what they are full."""
    rows, columns = count.shape
    side = WIDTH / columns
    full = max(float(np.percentile(count[count > 0], 95)), 1.0) if (count > 0).any() else 1.0
    parts = [_text(0.0, 16.0, title, "title")]
    for (row, column), number in np.ndenumerate(count):
        kind = (
            f'class="cell" fill-opacity="{0.15 + 0.85 * min(number / full, 1):.2f}"'
            if number
            else 'class="unknown"'
        )
        parts.append(
            f'<rect x="{column * side:.1f}" y="{26 + row * side:.1f}" width="{side - 1:.1f}" height="{side - 1:.1f}" '
            f"{kind}><title>{number} features</title></rect>"
        )
    below = 26 + rows * side + 8
    legend = [("0", 'class="unknown"'), ("1", 'class="cell" fill-opacity="0.15"')]
    legend.append((f"{full:.0f} or more", 'class="cell" fill-opacity="1"'))
    for k, (text, kind) in enumerate(legend):
        x = 60.0 * k
        parts.append(f'<rect x="{x:.1f}" y="{below:.1f}" width="12" height="12" {kind}></rect>')
        parts.append(_text(x + 17, below + 11, f"{text} {what}" if k == len(legend) - 1 else text, "small"))
    return _svg(parts, title, below + 16)


def bars_figure(
    title: str, count: Int[ndarray, " b"], edge: Float[ndarray, " c"], what: str, unit: str
) -> str:
    """A histogram, its first and last edge and its highest bar named."""
    high, width = HEIGHT - 78, WIDTH / len(count)
    parts = [_text(0.0, 16.0, title, "title")]
    parts.append(_text(WIDTH, 28.0, f"highest: {int(count.max())} {what}", "small end"))
    for k, number in enumerate(count.tolist()):
        tall = high * number / max(int(count.max()), 1)
        parts.append(
            f'<rect class="cell" x="{k * width:.1f}" y="{30 + high - tall:.1f}" width="{width - 1.5:.1f}" '
            f'height="{tall:.1f}"><title>{edge[k]:.2f} to {edge[k + 1]:.2f}: {number} {what}</title></rect>'
        )
    parts.append(_line([(0.0, 30 + high), (WIDTH, 30 + high)], "frame"))
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        kind = "small" if share == 0 else "small end" if share == 1 else "small middle"
        more = " and more" if share == 1 else ""
        parts.append(_text(share * WIDTH, HEIGHT - 32, f"{share * float(edge[-1]):.2g}{more}", kind))
    parts.append(_text(WIDTH / 2, HEIGHT - 14, unit, "small middle"))
    return _svg(parts, title)


def slice_figure(title: str, cut: Slice, marked: float, mark: str) -> str:
    """A slice of the map with axes in metres; `marked` is where the other slice cuts, on the second axis."""
    low, high = cut.extent
    left, top, right, bottom = 46.0, 48.0, 12.0, 40.0
    zoom = min((WIDTH - left - right) / (high[0] - low[0]), 1.3 * HEIGHT / (high[1] - low[1]))
    width, height = zoom * (high - low)
    # As masks over the page's own colours, which differ between light and dark.
    unknown = np.where(cut.unknown, np.uint8(255), np.uint8(0))
    occupied = np.where(cut.unknown, 0, 255 * cut.occupancy.clip(0, 1)).astype(np.uint8)
    layers = {"unknown": unknown, "occupied": occupied}
    box = f'x="{left}" y="{top}" width="{width:.1f}" height="{height:.1f}"'
    fill = f'{box} preserveAspectRatio="none"'
    axes = "".join("xyz"[k] for k in cut.axes)
    parts = [_text(12.0, 20.0, title, "title"), f'<rect {box} class="free"/>']
    for name, shares in layers.items():
        parts += [
            f'<mask id="{name}-{axes}"><image {fill} href="{picture_url(shares[::-1], "PNG")}"/></mask>',
            f'<rect {box} class="{name}" mask="url(#{name}-{axes})"/>',
        ]
    parts.append(f'<rect {box} class="frame"/>')
    for tick in _ticks(low[0], high[0]):
        x = left + zoom * (tick - low[0])
        parts.append(_line([(x, top + height), (x, top + height + 4)], "frame"))
        parts.append(_text(x, top + height + 16, f"{tick:g}", "small middle"))
    for tick in _ticks(low[1], high[1]):
        y = top + height - zoom * (tick - low[1])
        parts.append(_line([(left - 4, y), (left, y)], "frame"))
        parts.append(_text(left - 7, y + 4, f"{tick:g}", "small end"))
    parts.append(
        _text(left + width / 2, top + height + 32, f"{axes[0]} in the base frame (m)", "small middle")
    )
    parts.append(_text(left - 30, top - 9, f"{axes[1]} in the base frame (m)", "small"))
    if low[1] < marked < high[1]:
        y = top + height - zoom * (marked - low[1])
        parts.append(_line([(left, y), (left + width, y)], "mark"))
        parts.append(_text(left + width - 4, y - 4, mark, "small end mark-text"))
    return _svg(parts, title, height=top + height + bottom)


def rendered_points(
    points_in_camera: Float[ndarray, "n 3"],
    color: UInt8[ndarray, "n 3"],
    size: float,
    lens: Intrinsics,
    width: int,
) -> UInt8[ndarray, "h w 4"]:
    """RGBA of points, as squares of about `size` metres, seen through a pinhole scaled to `width` pixels.

    Transparent where there are none.
    """
    zoom = width / lens.width
    height = round(zoom * lens.height)
    depth = np.maximum(points_in_camera[:, 2], 1e-3)
    ahead = np.column_stack([points_in_camera[:, :2], depth])
    column, row = np.floor(zoom * (project(without_distortion(lens), ahead) + 0.5)).astype(int).T
    shown = (depth > 1e-3) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    rgba = np.zeros((height, width, 4), np.uint8)
    if not shown.any():
        return rgba
    # Far ones first: of two in one pixel the last, nearer one stays.
    far_to_near = np.flatnonzero(shown)[np.argsort(-depth[shown])]
    half = int(np.clip(0.5 * zoom * lens.fx * size / np.median(depth[shown]), 1, 5))
    offset = np.arange(-half, half + 1)
    square = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    columns = (column[far_to_near, None] + square[:, 0]).clip(0, width - 1)
    rows = (row[far_to_near, None] + square[:, 1]).clip(0, height - 1)
    # A pixel's four bytes are written as one number.
    opaque = np.column_stack([color, np.full(len(color), 255, np.uint8)]).view(np.uint32)
    rgba.view(np.uint32).reshape(-1)[rows * width + columns] = opaque[far_to_near]
    return rgba


def label_colors(count: int) -> UInt8[ndarray, "k 3"]:
    """Colours far apart on the wheel for neighbouring labels; grey for 0, which is no object."""
    hue = np.arange(count) * 0.618034 % 1.0
    rgb = np.array([colorsys.hsv_to_rgb(h, 0.6, 0.88) for h in hue])
    rgb[0] = 0.6
    return (255 * rgb).astype(np.uint8)


def picture_url(pixels: UInt8[ndarray, "h w *c"], kind: str) -> str:
    """A data URL of grey, RGB or (WEBP) RGBA pixels as JPEG, PNG or WEBP."""
    stream = io.BytesIO()
    if kind == "PNG":
        stream.write(encode_png(pixels))
    else:
        Image.fromarray(pixels).save(stream, kind, quality=80)
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"


def pyramid(lens: Intrinsics, depth: float) -> Float[ndarray, "5 3"]:
    """Centre and image corners of a camera, in its own frame, with the image plane at `depth`."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [lens.width, lens.height] - 0.5
    return depth * np.vstack([np.zeros(3), unproject(without_distortion(lens), corners)])


def _view_axes(azimuth_deg: float, elevation_deg: float) -> Float[ndarray, "2 3"]:
    """Right and up of the image, in the base frame."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    right = [-np.sin(a), np.cos(a), 0.0]
    up = [-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)]
    return np.array([right, up])


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no longer than `most`."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(next(step * power for step in (5, 2, 1) if step * power <= most))


def _ticks(low: float, high: float) -> list[float]:
    step = _round_length((high - low) / 3)
    # Adding 0 turns -0 into 0.
    return (step * np.arange(np.ceil(low / step), np.floor(high / step) + 1) + 0.0).round(9).tolist()


def _svg(parts: Sequence[str], label: str, height: float = HEIGHT) -> str:
    return (
        f'<svg class="figure" viewBox="0 0 {WIDTH:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def _text(x: float, y: float, text: str, kind: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}">{escape(text)}</text>'


def _line(ends: Sequence[Sequence[float] | ndarray], kind: str) -> str:
    return f'<polyline class="{kind}" points="{_points(ends)}"/>'


def _points(corners: Sequence[Sequence[float] | ndarray]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
