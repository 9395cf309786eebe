"""Least-squares fit of the two constant transforms between two stacks of poses in one unit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.equation import Poses, columns_of_arm, residuals
from jcr.geometry import Transform, retract
from jcr.least_squares import minimise


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
