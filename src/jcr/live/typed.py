"""Gripper poses typed by hand, one a line, in the notation and units of the pendant."""

from collections.abc import Callable, Iterator

import numpy as np

from jcr.capture.options import ConventionName, UnitsName
from jcr.capture.robot_poses import CONVENTIONS, poses_from_numbers
from jcr.errors import InputError
from jcr.live.asks import Ask

BY_COUNT: dict[int, ConventionName] = {6: "rotation-vector", 7: "quat-xyzw", 16: "matrix"}
"""What this many numbers are, where no convention was given."""


def typed_poses(
    lines: Iterator[str],
    show: Callable[[str], None],
    convention: ConventionName = "auto",
    units: UnitsName = "auto",
) -> Iterator[Ask]:
    """A request per line typed; an empty line or the end of the input ends the capture."""
    while True:
        show(f"pose at rest ({_wanted(convention, units)}; empty line ends):")
        line = next(lines, "").strip().strip("[]p")
        if not line:
            return
        try:
            numbers = [float(word) for word in line.replace(",", " ").split()]
        except ValueError:
            show("refused: not numbers; type the pose again")
            continue
        try:
            named = BY_COUNT.get(len(numbers)) if convention == "auto" else convention
            if named is None or len(numbers) != len(CONVENTIONS[named].columns):
                raise InputError(f"{len(numbers)} numbers; give {_wanted(convention, units)}")
            (pose,) = poses_from_numbers(np.array([numbers]), named, units, "typed")
        except InputError as error:
            show(f"refused: {error}")
        else:
            yield Ask(pose)


def _wanted(convention: ConventionName, units: UnitsName) -> str:
    if convention == "auto":
        unit = "m, rad" if units == "auto" else units.replace("-", ", ")
        return f"x y z rx ry rz | x y z qx qy qz qw | 16 numbers by rows; {unit}"
    form = CONVENTIONS[convention]
    names = "16 numbers by columns" if convention == "franka" else " ".join(form.columns)
    return f"{names}; {', '.join(form.units(units))}"
