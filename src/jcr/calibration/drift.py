"""Whether the camera still sits where it was calibrated, from new images located in the old reconstruction.

Under the null hypothesis a new image's reported gripper pose differs from the predicted one by the robot's errors, the
image's own uncertainty and that of the calibration. All new images share the latter, and systematic errors are alike
where new gripper poses are near old ones: old and new images are therefore solved together (mixed_model.py), with a
drift of the camera that only new ones see. The squared Mahalanobis distance of the drift follows χ²(6) when nothing
moved; its tail is averaged over the sizes of the robot's errors. The same with a motion of the scene tells a table
that was moved.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag
from scipy.optimize import root_scalar
from scipy.stats import chi2, ncx2

from jcr.estimation.cholesky import lower
from jcr.estimation.components import most_likely, over_sizes
from jcr.estimation.equation import (
    PRIOR_STD,
    ROTATION,
    SCALE,
    TRANSLATION,
    Poses,
    residuals,
    residuals_by_camera,
)
from jcr.estimation.mixed_model import Equations, LinearSolution, solve_equations
from jcr.estimation.solve import Solution
from jcr.estimation.systematic import Region
from jcr.estimation.wrist import Start
from jcr.geometry import retract, step_between

CLEAR = 10.0
"""Difference of −2 log likelihoods by which one explanation is preferred to the other (odds of 150 to 1)."""
POWER = 0.9
SETTLED = 1e-9

NewPoses = Float[ndarray, "k 4 4"]
Cause = Literal["camera", "scene", "either"]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One explanation of the new images: a motion of X, or of base_from_recon."""

    offset: Float[ndarray, "6"]
    """The step from the calibrated transform to the one now (m, rad); of X in gripper axes."""
    covariance: Float[ndarray, "6 6"]
    p_value: float
    """Of a motion like this or larger where nothing has moved."""
    misfit: float
    """Squared distance of the new images from it, averaged over the sizes of the robot's errors."""
    misfit_p_value: float | None
    """Of new images disagreeing like this when one motion explains them; None for one image."""


@dataclass(frozen=True, kw_only=True)
class Drift(Motion):
    """How far the camera seems to have moved on the gripper since the calibration."""

    cause: Cause
    """What explains the images better: the camera moved on the gripper, or the scene moved in the base."""
    detectable: tuple[float, float]
    """m, rad: drifts in the worst direction that the test at this `alpha` would find nine times in ten."""


def drift(
    calibrated: Solution,
    old: tuple[Poses, Poses],
    new: tuple[NewPoses, NewPoses, Float[ndarray, "k 6 6"]],
    systematic: Float[ndarray, "s s"],
    alpha: float,
) -> Drift:
    """The drift that new images show.

    `old` holds the gripper poses and cameras of the calibration, `new` those of the new images and the covariance of
    steps of these cameras (geometry.retract, recon axes); `systematic` is the covariance of the systematic errors of old
    and new gripper poses at 1 rad.
    """
    camera = _estimate_motion(calibrated, old, new, systematic, slice(0, 6))
    scene = _estimate_motion(calibrated, old, new, systematic, slice(7, 13))
    difference = camera.misfit - scene.misfit
    cause = "either" if abs(difference) < CLEAR else "camera" if difference < 0 else "scene"
    return Drift(**vars(camera), cause=cause, detectable=detectable(camera.covariance, alpha))


def detectable(covariance: Float[ndarray, "6 6"], alpha: float) -> tuple[float, float]:
    """Shifts (m) and rotations (rad) in the worst direction that a test at `alpha` finds nine times in ten."""
    least = chi2.isf(alpha, 6)
    found = root_scalar(lambda squared: float(ncx2.sf(least, 6, squared)) - POWER, bracket=(1e-3, 1e3))
    length = np.sqrt(found.root)
    worst = [np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (TRANSLATION, ROTATION)]
    return float(length * worst[0]), float(length * worst[1])


def _estimate_motion(
    calibrated: Solution,
    old: tuple[Poses, Poses],
    new: tuple[NewPoses, NewPoses, Float[ndarray, "k 6 6"]],
    systematic: Float[ndarray, "s s"],
    columns: slice,
) -> Motion:
    """Generalised least squares of old and new images together, in which new ones see a moved X or base_from_recon."""
    x, scale, z = calibrated.state.x[0], calibrated.state.scale, calibrated.state.z[0]
    of_x = columns.start == 0
    m, n = 6 * len(old[0]), 6 * len(new[0])
    residual, jacobian = residuals(x, scale, z, *old)
    stacked = jacobian.reshape(m, 13)
    region = Region.of_unknowns(np.delete(stacked, SCALE, axis=1), 13)
    prior = np.diag(np.r_[PRIOR_STD**-2.0, np.zeros(6)])
    alone = Equations(
        residual=residual.ravel(),
        jacobian=stacked,
        prior_information=prior,
        prior_gradient=np.zeros(13),
        systematic=region.left(systematic[:m, :m]),
        given=calibrated.noise.given,
    )
    log_sizes, information = most_likely(alone)

    def together(moved: Float[ndarray, "4 4"]) -> Equations:
        return _together(
            alone, region, (moved, scale, z) if of_x else (x, scale, moved), new, systematic, columns
        )

    start = moved = x if of_x else z
    for _ in range(10):
        step = solve_equations(together(moved), log_sizes).step[13:]
        moved = retract(moved, step)
        if float(np.abs(step).max()) < SETTLED:
            break
    return _averaged(
        alone, together(moved), over_sizes(alone, log_sizes, information), step_between(start, moved), n - 6
    )


def _together(
    alone: Equations,
    region: Region,
    seen_by_new: Start,
    new: tuple[NewPoses, NewPoses, Float[ndarray, "k 6 6"]],
    systematic: Float[ndarray, "s s"],
    columns: slice,
) -> Equations:
    """The equations of old images with those of new ones, whose X or base_from_recon, `columns`, is one of their own."""
    m, n = len(alone.residual), 6 * len(new[0])
    residual_new, jacobian_new = residuals(*seen_by_new, *new[:2])
    of_new = jacobian_new.reshape(n, 13)
    by_camera = residuals_by_camera(*seen_by_new, new[1])
    known = np.zeros((m + n, m + n))
    known[m:, m:] = block_diag(*(by_camera @ new[2] @ np.swapaxes(by_camera, 1, 2)))
    both = np.concatenate([alone.jacobian, of_new])
    design = np.concatenate([both, np.concatenate([np.zeros((m, 6)), of_new[:, columns]])], axis=1)
    everywhere = Region(np.delete(both, SCALE, axis=1), np.hstack([region.fit, np.zeros((12, n))]))
    return Equations(
        residual=np.concatenate([alone.residual, residual_new.ravel()]),
        jacobian=design,
        prior_information=np.diag(np.r_[np.diag(alone.prior_information), np.zeros(6)]),
        prior_gradient=np.zeros(19),
        known=known,
        systematic=everywhere.left(systematic),
        given=alone.given,
    )


def _averaged(
    alone: Equations,
    joint: Equations,
    known_sizes: Iterable[tuple[ndarray, ndarray, LinearSolution]],
    begun: Float[ndarray, "6"],
    freedom: int,
) -> Motion:
    """The motion, and how the new images agree on it, averaged over the sizes of the robot's errors that the old images
    leave open.

    `begun` is the motion at which `joint` is linear; `freedom` that of the new images' residuals beside it.
    """
    weights, steps, covariances, misfits = [], [], [], []
    for weight, sizes, by_old in known_sizes:
        solution = solve_equations(joint, sizes)
        weights.append(weight)
        steps.append(begun + solution.step[:, 13:])
        covariances.append(solution.covariance[:, 13:, 13:])
        misfits.append(np.maximum(_squares(joint, solution) - _squares(alone, by_old), 0.0))
    weight, steps, each, misfits = (np.concatenate(x) for x in (weights, steps, covariances, misfits))
    offset = weight @ steps
    off = steps - offset
    distances = np.einsum("ki,ki->k", steps, np.linalg.solve(each, steps[..., None])[..., 0])
    return Motion(
        offset=offset,
        covariance=np.einsum("k,kij->ij", weight, each) + np.einsum("k,ki,kj->ij", weight, off, off),
        p_value=float(weight @ chi2.sf(distances, 6)),
        misfit=float(weight @ misfits),
        misfit_p_value=float(weight @ chi2.sf(misfits, freedom)) if freedom > 0 else None,
    )


def _squares(equations: Equations, solution: LinearSolution) -> Float[ndarray, " k"]:
    """Squared distance of the residuals from the fit."""
    left = equations.residual[:, None] + equations.jacobian @ solution.step[..., None]
    prior = np.einsum("ki,ij,kj->k", solution.step, equations.prior_information, solution.step)
    return (lower(solution.root, left) ** 2).sum((-1, -2)) + prior
