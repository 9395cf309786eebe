"""Gripper poses typed by hand, one a line."""

from collections.abc import Callable, Iterator

from jcr.errors import InputError
from jcr.live.asks import Ask, pose_of_numbers


def typed_poses(lines: Iterator[str], say: Callable[[str], None]) -> Iterator[Ask]:
    """A request per line typed; an empty line or the end of the input ends the capture."""
    while True:
        say("pose at rest (x y z rx ry rz | x y z qx qy qz qw | 16 numbers; m, rad; empty line ends):")
        line = next(lines, "").strip().strip("[]p")
        if not line:
            return
        try:
            numbers = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            say("refused: not numbers; type the pose again")
            continue
        try:
            yield Ask(pose_of_numbers(numbers, "typed"))
        except InputError as error:
            say(f"refused: {error}")
