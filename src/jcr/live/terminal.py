"""Lines that a person types while a capture is taken: commands, and gripper poses read off the pendant."""

from collections.abc import Callable, Iterable, Iterator
from typing import Literal, get_args

from jaxtyping import Float
from numpy import ndarray

from jcr.capture.options import ConventionName, UnitsName
from jcr.live.robot import pose_columns, pose_of_numbers

Action = Literal["take", "retake", "remove", "undo", "finish"]
WITH_NUMBER: tuple[Action, ...] = ("retake", "remove")
HELP = "type take, retake [NUMBER], remove [NUMBER], undo or finish, and Enter; NUMBER counts from 1, unset: the last"


def command_of(line: str) -> tuple[Action, int | None] | None:
    """Return action and image number of a command, of which three letters suffice; None of any other line."""
    first, *rest = line.split() or [""]
    found = [action for action in get_args(Action) if len(first) >= 3 and action.startswith(first.lower())]
    if len(found) != 1 or len(rest) > (found[0] in WITH_NUMBER) or not all(w.isdecimal() for w in rest):
        return None
    return found[0], int(rest[0]) if rest else None


def without_commands(lines: Iterable[str], press: Callable[[Action, int | None], None]) -> Iterator[str]:
    """Yield the lines that are no commands; hand commands to `press`."""
    for line in lines:
        command = command_of(line)
        if command is None:
            yield line
        else:
            press(*command)


def typed_poses(
    lines: Iterator[str],
    show: Callable[[str], None],
    convention: ConventionName = "auto",
    units: UnitsName = "auto",
) -> Iterator[Float[ndarray, "4 4"]]:
    """Yield base_from_gripper of each typed line, until an empty one or the end of the input."""
    while True:
        show(f"pose at rest ({pose_columns(convention, units)}; empty line ends):")
        line = next(lines, "").strip().strip("[]p")
        if not line:
            return
        try:
            numbers = [float(word) for word in line.replace(",", " ").split()]
            yield pose_of_numbers(numbers, "typed", convention, units)
        except ValueError as error:  # InputError is one, too.
            show(f"refused: {error}")
