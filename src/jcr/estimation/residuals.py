"""How well a hand-eye calibration explains the motions, as the paper reports it."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.geometry import Transform, inverse, rotation_angle, scale_translation


def paper_residuals(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    gripper_from_camera: Transform,
    scale: float,
    used: Bool[ndarray, " n"],
) -> tuple[float, float]:
    """Mean δ_t (m) and δ_R (Frobenius norm) of A·X − X·B(λ) over consecutive used images (paper, eq. 16)."""
    a, b = (inverse(of[used][:-1]) @ of[used][1:] for of in (base_from_gripper, recon_from_camera))
    gap = a @ gripper_from_camera - gripper_from_camera @ scale_translation(b, scale)
    translation = np.linalg.norm(gap[:, :3, 3], axis=1).mean()
    return float(translation), float(np.linalg.norm(gap[:, :3, :3], axis=(1, 2)).mean())


def angle_ratio(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"]
) -> tuple[float, float]:
    """Rotation angles between cameras over those between grippers, and its standard deviation; of three or more images.

    Two conjugate rotations have the same angle, so it is 1 whatever gripper_from_camera is: a wrong focal length or a
    bent arm makes it another. Over all pairs, larger rotations counting for more; deviation by the jackknife.
    """
    gripper, camera = (
        np.asarray(rotation_angle(inverse(poses)[:, None, :3, :3] @ poses[None, :, :3, :3]))
        for poses in (base_from_gripper, recon_from_camera)
    )
    n = len(gripper)

    def ratio(kept: Bool[ndarray, " n"]) -> float:
        among = np.ix_(kept, kept)
        return float((gripper[among] * camera[among]).sum() / max((gripper[among] ** 2).sum(), 1e-12))

    without = np.array([ratio(np.arange(n) != k) for k in range(n)])
    std = np.sqrt((n - 1) / n * ((without - without.mean()) ** 2).sum())
    return ratio(np.ones(n, dtype=bool)), float(std)
