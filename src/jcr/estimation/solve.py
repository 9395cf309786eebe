"""Solution of an estimation problem by rounds: estimate the error sizes, then take a Gauss-Newton step of all unknowns.

Without observations only the arms' unknowns are estimated; else arms, cameras, rigs and points together. Each round
leaves up to 0.97 of the distance. The result is averaged over the sizes of the robot's errors (covariance.py).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.estimation.covariance import posterior
from jcr.estimation.elimination import cholesky, inverse_of, lower, over
from jcr.estimation.image_equations import (
    SIZES_SETTLED,
    ImageEvidence,
    RigInformation,
    adjusted_images,
    cost_of_images,
    image_evidence,
    information_along,
    linearised,
    with_model_error_of,
    with_pixel_noise,
)
from jcr.estimation.intrinsics_prior import reach_px, unmodelled
from jcr.estimation.pose_equations import (
    PoseEquations,
    pose_by_pose,
    pose_equations,
    reported_poses,
    share_within_limits,
    weak_prior,
)
from jcr.estimation.problem import (
    SCALE,
    Problem,
    State,
    full_step,
    similarities_of_rigs,
    stepped,
    transferred,
    with_free,
)
from jcr.estimation.projection import view_of
from jcr.estimation.robot_noise import (
    MOST_FOR_SIZES,
    Equations,
    Information,
    LinearSolution,
    LogSizes,
    left_out,
    log_evidence,
    most_likely,
    score,
    solve_equations,
)
from jcr.geometry import Transform, apply, fit_similarity, step_between
from jcr.least_squares import one_blas_thread
from jcr.records import (
    COVARIANCE_ORDER,
    Budget,
    JointCovariance,
    ModelError,
    RobotNoise,
    Tracks,
    Uncertainty,
)

START_NOISE = (1e-3, float(np.radians(0.2)))
"""Assumed random errors of gripper poses before their first estimate (m, rad)."""
MAX_ROUNDS, MAX_ARM_STEPS = 150, 50
"""Largest number of rounds with observations, and of steps of the arms alone. Of the solutions of 14 real captures the
slowest takes 109 rounds: 24 images from which a thin prism and the principal point are estimated together."""
DIVERGING, ASTRAY = 12, 3.0
"""Number of steps of the arms after which a step above one standard deviation shows that they diverge. In 107 fits that
converge, at most the first two steps were larger. The scale can change by a factor of 400 in these steps. Of rounds
with observations, steps above ASTRAY standard deviations show it: in 25 solutions of nine real captures only the first
round has such a step, but the twelfth of 70 has one above one."""
STEP_SETTLED = 0.01
"""Largest step of an arm's unknown, in standard deviations, at which the rounds end."""
ROUNDING = 1e-9
"""Relative increase of a cost that is accepted as rounding."""
ARMS_SETTLED, NEARLY_SETTLED = 1e-14, 1e-5
"""Squared step of the arms' unknowns (in σ²) at which their iteration ends: for a result, for a comparison of fits."""
TINY_STEP = 1e-6
"""Step of numerical derivatives by the arms' unknowns (m, rad, log scale)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Solution of a problem: estimate averaged over sizes of the robot's errors, covariance, linearised equations."""

    problem: Problem
    state: State
    """Estimate, averaged over the sizes of the robot's errors."""
    covariance: Float[ndarray, "p p"]
    """Covariance of the p unknowns: steps of the arms, then of the columns `Problem.free`."""
    budget: Budget | None
    """Covariance of the first arm's X and scale divided by cause; None if the sizes were not averaged."""
    most_likely: State
    """State at the most likely error sizes, before the averaging; the equations are linearised there."""
    poses: PoseEquations
    """Equations of the reported poses."""
    at_mode: LinearSolution
    """Solution of the linearised equations at the most likely sizes of the robot's errors."""
    size_information: Information
    """Expected information of the log sizes of the robot's errors."""
    evidence: ImageEvidence | None = None
    """Evidence of the images; None without observations."""
    settled: bool = True
    """Whether the rounds converged within MAX_ROUNDS."""
    iterations: int = 0
    """Number of rounds; 0 without observations."""
    last_step: float = 0.0
    """Largest step of an arm's unknown in the last round, in standard deviations; 0 without observations."""

    @property
    def equations(self) -> Equations:
        """Linearised equations of the used reported poses; unknowns in the order of the covariance."""
        return self.poses.equations

    @property
    def log_sizes(self) -> LogSizes:
        """Most likely logarithms of the error sizes σ_t (m), σ_r, σ_s (rad) of each arm."""
        assert self.most_likely.robot_log_sizes is not None
        return self.most_likely.robot_log_sizes

    @property
    def noise(self) -> RobotNoise:
        """Estimated sizes of the errors of the first arm's reported poses."""
        return self.equations.noise(self.log_sizes)

    @property
    def images(self) -> ImageEvidence:
        """Evidence of the images; only for a problem with observations."""
        assert self.evidence is not None
        return self.evidence

    @cached_property
    def log_evidence(self) -> float:
        """Natural logarithm of (2π)^(3m) times the marginal density of the 6m residuals of m used poses.

        Unknowns and error sizes are integrated out.
        """
        return log_evidence(self.equations, self.at_mode, self.size_information)

    @cached_property
    def leave_one_out(self) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 6"]]:
        """Residual of each of n reported poses from the fit to the other used poses, and its covariance.

        A residual is the step from the reported to the predicted pose: position (m), then rotation (rad); base axes.
        """
        used, every, solution, n = self.poses.used, self.poses.every, self.at_mode, len(self.poses.used)
        random = every.random(self.log_sizes)
        found, covariance = every.residual.reshape(n, 6).copy(), np.empty((n, 6, 6))
        found[used], covariance[used] = left_out(solution, random[np.repeat(used, 6)])
        if used.all():
            return found, covariance
        # The used poses predict the systematic error of an unused one (best linear unbiased prediction).
        variance, rows = every.variances(self.log_sizes)[2], np.repeat(used, 6)
        for i in np.flatnonzero(~used):
            mine = slice(6 * i, 6 * i + 6)
            alike = variance * every.systematic[:, mine] + (
                0.0 if every.known is None else every.known[:, mine]
            )
            gain = over(solution.root, alike[rows]).T
            by = every.jacobian[mine] - gain @ self.equations.jacobian
            found[i] -= gain @ self.equations.residual
            own = alike[mine] - gain @ alike[rows] + np.diag(random[mine])
            covariance[i] = own + by @ solution.covariance @ by.T
        return found, covariance

    @property
    def is_astray(self) -> bool:
        """Whether the rounds ended because their steps stayed large, so that no minimum is near."""
        return not self.settled and self.last_step > ASTRAY

    def camera_unknowns(self, columns: slice) -> slice:
        """Return the slice of the p unknowns for a slice of `Problem.columns` (cameras, model errors or boards)."""
        first = self.problem.arm_unknowns
        return slice(first + columns.start, first + columns.stop)

    def intrinsics_covariance(self, camera: int) -> Float[ndarray, "q q"]:
        """Return the covariance of the q intrinsics of one camera, in the order of camera.parameters.

        `camera` is its index in the problem; focal lengths and principal point are in px.
        """
        own = self.camera_unknowns(self.problem.columns.cameras)
        directions = self.problem.directions[self.problem.parameters_of[camera]]
        return directions @ self.covariance[own, own] @ directions.T

    def transform(self, of: Callable[[State], Transform]) -> tuple[Transform, Float[ndarray, "6 6"]]:
        """Return the transform `of(state)` at the estimate, and the covariance (6,6) of its step (geometry.retract).

        The step is translation, then rotation vector (rad), in axes of the frame to which the transform maps.
        """
        j = self.derivative(of)
        return of(self.state), j @ self.covariance @ j.T

    def derivative(self, of: Callable[[State], Transform]) -> Float[ndarray, "6 p"]:
        """Return the derivative of the step of the transform `of(state)` by the p unknowns, by numerical differences.

        The six rows are translation, then rotation vector (rad), in axes of the frame to which the transform maps.
        """
        found, cameras = of(self.state), self.problem.arm_unknowns
        size = TINY_STEP * np.ones(len(self.covariance))
        std = np.sqrt(np.diag(self.covariance))
        size[cameras:] = np.minimum(1e-2 * std[cameras:], 1e-2) + 1e-9
        j = np.empty((6, len(size)))
        for k, step in enumerate(np.diag(size)):
            ahead, behind = (of(full_step(self.problem, self.state, way * step)) for way in (1, -1))
            j[:, k] = (step_between(found, ahead) - step_between(found, behind)) / (2 * size[k])
        return j


@one_blas_thread
def solve(
    problem: Problem, start: State, *, averaged: bool = True, start_noise: tuple[float, float] = START_NOISE
) -> Solution:
    """Solve a problem from an initial state; return the estimate with its covariance.

    If `start` has an estimate of the pixel noise already, it is taken as near the solution. Otherwise a bundle
    adjustment with assumed robot errors precedes the rounds. `averaged`: average over the sizes of the robot's errors,
    else use their most likely values, which is faster and understates the uncertainty. `start_noise` are these assumed
    random errors of the poses (m, rad), unless the problem has a lower bound.
    """
    least = ARMS_SETTLED if averaged else NEARLY_SETTLED
    if problem.observations is None:
        return with_covariance(problem, _most_likely_arms(problem, start, None, least), None, averaged)
    if start.pixel_noise is None:
        state = with_pixel_noise(problem, start, view_of(problem, start))
        noise = np.repeat(problem.robot_noise_floor or start_noise, 3)
        white = np.tile(noise, sum(len(arm.rigs) for arm in problem.arms))
        start = adjusted_images(problem, state, _rig_information(problem, state, np.diag(white)))
    state, images, settled, rounds, last_step = _rounds(problem, start)
    state = _most_likely_arms(problem, state, images, least)
    found = with_covariance(problem, state, images, averaged)
    return replace(found, settled=settled, iterations=rounds, last_step=last_step)


def solve_again(found: Solution, **changes: Any) -> Solution:
    """Return the solution of the problem of `found` after `changes` of its fields, starting from `found`.

    The observations stay. Raises LinAlgError if the problem becomes singular.
    """
    problem = with_free(found.problem, **changes)
    vars(problem).pop("displacements", None)
    return solve(problem, transferred(found.problem, found.state, problem))


def uncertainty_of(found: Solution) -> Uncertainty:
    """Return the uncertainty of the first arm's X (gripper_from_camera), the scale and the first camera's intrinsics.

    It includes the budget by cause, and the model error where it was estimated; `found` is the solution.
    """
    problem, observations, model_error = found.problem, found.problem.observations, None
    known, directions = problem.intrinsics(found.state)[0], problem.directions[problem.parameters_of[0]]
    own, cameras = problem.columns.model_error[0], found.camera_unknowns(problem.columns.cameras)
    if own.stop > own.start:
        assert observations is not None
        unknowns = found.camera_unknowns(own)
        x_px, middle = observations.x_px[problem.camera_rows[0]], problem.cameras[0].intrinsics
        model_error = ModelError(
            likeliest=found.state.camera_steps[own],
            covariance=found.covariance[unknowns, unknowns],
            expressed=unmodelled(middle, directions, x_px)[1],
            reach_px=reach_px(known, x_px),
        )
    by_unknown = np.eye(7 + len(directions), len(found.covariance))
    by_unknown[7:] = 0.0
    by_unknown[7:, cameras] = directions
    together = by_unknown @ found.covariance @ by_unknown.T
    order = *COVARIANCE_ORDER, *parameter_names(known)
    return Uncertainty(
        covariance=together[:7, :7],
        budget=found.budget,
        joint=JointCovariance(covariance=together, order=order),
        model_error=model_error,
    )


def recon_frame(solution: Solution, tracks: Tracks) -> tuple[float, Transform]:
    """Return scale (metres per unit) and base_from_recon (metres) of the reconstruction that `tracks` belong to.

    They are the robust least-squares similarity from the reconstruction's points to the adjusted points in the base
    frame.
    """
    state, observations = solution.state, solution.problem.observations
    assert observations is not None and observations.point_rows is not None
    points = apply(state.z[0], state.scale * state.points_in_world)
    recon = tracks.points_in_recon[observations.point_rows].astype(np.float64)
    weight = np.ones(len(points))
    base_from_recon, scale = fit_similarity(points, recon, weight)
    for _ in range(5):
        gap = np.linalg.norm(apply(base_from_recon, scale * recon) - points, axis=1)
        weight = 1 / (1 + (gap / max(float(np.median(gap)), 1e-9)) ** 2)
        base_from_recon, scale = fit_similarity(points, recon, weight)
    return float(scale), base_from_recon


def size_of_boards(solution: Solution) -> tuple[float, Float[ndarray, " p"]]:
    """Return log(estimated size / stated size) of the boards, and its derivative by the p unknowns of the solution.

    All boards share the size. The logarithm is natural; the problem must have boards.
    """
    problem, column = solution.problem, solution.problem.columns.boards.start
    assert problem.boards is not None
    by_unknown = np.zeros(problem.unknowns)
    by_unknown[SCALE] = by_unknown[problem.arm_unknowns + np.searchsorted(problem.free, column)] = 1.0
    size = np.log(solution.state.scale * problem.boards.unit) + solution.state.camera_steps[column]
    return float(size), by_unknown


def _rounds(problem: Problem, start: State) -> tuple[State, ImageEvidence, bool, int, float]:
    """Estimate error sizes and step all unknowns, in at most MAX_ROUNDS rounds until both converge or a step is astray.

    Return the state, the evidence of the images, whether the rounds converged, their number, and the largest last step
    of an arm's unknown in standard deviations.
    """
    state, log_sizes, last_step, count = start, start.robot_log_sizes, np.inf, 0
    robots = problem.arm_unknowns
    for count in range(1, MAX_ROUNDS + 1):
        before, view = state, view_of(problem, state)
        state = with_pixel_noise(problem, state, view)
        images, normal = linearised(problem, state, view)
        images, resized = with_model_error_of(images)
        state, known_sizes = images.state, log_sizes
        poses = pose_equations(problem, state, images)
        equations = poses.equations
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        state = replace(state, robot_log_sizes=log_sizes)
        change = np.inf if known_sizes is None else float(np.abs(log_sizes - known_sizes).max())
        solution, columns = solve_equations(equations, log_sizes), np.zeros(problem.columns.count)
        columns[problem.free], columns[problem.by_arm] = solution.step[robots:], poses.rig_step(solution)
        arms, std = solution.step[:robots], np.sqrt(solution.covariance.diagonal())
        last_step = float(np.abs(arms / std[:robots]).max())
        assert before.pixel_noise is not None and state.pixel_noise is not None
        growth = np.log(state.pixel_noise.sigma_px / before.pixel_noise.sigma_px)
        change = max(change, resized, float(np.abs(growth).max()))
        if change < SIZES_SETTLED and last_step < STEP_SETTLED:
            return state, images, True, count, last_step
        share = share_within_limits(arms)
        moved = stepped(problem, state, share * arms, share * columns)
        moved = replace(moved, points_in_world=normal.stepped(state.points_in_world, share * columns))
        # Both costs use the weights and error sizes at the start of the step.
        root = cholesky(replace(equations, known=None).covariance(log_sizes))
        cost, moved_cost = (
            float((lower(root, reported_poses(problem, one)[0].reshape(-1, 1)) ** 2).sum())
            + cost_of_images(images, one)
            for one in (state, moved)
        )
        if last_step > ASTRAY and count >= DIVERGING:
            break
        # A shortened step means a poor initial estimate.
        if share == 1 and moved_cost <= cost * (1 + ROUNDING):
            state = moved
        else:
            state = adjusted_images(problem, state, _rig_information(problem, state, root))
            state = _most_likely_arms(problem, state, image_evidence(problem, state), STEP_SETTLED**2)
    state = replace(state, robot_log_sizes=log_sizes)
    return state, image_evidence(problem, state), False, count, last_step


def with_covariance(
    problem: Problem,
    state: State,
    images: ImageEvidence | None,
    averaged: bool = True,
    expected: bool = False,
) -> Solution:
    """Return the solution with its covariance, from the most likely state and the evidence of the images.

    `images` None: camera poses are given. `averaged` is that of `solve`. `expected`: the solution is
    predicted, its residuals are 0, and the sizes of the robot's errors are typical ones instead of estimates.
    """
    poses = pose_equations(problem, state, images)
    equations = poses.equations
    if expected:
        log_sizes, information = equations.typical, score(equations, equations.typical)[2]
    else:
        log_sizes, information = most_likely(equations, state.robot_log_sizes)
    state = likeliest = replace(state, robot_log_sizes=log_sizes)
    at_mode = solve_equations(equations, log_sizes)
    covariance, budget = at_mode.covariance, None
    if averaged:
        step, covariance, budget = posterior(
            equations, log_sizes, at_mode, information, poses.region, expected
        )
        state = full_step(problem, state, step)
    return Solution(
        problem=problem,
        state=state,
        covariance=covariance,
        budget=budget,
        most_likely=likeliest,
        poses=poses,
        at_mode=at_mode,
        size_information=information,
        evidence=images,
    )


def _most_likely_arms(problem: Problem, state: State, images: ImageEvidence | None, settled: float) -> State:
    """Return the state with the likeliest arms' unknowns (X, scale, Z) and error sizes, for constant image evidence.

    Given camera poses with a covariance move to their likeliest values, too. If they stayed, the scale would be too
    small: the regression on values with errors is attenuated (Fuller, Measurement error models, 1987, section 1.1). The
    iteration ends when the squared step in units of standard deviations is below `settled`, or still above 1 after
    DIVERGING steps.
    """
    arms, size, sizes = problem.arm_unknowns, np.inf, state.robot_log_sizes
    for count in range(MAX_ARM_STEPS):
        poses = pose_equations(problem, state, images)
        equations = poses.equations
        # Sizes that are estimated from some of the poses alternate by 1e-5 and less until the steps are tiny.
        if sizes is None or size > NEARLY_SETTLED or len(equations.residual) <= 6 * MOST_FOR_SIZES:
            sizes, _ = most_likely(equations, sizes, SIZES_SETTLED / 3)
        solution = solve_equations(equations, sizes)
        share = share_within_limits(solution.step[:arms])
        step = share * solution.step[:arms]
        columns = share * poses.rig_step(solution) if images is None else None
        state = replace(stepped(problem, state, step, columns), robot_log_sizes=sizes)
        size = float(((step @ solution.information_root[:arms]) ** 2).sum())
        del poses, equations, solution  # of many poses each takes much memory
        if size < settled or (size > 1 and count >= DIVERGING):
            break
    return state


def _rig_information(problem: Problem, state: State, root: Float[ndarray, "s s"]) -> RigInformation:
    """Return the information of the reported poses about the rigs (camera poses), with X, scale and Z eliminated.

    `root` (6n,6n) is the lower Cholesky factor of the covariance of the n poses' errors. Reference poses are the rigs
    of `state`. Information along the seven similarities of the world is added.
    """
    residual, jacobian, by_rig = reported_poses(problem, state)
    jacobian = jacobian.reshape(len(root), -1)
    weighed = over(root, jacobian)
    eliminated = over(cholesky(jacobian.T @ weighed + weak_prior(len(problem.arms))), weighed.T)
    projection, to_rig = inverse_of(root) - weighed @ eliminated, np.swapaxes(by_rig, 1, 2)
    information = pose_by_pose(to_rig, pose_by_pose(to_rig, projection).T)
    rows, count = problem.by_arm - problem.columns.first_rig, 6 * problem.n_rigs
    of_all, gradient = np.zeros((count, count)), np.zeros(count)
    of_all[np.ix_(rows, rows)] = (information + information.T) / 2
    gradient[rows] = pose_by_pose(to_rig, (projection @ residual.ravel())[:, None])[:, 0]
    now = state.world_from_rig
    of_all += information_along(similarities_of_rigs(now), float(of_all.diagonal().mean()))
    return RigInformation(now, of_all, gradient)
