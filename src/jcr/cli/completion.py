"""Completion in the shell: a script with the options of every command, as its parser has them.

shtab has no fish, and tyro's own scripts start Python at every Tab.
"""

from collections.abc import Mapping
from importlib import import_module

from jcr.cli.arguments import Argument, groups
from jcr.errors import InputError

SHELLS = ("bash", "zsh", "fish")
HELP = ("--help", "--help-all")
FILES = ("FILE", "PATH")
"""Names of values that are files."""


def script(shell: str, commands: Mapping[str, str]) -> str:
    """The completion script for a shell, to be sourced by it; InputError for a shell there is none for.

    `commands` are their names, each with a sentence on what it does.
    """
    if shell not in SHELLS:
        raise InputError(f"--completion {shell}: give one of {', '.join(SHELLS)}")
    table = {name: _arguments(name) for name in commands}
    if shell == "fish":
        return _fish(table, commands)
    return _bash(table) if shell == "bash" else f"autoload -U +X bashcompinit && bashcompinit\n{_bash(table)}"


def _arguments(name: str) -> list[Argument]:
    try:
        command = import_module(f"jcr.cli.{name.replace('-', '_')}")
    except InputError:  # what it needs is not installed
        return []
    return [argument for group in groups(command.Arguments, name) for argument in group.arguments]


def _bash(table: Mapping[str, list[Argument]]) -> str:
    """What a case offers is in `words`; without a match bash offers files."""
    cases = []
    for name, arguments in table.items():
        flags = " ".join([*(argument.flag for argument in arguments if argument.flag), *HELP])
        by_place = " ".join(word for argument in arguments if not argument.flag for word in argument.choices)
        for argument in arguments:
            if argument.flag and argument.value:
                cases.append(f'    "{name} {argument.flag}") words="{" ".join(argument.choices)}" ;;')
        cases.append(f'    "{name} "*) words="{by_place}"; [[ $2 == -* ]] && words="{flags}" ;;')
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


def _fish(table: Mapping[str, list[Argument]], commands: Mapping[str, str]) -> str:
    lines = [
        f'complete -c jcr -f -n __fish_use_subcommand -a {name} -d "{about}"'
        for name, about in commands.items()
    ]
    for name, arguments in table.items():
        where = f"complete -c jcr -n '__fish_seen_subcommand_from {name}'"
        for argument in arguments:
            values = f" -a '{' '.join(argument.choices)}'" if argument.choices else ""
            # -r: a value follows; -f: which is no file.
            takes = " -r" if argument.value else ""
            takes += " -f" if takes and not any(word in argument.value for word in FILES) else ""
            if argument.flag or values:
                flag = f" -l {argument.flag[2:]}{takes}" if argument.flag else ""
                lines.append(f"{where}{flag}{values}")
        lines += [f"{where} -l {flag[2:]}" for flag in HELP]
    return "\n".join(lines) + "\n"
