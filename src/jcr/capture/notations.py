"""Notations of rotations, names of robot makers for them, and the conversion of rows of numbers to transforms."""

import warnings

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.options import tolerated
from jcr.errors import InputError, did_you_mean, shown
from jcr.geometry import nearest_rotation, transform
from jcr.number_format import HUGE, significant

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Metres in each unit of length."""
RADIANS_LIMIT = 2 * np.pi + 0.01
"""Largest plausible angle of a pose in radians; larger numbers are degrees."""
METRES_LIMIT = 10.0
"""Largest plausible distance of a gripper from its base, m: the longest industrial arms reach 5 m, portals 10 m."""
NEAR_BASE = 200.0
"""Distance of all grippers from the base, in the unit as written, below which numbers that are no metres may be
centimetres as well as millimetres: no arm has all its poses within 200 mm of its base, and few reach beyond 2 m. With
300 the smallest arms (myCobot 280) would be asked; with 100, poses that are written in centimetres and go up to 1.5 m
are read ten times too small."""
FAR_FRAME = (
    "the base frame is far away: subtract one offset from all, or give the poses in the arm's own base frame"
)
"""Cause and remedy of positions that are near each other and far from the origin."""
UNIT_TOLERANCE = 1e-2
"""Largest accepted difference from 1 of a quaternion's length and of a matrix axis; three digits suffice."""
SEQUENCES = (
    *("xyz", "ZYX", "ZYZ", "XYZ", "zyx", "zyz", "xzy", "yxz", "yzx", "zxy", "XZY", "YXZ", "YZX", "ZXY"),
    *("xyx", "xzx", "yxy", "yzy", "zxz", "XYX", "XZX", "YXY", "YZY", "ZXZ"),
)
"""Sequences of Euler angles in SciPy's notation (lower case: fixed axes, upper case: moving axes), usual ones first."""
EULERS = tuple(f"euler:{sequence}" for sequence in SEQUENCES)
NUMBERS = {"quat:xyzw": 4, "quat:wxyz": 4, "rotvec": 3, "matrix": 9, "matrix:columns": 9} | dict.fromkeys(
    EULERS, 3
)
"""Notations of a rotation, and how many numbers each has."""


# "euler:xyz" about fixed axes is Rz(third)·Ry(second)·Rx(first); "euler:ZYX" is Rz(first)·Ry(second)·Rx(third).
MAKERS = {
    "rpy": "euler:xyz",  # ROS, REP 103 and URDF: roll, pitch, yaw about fixed axes
    "ur": "rotvec",  # Universal Robots, The URScript Programming Language, pose p[x, y, z, rx, ry, rz]
    "franka": "matrix:columns",  # Franka, libfranka, RobotState::O_T_EE: column-major 4x4
    "xarm": "euler:xyz",  # UFACTORY, xArm Developer Manual: roll, pitch, yaw about fixed axes
    "xarm-axis-angle": "rotvec",  # UFACTORY, xArm Developer Manual: axis-angle pose
    "kuka": "euler:ZYX",  # KUKA, System Software operating manual: A about Z, B about Y, C about X
    "fanuc": "euler:xyz",  # FANUC, operator's manual of the R-30iB: W, P, R about fixed X, Y, Z
    "yaskawa": "euler:xyz",  # Yaskawa, DX200 operator's manual: Rx, Ry, Rz about fixed X, Y, Z
    "abb": "quat:wxyz",  # ABB, RAPID technical reference manual, data type orient: q1 is the scalar
    "unitree": "euler:xyz",  # Unitree, Z1 SDK: roll, pitch, yaw
    "realman": "euler:xyz",  # RealMan, RM API2, rm_euler_t: rx, ry, rz about fixed axes
    "doosan": "euler:ZYZ",  # Doosan Robotics, programming manual, posx: A, B, C are Z-Y-Z
    "kawasaki": "euler:ZYZ",  # Kawasaki, AS Language reference manual: O, A, T are Z-Y-Z
    "staubli": "euler:XYZ",  # Stäubli, VAL 3 reference manual, type trsf: rx, ry, rz about moving X, Y, Z
    "mecademic": "euler:XYZ",  # Mecademic, Meca500 programming manual: mobile X-Y-Z
    "techman": "euler:xyz",  # Techman Robot, TMflow expression editor: RX, RY, RZ with R = Rz·Ry·Rx
    "aubo": "euler:xyz",  # AUBO, ARCS interface description: rx, ry, rz with R = Rz·Ry·Rx
    "jaka": "euler:xyz",  # JAKA, SDK manual, type Rpy: rx, ry, rz about fixed axes
    "epson": "euler:ZYX",  # Epson, RC+ user's guide: U about Z, V about Y, W about X
}
"""Notation of each maker, with the document that states it; units differ between the products of a maker, and follow
from the numbers or `--pose-units`."""


def notation_of(name: str) -> str:
    """Return the notation for a value of `--pose-convention`, a notation or a maker; raise InputError for others."""
    notation = MAKERS.get(name, name)
    sequence = notation.removeprefix("euler:")
    if notation in NUMBERS or (notation == f"euler:{sequence}" and sequence in SEQUENCES):
        return notation
    known = (*[one for one in NUMBERS if one not in EULERS], "euler:ZYX", *MAKERS)
    raise InputError(
        f"--pose-convention {shown(name)}: not one of {', '.join(known)} (any sequence of x, y, z about fixed or "
        f"X, Y, Z about moving axes){did_you_mean(name, (*NUMBERS, *MAKERS))}"
    )


def in_words(notation: str, angle: str = "") -> str:
    """Return a notation of a rotation in words, such as "angles zyx in degrees, R = Rx·Ry·Rz".

    `angle` is the unit "deg" or "rad"; empty: none is stated.
    """
    unit = {"deg": " in degrees", "rad": " in radians", "": ""}[angle]
    if notation == "rotvec":
        return f"rotation vector{unit}"
    if notation.startswith("quat:"):
        return f"quaternion {', '.join(notation[5:])}"
    if notation.startswith("matrix"):
        return "rotation matrix by columns" if notation.endswith("columns") else "rotation matrix"
    sequence = notation[6:]
    product = sequence[::-1] if sequence.islower() else sequence
    return f"angles {sequence}{unit}, R = {'·'.join(f'R{axis.lower()}' for axis in product)}"


def rotations_of(
    numbers: Float[ndarray, "n k"], notation: str, radians: float = 1.0
) -> Float[ndarray, "n 3 3"]:
    """Return the rotations that n rows of numbers describe in a notation; NaN for a row that is no rotation.

    `radians` is the size of the unit of angles. A quaternion whose length, or a matrix whose axes differ from 1 by more
    than 1 % is no rotation; nor is a mirrored matrix.
    """
    made = np.full((len(numbers), 3, 3), np.nan)
    sound = np.asarray((np.abs(np.nan_to_num(numbers, nan=np.inf)) < HUGE).all(axis=1))
    if notation.startswith("quat:"):
        sound &= np.abs(np.linalg.norm(np.where(sound[:, None], numbers, 0.0), axis=1) - 1) < UNIT_TOLERANCE
        order = [notation[5:].index(axis) for axis in "xyzw"]
        if not sound.any():  # SciPy 1.11 takes no empty arrays
            return made
        made[sound] = Rotation.from_quat(numbers[sound][:, order]).as_matrix()
    elif notation.startswith("matrix"):
        matrix = numbers.reshape(-1, 3, 3)
        matrix = np.swapaxes(matrix, 1, 2) if notation.endswith("columns") else matrix
        usable = np.where(sound[:, None, None], matrix, np.zeros((3, 3)))
        gap = np.abs(usable @ np.swapaxes(usable, 1, 2) - np.eye(3)).max((1, 2))
        sound &= (gap < 2 * UNIT_TOLERANCE) & (np.linalg.det(usable) > 0)
        made[sound] = nearest_rotation(matrix[sound])
    elif not sound.any():
        return made
    elif notation == "rotvec":
        made[sound] = Rotation.from_rotvec(numbers[sound] * radians).as_matrix()
    else:
        made[sound] = Rotation.from_euler(notation[6:], numbers[sound] * radians).as_matrix()
    return made


def rotation_fault(numbers: Float[ndarray, "n k"], notation: str) -> str:
    """Return why n rows of numbers are no rotations in a notation of quaternions or matrices, with the remedy."""
    is_quaternion = notation.startswith("quat:")
    axes = numbers[:, None] if is_quaternion else numbers.reshape(-1, 3, 3)
    lengths = np.linalg.norm(axes[np.isfinite(axes).all((1, 2))], axis=2)
    low, high = (significant(float(end)) for end in np.percentile(lengths, (10, 90)))
    size = f"the length {low}" if low == high else f"lengths of {low} to {high}"
    if is_quaternion:
        return f"have {size} instead of 1; correct or normalise them"
    if (np.abs(lengths - 1) < UNIT_TOLERANCE).mean() > 0.5:
        is_mirrored = np.median(np.linalg.det(axes)) < 0
        return f"are no rotations: {'they are mirrored' if is_mirrored else 'their axes are oblique'}; correct them"
    return f"are no rotations: their axes have {size} instead of 1; correct them"


def numbers_of(rotation: Float[ndarray, "n 3 3"], notation: str) -> Float[ndarray, "n k"]:
    """Return the numbers, with angles in radians, that describe n rotations in a notation; inverse of `rotations_of`."""
    read = Rotation.from_matrix(rotation)
    if notation.startswith("quat:"):
        return read.as_quat()[:, ["xyzw".index(axis) for axis in notation[5:]]]
    if notation.startswith("matrix"):
        return (np.swapaxes(rotation, 1, 2) if notation.endswith("columns") else rotation).reshape(-1, 9)
    if notation == "rotvec":
        return read.as_rotvec()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock
        return read.as_euler(notation[6:])


def poses_of(
    position: Float[ndarray, "n 3"], rotation: Float[ndarray, "n k"], notation: str, units: str = "m-rad"
) -> Float[ndarray, "n 4 4"]:
    """Return the transforms (m) of n positions and rotations as written; NaN for a row that is no transform.

    `notation` is that of the rotation and `units` are those of both, such as "mm-deg".
    """
    length, angle = units.split("-")
    made = transform(
        rotations_of(rotation, notation, np.radians(1.0) if angle == "deg" else 1.0),
        position * METRES[length],
    )
    bad = ~(np.isfinite(made).all((1, 2)) & (np.abs(made) < HUGE).all((1, 2)))
    made[bad] = np.nan
    return made


def length_unit(position: Float[ndarray, "n 3"], stated: str | None, where: str) -> str:
    """Return the unit (m, mm or cm) of positions as written, by their size; `stated` is the one that was given, if any.

    Raises InputError if the size contradicts the stated unit, or if the base frame is far from all positions. Positions
    further from the origin than 10 are no metres, and positions that are all within 10 of each other are no
    millimetres, because a calibration needs motions above 10 mm. Raises InputError, too, for several positions below
    NEAR_BASE that may be millimetres or centimetres.
    """
    position = position[np.isfinite(position).all(1)]
    if not len(position):
        return stated or "m"
    # A few wrong rows, which are left out later, must not change the unit of the others.
    counted = len(position) - (tolerated(len(position)) if len(position) > 3 else 0)
    far, spread = (
        float(np.sort(np.linalg.norm(position - origin, axis=1))[counted - 1])
        for origin in (np.zeros(3), np.median(position, axis=0))
    )
    unit = stated or ("m" if far <= METRES_LIMIT else "mm")
    per = METRES[unit]
    if stated in ("mm", "cm") and 0 < far <= METRES_LIMIT:
        raise InputError(
            f"{where}: the gripper is at most {far:.4g} {unit} from the base, too near for {unit}; these look like "
            "metres: give --pose-units m-rad, or m-deg for angles in degrees, or correct the unit in the column's name"
        )
    several = len(position) > 1
    is_map = several and 0 < spread < METRES_LIMIT < far and per < 1
    if is_map or (
        far * per > METRES_LIMIT and (stated is None or (several and spread * per <= METRES_LIMIT))
    ):
        size = f"{far:.4g} {'m' if is_map else unit}"
        raise InputError(f"{where}: the positions are up to {size} from the origin; {FAR_FRAME}")
    # A single transform may be that of a camera, which is near its gripper.
    if stated is None and METRES_LIMIT < far < NEAR_BASE and several:
        raise InputError(
            f"{where}: the positions are at most {far:.3g} from the origin, {far / 1e3:.2g} m as millimetres and "
            f"{far / 1e2:.2g} m as centimetres: say which with --pose-units mm-rad or cm-rad (or mm-deg, cm-deg)"
        )
    if far * per > METRES_LIMIT:
        raise InputError(
            f"{where}: the gripper is up to {far:.4g} {unit} from the base; these look like millimetres: give "
            "--pose-units mm-rad, or mm-deg for angles in degrees"
        )
    return unit


def angle_unit(numbers: Float[ndarray, "n k"], notation: str, stated: str | None, where: str) -> str:
    """Return the unit (rad or deg) of a rotation's numbers, by their size; `stated` is the one that was given, if any.

    Angles beyond 2π are degrees. Angles that are all within 2π are radians: as degrees they would turn the gripper by
    less than 7°. Raises InputError if the size contradicts the stated unit.
    """
    if NUMBERS[notation] != 3:
        return "rad"
    largest = float(np.nanmax(np.abs(numbers), initial=0.0))
    if stated == "rad" and largest > RADIANS_LIMIT:
        raise InputError(
            f"{where}: angles go up to {largest:.4g} rad; these look like degrees: give --pose-units m-deg, "
            "or mm-deg for positions in millimetres"
        )
    if stated == "deg" and 0 < largest < np.pi:
        raise InputError(
            f"{where}: angles are at most {largest:.3g}°, too small for a calibration; these look like radians: give "
            "--pose-units m-rad, or mm-rad for positions in millimetres"
        )
    return stated or ("rad" if largest <= RADIANS_LIMIT else "deg")
