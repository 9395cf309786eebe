"""`jcr docs`: the pages of the manual in the terminal, without a network."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from jcr.cli.output import Output
from jcr.pages import page, pages, title


@dataclass(frozen=True)
class Arguments:
    """Print a page of the manual, or list the pages.

    examples:
      jcr docs
      jcr docs captures
      jcr docs results/speed
    """

    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PAGE]")] = None
    """Page to print; none: list them."""
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Print a page, or the names and titles of all."""
    if arguments.name is not None:
        text = page(arguments.name)
        arguments.output.result(text, {"page": arguments.name, "markdown": text})
        return 0
    titles = {name: title(path) for name, path in pages().items()}
    text = "".join(f"{name:<22} {heading}\n" for name, heading in titles.items())
    arguments.output.result(text, {"pages": titles})
    return 0
