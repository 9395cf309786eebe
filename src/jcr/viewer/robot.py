"""Robot of a URDF at the joint values of a capture."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.urdf_chain import load_urdf
from jcr.errors import InputError
from jcr.records import Capture

if TYPE_CHECKING:
    import yourdfpy


def read_robot(urdf: Path, capture: Capture) -> "tuple[yourdfpy.URDF, Float[ndarray, 'n dof']]":
    """Return the robot with its visual meshes, and its configuration at each image (rad or m).

    The capture's joints are the first that move in the URDF; others, such as fingers, stay at 0. Raises InputError
    for a URDF that cannot be read or moves fewer joints, and for a capture without joint values.
    """
    import yourdfpy

    moving = load_urdf(urdf).actuated_joint_names
    if (joints := capture.joints) is None:
        raise InputError(
            f"{capture.folder}: has no joint values, so the robot's pose is unknown; add `joints` (rad) to each frame "
            "of its capture.json, or leave out --urdf"
        )
    if len(moving) < joints.shape[1]:
        raise InputError(
            f"{urdf}: moves {len(moving)} joints, but the capture has {joints.shape[1]} values for each image; give "
            "the URDF of the whole arm"
        )
    try:
        robot = yourdfpy.URDF.load(str(urdf))
    except Exception as error:  # whatever the readers of meshes raise
        raise InputError(f"{urdf}: a mesh cannot be read ({error})") from error
    return robot, np.pad(joints, ((0, 0), (0, len(moving) - joints.shape[1])))
