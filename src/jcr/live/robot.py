"""States of a robot arm over time, detection of rest, gripper poses from plain numbers, and typed lines."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.controllers import CONVENTIONS, poses_from_numbers
from jcr.capture.options import ConventionName, UnitsName
from jcr.errors import InputError
from jcr.geometry import inverse, rotation_angle

REST_S = 0.5
REST = (2e-4, np.radians(0.03))
"""m, rad: an arm that stays within this for REST_S is at rest."""
MOVED_ON = (0.01, np.radians(3.0))
"""m, rad: least distance of a rest from the last image at which the next image is taken."""
TRY_AGAIN = (1e-3, np.radians(0.2))
"""m, rad: the same distance after an image that was refused."""
BY_COUNT: dict[int, ConventionName] = {6: "rotation-vector", 7: "quat-xyzw", 16: "matrix"}
"""Convention of so many numbers, where none was given."""


@dataclass(frozen=True)
class RobotState:
    """Gripper pose and joint angles of an arm at one time."""

    time_s: float
    """Time on the controller's clock."""
    base_from_gripper: Float[ndarray, "4 4"]
    joints: Float[ndarray, " dof"] | None = None
    """Joint angles (rad); None where the source does not send them."""


States = Callable[[], Iterator[RobotState]]
"""Function that opens a connection and yields states from then on; closing the iterator closes the connection."""


def next_rest(states: States, last: Float[ndarray, "4 4"] | None, limit: tuple[float, float]) -> RobotState:
    """Return the state in which the arm rests next, farther than `limit` (m, rad) from the pose `last`."""
    recent: deque[RobotState] = deque()
    for state in states():
        if recent and state.time_s < recent[-1].time_s:
            recent.clear()  # The controller's clock was set back.
        while recent and is_farther(recent[0].base_from_gripper, state.base_from_gripper, REST):
            recent.popleft()
        recent.append(state)
        while len(recent) > 1 and state.time_s - recent[1].time_s >= REST_S:
            recent.popleft()
        is_new = last is None or is_farther(last, state.base_from_gripper, limit)
        if is_new and state.time_s - recent[0].time_s >= REST_S:
            return state
    raise InputError("the arm sends no more states; the same command resumes")


def is_farther(a: Float[ndarray, "4 4"], b: Float[ndarray, "4 4"], limit: tuple[float, float]) -> bool:
    """Test whether two poses are more than `limit` (m, rad) apart."""
    motion = inverse(a) @ b
    return bool(np.linalg.norm(motion[:3, 3]) > limit[0] or rotation_angle(motion[:3, :3]) > limit[1])


def pose_of_numbers(
    numbers: list[float], where: str, convention: ConventionName = "auto", units: UnitsName = "auto"
) -> Float[ndarray, "4 4"]:
    """Return base_from_gripper of the numbers of one pose; raise InputError for others.

    `convention` auto: x y z and a rotation vector, as UR shows, x y z qx qy qz qw, or a matrix by rows.
    """
    named = BY_COUNT.get(len(numbers)) if convention == "auto" else convention
    if named is None or len(numbers) != len(CONVENTIONS[named].columns):
        raise InputError(f"{where}: {len(numbers)} numbers; give {pose_columns(convention, units)}")
    return poses_from_numbers(np.array([numbers], np.float64), named, units, where)[0]


def pose_columns(convention: ConventionName, units: UnitsName) -> str:
    """Return names and units of the numbers of a pose."""
    if convention == "auto":
        unit = "m, rad" if units == "auto" else units.replace("-", ", ")
        return f"x y z rx ry rz | x y z qx qy qz qw | 16 numbers by rows; {unit}"
    form = CONVENTIONS[convention]
    names = "16 numbers by columns" if convention == "franka" else " ".join(form.columns)
    return f"{names}; {', '.join(form.units(units))}"


# Lines that a person types while a capture is taken: commands, and gripper poses read off the pendant.

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
