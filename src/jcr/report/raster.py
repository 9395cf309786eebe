"""Images inside the report: points as a camera sees them, colours of labels, data URLs."""

import base64
import colorsys
import io

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image
from PIL import WebPImagePlugin as _  # noqa: F401  (else Pillow loads all its formats to find this one, in 0.1 s)

from jcr.camera import project, without_distortion
from jcr.capture.images import encode_png
from jcr.records import Intrinsics

TRACK_COLOR = (229, 40, 40)
OPTIONS = {"JPEG": {"quality": 80}, "WEBP": {"quality": 80, "method": 1}}
"""Of Pillow; WebP's default method 4 takes three times as long, and makes files a twentieth smaller."""


def points_in_pixels(
    points_in_camera: Float[ndarray, "n 3"], size: float, intrinsics: Intrinsics, width: int
) -> Int[ndarray, "h w"]:
    """Which point each pixel shows, drawn as squares of about `size` metres through a pinhole scaled to `width` pixels.

    -1 where there is none; of two points in one pixel the nearer one.
    """
    zoom = width / intrinsics.width
    height = round(zoom * intrinsics.height)
    depth = np.maximum(points_in_camera[:, 2], 1e-3)
    ahead = np.column_stack([points_in_camera[:, :2], depth])
    at = np.floor(zoom * (project(without_distortion(intrinsics), ahead) + 0.5))
    column, row = at.clip(-1, max(width, height)).astype(np.int32).T
    shown = (depth > 1e-3) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    found = np.full(height * width, -1, np.int32)
    if not shown.any():
        return found.reshape(height, width)
    # Far ones first: the last one written to a pixel stays.
    far_to_near = np.flatnonzero(shown)[np.argsort(-depth[shown])].astype(np.int32)
    half = int(np.clip(0.5 * zoom * intrinsics.fx * size / np.median(depth[shown]), 1, 5))
    offset = np.arange(-half, half + 1, dtype=np.int32)
    columns = (column[far_to_near, None] + offset).clip(0, width - 1)
    rows = (row[far_to_near, None] + offset).clip(0, height - 1)
    pixels = rows[:, :, None] * np.int32(width) + columns[:, None, :]
    found[pixels.reshape(len(far_to_near), -1)] = far_to_near[:, None]
    return found.reshape(height, width)


def colored(shown: Int[ndarray, "h w"], color: UInt8[ndarray, "n 3"]) -> UInt8[ndarray, "h w 4"]:
    """RGBA of the points in pixels, transparent where there are none."""
    rgba = np.zeros((*shown.shape, 4), np.uint8)
    seen = shown >= 0
    rgba[seen, :3], rgba[seen, 3] = color[shown[seen]], 255
    return rgba


def label_colors(count: int) -> UInt8[ndarray, "k 3"]:
    """Colours far apart on the wheel for neighbouring labels; grey for 0, which is no object."""
    hue = np.arange(count) * 0.618034 % 1.0
    rgb = np.array([colorsys.hsv_to_rgb(h, 0.6, 0.88) for h in hue])
    rgb[0] = 0.6
    return (255 * rgb).astype(np.uint8)


def image_url(pixels: UInt8[ndarray, "h w *c"], kind: str) -> str:
    """A data URL of grey, RGB or (WEBP) RGBA pixels as JPEG, PNG or WEBP."""
    stream = io.BytesIO()
    if kind == "PNG":
        stream.write(encode_png(pixels))
    else:
        Image.fromarray(pixels).save(stream, kind, **OPTIONS[kind])
    return f"data:image/{kind.lower()};base64,{base64.b64encode(stream.getvalue()).decode()}"
