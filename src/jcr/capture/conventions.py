"""Conventions in which robots and their controllers write poses: rows of numbers to transforms and back."""

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
"""Largest difference of a quaternion's length from 1: three printed digits are within it."""
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Metres in each unit of length."""
RADIANS_LIMIT = 2 * np.pi + 0.01
"""Largest angle in radians; the angles of a wrist in degrees are larger."""
LEAST_REACH = 0.25
"""Smallest reach of an arm with a camera, m."""
METRES_LIMIT = 10.0
"""Largest distance of a gripper from its base in metres; in millimetres no gripper stays that near."""


QUATERNIONS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}
"""Notations of quaternions, and where x, y, z, w stand in each."""


@dataclass(frozen=True)
class Convention:
    """Notation and units of the poses of one kind of controller."""

    columns: tuple[str, ...]
    """Names of its numbers, in order: position first, unless it is a whole matrix."""
    rotation: str
    """Notation after the position: one of QUATERNIONS, `rotvec`, or SciPy's order of Euler angles, lower case about
    fixed axes, upper case about moving ones; `rows` or `columns` of a whole matrix."""
    length: str = "m"
    angle: str = "rad"

    @property
    def has_angles(self) -> bool:
        """Presence of angles, which have a unit."""
        return self.rotation not in (*QUATERNIONS, "rows", "columns")

    def units(self, asked: UnitsName = "auto") -> tuple[str, str]:
        """Return the names of the units of positions and angles, the convention's own or the given: ("mm", "deg")."""
        length, _, angle = (f"{self.length}-{self.angle}" if asked == "auto" else asked).partition("-")
        return length, angle


_XYZ = ("x", "y", "z")
_XYZW, _WXYZ = ("qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz")
_VECTOR, _RPY = ("rx", "ry", "rz"), ("roll", "pitch", "yaw")
_ROWS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_COLUMNS = tuple(f"m{row}{column}" for column in range(4) for row in range(4))

# "xyz" about fixed axes is Rz(yaw)·Ry(pitch)·Rx(roll); "ZYX" about moving ones is Rz(A)·Ry(B)·Rx(C).
CONVENTIONS = {
    "matrix": Convention(_ROWS, "rows"),
    "quat-xyzw": Convention(_XYZ + _XYZW, "xyzw"),
    "quat-wxyz": Convention(_XYZ + _WXYZ, "wxyz"),
    "rotation-vector": Convention(_XYZ + _VECTOR, "rotvec"),
    "rpy": Convention(_XYZ + _RPY, "xyz"),
    "ur": Convention(_XYZ + _VECTOR, "rotvec"),
    "franka": Convention(_COLUMNS, "columns"),
    "xarm": Convention(_XYZ + _RPY, "xyz", "mm", "deg"),
    "xarm-axis-angle": Convention(_XYZ + _VECTOR, "rotvec", "mm", "deg"),
    "kuka": Convention((*_XYZ, "a", "b", "c"), "ZYX", "mm", "deg"),
    "fanuc": Convention((*_XYZ, "w", "p", "r"), "xyz", "mm", "deg"),
    "yaskawa": Convention(_XYZ + _VECTOR, "xyz", "mm", "deg"),
    "abb": Convention((*_XYZ, "q1", "q2", "q3", "q4"), "wxyz", "mm"),
    "unitree": Convention(_XYZ + _RPY, "xyz"),
    "realman": Convention(_XYZ + _WXYZ, "wxyz"),
}


OF_ARM = {
    "ur3e": "ur",
    "ur5e": "ur",
    "ur10e": "ur",
    "panda": "franka",
    "fr3": "franka",
    "iiwa7": "kuka",
    "iiwa14": "kuka",
    "xarm6": "xarm",
    "xarm7": "xarm",
    "z1": "unitree",
}
"""Convention of the controller of each arm of estimation.arms.ROBOT_NAMES."""


def units_of(convention: str) -> str:
    """Return the units of a convention's numbers as text: "m, rad", "mm, °", or "m" without angles."""
    form = CONVENTIONS[convention]
    return f"{form.length}, {form.angle.replace('deg', '°')}" if form.has_angles else form.length


def numbers_from_poses(
    base_from_gripper: Float[ndarray, "n 4 4"], convention: str, units: UnitsName = "auto"
) -> Float[ndarray, "n k"]:
    """Return rows in a convention's columns, the inverse of `poses_from_numbers`."""
    form = CONVENTIONS[convention]
    position_unit, angle_unit = _in_metres_and_radians(form, units)
    position = base_from_gripper[:, :3, 3] / position_unit
    if form.rotation in ("rows", "columns"):
        matrices = transform(base_from_gripper[:, :3, :3], position)
        return (np.swapaxes(matrices, 1, 2) if form.rotation == "columns" else matrices).reshape(-1, 16)
    rotation = Rotation.from_matrix(base_from_gripper[:, :3, :3])
    if form.rotation in QUATERNIONS:
        order = np.argsort(QUATERNIONS[form.rotation])
        return np.hstack([position, rotation.as_quat(canonical=True)[:, order]])
    angles = rotation.as_rotvec() if form.rotation == "rotvec" else rotation.as_euler(form.rotation)
    return np.hstack([position, angles / angle_unit])


def poses_from_numbers(
    numbers: Float[ndarray, "n k"],
    convention: str,
    units: UnitsName,
    where: str,
    faults: dict[int, str] | None = None,
) -> Float[ndarray, "n 4 4"]:
    """Return base_from_gripper (n,4,4) of rows in a convention's columns; `units` other than auto override its own.

    Raises InputError on units that cannot be meant. A row that is no pose raises InputError too; where `faults` are
    given, a few such rows are NaN and their messages are added.
    """
    form = CONVENTIONS[convention]
    unit_m, _ = _in_metres_and_radians(form, units)
    found = dict(faults or {})
    for row in np.flatnonzero(~(np.abs(numbers) < HUGE).all(1)).tolist():
        text = f"holds NaN or infinity (or beyond {HUGE:.0e}); record it again or drop the row"
        found.setdefault(row, f"{where}: pose {row + 1} {text}")
    rows = [row for row in range(len(numbers)) if row not in found]
    poses, position = np.full((len(numbers), 4, 4), np.nan), np.full((len(numbers), 3), np.nan)
    matrices = None
    if form.rotation in ("rows", "columns"):
        matrices = _matrices(numbers[rows].reshape(-1, 4, 4), form, where)
        matrices[:, :3, 3] *= unit_m
    position[rows] = numbers[rows, :3] * unit_m if matrices is None else matrices[:, :3, 3]
    _check_position(position, unit_m, units, where, found)
    if matrices is None:
        rotation = _rotations(numbers[rows, 3:], form, units, where, rows, found)
        poses[rows] = transform(rotation.as_matrix(), position[rows])
    for row, matrix in zip(rows, () if matrices is None else matrices, strict=matrices is not None):
        try:
            poses[row] = require_rigid(matrix, f"{where}: pose {row + 1}")
        except InputError as error:
            found[row] = str(error)
    if found and (faults is None or len(found) > tolerated(len(numbers))):
        raise InputError(found[min(found)])
    if faults is not None:
        faults |= found
    poses[list(found)] = np.nan
    return poses


def tolerated(count: int) -> int:
    """Return how many of a number of frames may be left out as faulty; more of them have a common cause."""
    return max(1, count // 4)


def likely_unit(farthest: float) -> tuple[str, str, int]:
    """Return the unit of positions too far away for metres: its name, its sign, and how many are a metre."""
    return ("centimetres", "cm", 100) if farthest < 1000 * LEAST_REACH else ("millimetres", "mm", 1000)


def far_rows(position: Float[ndarray, "n 3"]) -> tuple[list[int], float, bool]:
    """Return the rows that are too far from the base for metres, the farthest distance, and whether they are many."""
    distance = np.linalg.norm(np.nan_to_num(position), axis=1)
    rows = np.flatnonzero(distance > METRES_LIMIT).tolist()
    return rows, float(distance.max(initial=0.0)), len(rows) > tolerated(len(distance))


def _matrices(numbers: Float[ndarray, "n 4 4"], form: Convention, where: str) -> Float[ndarray, "n 4 4"]:
    """Return a copy by rows; InputError where numbers that should be rows are columns."""
    if form.rotation == "columns":
        return np.swapaxes(numbers, 1, 2).copy()
    last = [0, 0, 0, 1]
    if np.allclose(numbers[:, :, 3], last, atol=1e-9) and not np.allclose(numbers[:, 3], last, atol=1e-9):
        raise InputError(
            f"{where}: the 16 numbers of a pose are a matrix by columns, as a Franka gives them: add "
            "--pose-convention franka"
        )
    return numbers.copy()


def _rotations(
    numbers: Float[ndarray, "n r"],
    form: Convention,
    units: UnitsName,
    where: str,
    row_of: Sequence[int],
    found: dict[int, str],
) -> Rotation:
    """Return the rotations of quaternions, vectors or angles; rows whose quaternion has no unit length go to `found`."""
    if form.rotation not in QUATERNIONS:
        unit = _in_metres_and_radians(form, units)[1]
        _check_angles(numbers, unit, units, where)
        if form.rotation == "rotvec":
            return Rotation.from_rotvec(numbers * unit)
        return Rotation.from_euler(form.rotation, numbers * unit)
    quaternion = numbers[:, QUATERNIONS[form.rotation]]
    length = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(length - 1) > QUATERNION_TOLERANCE
    for k in np.flatnonzero(wrong).tolist():
        found[row_of[k]] = (
            f"{where}: the quaternion of pose {row_of[k] + 1} has length {length[k]:.4g}, not 1; check which columns "
            "are the quaternion, and say how it is written (--pose-convention quat-xyzw or quat-wxyz)"
        )
    return Rotation.from_quat(np.where(wrong[:, None], [0.0, 0.0, 0.0, 1.0], quaternion))


def _in_metres_and_radians(form: Convention, units: UnitsName) -> tuple[float, float]:
    """Return metres per unit of position, radians per unit of angle."""
    length, angle = form.units(units)
    return METRES[length], np.radians(1.0) if angle == "deg" else 1.0


def _check_position(
    position: Float[ndarray, "n 3"], unit: float, units: UnitsName, where: str, found: dict[int, str]
) -> None:
    """Raise InputError where most positions cannot be in the unit; a single one that is too far goes to `found`."""
    far, farthest, many = far_rows(position)
    if many or len(position) == 1 and far:
        name, short, _ = likely_unit(farthest)
        raise InputError(
            f"{where}: the gripper is up to {farthest / unit:.4g} from the base; these look like {name}: "
            f"add --pose-units {short}-rad (or {short}-deg where angles are in degrees)"
        )
    for row in far:
        distance = float(np.linalg.norm(position[row]))
        text = f"pose {row + 1} is {distance:.4g} m from the base, the others are nearer; record it again"
        found.setdefault(row, f"{where}: {text}")
    if units == "auto" and unit < 1 and 0 < farthest < METRES_LIMIT * unit:
        raise InputError(
            f"{where}: the gripper is at most {farthest / unit:.4g} from the base, too near for this convention's "
            "millimetres; for metres add --pose-units m-deg (or m-rad)"
        )


def _check_angles(angles: Float[ndarray, "n 3"], unit: float, units: UnitsName, where: str) -> None:
    """Raise InputError where angles cannot be in the unit."""
    largest = float(np.abs(angles).max(initial=0.0))
    if unit == 1.0 and largest > RADIANS_LIMIT:
        raise InputError(
            f"{where}: angles go up to {largest:.4g}; these look like degrees: add --pose-units m-deg "
            "(or mm-deg where positions are in millimetres)"
        )
    if units == "auto" and unit < 1.0 and 0 < largest < RADIANS_LIMIT:
        raise InputError(
            f"{where}: angles are at most {largest:.3g}, too small for this convention's degrees; "
            "for radians add --pose-units mm-rad (or m-rad)"
        )
