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

from jcr.estimation.components import log_evidence, most_likely
from jcr.estimation.mixed_model import Equations, LogSizes, Solution, left_out, solve
from jcr.estimation.pose_equations import (
    SCALE,
    TRANSLATION,
    UNKNOWNS,
    Poses,
    pose_by_pose,
    residuals,
    residuals_by_camera,
    share_within_limits,
    weak_prior,
)
from jcr.estimation.posterior import expected_covariance_at, expected_posterior, posterior
from jcr.estimation.systematic import Region
from jcr.geometry import Transform, retract
from jcr.records import Budget, RobotNoise

ITERATIONS = 50

Unknowns = tuple[Transform, float, Transform]
"""gripper_from_camera, scale, base_from_recon."""


@dataclass(frozen=True)
class Cues:
    """What the user measured, for motions that leave it unseen; each with its standard deviation."""

    scale: tuple[float, float] | None = None
    """Metres per recon unit, relative standard deviation."""
    offset: tuple[Float[ndarray, "3"], float, float] | None = None
    """Axis in the gripper frame, camera centre along it (m), standard deviation (m)."""


@dataclass(frozen=True, kw_only=True)
class PoseProblem:
    """Poses of n images, and what is known beside; r = 6n."""

    base_from_gripper: Poses
    recon_from_camera: Poses
    used: Bool[ndarray, " n"]
    """Which of them the fit rests on."""
    systematic: Float[ndarray, "r r"]
    """Covariance of the systematic errors at 1 rad (systematic.py)."""
    noise: tuple[float, float] | None = None
    """The robot's (m, rad), at least; the residuals may show more."""
    cues: Cues = Cues()
    camera_covariance: Float[ndarray, "r r"] | None = None
    """Of steps of the cameras (geometry.retract, recon axes); None where they are exact beside the robot."""


@dataclass(frozen=True, kw_only=True)
class PoseFit:
    """The fit, and what its residuals show."""

    gripper_from_camera: Transform
    scale: float
    base_from_recon: Transform
    residual: Float[ndarray, "n 6"]
    """Steps from the reported to the predicted gripper (m, rad; base axes), of every pose, used or not."""
    noise: RobotNoise
    log_evidence: float
    """Log density of the used poses' residuals, averaged over unknowns and sizes of errors, times (2π)^(3m)."""
    covariance: Float[ndarray, "7 7"]
    """In records.COVARIANCE_ORDER."""
    budget: Budget | None
    """Its parts; None of a fit that is not averaged."""
    leave_one_out: Float[ndarray, "n 6"]
    """Each pose's residual (m, rad; base axes) from a fit without it."""
    leave_one_out_covariance: Float[ndarray, "n 6 6"]
    """What to expect of that, the pose's own noise included."""


def fit_poses(problem: PoseProblem, start: Unknowns, averaged: bool = True) -> PoseFit:
    """Gauss-Newton from `start` on the used poses; the answer is the effective hand-eye transform.

    Between two steps the sizes of the errors are estimated, and with them the residuals' covariance: what falls is no
    sum of squares that least_squares.py could watch. Without `averaged` the sizes of the errors are taken at their most
    likely values, which is faster and claims too much.
    """
    unknowns, log_sizes = _most_likely_unknowns(problem, start, 1e-14 if averaged else 1e-6)
    linear = linearised(problem, unknowns)
    equations = linear.equations
    log_sizes, information = most_likely(equations, log_sizes)
    solution = solve(equations, log_sizes)
    covariance, budget = solution.covariance, None
    if averaged:
        found = posterior(equations, log_sizes, information, linear.region)
        unknowns, covariance, budget = after(unknowns, found.step), found.covariance, found.budget
    noise = equations.noise(log_sizes)
    leave_one_out, leave_one_out_covariance = _leave_one_out(problem, linear, solution, noise)
    return PoseFit(
        gripper_from_camera=unknowns[0],
        scale=unknowns[1],
        base_from_recon=unknowns[2],
        residual=residuals(*unknowns, problem.base_from_gripper, problem.recon_from_camera)[0],
        noise=noise,
        log_evidence=log_evidence(equations, solution, information),
        covariance=covariance[:7, :7],
        budget=budget,
        leave_one_out=leave_one_out,
        leave_one_out_covariance=leave_one_out_covariance,
    )


def expected_fit(
    base_from_gripper: Poses,
    gripper_from_camera: Transform,
    noise: RobotNoise,
    systematic: Float[ndarray, "r r"],
    cues: Cues | None = None,
    averaged: bool = True,
) -> Float[ndarray, "7 7"]:
    """Covariance that a fit to exact camera poses is expected to report, of a robot with this noise; the scale being 1.

    `systematic` and `cues` are those of a PoseProblem, `averaged` that of `fit_poses`.
    """
    problem = PoseProblem(
        base_from_gripper=base_from_gripper,
        recon_from_camera=base_from_gripper @ gripper_from_camera,
        used=np.ones(len(base_from_gripper), bool),
        systematic=systematic,
        noise=noise.given,
        cues=cues or Cues(),
    )
    linear = linearised(problem, (gripper_from_camera, 1.0, np.eye(4)))
    if averaged:
        return expected_posterior(linear.equations, noise, linear.region).covariance[:7, :7]
    return expected_covariance_at(linear.equations, noise, linear.region)[:7, :7]


def _most_likely_unknowns(
    problem: PoseProblem, unknowns: Unknowns, settled: float
) -> tuple[Unknowns, LogSizes | None]:
    """The unknowns after steps until one of less than `settled` squared standard deviations; the sizes before it."""
    log_sizes = None
    for _ in range(ITERATIONS):
        equations = linearised(problem, unknowns).equations
        log_sizes, _ = most_likely(equations, log_sizes)
        solution = solve(equations, log_sizes)
        step = share_within_limits(solution.step) * solution.step
        unknowns = after(unknowns, step)
        if float(((solution.information_root.T @ step) ** 2).sum()) < settled:
            break
    return unknowns, log_sizes


def after(unknowns: Unknowns, step: Float[ndarray, "13"]) -> Unknowns:
    """The unknowns after a step in the order of equation.py."""
    x, scale, z = unknowns
    return retract(x, step[:6]), float(scale * np.exp(step[6])), retract(z, step[7:])


@dataclass(frozen=True, kw_only=True)
class Linearised:
    """The equations at one value of the unknowns, of all poses and of the used ones."""

    residual: Float[ndarray, "n 6"]
    jacobian: Float[ndarray, "n 6 13"]
    shared: Float[ndarray, "r r"]
    """Covariance that the cameras give the residuals of all poses; 0 where they are exact."""
    systematic: Float[ndarray, "r r"]
    """Of what systematic errors leave in all poses, at 1 rad."""
    region: Region
    equations: Equations


def linearised(problem: PoseProblem, unknowns: Unknowns) -> Linearised:
    """The equations of poses at one value of the unknowns."""
    rows, n = np.repeat(problem.used, 6), len(problem.used)
    residual, jacobian = residuals(*unknowns, problem.base_from_gripper, problem.recon_from_camera)
    stacked = jacobian.reshape(6 * n, UNKNOWNS)
    region = Region.of_poses(stacked[rows])
    fit = np.zeros((12, 6 * n))
    fit[:, rows] = region.fit
    systematic = Region(np.delete(stacked, SCALE, axis=1), fit).left(problem.systematic)
    shared = np.zeros((6 * n, 6 * n))
    if problem.camera_covariance is not None:
        by_camera = residuals_by_camera(*unknowns, problem.recon_from_camera)
        shared = pose_by_pose(by_camera, pose_by_pose(by_camera, problem.camera_covariance).T)
    among = np.ix_(rows, rows)
    prior_information, prior_gradient = _prior(unknowns, problem.cues)
    equations = Equations(
        residual=residual[problem.used].ravel(),
        jacobian=stacked[rows],
        prior_information=prior_information,
        prior_gradient=prior_gradient,
        known=None if problem.camera_covariance is None else shared[among],
        systematic=systematic[among],
        given=problem.noise,
    )
    return Linearised(
        residual=residual,
        jacobian=jacobian,
        shared=shared,
        systematic=systematic,
        region=region,
        equations=equations,
    )


def _leave_one_out(
    problem: PoseProblem, linear: Linearised, solution: Solution, noise: RobotNoise
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 6"]]:
    """Each pose's residual from a fit without it, and its covariance."""
    equations, used = linear.equations, problem.used
    found, covariance = np.empty_like(linear.residual), np.empty((len(used), 6, 6))
    random = noise.translation, noise.rotation
    found[used], covariance[used] = left_out(solution, random)
    # What the other poses' errors show of an unused one's (best linear unbiased prediction).
    alike = linear.shared + noise.systematic**2 * linear.systematic
    rows = np.repeat(used, 6)
    for i in np.flatnonzero(~used):
        mine = slice(6 * i, 6 * i + 6)
        gain = alike[mine, rows] @ solution.weight
        jacobian = linear.jacobian[i] - gain @ equations.jacobian
        found[i] = linear.residual[i] - gain @ equations.residual
        own = alike[mine, mine] - gain @ alike[mine, rows].T + np.diag(np.repeat(np.square(random), 3))
        covariance[i] = own + jacobian @ solution.covariance @ jacobian.T
    return found, covariance


def _prior(unknowns: Unknowns, cues: Cues) -> tuple[Float[ndarray, "13 13"], Float[ndarray, "13"]]:
    """Information of what is known beforehand, and its gradient."""
    (x, scale, _), information, gradient = unknowns, weak_prior(), np.zeros(UNKNOWNS)
    if cues.scale is not None:
        known, std = cues.scale
        information[SCALE, SCALE] += std**-2
        gradient[SCALE] += np.log(scale / known) * std**-2
    if cues.offset is not None:
        axis, known, std = cues.offset
        information[TRANSLATION, TRANSLATION] += np.outer(axis, axis) * std**-2
        gradient[TRANSLATION] += axis * (axis @ x[:3, 3] - known) * std**-2
    return information, gradient
