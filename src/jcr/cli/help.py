"""Help of a command, in plain text: the options that most users set, or all."""

import inspect
import shutil
import textwrap
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

from jcr.cli.arguments import Argument, groups

EVERYTHING = "--help-all"
COLUMN = 26
"""Where what is said of an argument begins."""
NARROWEST, WIDEST = 60, 110
COMMON = (
    "--pose-convention",
    "--pose-units",
    "--camera-info",
    "--frames",
    "--robot",
    "--require",
    "--robot-noise",
    "--board",
    "--backend",
    "--focus",
    "--no-map",
    "--camera",
    "--poses",
    "--camera-size",
    "--intrinsics-from",
    "--scene",
    "--images",
    "--joint-offsets",
    "--link-errors",
    "--json",
    "--quiet",
)
"""Options that help lists of a command that has many; `--help-all` lists the rest too."""
MANY = 16


def help_text(command: ModuleType, program: str, everything: bool) -> str:
    """Usage, what the command does with examples, and its arguments, as wide as the terminal."""
    width = min(max(shutil.get_terminal_size().columns, NARROWEST), WIDEST)
    listed = groups(command.Arguments, program)
    by_place = [argument for group in listed for argument in group.arguments if not argument.flag]
    options = [argument for group in listed for argument in group.arguments if argument.flag]
    usage = " ".join(["usage:", program, "[OPTIONS]", *(argument.value for argument in by_place)])
    parts = [usage, "", *_description(command.Arguments, width)]
    parts += [*(line for argument in by_place for line in _lines(argument, width)), ""] if by_place else []
    if everything or len(options) <= MANY:
        for group in listed:
            few = [argument for argument in group.arguments if argument.flag]
            if few:
                title = group.title.removesuffix(" options").removesuffix("options").replace(".", ", ")
                parts += [": ".join((f"{title} options".strip(), group.about)).rstrip(" ")]
                parts += [*(line for argument in few for line in _lines(argument, width)), ""]
        return "\n".join(parts)
    parts += ["options:"]
    parts += [line for argument in options if argument.flag in COMMON for line in _lines(argument, width)]
    rest = sum(argument.flag not in COMMON for argument in options)
    return "\n".join([*parts, "", f"{rest} more options: {program} {EVERYTHING}", ""])


def _description(record: Any, width: int) -> Iterator[str]:
    """The docstring, paragraphs wrapped and examples as they are."""
    for paragraph in inspect.cleandoc(record.__doc__ or "").split("\n\n"):
        is_code = paragraph.startswith("examples:")
        yield from paragraph.splitlines() if is_code else textwrap.wrap(paragraph, width)
        yield ""


def _lines(argument: Argument, width: int) -> Sequence[str]:
    value = argument.value.replace(",", ", ") if argument.value.startswith("{") else argument.value
    head = "  " + " ".join(filter(None, (argument.flag, value)))
    first = textwrap.wrap(head, width, subsequent_indent=" " * 6, break_on_hyphens=False)
    text = textwrap.wrap(argument.text, width - COLUMN, break_on_hyphens=False)
    indented = [" " * COLUMN + line for line in text]
    if len(head) < COLUMN - 1 and indented:
        return [head.ljust(COLUMN) + text[0], *indented[1:]]
    return [*first, *indented]
