"""Images of the report as data URLs, and the colours of labels."""

import base64
import colorsys
import io

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image

TRACK_COLOR = (229, 40, 40)
JPEG_QUALITY = 80


def label_colors(count: int) -> UInt8[ndarray, "k 3"]:
    """Return colours far apart on the wheel for neighbouring labels; grey for label 0, none."""
    hue = np.arange(count) * 0.618034 % 1.0
    rgb = np.array([colorsys.hsv_to_rgb(h, 0.6, 0.88) for h in hue])
    rgb[0] = 0.6
    return (255 * rgb).astype(np.uint8)


def image_url(pixels: UInt8[ndarray, "h w *c"]) -> str:
    """Return grey or RGB pixels as the data URL of a JPEG."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", quality=JPEG_QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"
