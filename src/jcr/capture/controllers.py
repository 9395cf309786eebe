"""Pose conventions of robots and their controllers: conversion between rows of numbers and transforms."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.options import UnitsName
from jcr.errors import InputError
from jcr.geometry import HUGE, require_rigid, transform

QUATERNION_TOLERANCE = 1e-2
"""Largest accepted difference of a quaternion's length from 1; rounding to three digits stays below it."""
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Metres in each unit of length."""
RADIANS_LIMIT = 2 * np.pi + 0.01
"""Largest plausible angle of a pose in radians; larger numbers are taken for degrees."""
LEAST_REACH = 0.25
"""Smallest reach of an arm with a camera, m. Positions in a wrong unit are cm if their largest distance from the base
is under 1000 times this number, otherwise mm."""
METRES_LIMIT = 10.0
"""Largest plausible distance of a gripper from its base, m; larger numbers are not in metres."""
QUATERNIONS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}
"""Orders in which a quaternion is written, and the indices of x, y, z, w in each."""


@dataclass(frozen=True)
class Convention:
    """Pose convention: names, order, rotation notation and units of the numbers with which a robot writes a pose."""

    columns: tuple[str, ...]
    """Names of a pose's numbers, in the order in which they are written. The position is first, except in a matrix."""
    rotation: str
    """Notation of the rotation: a key of QUATERNIONS, `rotvec`, `matrix`, or SciPy's sequence of Euler angles (lower
    case: about fixed axes, upper case: about moving axes)."""
    usual: UnitsName = "m-rad"
    """Units of position and angle that the robot uses."""

    @property
    def has_angles(self) -> bool:
        """True if the pose has numbers in a unit of angle; False if its rotation is a quaternion or a matrix."""
        return self.rotation not in (*QUATERNIONS, "matrix")

    def scales(self, asked: UnitsName) -> tuple[float, float]:
        """Return the factors from the pose's numbers to metres and to radians, for the units `asked`, such as "mm-deg".

        For `asked` "auto" they are those of the convention's usual units.
        """
        length, angle = (self.usual if asked == "auto" else asked).split("-")
        return METRES[length], np.radians(1.0) if angle == "deg" else 1.0


_XYZ = ("x", "y", "z")
_XYZW, _WXYZ = ("qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz")
_VECTOR, _RPY = ("rx", "ry", "rz"), ("roll", "pitch", "yaw")
_ROWS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))

# "xyz" about fixed axes is Rz(yaw)·Ry(pitch)·Rx(roll); "ZYX" about moving ones is Rz(A)·Ry(B)·Rx(C).
CONVENTIONS = {
    "matrix": Convention(_ROWS, "matrix"),
    "quat-xyzw": Convention(_XYZ + _XYZW, "xyzw"),
    "quat-wxyz": Convention(_XYZ + _WXYZ, "wxyz"),
    "rotation-vector": Convention(_XYZ + _VECTOR, "rotvec"),
    "rpy": Convention(_XYZ + _RPY, "xyz"),
    "ur": Convention(_XYZ + _VECTOR, "rotvec"),
    "franka": Convention(tuple(f"m{row}{column}" for column in range(4) for row in range(4)), "matrix"),
    "xarm": Convention(_XYZ + _RPY, "xyz", "mm-deg"),
    "xarm-axis-angle": Convention(_XYZ + _VECTOR, "rotvec", "mm-deg"),
    "kuka": Convention((*_XYZ, "a", "b", "c"), "ZYX", "mm-deg"),
    "fanuc": Convention((*_XYZ, "w", "p", "r"), "xyz", "mm-deg"),
    "yaskawa": Convention(_XYZ + _VECTOR, "xyz", "mm-deg"),
    "abb": Convention((*_XYZ, "q1", "q2", "q3", "q4"), "wxyz", "mm-rad"),
    "unitree": Convention(_XYZ + _RPY, "xyz"),
    "realman": Convention(_XYZ + _WXYZ, "wxyz"),
}


def poses_from_numbers(
    numbers: Float[ndarray, "n k"], convention: str, units: UnitsName, where: str
) -> Float[ndarray, "n 4 4"]:
    """Convert rows of the k numbers of a pose convention to base_from_gripper (m); raise InputError for other rows.

    `convention` is a key of CONVENTIONS. The numbers are in its order and in `units` ("mm-deg"); "auto": the
    convention's usual ones. Messages begin with `where`.
    """
    poses, faults = checked_rows(numbers, convention, units, where)
    if faults:
        raise InputError(faults[min(faults)])
    return poses


def checked_rows(
    numbers: Float[ndarray, "n k"], convention: str, units: UnitsName, where: str
) -> tuple[Float[ndarray, "n 4 4"], dict[int, str]]:
    """Convert rows of the k numbers of a pose convention to base_from_gripper (m); return also the faults of the rows.

    The faults map the index of each row that is no pose to a message; its pose is NaN. Such a row holds NaN or
    infinity, a position over 10 m from the base, or an invalid rotation. `convention` is a key of CONVENTIONS; `units`
    are such as "mm-deg", or "auto" for the convention's. Raises InputError, begun with `where`, if the size of the
    numbers contradicts the units.
    """
    form = CONVENTIONS[convention]
    per_m, per_rad = form.scales(units)
    names = [f"{where}: pose {k + 1}" for k in range(len(numbers))]
    text = f"holds NaN or infinity (or beyond {HUGE:.0e}); record it again or drop the row"
    unusable = np.asarray(~(np.abs(numbers) < HUGE).all(axis=1))
    faults = {k: f"{names[k]} {text}" for k in np.flatnonzero(unusable).tolist()}
    numbers = np.where(unusable[:, None], 0.0, numbers)
    is_matrix, rest = form.rotation == "matrix", numbers[:, 3:].copy()
    if is_matrix:
        poses = numbers[:, [form.columns.index(name) for name in _ROWS]].reshape(-1, 4, 4)
    else:
        poses = transform(np.eye(3), numbers[:, :3])
    poses[:, :3, 3] *= per_m
    faults |= far_faults(poses[:, :3, 3], where, names)
    _require_units(poses[:, :3, 3], rest, form, units, where)
    if form.rotation in QUATERNIONS:
        length = np.linalg.norm(rest, axis=1)
        for k in np.flatnonzero(np.abs(length - 1) > QUATERNION_TOLERANCE).tolist():
            text = f"its quaternion has length {length[k]:.4g}, not 1; check which columns are the quaternion, and "
            text += "say how it is written (--pose-convention quat-xyzw or quat-wxyz)"
            faults.setdefault(k, f"{names[k]}: {text}")
            rest[k] = [1.0, 0.0, 0.0, 0.0]
        poses[:, :3, :3] = Rotation.from_quat(rest[:, QUATERNIONS[form.rotation]]).as_matrix()
    elif form.rotation == "rotvec":
        poses[:, :3, :3] = Rotation.from_rotvec(rest * per_rad).as_matrix()
    elif not is_matrix:
        poses[:, :3, :3] = Rotation.from_euler(form.rotation, rest * per_rad).as_matrix()
    for k in range(len(poses)) if is_matrix else ():
        try:
            poses[k] = require_rigid(poses[k], names[k])
        except InputError as error:
            faults.setdefault(k, str(error))
    poses[list(faults)] = np.nan
    return poses, faults


def tolerated(count: int) -> int:
    """Return the number of faulty frames among `count` that may be left out: a quarter, rounded down, at least one."""
    return max(1, count // 4)


def far_faults(position: Float[ndarray, "n 3"], where: str, names: Sequence[str]) -> dict[int, str]:
    """Return a message for each position (m, base frame) that is more than 10 m from the base, by the index of its row.

    Raises InputError, begun with `where`, if more rows are that far than `tolerated` permits, or the only row is. Wrong
    units are then the cause. `names` are the names of the rows in the messages. NaN counts as 0.
    """
    distance = np.linalg.norm(np.nan_to_num(position), axis=1)
    rows = np.flatnonzero(distance > METRES_LIMIT).tolist()
    if len(rows) > tolerated(len(distance)) or (rows and len(distance) == 1):
        farthest = float(distance.max())
        is_cm = farthest < 1000 * LEAST_REACH
        name, short, a_metre = ("centimetres", "cm", 100) if is_cm else ("millimetres", "mm", 1000)
        raise InputError(
            f"{where}: the gripper is up to {farthest:.4g} from the base; these look like {name}: divide the "
            f"translations by {a_metre} (a pose table: add --pose-units {short}-rad, or {short}-deg where angles are in "
            "degrees)"
        )
    text = "m from the base, the others are nearer; record it again"
    return {k: f"{names[k]} is {distance[k]:.4g} {text}" for k in rows}


def _require_units(
    position: Float[ndarray, "n 3"],
    rest: Float[ndarray, "n r"],
    form: Convention,
    units: UnitsName,
    where: str,
) -> None:
    """Raise InputError if angles are too large or, for `units` "auto", angles or positions too small for their unit.

    `position` is in m, in the base frame; `rest` has the numbers of the rotation as written, in the convention `form`.
    Too large are angles over 2π in radians. Too small are sets of poses with all angles below 2π in degrees, or all
    positions within 10 mm. The message begins with `where` and names the option that helps.
    """
    per_m, per_rad = form.scales(units)
    farthest = float(np.linalg.norm(position, axis=1).max(initial=0.0)) / per_m
    largest = float(np.abs(rest).max(initial=0.0)) if form.has_angles else 0.0
    if units == "auto" and per_m < 1 and 0 < farthest < METRES_LIMIT:
        raise InputError(
            f"{where}: the gripper is at most {farthest:.4g} from the base, too near for this convention's "
            "millimetres; for metres add --pose-units m-deg (or m-rad)"
        )
    if per_rad == 1.0 and largest > RADIANS_LIMIT:
        raise InputError(
            f"{where}: angles go up to {largest:.4g}; these look like degrees: add --pose-units m-deg "
            "(or mm-deg where positions are in millimetres)"
        )
    if units == "auto" and per_rad < 1.0 and 0 < largest < RADIANS_LIMIT:
        raise InputError(
            f"{where}: angles are at most {largest:.3g}, too small for this convention's degrees; "
            "for radians add --pose-units mm-rad (or m-rad)"
        )
