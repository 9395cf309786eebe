"""Whether the camera still sits where it was calibrated, from new images located in the old reconstruction.

Under the null hypothesis a new image's reported gripper pose differs from the predicted one by the robot's noise,
the image's own uncertainty and that of the calibration, Σ; all new images share the latter. With the residuals r
of K images, V = J Σ Jᵀ + noise and D their derivative by the camera's place on the gripper, generalised least
squares gives the drift d = −(DᵀV⁻¹D)⁻¹DᵀV⁻¹r, and dᵀ(DᵀV⁻¹D)d / 6 follows F(6, ν) when nothing moved. ν is the
harmonic mean of the degrees of freedom behind the drift's independent directions (noise.py), which errs towards fewer
alarms: in 2700 simulated cases p was below 5 % in 2.8 %, below 1 % in 0.5 %, below 0.1 % in 0.11 %. The same with the
scene's place in D tells a table that was moved.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag
from scipy.optimize import root_scalar
from scipy.stats import chi2, f, hmean, ncf, ncx2

from jcr.geometry import retract, step_between
from jcr.handeye.equation import (
    BASE_ROTATION,
    BASE_TRANSLATION,
    ROTATION,
    TRANSLATION,
    Poses,
    residuals,
    residuals_by_camera,
)
from jcr.handeye.fit import PoseFit
from jcr.handeye.noise import NoiseShare, directions

CLEAR = 10.0
"""Difference of −2 log likelihoods by which one explanation is preferred to the other (odds of 150 to 1)."""
POWER = 0.9

Cause = Literal["camera", "scene", "either"]


@dataclass(frozen=True)
class Drift:
    """How far the camera seems to have moved on the gripper since the calibration."""

    offset: Float[ndarray, "6"]
    """The step from the calibrated gripper_from_camera to the one now (m, rad), gripper axes."""
    covariance: Float[ndarray, "6 6"]
    p_value: float
    """Of a drift like this or larger where nothing has moved."""
    misfit_p_value: float | None
    """Of new images disagreeing like this when one drift explains them; None for one image."""
    cause: Cause
    """What explains the images better: the camera moved on the gripper, or the scene moved in the base."""
    detectable: tuple[float, float]
    """m, rad: drifts in the worst direction that the test at this `alpha` would find nine times in ten."""


def drift(
    calibrated: PoseFit,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    camera_covariance: Float[ndarray, "n 6 6"],
    alpha: float,
) -> Drift:
    """The drift that new images show; `camera_covariance` is of steps of the cameras, recon axes."""
    camera, camera_misfit = _moved_by(
        calibrated, base_from_gripper, recon_from_camera, camera_covariance, (TRANSLATION, ROTATION)
    )
    _, scene_misfit = _moved_by(
        calibrated, base_from_gripper, recon_from_camera, camera_covariance, (BASE_TRANSLATION, BASE_ROTATION)
    )
    offset, covariance, nu = camera
    more = 6 * (len(base_from_gripper) - 1)
    difference = camera_misfit - scene_misfit
    return Drift(
        offset,
        covariance,
        _tail(float(offset @ np.linalg.solve(covariance, offset)), 6, nu),
        _tail(camera_misfit, more, nu) if more else None,
        "either" if abs(difference) < CLEAR else "camera" if difference < 0 else "scene",
        detectable(covariance, alpha, nu),
    )


def _tail(squares: float, dof: int, nu: float) -> float:
    """Probability of a sum of `dof` squares at least this large, its variance estimated with `nu` of freedom."""
    return float(chi2.sf(squares, dof) if np.isinf(nu) else f.sf(squares / dof, dof, nu))


def detectable(covariance: Float[ndarray, "6 6"], alpha: float, nu: float = np.inf) -> tuple[float, float]:
    """Shifts (m) and turns (rad) in the worst direction that a test at `alpha` finds nine times in ten."""

    def power(squared: float) -> float:
        if np.isinf(nu):
            return float(ncx2.sf(chi2.isf(alpha, 6), 6, squared))
        return float(ncf.sf(f.isf(alpha, 6, nu), 6, nu, squared))

    length = np.sqrt(root_scalar(lambda squared: power(squared) - POWER, bracket=(1e-3, 1e3)).root)
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])


def _moved_by(
    calibrated: PoseFit,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    camera_covariance: Float[ndarray, "n 6 6"],
    columns: tuple[slice, slice],
) -> tuple[tuple[Float[ndarray, "6"], Float[ndarray, "6 6"], float], float]:
    """Generalised least squares for a motion of X or of base_from_recon: the motion, its covariance and the degrees
    of freedom behind that, and the misfit.

    The covariance of the residuals changes with the unknowns, which least_squares.py does not know.
    """
    x, scale, z = calibrated.gripper_from_camera, calibrated.scale, calibrated.base_from_recon
    of_x = columns[0] == TRANSLATION
    spread, from_old = np.linalg.inv(calibrated.hessian), calibrated.noise_share
    start = x if of_x else z
    n = 6 * len(base_from_gripper)
    own = np.tile(np.repeat(np.diag(np.square(calibrated.noise)), 3, axis=1), len(base_from_gripper))
    own = own[:, None] * np.eye(n)
    normal, misfit, nu = np.eye(6), 0.0, np.inf
    for _ in range(10):
        residual, jacobian = residuals(x, scale, z, base_from_gripper, recon_from_camera)
        residual = residual.ravel()
        by_camera = residuals_by_camera(x, scale, z, recon_from_camera)
        of_camera = by_camera @ camera_covariance @ np.swapaxes(by_camera, 1, 2)
        stacked = jacobian.reshape(n, 13)
        v = stacked @ spread @ stacked.T + own.sum(0) + block_diag(*of_camera)
        design = np.concatenate([stacked[:, part] for part in columns], axis=1)
        weighted = np.linalg.solve(v, np.c_[design, residual])
        normal, misfit = design.T @ weighted[:, :6], float(residual @ weighted[:, 6])
        step = -np.linalg.solve(normal, design.T @ weighted[:, 6])
        misfit -= float(step @ normal @ step)
        gain = np.linalg.solve(normal, weighted[:, :6].T)
        of_noise = gain @ (stacked @ from_old.by_log_variance @ stacked.T + own) @ gain.T
        share = NoiseShare(of_noise, from_old.log_variance_covariance)
        nu = float(hmean(directions(np.linalg.inv(normal), share)[1]))
        x, z = (retract(x, step), z) if of_x else (x, retract(z, step))
        if float(step @ normal @ step) < 1e-10:
            break
    offset = step_between(start, x if of_x else z)
    return (offset, np.linalg.inv(normal), nu), max(misfit, 0.0)
