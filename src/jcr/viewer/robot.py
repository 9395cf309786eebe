"""The robot of a URDF at the poses of a capture: by given joint values, or by values that put a link there."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares

from jcr.capture.plain_files import read_npy
from jcr.capture.urdf_chain import load_urdf
from jcr.errors import InputError
from jcr.geometry import ARM, step_between

if TYPE_CHECKING:
    import yourdfpy

REACHED = 2e-3
"""Metres, an angle by ARM: how near it must come."""
STARTS = 12
"""Joint values tried as a start, at most; the first is where the arm was for the pose before."""


def read_urdf(path: Path) -> "yourdfpy.URDF":
    """The robot in a URDF file with its visual meshes; InputError where it cannot be read or has nothing to move."""
    import yourdfpy

    if not path.is_file():
        raise InputError(f"{path}: no such URDF file")
    load_urdf(path, build_scene_graph=False)
    try:
        robot = yourdfpy.URDF.load(str(path))
    except Exception as error:  # whatever XML and mesh readers raise
        raise InputError(f"{path}: cannot be read as URDF ({error})") from error
    if not robot.actuated_joint_names:
        raise InputError(
            f"{path}: has no joint that moves, so no pose to show; give the URDF of the whole arm"
        )
    return robot


def read_joints(path: Path, robot: "yourdfpy.URDF", images: int) -> Float[ndarray, "n dof"]:
    """Joint values (n,dof) from .csv (a header is fine) or .npy, a row an image; InputError for anything else."""
    names = robot.actuated_joint_names
    try:
        if path.suffix == ".npy":
            values = read_npy(path)
        else:
            lines = [line for line in path.read_text("utf-8").splitlines() if line.strip()]
            header = int(any(word.strip() in names for word in lines[0].split(",")))
            values = np.array([[float(word) for word in line.split(",")] for line in lines[header:]])
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: cannot be read as joint values ({error}); give .csv or .npy") from None
    if (
        values.dtype.kind not in "fiu"
        or values.shape != (images, len(names))
        or not np.isfinite(values).all()
    ):
        raise InputError(
            f"{path}: expected finite joint values of shape ({images}, {len(names)}), a row an image, columns "
            f"{', '.join(names)}, got {values.shape}"
        )
    return values.astype(float)


def solve_joints(
    robot: "yourdfpy.URDF", tip: str, base_from_tip: Float[ndarray, "n 4 4"]
) -> Float[ndarray, "n dof"]:
    """Joint values (n,dof) that put the link `tip` at poses in the robot's base, near to each other in turn.

    Raises InputError for a link the robot does not have, and where it cannot reach a pose.
    """
    if tip not in robot.link_map:
        raise InputError(f"--tip {tip}: the URDF has no such link; it has {', '.join(robot.link_map)}")
    low, high = np.array([_limits(joint) for joint in robot.actuated_joints]).T
    rng = np.random.default_rng(0)

    def miss(values: Float[ndarray, " dof"], goal: Float[ndarray, "4 4"]) -> Float[ndarray, "6"]:
        robot.update_cfg(values)
        reached = robot.get_transform(tip, robot.base_link)
        return step_between(goal, reached) * np.repeat([1.0, ARM], 3)

    solved, near = [], np.clip(np.zeros(len(low)), low, high)
    for k, goal in enumerate(base_from_tip):
        best = None
        for start in [near, *rng.uniform(low, high, (STARTS - 1, len(low)))]:
            inside = np.clip(start, low + 1e-6, high - 1e-6)
            found = least_squares(miss, inside, bounds=(low, high), args=(goal,), max_nfev=100)
            if best is None or found.cost < best.cost:
                best = found
            if np.linalg.norm(best.fun) < REACHED:
                break
        assert best is not None  # at least one start
        if (off := float(np.linalg.norm(best.fun))) >= REACHED:
            raise InputError(
                f"--tip {tip}: the robot cannot bring it to gripper pose {k} (it stays {1e3 * off:.0f} mm off); name "
                "the link whose poses the capture has, or give --joints"
            )
        near = best.x
        solved.append(near)
    return np.array(solved)


def _limits(joint: "yourdfpy.Joint") -> tuple[float, float]:
    """Of its value, rad or m; a rotation either way where it has none."""
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return -np.pi, np.pi
    return float(limit.lower), max(float(limit.upper), float(limit.lower) + 1e-3)
