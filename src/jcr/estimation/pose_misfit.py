"""Robust misfit of gripper poses to camera poses in closed form, for the comparison of many readings of the poses."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.closed_form import closed_form
from jcr.estimation.outlier_rejection import least_trimmed
from jcr.estimation.pose_equations import pose_residuals
from jcr.geometry import Poses, Transform

SHARE = 0.8
"""Share of the images that the misfit counts; the worst fifth may have wrong poses."""
MM_PER_DEG = 5.0
"""Millimetres of translation that count as much as one degree, as at a gripper 0.3 m from the scene."""
MAX_NOISE = (0.02, float(np.radians(3.0)))
"""Largest error per axis (m, rad) of a working robot. Servo arms have less, so that larger errors mean that poses and
images do not belong together."""
NO_ROBOT = float(2 * np.sqrt(3) * MAX_NOISE[1])
"""Difference (rad) of the angles of gripper and camera above which poses cannot be those of a working robot: both images
have the largest error on three axes."""


class Misfit(NamedTuple):
    """Errors of gripper poses after a closed-form calibration with the images that agree best."""

    metres: float
    radians: float
    """Root mean square per axis over the best SHARE of the images."""
    x: Transform
    """gripper_from_camera of the calibration."""
    z: Transform
    """base_from_recon of the calibration, in metres."""

    @property
    def mm(self) -> float:
        """Size of both errors in mm: the translation, plus 5 mm per degree; infinite if no calibration exists."""
        return 1e3 * self.metres + MM_PER_DEG * float(np.degrees(self.radians))

    @property
    def is_of_robot(self) -> bool:
        """Whether the errors are not larger than those of a working robot."""
        return self.metres <= MAX_NOISE[0] and self.radians <= MAX_NOISE[1]


NO_FIT = Misfit(np.inf, np.inf, np.eye(4), np.eye(4))
"""Misfit of poses for which there is no calibration."""


def pose_misfit(base_from_gripper: Poses, recon_from_camera: Poses, share: float = SHARE) -> Misfit:
    """Return the misfit of n gripper poses to camera poses of the same images; infinite for a mirrored scene.

    The errors are those of the best `share` of the images, and the calibration is the closed form on the images of
    least trimmed squares. Poses of another scene scale fit equally well, because the scale is estimated.
    """
    agree, _ = least_trimmed(base_from_gripper, recon_from_camera)
    x, scale, z = closed_form(base_from_gripper[agree], recon_from_camera[agree])
    if not scale > 0:
        return NO_FIT
    residual, _ = pose_residuals(x, float(scale), z, base_from_gripper, recon_from_camera)
    squared = (residual.reshape(-1, 2, 3) ** 2).mean(2)
    size = 1e3 * np.sqrt(squared[:, 0]) + MM_PER_DEG * np.degrees(np.sqrt(squared[:, 1]))
    best = np.argsort(size, kind="stable")[: int(np.ceil(share * len(size)))]
    metres, radians = np.sqrt(squared[best].mean(0)).tolist()
    return Misfit(metres, radians, x, z)


def angle_gap(gripper_angles: Float[ndarray, "n n"], camera_angles: Float[ndarray, "n n"]) -> float:
    """Return the typical difference (rad) of the angles by which gripper and camera turn between the same two images.

    It is the 60 % quantile over all pairs, which 20 % wrong images leave almost unchanged. Whatever the
    hand-eye transform and the scale are, both angles are equal.
    """
    upper = np.triu_indices(len(gripper_angles), 1)
    return float(np.quantile(np.abs(gripper_angles - camera_angles)[upper], 0.6))
