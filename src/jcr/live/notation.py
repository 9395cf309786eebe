"""Gripper poses in the notation of an arm: pendant, program, joint angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.conventions import CONVENTIONS, numbers_from_poses
from jcr.capture.options import ConventionName, UnitsName
from jcr.estimation.inverse_kinematics import FITS, inverse_kinematics, reach_toward
from jcr.estimation.kinematics import Arm, forward_kinematics
from jcr.geometry import inverse, rotation_angle


@dataclass(frozen=True)
class Notation:
    """Convention, units and arm with which poses are written."""

    convention: ConventionName = "auto"
    """Pose convention; auto: quat-xyzw."""
    units: UnitsName = "auto"
    arm: Arm | None = None
    """Arm whose joint angles are written too; None where it is not known."""


def pose_lines(
    pose: Float[ndarray, "4 4"], notation: Notation, joints: Float[ndarray, " dof"] | None = None
) -> list[str]:
    """Return the pose as the arm's pendant or program writes it, and its joint angles (rad) where they are known."""
    convention = "quat-xyzw" if notation.convention == "auto" else notation.convention
    if convention == "ur":
        row = numbers_from_poses(pose[None], "ur")[0]
        shown = ", ".join(f"{name} {1e3 * value:.1f}" for name, value in zip("xyz", row[:3], strict=True))
        rotation = ", ".join(
            f"{name} {value:.4f}" for name, value in zip(("rx", "ry", "rz"), row[3:], strict=True)
        )
        numbers = ", ".join(f"{value:.5f}" for value in row)
        lines = [f"pendant: {shown} mm, {rotation} rad", f"URScript: movel(p[{numbers}], a=0.3, v=0.1)"]
    elif convention in ("franka", "matrix"):
        row = numbers_from_poses(pose[None], convention, notation.units)[0]
        order = "O_T_EE, by columns" if convention == "franka" else "base_from_gripper, by rows"
        lines = [f"{order}: [{', '.join(f'{value:.5f}' for value in row)}]"]
    else:
        lines = [named_numbers(pose, convention, notation.units)]
    if joints is not None:
        degrees = ", ".join(f"{value:.2f}" for value in np.degrees(joints))
        lines.append(f"joints, °: {degrees}")
        lines.append(f"joints, rad: {', '.join(f'{value:.4f}' for value in joints)}")
    return lines


def named_numbers(pose: Float[ndarray, "4 4"], convention: ConventionName, units: UnitsName) -> str:
    """Return the numbers of the pose, each with its name, and the units."""
    form = CONVENTIONS[convention]
    length, angle = form.units(units)
    row = numbers_from_poses(pose[None], convention, units)[0]
    digits = [1 if length == "mm" else 4] * 3 + [5 if not form.has_angles else 2 if angle == "deg" else 4] * 4
    text = [f"{name} {value:.{k}f}" for name, value, k in zip(form.columns, row, digits, strict=False)]
    unit = f" {angle.replace('deg', '°')}" if form.has_angles else ""
    return f"{' '.join(text[:3])} {length}, {' '.join(text[3:])}{unit}"


def joints_at(
    arm: Arm,
    base_from_gripper: Float[ndarray, "n 4 4"],
    joints: Float[ndarray, "n dof"] | None,
    goal: Float[ndarray, "4 4"],
) -> Float[ndarray, " dof"] | None:
    """Return joint angles (rad) within the limits that reach `goal`; None where none do.

    `base_from_gripper` and `joints` (rad, None where not recorded) are those of the images. With recorded angles the
    tool follows from them and their pose, and the answer is of the branch that the arm is in.
    """
    if joints is not None:
        now = joints[-1:]
        flange_from_tool = (inverse(forward_kinematics(arm, now)) @ base_from_gripper[-1:])[0]
        flange = (goal @ inverse(flange_from_tool))[None]
        found = reach_toward(arm, flange, now, steps=60)
        off = inverse(forward_kinematics(arm, found)) @ flange
        if np.linalg.norm(off[0, :3, 3]) < FITS[0] and float(rotation_angle(off[0, :3, :3])) < FITS[1]:
            return found[0]
        return None
    posture = inverse_kinematics(arm, np.concatenate([base_from_gripper, goal[None]]))
    reached = posture.misfit_m[-1] < FITS[0] and posture.misfit_rad[-1] < FITS[1]
    return posture.joints[-1] if reached else None
