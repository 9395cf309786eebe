"""Two stacks of poses in the same unit: the two constant transforms between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import retract
from jcr.handeye.equation import Poses, residuals

FREE = np.r_[0:6, 7:13]
"""Columns of the 13 unknowns without scale."""
STEPS, SETTLED = 30, 1e-12


@dataclass(frozen=True)
class Fit:
    """base_from_gripper · `gripper_from_camera` ≈ `base_from_recon` · recon_from_camera."""

    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_recon: Float[ndarray, "4 4"]
    residual: Float[ndarray, "n 6"]
    """As in `equation.residuals`: m and rad."""


def fit_known_scale(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]],
    noise: tuple[float, float],
) -> Fit:
    """Weighted least squares (Gauss-Newton) from `start` (gripper_from_camera, base_from_recon); `noise` in m, rad.

    Where the motions do not determine both, the solution nearest the start.
    """
    x, z = start
    weight = 1 / np.repeat(noise, 3)
    for _ in range(STEPS):
        residual, jacobian = residuals(x, 1.0, z, base_from_gripper, recon_from_camera)
        step = np.zeros(13)
        rows = (weight[:, None] * jacobian[:, :, FREE]).reshape(-1, len(FREE))
        step[FREE] = -np.linalg.lstsq(rows, (weight * residual).ravel(), rcond=1e-9)[0]
        step *= min(1.0, 0.5 / max(np.abs(step[[3, 4, 5, 10, 11, 12]]).max(), 1e-300))
        x, z = retract(x, step[:6]), retract(z, step[7:])
        if np.abs(step).max() < SETTLED:
            break
    return Fit(x, z, residuals(x, 1.0, z, base_from_gripper, recon_from_camera)[0])
