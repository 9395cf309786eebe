"""What a person commands while a capture is taken: on the terminal, on the live page, or by a ROS service."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

Action = Literal["take", "retake", "remove", "undo", "finish"]
OF_ONE_IMAGE: tuple[Action, ...] = ("retake", "remove")
HELP = "type take, retake [NUMBER], remove [NUMBER], undo or finish, and Enter; NUMBER counts from 1, unset: the last"


@dataclass(frozen=True)
class Command:
    """A command."""

    action: Action
    number: int | None = None
    """Of the image, the first is 1; None: the last one."""


def command_of(line: str) -> Command | None:
    """The command that a line is, by its whole first word or its beginning; None of any other line."""
    first, *rest = line.split() or [""]
    found = [action for action in get_args(Action) if len(first) >= 3 and action.startswith(first.lower())]
    if len(found) != 1 or len(rest) > (found[0] in OF_ONE_IMAGE) or not all(w.isdecimal() for w in rest):
        return None
    return Command(found[0], int(rest[0]) if rest else None)


def without_commands(lines: Iterable[str], press: Callable[[Command], None]) -> Iterator[str]:
    """The lines that are no commands; commands are handed on."""
    for line in lines:
        command = command_of(line)
        if command is None:
            yield line
        else:
            press(command)
