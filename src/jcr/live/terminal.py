"""Lines that a person types while a capture is taken: commands, and gripper poses read off the pendant."""

from collections.abc import Callable, Iterable, Iterator
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.options import ConventionName, UnitsName
from jcr.capture.robot_poses import CONVENTIONS, poses_from_numbers
from jcr.errors import InputError

Action = Literal["take", "retake", "remove", "undo", "finish"]
WITH_NUMBER: tuple[Action, ...] = ("retake", "remove")
HELP = "type take, retake [NUMBER], remove [NUMBER], undo or finish, and Enter; NUMBER counts from 1, unset: the last"
BY_COUNT: dict[int, ConventionName] = {6: "rotation-vector", 7: "quat-xyzw", 16: "matrix"}
"""Convention of so many numbers, where none was given."""


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
        show(f"pose at rest ({_wanted(convention, units)}; empty line ends):")
        line = next(lines, "").strip().strip("[]p")
        if not line:
            return
        try:
            yield _typed_pose(line, convention, units)
        except InputError as error:
            show(f"refused: {error}")


def _typed_pose(line: str, convention: ConventionName, units: UnitsName) -> Float[ndarray, "4 4"]:
    """Return base_from_gripper of a line of numbers; raise InputError for any other."""
    try:
        numbers = [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        raise InputError("not numbers; type the pose again") from None
    named = BY_COUNT.get(len(numbers)) if convention == "auto" else convention
    if named is None or len(numbers) != len(CONVENTIONS[named].columns):
        raise InputError(f"{len(numbers)} numbers; give {_wanted(convention, units)}")
    return poses_from_numbers(np.array([numbers]), named, units, "typed")[0]


def _wanted(convention: ConventionName, units: UnitsName) -> str:
    """Return names and units of the numbers of a pose."""
    if convention == "auto":
        unit = "m, rad" if units == "auto" else units.replace("-", ", ")
        return f"x y z rx ry rz | x y z qx qy qz qw | 16 numbers by rows; {unit}"
    form = CONVENTIONS[convention]
    names = "16 numbers by columns" if convention == "franka" else " ".join(form.columns)
    return f"{names}; {', '.join(form.units(units))}"
