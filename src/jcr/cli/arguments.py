"""Parse the arguments of a command with tyro; a wrong one is an InputError of one line.

The hooks of tyro are in its modules `_errors` and `_fields`; pyproject.toml bounds its minor version.
"""

import inspect
import io
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import islice, takewhile
from typing import Any, get_type_hints

import tyro
from tyro import _errors, _fields

from jcr.cli import COMMANDS, command
from jcr.errors import InputError, did_you_mean
from jcr.findings.finding import joined

CONFIGURATION = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
    tyro.conf.DisallowNone,
)
"""Settings of tyro for the conversion of a command's fields to options."""
HELP_WIDTH = 120
"""Largest width of the help's paragraphs in columns, also on a wider terminal."""
LISTED_BY = {
    "run": ("reconstruction and calibration", ("calibrate", "reconstruct"), ("calibrate",)),
    "check": ("reading images and poses without a capture.json", ("read",), ()),
    "map": ("points, map and objects", ("cloud", "map", "segment"), ()),
}
"""Commands whose help lists the options of a subject for all commands that have them: the subject, the fields of these
options, and other commands that list them, too."""


def parsed(record: Any, program: str, arguments: Sequence[str]) -> Any:
    """Parse the command-line `arguments` of a command, whose class is `record`, and return an instance of the class.

    `program` is the name in the help text. Raises InputError with a one-line message for wrong arguments.
    """

    def refuse(event: _errors.ParseErrorEvent) -> None:
        known, why = {*_flags(record), "--help", "-h"}, "the arguments cannot be understood"
        words = (word.partition("=")[0] for word in arguments if word.startswith("-"))
        options = (word.replace("_", "-") for word in words if word.lstrip("-")[:1].isalpha())
        match event:
            case _ if unknown := next((word for word in options if word not in known), None):
                owners = [f"jcr {name}" for name in COMMANDS if unknown in _flags(command(name))]
                where = f"; it is an option of {joined(owners)}" if owners else did_you_mean(unknown, known)
                if unknown.lstrip("-") in (positional := list(_marked(record, tyro.conf.Positional))):
                    where = f"; give it by its place: {program} {' '.join(map(str.upper, positional))}"
                why = f"{program} has no option {unknown}{where}"
            case _errors.MissingArgs(missing_arguments=missing):
                why = f"{', '.join(str(one.arg.lowered.metavar) for one in missing)}: required, and not given"
            case _errors.UnrecognizedArgs(tokens=[first, *_]):
                why = f"{first!r}: one argument too many for {program}"
            case _errors.InvalidChoice(argument=argument, value=value):
                choices = sorted(set(event.choices) - {"None"})  # None stands for an omitted option
                like, name = did_you_mean(value, choices), argument.display_name()
                why = f"invalid choice {value!r} for {name}{like}; choose from {', '.join(choices)}"
            case _errors.BadValue(argument=argument) | _errors.InstantiationFailure(argument=argument) if (
                argument
            ):
                name = argument.display_name()
                words = [part for word in arguments for part in word.split("=", 1)]
                after = words[words.index(name) + 1 :] if name in words else []
                given = ", ".join(map(repr, takewhile(lambda word: not word.startswith("--"), after)))
                why = f"{name} takes {argument.lowered.metavar}, not {given or 'none'}"
            case _errors.InstantiationFailure(message=message):
                why = message
        raise InputError(f"{why} ({program} --help)")

    if "" in arguments:
        raise InputError(f"an argument of {program} is empty; is the shell's variable unset?")
    # tyro also understands -h among the values of an option as a request for help.
    listed = _as_listed(record, program) if {"-h", "--help"} & {*arguments} else record
    with _errors.on_parse_error(refuse), _plain_descriptions(), _wrapped_paragraphs():
        return tyro.cli(listed, prog=program, args=list(arguments), config=CONFIGURATION)


def _as_listed(record: Any, program: str) -> Any:
    """Return the class of a command without the options that the help of another command lists, which it names."""
    name, hints, hidden, more = (
        program.removeprefix("jcr "),
        get_type_hints(record),
        dict[str, Any](),
        list[str](),
    )
    for command_name, (subject, groups, also) in LISTED_BY.items():
        if name not in (command_name, *also) and (here := [group for group in groups if group in hints]):
            hidden |= {group: tyro.conf.Suppress[hints[group]] for group in here}
            few = ", ".join(islice((flag for group in here for flag in _flags(hints[group])), 3))
            more.append(f"  jcr {command_name} --help  {subject} ({few}, …)")
    if not more:
        return record
    about = "\n".join(
        [inspect.getdoc(record) or "", "", "more options of this command are listed by:", *more]
    )
    defaults = {group: field(default_factory=hints[group]) for group in hidden}
    shorter = type(record.__name__, (record,), {"__annotations__": hidden, "__doc__": about, **defaults})
    return dataclass(frozen=True, kw_only=True)(shorter)


@contextmanager
def _plain_descriptions() -> Iterator[None]:
    """Join the lines of an option's docstring in the help, and omit a default without information, while active.

    tyro would keep line breaks before a line that is indented.
    """
    made = _fields.FieldDefinition.make

    def make(*arguments: Any, **named: Any) -> _fields.FieldDefinition:
        field = made(*arguments, **named)
        given = field.helptext
        field.helptext = lambda: " ".join(((given() if callable(given) else given) or "").split()) or None
        if tyro.conf.UseAppendAction not in field.markers:  # tyro shows "(repeatable)" for those
            field.argconf = replace(field.argconf, help_behavior_hint=_default_hint)
        return field

    _fields.FieldDefinition.make = make
    try:
        yield
    finally:
        _fields.FieldDefinition.make = made


def _default_hint(label: str) -> str:
    """Return the default of an option for the help; empty if it is None or empty, or the option is a flag."""
    return "" if label in ("", "None", "False", "True") else f"(default: {label})"


@contextmanager
def _wrapped_paragraphs() -> Iterator[None]:
    """Wrap the paragraphs of the help at words while the context is active; tyro 1.0 prints each as one line."""
    width, output = min(shutil.get_terminal_size().columns, HELP_WIDTH), sys.stdout
    # These two attributes decide which box characters and colours tyro uses.
    like_output = {"encoding": output.encoding, "isatty": output.isatty}
    printed = type("Help", (io.StringIO,), like_output)()
    try:
        with redirect_stdout(printed):
            yield
    finally:
        lines = printed.getvalue().split("\n")
        wrapped = (textwrap.fill(line, width) if line[:1].isalpha() else line for line in lines)
        if printed.getvalue():  # writing even an empty text fails on a full disk
            output.write("\n".join(wrapped))


def _marked(record: Any, marker: Any) -> Iterator[str]:
    """Yield the names of the fields of a class that have a marker of tyro, such as Positional."""
    extra = get_type_hints(record, include_extras=True)
    for one in fields(record):
        if marker in getattr(extra[one.name], "__metadata__", ()):
            yield one.name


def _flags(record: Any) -> Iterator[str]:
    """Yield the names (--NAME) of all options of a command's class, also those of nested classes of options."""
    if is_dataclass(record):
        hints = get_type_hints(record)
        no_option = {*_marked(record, tyro.conf.Positional), *_marked(record, tyro.conf.Suppress)}
        for one in fields(record):
            if one.name in no_option:
                continue
            if is_dataclass(hints[one.name]):
                yield from _flags(hints[one.name])
            else:
                yield f"--{'no-' * (one.default is True)}{one.name.replace('_', '-')}"
