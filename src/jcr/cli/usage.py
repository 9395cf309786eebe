"""The arguments of a command as its record; wrong ones as an InputError, made of what the parser reports as data.

The hook of tyro for parse errors is in its module `_errors`, which pyproject.toml bounds by the minor version.
"""

from collections.abc import Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from types import NoneType
from typing import Any, get_args

import tyro
from tyro import _errors

from jcr.cli.arguments import CONFIGURATION, groups
from jcr.errors import InputError, did_you_mean

VALUES = {float: "number", int: "whole number", str: "text", Path: "path"}
"""Types of values, for people."""


def parsed(record: type, program: str, arguments: Sequence[str]) -> Any:
    """The record that a command line makes; InputError in one line where it makes none."""

    def refuse(event: _errors.ParseErrorEvent) -> None:
        raise InputError(f"{_complaint(event, record, program, arguments)} ({program} --help)")

    with _errors.on_parse_error(refuse):
        return tyro.cli(record, prog=program, args=list(arguments), config=CONFIGURATION, add_help=False)


def _complaint(event: _errors.ParseErrorEvent, record: type, program: str, arguments: Sequence[str]) -> str:
    listed = [argument for group in groups(record, program) for argument in group.arguments]
    flags = [argument.flag for argument in listed]
    known = {*flags, *(alias for argument in listed for alias in argument.aliases)}
    options = (word.partition("=")[0] for word in arguments if word.startswith("--"))
    if unknown := next((word for word in options if word.replace("_", "-") not in known), None):
        return f"{program} has no option {unknown}{did_you_mean(unknown, filter(None, flags))}"
    match event:
        case _errors.UnrecognizedArgs(tokens=[first, *_]):
            return f"{first!r}: one argument too many for {program}"
        case _errors.MissingArgs(missing_arguments=missing):
            return f"{', '.join(str(one.arg.lowered.metavar) for one in missing)}: required, and not given"
        case _errors.InvalidChoice(argument=argument, value=value):
            known = sorted(set(event.choices) - {"None"})  # which stands for none given
            like = did_you_mean(value, known)
            return f"invalid choice {value!r} for {argument.display_name()}{like}; choose from {', '.join(known)}"
        case _errors.BadValue(argument=argument) | _errors.InstantiationFailure(argument=argument) if (
            argument
        ):
            given = ", ".join(map(repr, _values_of(argument.display_name(), arguments)))
            return f"{argument.display_name()} takes {_wanted(argument.field.type)}, not {given or 'none'}"
        case _errors.InstantiationFailure(message=message):
            return message
    return "the arguments cannot be understood"


def _values_of(flag: str, arguments: Sequence[str]) -> list[str]:
    """What follows an option on the command line."""
    words = [part for word in arguments for part in (word.split("=", 1) if word.startswith(flag) else [word])]
    after = words[words.index(flag) + 1 :] if flag in words else []
    return list(takewhile(lambda word: not word.startswith("--"), after))


def _wanted(kind: object) -> str:
    words = [VALUES.get(leaf, "value") for leaf in _leaves(kind) if leaf is not NoneType]
    return f"a {words[0]}" if len(words) == 1 else f"{len(words)} values ({', '.join(words)})"


def _leaves(kind: Any) -> Iterator[Any]:
    """The types that unions, tuples and annotated types are made of."""
    if hasattr(kind, "__metadata__"):
        yield from _leaves(get_args(kind)[0])
    elif parts := get_args(kind):
        for part in parts:
            yield from _leaves(part)
    elif kind is not Ellipsis:
        yield kind
