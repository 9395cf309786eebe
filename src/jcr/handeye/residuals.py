"""How well a hand-eye calibration explains the motions, as the paper reports it."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.geometry import inverse, scale_translation


def paper_residuals(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    gripper_from_camera: Float[ndarray, "4 4"],
    scale: float,
    used: Bool[ndarray, " n"],
) -> tuple[float, float]:
    """Mean δ_t (m) and δ_R (Frobenius norm) of A·X − X·B(λ) over consecutive used images (paper, eq. 8)."""
    g, c = base_from_gripper[used], recon_from_camera[used]
    a = inverse(g[:-1]) @ g[1:]
    b = scale_translation(inverse(c[:-1]) @ c[1:], scale)
    gap = a @ gripper_from_camera - gripper_from_camera @ b
    return (
        float(np.linalg.norm(gap[:, :3, 3], axis=1).mean()),
        float(np.linalg.norm(gap[:, :3, :3], axis=(1, 2)).mean()),
    )
