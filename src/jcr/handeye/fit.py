"""Maximum-likelihood hand-eye calibration from poses: the robot's reported poses err, each image at random and all
alike.

The reported gripper pose of image i differs from `base_from_recon · S_λ(recon_from_camera) · X⁻¹` by a random error,
σ_t per axis of position and σ_r per axis of rotation, and by a systematic one that it shares with poses near it
(systematic.py). Their sizes are estimated with the rest (components.py), so the covariance is that of the robot at
hand. Working with images instead of motions keeps the random errors independent, and makes the result blind to their
order.

Camera poses are taken as exact beside the robot's, unless their joint covariance is given: then both errors count
(generalised least squares), which is what kinematic alignment does, to first order and with the robot pose noise
estimated. Few images, or a robot better than the cameras, need it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.linalg import cho_solve

from jcr.geometry import retract
from jcr.handeye.components import (
    Equations,
    Solution,
    expected_covariance_at,
    expected_posterior,
    log_evidence,
    most_likely,
    posterior,
    solve,
)
from jcr.handeye.equation import PRIOR_STD, SCALE, TRANSLATION, Poses, residuals, residuals_by_camera
from jcr.handeye.systematic import Region, smooth_errors
from jcr.records import Budget, RobotNoise

SHOWN = 1.1
"""Times the noise that was given: so much more is the residuals' doing."""
LARGEST_TURN = 0.5
"""rad, and of the logarithm of scale: a poor start on nearly unobservable motions must not throw rotations around the
circle."""

Unknowns = tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]]
"""gripper_from_camera, scale, base_from_recon."""


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
    """σ_t (m) and σ_r (rad) per axis of the random errors, given or estimated."""
    noise_estimated: bool
    given_noise: tuple[float, float] | None
    systematic: float
    """σ_s (rad) of the systematic errors."""
    systematic_left: tuple[float, float]
    """m, rad per axis: what of them is left in the used poses."""
    log_evidence: float
    """Log density of the used poses' residuals, averaged over unknowns and sizes of errors, times (2π)^(3m)."""
    covariance: Float[ndarray, "7 7"]
    """In records.COVARIANCE_ORDER."""
    budget: Budget | None
    """Its parts; None of a fit that is not averaged."""
    missed: Float[ndarray, "n 6"]
    """By how much a fit without it misses each pose: translation (m), rotation (rad), both in base axes."""
    missed_covariance: Float[ndarray, "n 6 6"]
    """What to expect of that, the pose's own noise included."""


def fit_poses(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    start: Unknowns,
    used: Bool[ndarray, " n"],
    noise: tuple[float, float] | None = None,
    cues: Cues | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    systematic: Float[ndarray, "r r"] | None = None,
    averaged: bool = True,
    iterations: int = 50,
) -> PoseFit:
    """Gauss-Newton from `start` on the `used` poses; the answer is the effective hand-eye transform.

    Between two steps the sizes of the errors are estimated, and with them the residuals' covariance: what falls is no
    sum of squares that least_squares.py could watch.

    `noise` is the robot's in (m, rad), at least; the residuals may say more. `camera_covariance` is that of the steps
    of the cameras (geometry.retract, recon axes); None where the cameras are exact beside the robot. `systematic` is
    the covariance of the systematic errors at 1 rad; None: that of errors smooth over the poses. Without `averaged`
    the sizes of the errors are taken at their most likely values, which is faster and claims too much.
    """
    cues = cues or Cues()
    if systematic is None:
        systematic = smooth_errors(base_from_gripper)
    problem = _Problem(base_from_gripper, recon_from_camera, used, noise, cues, camera_covariance, systematic)
    unknowns, log_sizes = _stepped(problem, start, 1e-14 if averaged else 1e-6, iterations)
    linear = _linearised(problem, unknowns)
    log_sizes, information = most_likely(linear.equations, log_sizes)
    solution = solve(linear.equations, log_sizes)
    if averaged:
        found = posterior(linear.equations, log_sizes, information, linear.region)
        unknowns, covariance, budget = _moved(*unknowns, found.step), found.covariance, found.budget
    else:
        covariance = solution.covariance
        budget = None
    sigma_t, sigma_r, sigma_s = (float(x) for x in np.sqrt(linear.equations.variances(log_sizes)))
    missed, missed_covariance = _missed(problem, linear, solution, (sigma_t, sigma_r), sigma_s)
    residual = residuals(*unknowns, base_from_gripper, recon_from_camera)[0]
    return PoseFit(
        *unknowns,
        residual[:, :3],
        residual[:, 3:],
        (sigma_t, sigma_r),
        exceeds((sigma_t, sigma_r), noise),
        noise,
        sigma_s,
        linear.equations.systematic_left(log_sizes),
        log_evidence(linear.equations, solution, information),
        covariance[:7, :7],
        budget,
        missed,
        missed_covariance,
    )


def expected_fit(
    base_from_gripper: Poses,
    gripper_from_camera: Float[ndarray, "4 4"],
    noise: RobotNoise,
    systematic: Float[ndarray, "r r"],
    cues: Cues | None = None,
    averaged: bool = True,
) -> Float[ndarray, "7 7"]:
    """Covariance that a fit to exact camera poses is expected to report, of a robot with this noise; the scale being 1.

    `systematic`, `cues` and `averaged` are as `fit_poses` takes them.
    """
    problem = _Problem(
        base_from_gripper,
        base_from_gripper @ gripper_from_camera,
        np.ones(len(base_from_gripper), bool),
        noise.given,
        cues or Cues(),
        None,
        systematic,
    )
    linear = _linearised(problem, (gripper_from_camera, 1.0, np.eye(4)))
    if averaged:
        return expected_posterior(linear.equations, noise, linear.region).covariance[:7, :7]
    return expected_covariance_at(linear.equations, noise, linear.region)[:7, :7]


def _stepped(
    problem: "_Problem", unknowns: Unknowns, settled: float, iterations: int
) -> tuple[Unknowns, Float[ndarray, " c"] | None]:
    """Gauss-Newton until a step of less than `settled` squared standard deviations; the sizes of errors before it."""
    log_sizes = None
    for _ in range(iterations):
        linear = _linearised(problem, unknowns)
        log_sizes, _ = most_likely(linear.equations, log_sizes)
        solution = solve(linear.equations, log_sizes)
        step = solution.step * min(
            1.0, LARGEST_TURN / max(np.abs(solution.step[[3, 4, 5, 6, 10, 11, 12]]).max(), 1e-300)
        )
        unknowns = _moved(*unknowns, step)
        if float(((solution.information_root.T @ step) ** 2).sum()) < settled:
            break
    return unknowns, log_sizes


def exceeds(noise: tuple[float, float], given: tuple[float, float] | None) -> bool:
    """Whether a noise is the residuals' doing, and not the one that was given."""
    return given is None or any(size > SHOWN * known for size, known in zip(noise, given, strict=True))


@dataclass(frozen=True)
class _Problem:
    """What stays while the unknowns move; r = 6n."""

    base_from_gripper: Poses
    recon_from_camera: Poses
    used: Bool[ndarray, " n"]
    noise: tuple[float, float] | None
    cues: Cues
    camera_covariance: Float[ndarray, "r r"] | None
    systematic: Float[ndarray, "r r"]


@dataclass(frozen=True)
class _Linearised:
    """The equations at one value of the unknowns, of all poses and of the used ones."""

    residual: Float[ndarray, "n 6"]
    jacobian: Float[ndarray, "n 6 13"]
    shared: Float[ndarray, "r r"]
    """Covariance that the cameras give the residuals of all poses; 0 where they are exact."""
    systematic: Float[ndarray, "r r"]
    """Of what systematic errors leave in all poses, at 1 rad."""
    region: Region
    equations: Equations


def _linearised(problem: _Problem, unknowns: Unknowns) -> _Linearised:
    used, n = problem.used, len(problem.used)
    rows = np.repeat(used, 6)
    residual, jacobian = residuals(*unknowns, problem.base_from_gripper, problem.recon_from_camera)
    stacked = jacobian.reshape(6 * n, 13)
    region = Region.of_poses(stacked[rows])
    fit = np.zeros((12, 6 * n))
    fit[:, rows] = region.fit
    systematic = Region(np.delete(stacked, SCALE, axis=1), fit).left(problem.systematic)
    shared = np.zeros((6 * n, 6 * n))
    if problem.camera_covariance is not None:
        by_camera = residuals_by_camera(*unknowns, problem.recon_from_camera)
        blocks = problem.camera_covariance.reshape(n, 6, n, 6).swapaxes(1, 2)
        shared = (
            (by_camera[:, None] @ blocks @ np.swapaxes(by_camera, 1, 2)).swapaxes(1, 2).reshape(6 * n, 6 * n)
        )
    among = np.ix_(rows, rows)
    equations = Equations(
        residual[used].ravel(),
        stacked[rows],
        *_prior(*unknowns[:2], problem.cues),
        None if problem.camera_covariance is None else shared[among],
        systematic[among],
        problem.noise,
    )
    return _Linearised(residual, jacobian, shared, systematic, region, equations)


def _missed(
    problem: _Problem, linear: _Linearised, solution: Solution, noise: tuple[float, float], systematic: float
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 6"]]:
    """Each pose's residual from a fit without it, and its covariance."""
    equations, used = linear.equations, problem.used
    missed, covariance = np.empty_like(linear.residual), np.empty((len(used), 6, 6))
    missed[used], covariance[used] = left_out(equations, solution, noise)
    weight = cho_solve((solution.root, True), np.eye(len(equations.residual)))
    # What the other poses' errors tell of an unused one's (best linear unbiased prediction).
    alike = linear.shared + systematic**2 * linear.systematic
    rows = np.repeat(used, 6)
    for i in np.flatnonzero(~used):
        mine = slice(6 * i, 6 * i + 6)
        gain = alike[mine, rows] @ weight
        jacobian = linear.jacobian[i] - gain @ equations.jacobian
        missed[i] = linear.residual[i] - gain @ equations.residual
        own_spread = alike[mine, mine] - gain @ alike[mine, rows].T
        own_noise = np.diag(np.repeat(np.square(noise), 3))
        covariance[i] = own_spread + own_noise + jacobian @ solution.covariance @ jacobian.T
    return missed, covariance


def left_out(
    equations: Equations, solution: Solution, noise: tuple[float, float]
) -> tuple[Float[ndarray, "m 6"], Float[ndarray, "m 6 6"]]:
    """Each used pose's residual from a fit without it, P_ii⁻¹ (P r)_i with P = V⁻¹ − V⁻¹J C JᵀV⁻¹, and its covariance
    P_ii⁻¹.

    `noise` (m, rad) sets the units in which the matrices are inverted.
    """
    sigma, m = np.repeat(noise, 3), len(equations.residual) // 6
    weight = cho_solve((solution.root, True), np.eye(6 * m))
    left = weight @ (equations.residual + equations.jacobian @ solution.step)
    projection = weight - solution.weighed @ solution.gain
    own = projection.reshape(m, 6, m, 6)[range(m), :, range(m)]
    without = np.linalg.inv(sigma[:, None] * own * sigma + 1e-9 * np.eye(6))
    missed = sigma * np.einsum("mij,mj->mi", without, sigma * left.reshape(m, 6))
    return missed, sigma[:, None] * without * sigma


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
) -> Unknowns:
    return retract(x, step[:6]), float(scale * np.exp(step[6])), retract(z, step[7:])
