"""The arguments of a command as its parser has them: what help lists, completion offers, and usage errors name."""

import re
import warnings
from dataclasses import dataclass
from typing import Any

import tyro

CONFIGURATION = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.DisallowNone,
)
"""How tyro makes options of the fields of a command's `Arguments`."""
NO_DEFAULT = re.compile(r" *\(default: *(?:None|True|False|)\)")
"""What the parser adds to options that have no value, and of switches."""


@dataclass(frozen=True, kw_only=True)
class Argument:
    """One argument as help shows it."""

    flag: str
    """--name; empty for one that is given by its place."""
    value: str
    """How its value is named, or its choices in braces; empty for a switch."""
    text: str
    choices: tuple[str, ...] = ()
    """Its values, where these are few."""
    aliases: tuple[str, ...] = ()
    """Its further names, --name, which help does not list: those of earlier versions."""


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
    flags = action.option_strings  # the aliases come first
    text = " ".join(str(action.help).replace("%%", "%").split())
    return Argument(
        flag=flags[-1] if flags else "",
        value=" ".join(value) if isinstance(value, tuple) else value,
        text=NO_DEFAULT.sub("", text),
        choices=tuple(choice for choice in action.choices or () if choice != "None"),
        aliases=tuple(flags[:-1]),
    )
