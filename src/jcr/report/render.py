"""The templates of the pages, filled: every text is escaped, and a page loads nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

REPORT = "jcr.report"


@dataclass(frozen=True)
class Section:
    """Section of the report."""

    name: str
    """Id in the page, and name of the template in templates/."""
    content: Mapping[str, Any]
    """Content, the variable `it` of the template."""


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
