"""Poses as robots and their controllers write them: rows of numbers to transforms, and nothing of files."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.options import UnitsName
from jcr.errors import InputError
from jcr.geometry import HUGE, require_rigid, transform

QUATERNION_TOLERANCE = 1e-2
"""On its length; three printed digits pass."""
METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Of a unit of length."""
RADIANS_LIMIT = 2 * np.pi + 0.01
"""No angle in radians is larger, and no wrist worth calibrating keeps all of its angles smaller in degrees."""
LEAST_REACH = 0.25
"""m: no arm with a camera stays nearer to its base."""
METRES_LIMIT = 10.0
"""No position in metres is larger, and no gripper is always within 1 cm of its base in millimetres."""


@dataclass(frozen=True)
class Convention:
    """How one kind of controller writes a pose."""

    columns: tuple[str, ...]
    """Names of its numbers, in order: position first, unless it is a whole matrix."""
    millimetres: bool = False
    degrees: bool = False
    rotation: Callable[[Float[ndarray, "n k"]], Float[ndarray, "n 3 3"]] | None = None
    """Of the numbers after the position, angles in radians; None: a matrix."""
    quaternion: bool = False
    numbers: Callable[[Rotation], Float[ndarray, "n k"]] | None = None
    """The way back: `rotation`'s numbers of rotations."""


def _euler(order: str) -> Callable[[Float[ndarray, "n 3"]], Float[ndarray, "n 3 3"]]:
    """SciPy's order: lower case about fixed axes, upper case about moving ones."""
    return lambda angles: Rotation.from_euler(order, angles).as_matrix()


def _as_euler(order: str) -> Callable[[Rotation], Float[ndarray, "n 3"]]:
    return lambda rotation: rotation.as_euler(order)


def _as_quat_wxyz(rotation: Rotation) -> Float[ndarray, "n 4"]:
    return rotation.as_quat(canonical=True)[:, [3, 0, 1, 2]]


def _as_quat_xyzw(rotation: Rotation) -> Float[ndarray, "n 4"]:
    return rotation.as_quat(canonical=True)


def _quat_xyzw(quat_xyzw: Float[ndarray, "n 4"]) -> Float[ndarray, "n 3 3"]:
    return Rotation.from_quat(quat_xyzw).as_matrix()


def _quat_wxyz(quat_wxyz: Float[ndarray, "n 4"]) -> Float[ndarray, "n 3 3"]:
    return Rotation.from_quat(quat_wxyz[:, [1, 2, 3, 0]]).as_matrix()


def _rotation_vector(vector: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
    return Rotation.from_rotvec(vector).as_matrix()


_XYZ = ("x", "y", "z")
_XYZW, _WXYZ = ("qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz")
_VECTOR, _RPY = ("rx", "ry", "rz"), ("roll", "pitch", "yaw")
_ROWS = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
_COLUMNS = tuple(f"m{row}{column}" for column in range(4) for row in range(4))

# "xyz" about fixed axes is Rz(yaw)·Ry(pitch)·Rx(roll); "ZYX" about moving ones is Rz(A)·Ry(B)·Rx(C).
CONVENTIONS = {
    "matrix": Convention(_ROWS),
    "quat-xyzw": Convention(_XYZ + _XYZW, rotation=_quat_xyzw, quaternion=True, numbers=_as_quat_xyzw),
    "quat-wxyz": Convention(_XYZ + _WXYZ, rotation=_quat_wxyz, quaternion=True, numbers=_as_quat_wxyz),
    "rotation-vector": Convention(_XYZ + _VECTOR, rotation=_rotation_vector, numbers=Rotation.as_rotvec),
    "rpy": Convention(_XYZ + _RPY, rotation=_euler("xyz"), numbers=_as_euler("xyz")),
    "ur": Convention(_XYZ + _VECTOR, rotation=_rotation_vector, numbers=Rotation.as_rotvec),
    "franka": Convention(_COLUMNS),
    "xarm": Convention(_XYZ + _RPY, True, True, _euler("xyz"), numbers=_as_euler("xyz")),
    "xarm-axis-angle": Convention(_XYZ + _VECTOR, True, True, _rotation_vector, numbers=Rotation.as_rotvec),
    "kuka": Convention((*_XYZ, "a", "b", "c"), True, True, _euler("ZYX"), numbers=_as_euler("ZYX")),
    "fanuc": Convention((*_XYZ, "w", "p", "r"), True, True, _euler("xyz"), numbers=_as_euler("xyz")),
    "yaskawa": Convention(_XYZ + _VECTOR, True, True, _euler("xyz"), numbers=_as_euler("xyz")),
    "abb": Convention((*_XYZ, "q1", "q2", "q3", "q4"), True, False, _quat_wxyz, True, numbers=_as_quat_wxyz),
    "unitree": Convention(_XYZ + _RPY, rotation=_euler("xyz"), numbers=_as_euler("xyz")),
    "realman": Convention(_XYZ + _WXYZ, rotation=_quat_wxyz, quaternion=True, numbers=_as_quat_wxyz),
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
"""What the controller of an arm (handeye.arms.ROBOT_NAMES) writes."""


def units_of(convention: str) -> str:
    """The units of a convention's numbers, for people: "m, rad", "mm, °", or "m" where no angle is among them."""
    form = CONVENTIONS[convention]
    length = "mm" if form.millimetres else "m"
    return (
        length if form.rotation is None or form.quaternion else f"{length}, {'°' if form.degrees else 'rad'}"
    )


def numbers_from_poses(
    base_from_gripper: Float[ndarray, "n 4 4"], convention: str, units: UnitsName = "auto"
) -> Float[ndarray, "n k"]:
    """Rows in a convention's columns, the inverse of `poses_from_numbers`; `units` likewise."""
    form = CONVENTIONS[convention]
    position_unit, angle_unit = _units(form, units)
    if form.numbers is None:
        matrices = base_from_gripper.copy()
        matrices[:, :3, 3] /= position_unit
        return (np.swapaxes(matrices, 1, 2) if convention == "franka" else matrices).reshape(-1, 16)
    turn = form.numbers(Rotation.from_matrix(base_from_gripper[:, :3, :3]))
    return np.hstack(
        [base_from_gripper[:, :3, 3] / position_unit, turn / (1.0 if form.quaternion else angle_unit)]
    )


def poses_from_numbers(
    numbers: Float[ndarray, "n k"], convention: str, units: UnitsName, where: str
) -> Float[ndarray, "n 4 4"]:
    """base_from_gripper (n,4,4) from rows in a convention's columns; `units` other than auto override its own.

    Raises InputError on numbers that are no pose, and on units that cannot be meant.
    """
    form = CONVENTIONS[convention]
    sound = (np.abs(numbers) < HUGE).all(1)
    if not sound.all():
        row = int(np.argmin(sound))
        raise InputError(
            f"{where}: pose {row + 1} holds NaN or infinity (or beyond {HUGE:.0e}); record it again or drop the row"
        )
    position_unit, angle_unit = _units(form, units)
    if form.rotation is None:
        matrices = numbers.reshape(-1, 4, 4)
        if convention == "franka":
            matrices = np.swapaxes(matrices, 1, 2)
        elif np.allclose(matrices[:, :, 3], [0, 0, 0, 1], atol=1e-9) and not np.allclose(
            matrices[:, 3], [0, 0, 0, 1], atol=1e-9
        ):
            raise InputError(
                f"{where}: the 16 numbers of a pose are a matrix by columns, as a Franka gives them: add "
                "--pose-convention franka"
            )
        matrices = matrices.copy()
        matrices[:, :3, 3] *= position_unit
        _check_position(matrices[:, :3, 3], position_unit, units, where)
        rigid = [require_rigid(matrix, f"{where}: pose {i + 1}") for i, matrix in enumerate(matrices)]
        return np.reshape(rigid, (-1, 4, 4))
    position, turn = numbers[:, :3] * position_unit, numbers[:, 3:]
    _check_position(position, position_unit, units, where)
    if form.quaternion:
        _check_quaternion(turn, where)
    else:
        _check_angles(turn, angle_unit, units, where)
        turn = turn * angle_unit
    return transform(form.rotation(turn), position)


def _units(form: Convention, units: UnitsName) -> tuple[float, float]:
    """Metres per unit of position, radians per unit of angle."""
    length, angle = ("mm" if form.millimetres else "m", "deg" if form.degrees else "rad")
    if units != "auto":
        length, angle = units.split("-")
    return METRES[length], np.radians(1.0) if angle == "deg" else 1.0


def likely_unit(farthest: float) -> tuple[str, str, int]:
    """The unit of positions up to so far from the base, too far for metres; its sign, and how many are a metre."""
    return ("centimetres", "cm", 100) if farthest < 1000 * LEAST_REACH else ("millimetres", "mm", 1000)


def _check_quaternion(quaternion: Float[ndarray, "n 4"], where: str) -> None:
    length = np.linalg.norm(quaternion, axis=1)
    off = np.abs(length - 1) > QUATERNION_TOLERANCE
    if off.any():
        row = int(off.argmax())
        raise InputError(
            f"{where}: the quaternion of pose {row + 1} has length {length[row]:.4g}, not 1; check which columns "
            "are the quaternion, and say how it is written (--pose-convention quat-xyzw or quat-wxyz)"
        )


def _check_position(position: Float[ndarray, "n 3"], unit: float, units: UnitsName, where: str) -> None:
    farthest = float(np.linalg.norm(position, axis=1).max(initial=0.0))
    if farthest > METRES_LIMIT:
        name, short, _ = likely_unit(farthest)
        raise InputError(
            f"{where}: the gripper is up to {farthest / unit:.4g} from the base; these look like {name}: "
            f"add --pose-units {short}-rad (or {short}-deg where angles are in degrees)"
        )
    if units == "auto" and unit < 1 and 0 < farthest < METRES_LIMIT * unit:
        raise InputError(
            f"{where}: the gripper is at most {farthest / unit:.4g} from the base, too near for this convention's "
            "millimetres; for metres add --pose-units m-deg (or m-rad)"
        )


def _check_angles(angles: Float[ndarray, "n 3"], unit: float, units: UnitsName, where: str) -> None:
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
