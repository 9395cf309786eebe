"""Conventions in which robots and their controllers write poses: rows of numbers to transforms and back."""

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
    numbers: Float[ndarray, "n k"], convention: str, units: UnitsName, where: str
) -> Float[ndarray, "n 4 4"]:
    """Return base_from_gripper (n,4,4) of rows as `checked_rows`; raise InputError where a row is no pose."""
    poses, faults = checked_rows(numbers, convention, units, where)
    if faults:
        raise InputError(faults[min(faults)])
    return poses


def checked_rows(
    numbers: Float[ndarray, "n k"], convention: str, units: UnitsName, where: str
) -> tuple[Float[ndarray, "n 4 4"], dict[int, str]]:
    """Return base_from_gripper (n,4,4) of rows in a convention's columns, and the messages of rows that are no pose.

    The pose of such a row is NaN. `units` other than auto override the convention's own. Raises InputError on units
    that cannot be meant, and on matrices by columns in place of rows.
    """
    form = CONVENTIONS[convention]
    per_m, per_rad = _in_metres_and_radians(form, units)
    finite = np.asarray((np.abs(numbers) < HUGE).all(axis=1))
    if form.rotation == "rows":
        _require_rows(numbers[finite].reshape(-1, 4, 4), where)
    at = {"rows": [3, 7, 11], "columns": [12, 13, 14]}.get(form.rotation, [0, 1, 2])
    faults = _check_units(np.where(finite[:, None], numbers, 0.0), at, form, units, where)
    poses = np.full((len(numbers), 4, 4), np.nan)
    for row in range(len(numbers)):
        if not finite[row]:
            text = f"holds NaN or infinity (or beyond {HUGE:.0e}); record it again or drop the row"
            faults[row] = f"{where}: pose {row + 1} {text}"
        if row not in faults:
            try:
                poses[row] = _pose(numbers[row], form, per_m, per_rad, f"{where}: pose {row + 1}")
            except InputError as error:
                faults[row] = str(error)
    return poses, faults


def _pose(
    numbers: Float[ndarray, " k"], form: Convention, per_m: float, per_rad: float, where: str
) -> Float[ndarray, "4 4"]:
    """Return base_from_gripper of the numbers of one pose; raise InputError where they are none."""
    if form.rotation in ("rows", "columns"):
        rows = numbers.reshape(4, 4) if form.rotation == "rows" else numbers.reshape(4, 4).T
        matrix = transform(rows[:3, :3], rows[:3, 3] * per_m)
        matrix[3] = rows[3]
        return require_rigid(matrix, where)
    if form.rotation in QUATERNIONS:
        quaternion = numbers[3:][QUATERNIONS[form.rotation]]
        if abs((length := float(np.linalg.norm(quaternion))) - 1) > QUATERNION_TOLERANCE:
            raise InputError(
                f"{where}: its quaternion has length {length:.4g}, not 1; check which columns are the quaternion, and "
                "say how it is written (--pose-convention quat-xyzw or quat-wxyz)"
            )
        rotation = Rotation.from_quat(quaternion)
    elif form.rotation == "rotvec":
        rotation = Rotation.from_rotvec(numbers[3:] * per_rad)
    else:
        rotation = Rotation.from_euler(form.rotation, numbers[3:] * per_rad)
    return transform(rotation.as_matrix(), numbers[:3] * per_m)


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


def _require_rows(matrices: Float[ndarray, "n 4 4"], where: str) -> None:
    """Raise InputError where numbers that should be matrices by rows are by columns."""
    last = [0, 0, 0, 1]
    if np.allclose(matrices[:, :, 3], last, atol=1e-9) and not np.allclose(matrices[:, 3], last, atol=1e-9):
        raise InputError(
            f"{where}: the 16 numbers of a pose are a matrix by columns, as a Franka gives them: add "
            "--pose-convention franka"
        )


def _in_metres_and_radians(form: Convention, units: UnitsName) -> tuple[float, float]:
    """Return metres per unit of position, radians per unit of angle."""
    length, angle = form.units(units)
    return METRES[length], np.radians(1.0) if angle == "deg" else 1.0


def _check_units(
    numbers: Float[ndarray, "n k"], at: list[int], form: Convention, units: UnitsName, where: str
) -> dict[int, str]:
    """Return messages of single rows that are too far away; raise InputError on units that cannot be meant.

    `at` are the columns of the position.
    """
    per_m, per_rad = _in_metres_and_radians(form, units)
    position = numbers[:, at] * per_m
    far, farthest, many = far_rows(position)
    if many or len(position) == 1 and far:
        name, short, _ = likely_unit(farthest)
        raise InputError(
            f"{where}: the gripper is up to {farthest / per_m:.4g} from the base; these look like {name}: "
            f"add --pose-units {short}-rad (or {short}-deg where angles are in degrees)"
        )
    if units == "auto" and per_m < 1 and 0 < farthest < METRES_LIMIT * per_m:
        raise InputError(
            f"{where}: the gripper is at most {farthest / per_m:.4g} from the base, too near for this convention's "
            "millimetres; for metres add --pose-units m-deg (or m-rad)"
        )
    largest = float(np.abs(numbers[:, 3:]).max(initial=0.0)) if form.has_angles else 0.0
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
    text = "pose {} is {:.4g} m from the base, the others are nearer; record it again"
    distance = np.linalg.norm(position, axis=1)
    return {row: f"{where}: {text.format(row + 1, distance[row])}" for row in far}
