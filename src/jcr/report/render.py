"""The templates of the pages, filled: every text is escaped, and a page loads nothing else; images and colours."""

import base64
import colorsys
import io
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import UInt8
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy import ndarray
from PIL import Image

REPORT = "jcr.report"
TRACK_COLOR = (229, 40, 40)
JPEG_QUALITY = 80


Content = Mapping[str, Any]
"""Content of a section of the report: the variable `it` of its template."""


def render(template: str, content: Mapping[str, Any], package: str = REPORT) -> str:
    """Return the page, or part of one, that a template in `templates/` of a package makes of its content."""
    return _environment(package).get_template(template).render(content)


@cache
def _environment(package: str) -> Environment:
    """Return the templates of a package and of the report, whose layout, style and macros all pages share."""
    loader = ChoiceLoader([PackageLoader(name, "templates") for name in dict.fromkeys((package, REPORT))])
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )

    def source(name: str) -> Markup:
        """Return a style sheet or script of a package unescaped."""
        return Markup(loader.get_source(environment, name)[0])  # nosec B704: a file of this package, no text from outside

    environment.globals["source"] = source
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment


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
