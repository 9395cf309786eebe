"""How an arm with known joint angles is mounted: the constant base and tool between its kinematics and reported poses.

Controllers report poses in a base and of a tool of the user's choice. Both are constant, so joint angles and poses of a
few images determine them, and what remains shows whether angles and poses belong to this arm at all.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.closed_form import closed_form
from jcr.estimation.equation import Poses, expected_covariance, residuals
from jcr.estimation.kinematics import Arm, Joints, forward_kinematics, with_tool
from jcr.estimation.known_scale import fit_known_scale
from jcr.geometry import ARM, inverse, rotation_exp, transform

NOISE = (1e-3, 1e-3 / ARM)
"""m, rad: differences of equal weight."""
AGREE = (0.015, np.radians(1.5))
"""Of the reach, rad; root mean square. Controllers use kinematics calibrated at the factory, which are millimetres
from the nominal arm."""
ALIKE, SURE = 0.01, 5.0
"""Relative, and in standard deviations: further apart, reported positions are of another length than the arm's links. A
factory's calibration changes them by less."""


class LengthError(InputError):
    """Gripper positions are by one factor longer or shorter than the arm's; no image would show it."""


def mounted_arm(arm: Arm, joints: Joints, base_from_gripper: Poses) -> Arm:
    """The arm with the base and tool with which its forward kinematics gives the reported poses best.

    Where the motions do not determine them, those nearest the arm's own. InputError where angles and poses disagree,
    LengthError where they do by a factor of all positions.
    """
    nominal = forward_kinematics(arm, joints)
    weights = np.ones(len(joints))
    half_rotation = transform(rotation_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    tool, _, base = closed_form(base_from_gripper, nominal, weights)
    fits = [
        fit_known_scale(base_from_gripper, nominal, start, NOISE)
        for start in ((np.eye(4), np.eye(4)), (np.eye(4), half_rotation), (tool, base))
    ]
    _require_length(arm, base_from_gripper, nominal)
    best = min(fits, key=lambda fit: float((fit.residual / np.repeat(NOISE, 3)) ** 2 @ np.ones(6) @ weights))
    metres, radians = _apart(best.residual)
    if metres > AGREE[0] * arm.reach or radians > AGREE[1]:
        raise InputError(
            f"joint angles and gripper poses disagree on a {arm.name}: {1e3 * metres:.0f} mm, "
            f"{np.degrees(radians):.1f}° apart; check the robot, the order of its joints and their unit (rad)"
        )
    frames = arm.parent_from_joint.copy()
    frames[0] = best.base_from_recon @ frames[0]
    return with_tool(replace(arm, parent_from_joint=frames), inverse(best.gripper_from_camera))


def _require_length(arm: Arm, base_from_gripper: Poses, nominal: Poses) -> None:
    """LengthError where one factor on all positions makes them agree with the nominal arm, and it is not 1."""
    tool, scale, base = closed_form(base_from_gripper, nominal)
    factor = float(scale)
    if factor <= 0:  # unobservable
        return
    residual, j = residuals(tool, factor, base, base_from_gripper, nominal)
    metres, radians = _apart(residual)
    if metres > AGREE[0] * arm.reach * factor or radians > AGREE[1]:
        return
    left = max(6 * len(nominal) - j.shape[2], 1)
    noise = np.maximum(np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum((0, 2)) * 2 / left), NOISE)
    j /= np.repeat(noise, 3)[:, None]
    std = factor * float(np.sqrt(expected_covariance(np.einsum("nij,nik->jk", j, j))[6, 6]))
    if abs(factor - 1) > max(ALIKE, SURE * std):
        raise LengthError(
            f"the gripper positions are {100 * abs(factor - 1):.1f} ± {100 * std:.1f} % too "
            f"{'long' if factor > 1 else 'short'} for a {arm.name} with these joint angles; check the unit of the "
            "positions, and that this is the robot"
        )


def _apart(residual: Float[ndarray, "n 6"]) -> Float[ndarray, "2"]:
    """m and rad, root mean square."""
    return np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum(2).mean(0))
