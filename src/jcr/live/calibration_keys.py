"""What a person types while a capture is taken: retake, remove, finish."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

Action = Literal["retake", "remove", "finish"]
HELP = "type retake [NUMBER], remove [NUMBER] or finish and Enter; NUMBER counts images from 1, unset: the last one"


@dataclass(frozen=True)
class Typed:
    """A command."""

    action: Action
    number: int | None = None
    """Of the image, the first is 1; None: the last one."""


def command_of(line: str) -> Typed | None:
    """The command that a line is, by its whole first word or its beginning; None of any other line."""
    first, *rest = line.split() or [""]
    found = [action for action in get_args(Action) if len(first) >= 3 and action.startswith(first.lower())]
    if len(found) != 1 or len(rest) > 1 or not all(word.isdigit() for word in rest):
        return None
    return Typed(found[0], int(rest[0]) if rest else None)


def without_commands(lines: Iterable[str], typed: Callable[[Typed], None]) -> Iterator[str]:
    """The lines that are no commands; commands are handed on."""
    for line in lines:
        command = command_of(line)
        if command is None:
            yield line
        else:
            typed(command)
