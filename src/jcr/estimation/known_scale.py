"""Two stacks of poses in the same unit: the two constant transforms between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.equation import UNKNOWNS, Poses, columns_of_arm, residuals, share_within_limits
from jcr.geometry import Transform, retract

STEPS, SETTLED = 30, 1e-12


@dataclass(frozen=True)
class Fit:
    """base_from_gripper · `gripper_from_camera` ≈ `base_from_recon` · recon_from_camera."""

    gripper_from_camera: Transform
    base_from_recon: Transform
    residual: Float[ndarray, "n 6"]
    """As in `equation.residuals`: m and rad."""


def fit_known_scale(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Transform, Transform],
    noise: tuple[float, float],
    exchanged: bool = False,
) -> Fit:
    """Weighted least squares (Gauss-Newton) from `start` (gripper_from_camera, base_from_recon); `noise` in m, rad.

    Where the motions do not determine both, the solution nearest the start. `exchanged` is that of `equation.residuals`.
    """
    (x, z), free = start, columns_of_arm(0)
    weight = 1 / np.repeat(noise, 3)
    for _ in range(STEPS):
        residual, jacobian = residuals(x, 1.0, z, base_from_gripper, recon_from_camera, exchanged)
        step = np.zeros(UNKNOWNS)
        rows = (weight[:, None] * jacobian[:, :, free]).reshape(-1, len(free))
        step[free] = -np.linalg.lstsq(rows, (weight * residual).ravel(), rcond=1e-9)[0]
        step *= share_within_limits(step)
        x, z = retract(x, step[:6]), retract(z, step[7:])
        if np.abs(step).max() < SETTLED:
            break
    return Fit(x, z, residuals(x, 1.0, z, base_from_gripper, recon_from_camera, exchanged)[0])
