"""Rendering of HTML pages from templates, with every text escaped and all files embedded, and label colours."""

import colorsys
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import UInt8
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy import ndarray

from jcr.number_format import significant

REPORT = "jcr.report"
"""Package whose templates all pages share."""
TRACK_COLOR = (229, 40, 40)
"""RGB of tracked features in 3D views."""
Content = Mapping[str, Any]
"""Content of a section of the report; its template reads it as the variable `it`."""


def render(template: str, content: Mapping[str, Any], package: str = REPORT) -> str:
    """Return the HTML of a template, a file in `templates/` of the Python package `package`, filled with `content`."""
    return _environment(package).get_template(template).render(content)


@cache
def _environment(package: str) -> Environment:
    """Return the Jinja environment with the templates of a package and those of the report, which all pages share."""
    loader = ChoiceLoader([PackageLoader(name, "templates") for name in dict.fromkeys((package, REPORT))])
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )

    def source(name: str) -> Markup:
        return Markup(loader.get_source(environment, name)[0])  # nosec B704: a file of this package, no text from outside

    environment.globals["source"] = source
    environment.filters["significant"] = significant
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment


def label_colors(count: int) -> UInt8[ndarray, "k 3"]:
    """Return RGB (k,3) of `count` labels, with different hues for successive labels; label 0, none, is grey."""
    hue = np.arange(count) * 0.618034 % 1.0
    rgb = np.array([colorsys.hsv_to_rgb(h, 0.6, 0.88) for h in hue])
    rgb[0] = 0.6
    return (255 * rgb).astype(np.uint8)
