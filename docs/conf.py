"""Sphinx's configuration of the site: `make docs`."""

import os
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from generated import write_pages  # noqa: E402

write_pages()

project = "jcr"
author = "The jcr developers"
copyright = "The jcr developers, Apache-2.0"
release = metadata.version("jcr-handeye")

extensions = ["myst_parser", "sphinx_copybutton"]
exclude_patterns = ["_site"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 3
smartquotes = False  # a pair of dashes begins an option
myst_enable_extensions = ["dollarmath"]
suppress_warnings = ["myst.strikethrough"]
nitpicky = True
highlight_language = "text"

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"jcr {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}

REPOSITORY = os.environ.get("JCR_REPOSITORY", "")
"""Address of the source, as https://github.com/OWNER/NAME; links to files beside docs/ lead there."""


def _files_beside(app: Sphinx, name: str, source: list[str]) -> None:
    """Links to files of the source that are no pages: to the repository, or plain text where none is named."""
    here = Path(app.env.doc2path(name)).parent

    def there(link: re.Match[str]) -> str:
        file = (here / link[2].partition("#")[0]).resolve()
        if HERE in file.parents or not file.is_file():
            return link[0]
        where = file.relative_to(HERE.parent)
        return f"[{link[1]}]({REPOSITORY}/blob/main/{where})" if REPOSITORY else f"{link[1]} (`{where}`)"

    source[0] = re.sub(r"\[([^\]\n]+)\]\((\.\.?/[^)\s]+)\)", there, source[0])


def _formula(translator: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers draw without a script from elsewhere."""
    display = "block" if isinstance(node, nodes.math_block) else "inline"
    translator.body.append(convert(node.astext(), display=display))
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (_formula, None), (_formula, None))
    app.connect("source-read", _files_beside)
