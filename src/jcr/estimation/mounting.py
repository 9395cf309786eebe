"""Constant base and tool between the kinematics of an arm with known joint angles and its reported poses.

Controllers report poses in a base and of a tool of the user's choice. Both are constant, so joint angles and poses of
a few images determine them, and what remains shows whether angles and poses belong to this arm at all.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.closed_form import closed_form
from jcr.estimation.equation import Poses, columns_of_arm, expected_covariance, residuals
from jcr.estimation.kinematics import Arm, Joints, forward_kinematics, with_tool
from jcr.geometry import ARM, Transform, inverse, retract, rotation_exp, transform
from jcr.least_squares import minimise

NOISE = (1e-3, 1e-3 / ARM)
"""Differences (m, rad) of equal weight."""
AGREE = (0.015, np.radians(1.5))
"""Largest rms difference of agreeing angles and poses, as a share of the reach and in rad. Controllers use kinematics
calibrated at the factory, which are millimetres from the nominal arm."""
ALIKE, SURE = 0.01, 5.0
"""Difference of lengths from which reported positions are not of this arm: relative, and in standard deviations. A
factory's calibration changes lengths by less."""


class LengthError(InputError):
    """Error for gripper positions that are longer or shorter than the arm's by one factor, which no image shows."""


def mounted_arm(arm: Arm, joints: Joints, base_from_gripper: Poses) -> Arm:
    """Return the arm with the base and tool whose forward kinematics fits the reported poses best.

    Where the motions do not determine them, they are nearest the arm's own. Raise InputError where angles and poses
    disagree, and LengthError where they do by a factor of all positions.
    """
    nominal = forward_kinematics(arm, joints)
    half_rotation = transform(rotation_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    tool, _, base = closed_form(base_from_gripper, nominal)
    fits = [
        fit_known_scale(base_from_gripper, nominal, start, NOISE)
        for start in ((np.eye(4), np.eye(4)), (np.eye(4), half_rotation), (tool, base))
    ]
    _require_length(arm, base_from_gripper, nominal)
    best = min(fits, key=lambda fit: float(((fit.residual / np.repeat(NOISE, 3)) ** 2).sum()))
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
    """Raise LengthError where one factor other than 1 on all positions makes them agree with the nominal arm."""
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
    """Return the rms difference in m and rad."""
    return np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum(2).mean(0))


class Fit(NamedTuple):
    """Transforms with base_from_gripper · `gripper_from_camera` ≈ `base_from_recon` · recon_from_camera."""

    gripper_from_camera: Transform
    base_from_recon: Transform
    residual: Float[ndarray, "n 6"]
    """Steps of `equation.residuals` (m, rad)."""


def fit_known_scale(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Transform, Transform],
    noise: tuple[float, float],
    exchanged: bool = False,
) -> Fit:
    """Return the weighted least-squares fit from `start` (gripper_from_camera, base_from_recon); `noise` in m, rad.

    Directions that the motions do not determine stay as they are in `start`. `exchanged` is that of
    `equation.residuals`.
    """
    weight, columns = 1 / np.repeat(noise, 3), columns_of_arm(0)

    def linearised(at: tuple[Transform, Transform]) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 12"]]:
        residual, jacobian = residuals(at[0], 1.0, at[1], base_from_gripper, recon_from_camera, exchanged)
        return weight * residual, weight[:, None] * jacobian[:, :, columns]

    def moved(at: tuple[Transform, Transform], step: Float[ndarray, "12"]) -> tuple[Transform, Transform]:
        return retract(at[0], step[:6]), retract(at[1], step[6:])

    x, z = minimise(linearised, start, moved).unknowns
    return Fit(x, z, residuals(x, 1.0, z, base_from_gripper, recon_from_camera, exchanged)[0])
