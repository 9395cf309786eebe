"""Filling the page's templates."""

from importlib import resources
from string import Template

PAGE = resources.files("jcr.report") / "page"


def filled(template: str, **parts: str) -> str:
    """The template with its placeholders replaced by markup; text from files must come escaped."""
    return Template((PAGE / template).read_text("utf-8")).substitute(parts)
