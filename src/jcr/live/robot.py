"""States of a robot arm over time, detection of rest, and gripper poses from plain numbers."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.checks import check_metres, read_rigid
from jcr.errors import InputError
from jcr.geometry import inverse, rotation_angle, rotation_exp, transform

REST_S = 0.5
REST = (2e-4, np.radians(0.03))
"""m, rad: an arm that stays within this for REST_S is at rest."""
MOVED_ON = (0.01, np.radians(3.0))
"""m, rad: least distance of a rest from the last image at which the next image is taken."""
TRY_AGAIN = (1e-3, np.radians(0.2))
"""m, rad: the same distance after an image that was refused."""


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


def pose_of_numbers(numbers: list[float], where: str) -> Float[ndarray, "4 4"]:
    """Return base_from_gripper from 6, 7 or 16 numbers in metres and radians; raise InputError for others.

    6: x y z and a rotation vector, as UR shows; 7: x y z qx qy qz qw; 16: a matrix, row by row.
    """
    values = np.array(numbers, dtype=np.float64)
    if not np.isfinite(values).all():
        raise InputError(f"{where}: holds NaN or infinity; read the pose again")
    if len(values) == 16:
        pose = read_rigid(values.reshape(4, 4).tolist(), where)
    elif len(values) == 7 and abs(np.linalg.norm(values[3:]) - 1) < 1e-2:
        pose = transform(Rotation.from_quat(values[3:]).as_matrix(), values[:3])
    elif len(values) == 7:
        raise InputError(f"{where}: the last four of 7 numbers are no quaternion qx qy qz qw of length 1")
    elif len(values) == 6 and np.linalg.norm(values[3:]) < 2 * np.pi + 0.01:
        pose = transform(rotation_exp(values[3:]), values[:3])
    elif len(values) == 6:
        raise InputError(f"{where}: the last three of 6 numbers are no rotation vector in radians")
    else:
        raise InputError(
            f"{where}: {len(values)} numbers; give x y z rx ry rz (rotation vector, radians), "
            "x y z qx qy qz qw, or a matrix of 16, all in metres"
        )
    check_metres(pose[None], where)
    return pose
