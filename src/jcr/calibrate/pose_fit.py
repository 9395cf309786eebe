"""Maximum-likelihood hand-eye calibration from poses: the robot's reported poses are noisy, each image once.

The reported gripper pose of image i differs from `base_from_recon · S_λ(recon_from_camera) · X⁻¹` by the
robot's own noise: σ_t per axis of position, σ_r per axis of orientation. Both are estimated with the rest
unless given (restricted maximum likelihood), so the covariance is that of the robot at hand. Working with
images instead of motions keeps their errors independent, and makes the result blind to their order.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.stats import chi2, f

from jcr.geometry import inverse, rotation_exp, rotation_log, skew, transform

Poses = Float[ndarray, "n 4 4"]
TRANSLATION, ROTATION, SCALE, BASE_TRANSLATION, BASE_ROTATION = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 7),
    slice(7, 10),
    slice(10, 13),
)
"""Columns of the 13 unknowns; the first seven are records.COVARIANCE_ORDER."""

PRIOR_STD = np.array([1.0] * 3 + [np.pi] * 3 + [5.0])
"""So weak that it only keeps what the motions cannot see finite: 1 m, π rad, a factor e⁵."""
NOISE_FLOOR = (2e-5, np.radians(0.002))
"""m, rad; so that a perfect fit does not claim a perfect robot."""
REACH = 0.45
"""m. A joint's error shows in position as in orientation times the reach behind it: σ_t ≈ REACH · σ_r."""
REACH_WEIGHT = 5.0
"""That relation counts as so many observations. A lens that is slightly off disturbs positions more than
orientations, and few images do not tell the two noises apart: without it, real captures trust positions too
much."""


@dataclass(frozen=True)
class Cues:
    """What the user measured, for motions that leave it unseen; each with its standard deviation."""

    scale: tuple[float, float] | None = None
    """Metres per recon unit, relative standard deviation."""
    offset: tuple[Float[ndarray, "3"], float, float] | None = None
    """Axis in the gripper frame, camera centre along it (m), standard deviation (m)."""


@dataclass(frozen=True)
class PoseFit:
    """The fit and what its residuals say."""

    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    base_from_recon: Float[ndarray, "4 4"]
    translation_residual: Float[ndarray, "n 3"]
    """Predicted minus reported gripper position (m), base axes; of every pose, used or not."""
    rotation_residual: Float[ndarray, "n 3"]
    """Rotation vector from reported to predicted gripper (rad), gripper axes."""
    noise: tuple[float, float]
    """σ_t (m) and σ_r (rad) per axis, given or estimated."""
    degrees_of_freedom: tuple[float, float]
    """Of the two estimates; infinite when the noise was given."""
    hessian: Float[ndarray, "13 13"]
    """Of the negative log likelihood, prior included."""
    hat: Float[ndarray, "n 6 6"]
    """Covariance of the prediction at each pose, in units of σ (translation 3, rotation 3)."""

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance in records.COVARIANCE_ORDER, widened for an estimated noise."""
        return np.linalg.inv(self.hessian)[:7, :7] * widening(self.degrees_of_freedom)


def widening(degrees_of_freedom: tuple[float, float]) -> float:
    """Factor on a 7×7 covariance whose two variances were estimated with so many degrees of freedom.

    A squared Mahalanobis distance then follows 7·F(7, ν), not χ²(7); the factor makes the 95 % ellipsoid that
    users draw from a covariance hold 95 %. The tie between the variances adds its own observations to ν.
    """
    nu = sum(degrees_of_freedom) + 2 * REACH_WEIGHT
    return 1.0 if np.isinf(nu) else float(7 * f.ppf(0.95, 7, nu) / chi2.ppf(0.95, 7))


def robot_noise(
    squares: tuple[float, float], degrees_of_freedom: tuple[float, float], before: tuple[float, float]
) -> tuple[float, float]:
    """σ_t and σ_r from sums of squared residuals (m², rad²), tied to each other by the arm's reach."""
    weight = REACH_WEIGHT
    sigma_t = np.sqrt((squares[0] + weight * (REACH * before[1]) ** 2) / (degrees_of_freedom[0] + weight))
    sigma_r = np.sqrt((squares[1] + weight * (before[0] / REACH) ** 2) / (degrees_of_freedom[1] + weight))
    return max(float(sigma_t), NOISE_FLOOR[0]), max(float(sigma_r), NOISE_FLOOR[1])


def deleted_residuals(residual: Float[ndarray, "n 6"], hat: Float[ndarray, "n 6 6"]) -> Float[ndarray, "n 6"]:
    """Residuals of each pose from the fit without it, from those of the fit with it: (I − H)⁻¹ r."""
    return np.linalg.solve(np.eye(6) - hat + 1e-9 * np.eye(6), residual[..., None])[..., 0]


def fit_poses(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]],
    weights: Float[ndarray, " n"],
    noise: tuple[float, float] | None = None,
    cues: Cues | None = None,
    iterations: int = 50,
) -> PoseFit:
    """Gauss-Newton from `start` (gripper_from_camera, scale, base_from_recon); noise in (m, rad)."""
    x, scale, z = start
    cues = cues or Cues()
    sigma_t, sigma_r = noise or (5e-4, np.radians(0.1))
    dof, hessian = (np.inf, np.inf), np.eye(13)
    for _ in range(iterations):
        r_t, r_r, j_t, j_r = _residuals(x, scale, z, base_from_gripper, recon_from_camera)
        h_t = np.einsum("n,nij,nik->jk", weights, j_t, j_t)
        h_r = np.einsum("n,nij,nik->jk", weights, j_r, j_r)
        prior_h, prior_g = _prior(x, scale, cues)
        hessian = h_t / sigma_t**2 + h_r / sigma_r**2 + prior_h
        if noise is None:
            inverse_h = np.linalg.inv(hessian)
            m = weights.sum()
            dof = (
                max(3 * m - float((inverse_h * h_t).sum()) / sigma_t**2, 0.1),
                max(3 * m - float((inverse_h * h_r).sum()) / sigma_r**2, 0.1),
            )
            squares = float(weights @ (r_t**2).sum(1)), float(weights @ (r_r**2).sum(1))
            before = (sigma_t, sigma_r)
            sigma_t, sigma_r = robot_noise(squares, dof, before)
            settled = abs(sigma_t / before[0] - 1) < 1e-6 and abs(sigma_r / before[1] - 1) < 1e-6
            hessian = h_t / sigma_t**2 + h_r / sigma_r**2 + prior_h
        else:
            settled = True
        gradient = (
            np.einsum("n,nij,ni->j", weights, j_t, r_t) / sigma_t**2
            + np.einsum("n,nij,ni->j", weights, j_r, r_r) / sigma_r**2
            + prior_g
        )
        step = -np.linalg.solve(hessian, gradient)
        # A wild start on nearly unobservable motions must not throw rotations around the circle.
        step *= min(1.0, 0.5 / max(np.abs(step[[3, 4, 5, 6, 10, 11, 12]]).max(), 1e-300))
        x, scale, z = _moved(x, scale, z, step)
        if settled and float(step @ hessian @ step) < 1e-14:
            break
    r_t, r_r, j_t, j_r = _residuals(x, scale, z, base_from_gripper, recon_from_camera)
    jacobian = np.concatenate([j_t / sigma_t, j_r / sigma_r], axis=1)
    hat = jacobian @ np.linalg.inv(hessian) @ np.swapaxes(jacobian, 1, 2)
    return PoseFit(x, scale, z, r_t, r_r, (sigma_t, sigma_r), dof, hessian, hat)


def pose_information(
    base_from_gripper: Poses, gripper_from_camera: Float[ndarray, "4 4"], noise: tuple[float, float]
) -> Float[ndarray, "n 13 13"]:
    """What each gripper pose tells of the 13 unknowns (Fisher information), whatever its picture shows."""
    # Any frame and unit of the reconstruction will do: the base's, in metres.
    camera = base_from_gripper @ gripper_from_camera
    _, _, j_t, j_r = _residuals(gripper_from_camera, 1.0, np.eye(4), base_from_gripper, camera)
    j = np.concatenate([j_t / noise[0], j_r / noise[1]], axis=1)
    return np.swapaxes(j, 1, 2) @ j


def predict(
    x: Float[ndarray, "4 4"], scale: float, z: Float[ndarray, "4 4"], recon_from_camera: Poses
) -> Poses:
    """Gripper poses in base (n,4,4): base_from_recon · S_λ(recon_from_camera) · X⁻¹."""
    scaled = recon_from_camera.copy()
    scaled[:, :3, 3] *= scale
    return z @ scaled @ inverse(x)


def _residuals(
    x: Float[ndarray, "4 4"],
    scale: float,
    z: Float[ndarray, "4 4"],
    base_from_gripper: Poses,
    recon_from_camera: Poses,
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3"], Float[ndarray, "n 3 13"], Float[ndarray, "n 3 13"]]:
    """Residuals of position (base axes) and orientation (gripper axes) and their Jacobians.

    Perturbations: R_X ← exp(ω) R_X, t_X + dt, λ·exp(s), R_Z ← exp(ζ) R_Z, t_Z + dz.
    """
    predicted = predict(x, scale, z, recon_from_camera)
    rotation = predicted[:, :3, :3]
    r_t = predicted[:, :3, 3] - base_from_gripper[:, :3, 3]
    r_r = rotation_log(np.swapaxes(base_from_gripper[:, :3, :3], 1, 2) @ rotation)
    arm = scale * recon_from_camera[:, :3, 3] @ z[:3, :3].T
    n = len(predicted)
    j_t = np.zeros((n, 3, 13))
    j_t[:, :, TRANSLATION] = -rotation
    j_t[:, :, ROTATION] = -rotation @ skew(x[:3, 3])
    j_t[:, :, 6] = arm
    j_t[:, :, BASE_TRANSLATION] = np.eye(3)
    j_t[:, :, BASE_ROTATION] = -skew(arm - rotation @ x[:3, 3])
    j_r = np.zeros((n, 3, 13))
    j_r[:, :, ROTATION] = -np.eye(3)
    j_r[:, :, BASE_ROTATION] = np.swapaxes(rotation, 1, 2)
    return r_t, r_r, j_t, j_r


def _prior(
    x: Float[ndarray, "4 4"], scale: float, cues: Cues
) -> tuple[Float[ndarray, "13 13"], Float[ndarray, "13"]]:
    hessian, gradient = np.zeros((13, 13)), np.zeros(13)
    hessian[range(7), range(7)] = PRIOR_STD**-2.0
    if cues.scale is not None:
        known, std = cues.scale
        hessian[6, 6] += std**-2
        gradient[6] += np.log(scale / known) * std**-2
    if cues.offset is not None:
        axis, known, std = cues.offset
        hessian[TRANSLATION, TRANSLATION] += np.outer(axis, axis) * std**-2
        gradient[TRANSLATION] += axis * (axis @ x[:3, 3] - known) * std**-2
    return hessian, gradient


def _moved(
    x: Float[ndarray, "4 4"], scale: float, z: Float[ndarray, "4 4"], step: Float[ndarray, "13"]
) -> tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]]:
    return (
        transform(rotation_exp(step[ROTATION]) @ x[:3, :3], x[:3, 3] + step[TRANSLATION]),
        float(scale * np.exp(step[6])),
        transform(rotation_exp(step[BASE_ROTATION]) @ z[:3, :3], z[:3, 3] + step[BASE_TRANSLATION]),
    )
