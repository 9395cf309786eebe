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
    """A section of the report."""

    name: str
    """Its id in the page, and its template in templates/."""
    content: Mapping[str, Any]
    """What the template calls `it`."""


def render(template: str, content: Mapping[str, Any], package: str = REPORT) -> str:
    """The page or part of one that a template in `templates/` of a package makes of its content."""
    return _environment(package).get_template(template).render(content)


@cache
def _environment(package: str) -> Environment:
    """Templates of the package, then those of the report, whose layout, style and macros all pages share."""
    loader = ChoiceLoader([PackageLoader(name, "templates") for name in dict.fromkeys((package, REPORT))])
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )

    def source(name: str) -> Markup:
        """A style sheet or script of ours as it is."""
        return Markup(loader.get_source(environment, name)[0])  # noqa: S704

    environment.globals["source"] = source
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment
