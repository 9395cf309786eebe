"""Completion in the shell: a script with the options of every command, made from their `Arguments`."""

import types
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal, Union, get_args, get_origin, get_type_hints

import tyro

from jcr.cli import COMMANDS
from jcr.errors import InputError

SHELLS = ("bash", "zsh", "fish")
SUPPRESSED = get_args(tyro.conf.Suppress[int])[1]
"""Marks what the help does not list."""


@dataclass(frozen=True)
class Argument:
    """What can be completed of one argument."""

    flag: str | None
    """--name; None for one that is given by its place."""
    takes_value: bool
    values: tuple[str, ...]
    """Empty where any value will do: files are offered."""
    is_file: bool


def script(shell: str) -> str:
    """The completion script for a shell, to be sourced by it; InputError for a shell there is none for."""
    if shell not in SHELLS:
        raise InputError(f"--completion {shell}: give one of {', '.join(SHELLS)}")
    table = {name: tuple(_arguments(name)) for name in COMMANDS}
    if shell == "fish":
        return _fish(table)
    return _bash(table) if shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{_bash(table)}"


def _arguments(name: str) -> Iterator[Argument]:
    try:
        command = import_module(f"jcr.cli.{name.replace('-', '_')}")
    except InputError:  # what it needs is not installed
        return
    yield from arguments_of(command.Arguments)


def arguments_of(record: type) -> Iterator[Argument]:
    """Those of a command, as tyro reads them from its dataclass and the dataclasses in it."""
    hints = get_type_hints(record, include_extras=True)
    for field in fields(record):
        kind, marks = hints[field.name], ()
        if get_origin(kind) is Annotated:
            kind, *marks = get_args(kind)
        if SUPPRESSED in marks:
            continue
        if is_dataclass(kind) and isinstance(kind, type):
            yield from arguments_of(kind)
            continue
        name = field.name.replace("_", "-")
        # A switch is named for what it changes, as tyro's FlagCreatePairsOff has it.
        flag = (
            None
            if tyro.conf.Positional in marks
            else f"--no-{name}"
            if field.default is True
            else f"--{name}"
        )
        leaves = tuple(_leaves(kind))
        values = tuple(leaf for leaf in leaves if isinstance(leaf, str))
        yield Argument(flag, kind is not bool, values, Path in leaves)


def _leaves(kind: object) -> Iterator[object]:
    """The types that unions and tuples are made of, and the values of literals."""
    if get_origin(kind) is Annotated:
        yield from _leaves(get_args(kind)[0])
    elif get_origin(kind) is Literal:
        yield from get_args(kind)
    elif get_origin(kind) in (Union, types.UnionType, tuple):
        for part in get_args(kind):
            yield from _leaves(part)
    else:
        yield kind


def _flags(arguments: tuple[Argument, ...]) -> str:
    return " ".join([*(argument.flag for argument in arguments if argument.flag), "--help", "--help-all"])


def _bash(table: dict[str, tuple[Argument, ...]]) -> str:
    """What a case offers is in `words`; without a match bash offers files."""
    cases = []
    for name, arguments in table.items():
        options = [argument for argument in arguments if argument.flag and argument.takes_value]
        told = [value for argument in arguments if not argument.flag for value in argument.values]
        for argument in options:
            cases.append(f'    "{name} {argument.flag}") words="{" ".join(argument.values)}" ;;')
        cases.append(
            f'    "{name} "*) words="{" ".join(told)}"; [[ $2 == -* ]] && words="{_flags(arguments)}" ;;'
        )
    listed = "\n".join(cases)
    return f"""\
_jcr() {{
  local words=
  if ((COMP_CWORD == 1)); then
    words="{" ".join(table)} --help --version"
  else
    case "${{COMP_WORDS[1]}} $3" in
{listed}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$2"))
}}
complete -o default -F _jcr jcr
"""


def _fish(table: dict[str, tuple[Argument, ...]]) -> str:
    lines = [
        f'complete -c jcr -f -n __fish_use_subcommand -a {name} -d "{about}"'
        for name, about in COMMANDS.items()
    ]
    for name, arguments in table.items():
        where = f"complete -c jcr -n '__fish_seen_subcommand_from {name}'"
        for argument in arguments:
            values = f" -a '{' '.join(argument.values)}'" if argument.values else ""
            if argument.flag is None:
                lines += [where + values] if values else []
            elif argument.takes_value:
                # -r: a value follows; -f: which is no file.
                files = "" if argument.is_file else " -f"
                lines.append(f"{where} -l {argument.flag[2:]} -r{files}{values}")
            else:
                lines.append(f"{where} -l {argument.flag[2:]}")
        lines += [f"{where} -l help", f"{where} -l help-all"]
    return "\n".join(lines) + "\n"
