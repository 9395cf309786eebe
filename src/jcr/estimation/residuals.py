"""Residuals δ_t and δ_R of the motions, as the paper reports them."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.geometry import Transform, inverse, scale_translation


def paper_residuals(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    gripper_from_camera: Transform,
    scale: float,
    used: Bool[ndarray, " n"],
) -> tuple[float, float]:
    """Return the mean δ_t (m) and δ_R (Frobenius norm) of A·X − X·B(λ) over consecutive used images (paper, eq. 16)."""
    a, b = (inverse(of[used][:-1]) @ of[used][1:] for of in (base_from_gripper, recon_from_camera))
    gap = a @ gripper_from_camera - gripper_from_camera @ scale_translation(b, scale)
    translation = np.linalg.norm(gap[:, :3, 3], axis=1).mean()
    return float(translation), float(np.linalg.norm(gap[:, :3, :3], axis=(1, 2)).mean())
