"""Help of a command, in plain text: the options that most users set, or all."""

import inspect
import re
import shutil
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import tyro

from jcr.cli.usage import CONFIGURATION

EVERYTHING = "--help-all"
COLUMN = 26
"""Where what is said of an argument begins."""
NARROWEST, WIDEST = 60, 110
NO_DEFAULT = re.compile(r" *\(default: *(?:None|True|False|)\)")
"""What the parser says of options that have no value, and of switches."""
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


@dataclass(frozen=True)
class Argument:
    """One argument as help shows it."""

    flag: str
    """--name; empty for one that is given by its place."""
    value: str
    """How its value is named, or its choices in braces; empty for a switch."""
    text: str
    choices: tuple[str, ...] = ()
    """Its values, where these are few."""


@dataclass(frozen=True)
class Group:
    """Arguments under one heading."""

    title: str
    about: str
    arguments: tuple[Argument, ...]


def groups(record: Any, program: str) -> list[Group]:
    """The arguments of a command's `Arguments` but for its help, as the parser has them."""
    with warnings.catch_warnings():
        # The only way to ask tyro for what it has parsed; it is to go with nothing in its place yet.
        warnings.simplefilter("ignore", DeprecationWarning)
        parser = tyro.extras.get_parser(record, prog=program, config=CONFIGURATION)
    found = []
    for group in parser._action_groups:
        arguments = tuple(_argument(action) for action in group._group_actions if action.dest != "help")
        if arguments:
            found.append(Group(group.title or "", group.description or "", arguments))
    return found


def _argument(action: Any) -> Argument:
    value = "" if action.nargs == 0 else action.metavar or ""
    text = " ".join(str(action.help).replace("%%", "%").split())
    return Argument(
        flag=action.option_strings[-1] if action.option_strings else "",
        value=" ".join(value) if isinstance(value, tuple) else value,
        text=NO_DEFAULT.sub("", text),
        choices=tuple(choice for choice in action.choices or () if choice != "None"),
    )


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
