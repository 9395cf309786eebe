"""Maximum-likelihood hand-eye calibration from poses: the robot's reported poses are noisy, each image once.

The reported gripper pose of image i differs from `base_from_recon · S_λ(recon_from_camera) · X⁻¹` by the
robot's own noise: σ_t per axis of position, σ_r per axis of orientation. Both are estimated with the rest
unless given (restricted maximum likelihood), so the covariance is that of the robot at hand. Working with
images instead of motions keeps their errors independent, and makes the result blind to their order.

Camera poses are taken as exact beside the robot's, unless their joint covariance is given: then both errors count
(generalised least squares), which is what kinematic alignment does, to first order and with the robot's noise
estimated. Few images, or a robot better than the cameras, need it.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.geometry import retract
from jcr.handeye.equation import PRIOR_STD, TRANSLATION, Poses, residuals, residuals_by_camera
from jcr.handeye.noise import NoiseShare, noise_share, robot_noise, widened


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
    """Rotation vector from reported to predicted gripper (rad), base axes."""
    noise: tuple[float, float]
    """σ_t (m) and σ_r (rad) per axis, given or estimated."""
    noise_estimated: bool
    degrees_of_freedom: tuple[float, float]
    """Of the two estimates; infinite where a noise was given that explains the residuals."""
    hessian: Float[ndarray, "13 13"]
    """Of the negative log likelihood, prior included."""
    noise_share: NoiseShare
    """In the inverse of `hessian`."""
    missed: Float[ndarray, "n 6"]
    """By how much a fit without it misses each pose: translation (m) and rotation (rad), base axes."""
    missed_covariance: Float[ndarray, "n 6 6"]
    """What to expect of that, the pose's own noise included."""

    @property
    def covariance(self) -> Float[ndarray, "7 7"]:
        """Covariance in records.COVARIANCE_ORDER, widened for an estimated noise."""
        share = self.noise_share
        of_seven = NoiseShare(share.by_log_variance[:, :7, :7], share.log_variance_covariance)
        return widened(np.linalg.inv(self.hessian)[:7, :7], of_seven)


def deleted_residuals(residual: Float[ndarray, "n 6"], hat: Float[ndarray, "n 6 6"]) -> Float[ndarray, "n 6"]:
    """Residuals of each pose from the fit without it, from those of the fit with it: (I − H)⁻¹ r."""
    return np.linalg.solve(np.eye(6) - hat + 1e-9 * np.eye(6), residual[..., None])[..., 0]


def fit_poses(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]],
    used: Bool[ndarray, " n"],
    noise: tuple[float, float] | None = None,
    cues: Cues | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    iterations: int = 50,
) -> PoseFit:
    """Gauss-Newton from `start` (gripper_from_camera, scale, base_from_recon) on the `used` poses.

    Between two steps the noise is estimated, and with it the residuals' covariance: what falls is no sum of squares that
    least_squares.py could watch.

    `noise` is the robot's in (m, rad), at least; the residuals may say more. `camera_covariance` is that of the
    cameras, as records.CameraEvidence has it; None where they are exact beside the robot.
    """
    unknowns, cues = start, cues or Cues()
    robot, dof = noise or (5e-4, np.radians(0.1)), (np.inf, np.inf)
    poses = (base_from_gripper, recon_from_camera, used, camera_covariance, cues)
    for _ in range(iterations):
        system = _system(unknowns, robot, *poses)
        before, (robot, dof) = robot, _estimated_noise(system, robot, noise)
        settled = bool(np.allclose(robot, before, rtol=1e-6, atol=0.0))
        system = _system(unknowns, robot, *poses)
        step = -np.linalg.solve(system.hessian, system.gradient)
        # A wild start on nearly unobservable motions must not throw rotations around the circle.
        step *= min(1.0, 0.5 / max(np.abs(step[[3, 4, 5, 6, 10, 11, 12]]).max(), 1e-300))
        unknowns = _moved(*unknowns, step)
        if settled and float(step @ system.hessian @ step) < 1e-14:
            break
    system = _system(unknowns, robot, *poses)
    missed, missed_covariance = _missed(system, robot)
    share = noise_share(*system.passed_on(), robot, noise)
    return PoseFit(
        *unknowns,
        system.residual[:, :3],
        system.residual[:, 3:],
        robot,
        robot != noise,
        dof if share.log_variance_covariance.any() else (np.inf, np.inf),
        system.hessian,
        share,
        missed,
        missed_covariance,
    )


@dataclass(frozen=True)
class _System:
    """The equations at one value of the unknowns; r = 6 times the used poses, s = 6n."""

    residual: Float[ndarray, "n 6"]
    jacobian: Float[ndarray, "n 6 13"]
    used: Bool[ndarray, " n"]
    spread: Float[ndarray, "s s"] | None
    """Covariance that the cameras' errors give the residuals."""
    weight: Float[ndarray, " r"] | Float[ndarray, "r r"]
    """Inverse covariance of the used residuals; its diagonal where they are independent."""
    hessian: Float[ndarray, "13 13"]
    gradient: Float[ndarray, "13"]

    def weighed(self, x: Float[ndarray, "r *k"]) -> Float[ndarray, "r *k"]:
        """`weight` times x."""
        return (self.weight * x.T).T if self.weight.ndim == 1 else self.weight @ x

    def projected(self) -> tuple[Float[ndarray, "m 6"], Float[ndarray, "m 6 6"]]:
        """P r, and the diagonal blocks of P = W - W J H⁻¹ Jᵀ W: what residuals say once the unknowns are fitted
        (Searle et al., "Variance components", 1992, section 6.6)."""
        m = int(self.used.sum())
        by_unknown = self.weighed(self.jacobian[self.used].reshape(6 * m, 13)).reshape(m, 6, 13)
        if self.weight.ndim == 1:
            own = self.weight.reshape(m, 6, 1) * np.eye(6)
        else:
            own = self.weight.reshape(m, 6, m, 6)[range(m), :, range(m)]
        explained = by_unknown @ np.linalg.inv(self.hessian) @ np.swapaxes(by_unknown, 1, 2)
        return self.weighed(self.residual[self.used].ravel()).reshape(m, 6), own - explained

    def passed_on(self) -> tuple[Float[ndarray, "13 r"], Float[ndarray, "r r"]]:
        """H⁻¹ Jᵀ W, by which errors of the used poses pass into the unknowns, and P = W - W J H⁻¹ Jᵀ W."""
        by_unknown = self.weighed(self.jacobian[self.used].reshape(-1, 13))
        gain = np.linalg.solve(self.hessian, by_unknown.T)
        weight = np.diag(self.weight) if self.weight.ndim == 1 else self.weight
        return gain, weight - by_unknown @ gain


def _system(
    unknowns: tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]],
    robot: tuple[float, float],
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    used: Bool[ndarray, " n"],
    camera_covariance: Float[ndarray, "r r"] | None,
    cues: Cues,
) -> _System:
    residual, jacobian = residuals(*unknowns, base_from_gripper, recon_from_camera)
    variance = np.tile(np.repeat(np.square(robot), 3), used.sum())
    spread, weight = None, 1.0 / variance
    if camera_covariance is not None:
        n = len(used)
        by_camera = residuals_by_camera(*unknowns, recon_from_camera)
        blocks = camera_covariance.reshape(n, 6, n, 6).swapaxes(1, 2)
        spread = by_camera[:, None] @ blocks @ np.swapaxes(by_camera, 1, 2)
        spread = spread.swapaxes(1, 2).reshape(6 * n, 6 * n)
        rows = np.repeat(used, 6)
        weight = np.linalg.inv(spread[np.ix_(rows, rows)] + np.diag(variance))
    prior_hessian, prior_gradient = _prior(*unknowns[:2], cues)
    system = _System(residual, jacobian, used, spread, weight, prior_hessian, prior_gradient)
    j = jacobian[used].reshape(-1, 13)
    weighed = system.weighed(j)
    return replace(
        system,
        hessian=weighed.T @ j + prior_hessian,
        gradient=weighed.T @ residual[used].ravel() + prior_gradient,
    )


def _estimated_noise(
    system: _System, robot: tuple[float, float], given: tuple[float, float] | None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """One step of restricted maximum likelihood for the robot's noise, and its degrees of freedom."""
    told, own = system.projected()
    variance = np.repeat(np.square(robot), 3)
    squares = ((variance * told) ** 2).sum(0)
    degrees = (variance * np.einsum("mii->mi", own)).sum(0)
    dof = max(float(degrees[:3].sum()), 0.1), max(float(degrees[3:].sum()), 0.1)
    return robot_noise((float(squares[:3].sum()), float(squares[3:].sum())), dof, robot, given), dof


def _missed(
    system: _System, robot: tuple[float, float]
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 6"]]:
    """Each pose's residual from a fit without it, and its covariance; of a used pose P_ii⁻¹ (P r)_i and P_ii⁻¹."""
    sigma, used = np.repeat(robot, 3), system.used
    missed, covariance = np.empty_like(system.residual), np.empty((len(used), 6, 6))
    told, own = system.projected()
    without = np.linalg.inv(sigma[:, None] * own * sigma + 1e-9 * np.eye(6))
    missed[used] = sigma * np.einsum("mij,mj->mi", without, sigma * told)
    covariance[used] = sigma[:, None] * without * sigma
    inverse_hessian = np.linalg.inv(system.hessian)
    rows = np.repeat(used, 6)
    for i in np.flatnonzero(~used):
        residual, jacobian, own_spread = system.residual[i], system.jacobian[i], np.diag(sigma**2)
        if system.spread is not None:
            # What the other cameras' errors tell of this one's (best linear unbiased prediction).
            shared = system.spread[6 * i : 6 * i + 6, rows]
            gain = shared @ system.weight
            residual = residual - gain @ system.residual[used].ravel()
            jacobian = jacobian - gain @ system.jacobian[used].reshape(-1, 13)
            own_spread = own_spread + system.spread[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] - gain @ shared.T
        missed[i] = residual
        covariance[i] = own_spread + jacobian @ inverse_hessian @ jacobian.T
    return missed, covariance


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
    return retract(x, step[:6]), float(scale * np.exp(step[6])), retract(z, step[7:])
