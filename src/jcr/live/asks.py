"""Where gripper poses come from while a capture is taken: each is a request to take an image there, now."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.checks import check_metres, read_rigid
from jcr.errors import InputError
from jcr.geometry import rotation_exp, transform

Answer = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Ask:
    """The gripper rests here: take an image."""

    base_from_gripper: Float[ndarray, "4 4"] = field(kw_only=False)
    answer: Callable[[Answer], None] = field(default=lambda answer: None)
    """Is called with the answer, once."""
    current: Callable[[], Float[ndarray, "4 4"]] | None = None
    """Reads the pose once more after the image; None where the source has no other than this one."""
    joints: Float[ndarray, " dof"] | None = None
    """Joint angles (rad) at rest; None where the arm does not send them."""
    waits: bool = False
    """Whether the answer is the calibration with the image, seconds later."""


def pose_of_numbers(numbers: list[float], where: str) -> Float[ndarray, "4 4"]:
    """base_from_gripper from 6, 7 or 16 numbers in metres and radians, or InputError.

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
