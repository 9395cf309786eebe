"""Errors of gripper poses: their covariance, the mixed linear model, and the estimates of their sizes.

The residuals of n poses are r = −J θ + e + ε. The random part ε has the variance σ_t² per axis of position and σ_r² per
axis of rotation; the systematic part e has the covariance σ_s² G. The *sizes* of the errors are σ_t (m), σ_r and σ_s
(rad), estimated by restricted maximum likelihood (Searle, Casella and McCulloch, "Variance components", 1992, section
6.6). Few images determine them badly, so results are averaged over a grid of log sizes about their mode (Rue, Martino
and Chopin, J. R. Statist. Soc. B 71, 2009, section 3).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.elimination import (
    cholesky,
    inverse_of,
    inverse_root,
    log_root_determinant,
    lower,
    over,
    upper,
)
from jcr.estimation.kinematics import Arm, Joints, error_jacobian, error_std
from jcr.geometry import Poses
from jcr.records import RobotNoise

REACH = 0.45
"""Typical lever (m) between an arm's joint and its gripper, which turns an angle error into a position error."""
ALIKE = 1.0
"""Distance of gripper poses (chord 2 sin(θ/2) of the angle θ; lengths over REACH) with the correlation e^(−1/2). The
errors of the eleven named arms are most likely with 1 for 12 views, and with 0.7 for 30. With 1.7, σ along the optical
axis is 9 % larger, and the share of points within 95 % changes by less than its chance."""
LINK_PER_JOINT = 3e-3 / np.radians(1.0)
"""Assumed ratio (m/rad) of link errors to joint offsets: 0.3 mm with 0.1°, 1 mm with 0.3°."""


def smooth_errors(base_from_gripper: Poses) -> Float[ndarray, "s s"]:
    """Return the covariance (6n,6n) of errors of n poses whose correlation decreases with the distance of the poses.

    Rows are position (m), then rotation (rad), pose by pose, in base axes. Standard deviations are REACH metres and 1
    rad per axis. The correlation is e^(−1/2) at the distance ALIKE. Half of the variance is constant in base axes, half
    in gripper axes.
    """
    n = len(base_from_gripper)
    rotation, position = base_from_gripper[:, :3, :3], base_from_gripper[:, :3, 3]
    between = rotation[:, None] @ np.swapaxes(rotation, 1, 2)[None]
    squared_apart = ((position[:, None] - position) ** 2).sum(-1) / REACH**2
    # The chord 2 sin(θ/2) of an angle θ: with θ itself the matrix has negative eigenvalues (a Gaussian of the geodesic
    # distance on SO(3) is not positive definite).
    squared_chord = 3 - np.trace(between, axis1=-2, axis2=-1)
    between += np.eye(3)
    between *= np.exp(-(squared_chord + squared_apart) / (2 * ALIKE**2))[..., None, None] / 2
    out = np.zeros((n, 6, n, 6))
    out[:, :3, :, :3] = out[:, 3:, :, 3:] = between.swapaxes(1, 2)
    out[:, :3, :, :3] *= REACH**2
    return out.reshape(6 * n, 6 * n)


def arm_errors(arm: Arm, joints: Joints) -> Float[ndarray, "s s"]:
    """Return the covariance (6n,6n) of the errors of n poses that an arm's joint offsets and link errors cause.

    Rows are position (m), then rotation (rad), pose by pose, in base axes. Joint offsets have 1 rad standard deviation,
    link translations LINK_PER_JOINT metres, link rotations as in `error_std`. `joints` (n,dof) are angles in rad.
    """
    columns = error_jacobian(arm, joints) * error_std(arm, 1.0, LINK_PER_JOINT)
    stacked = columns.reshape(-1, columns.shape[2])
    return stacked @ stacked.T


def of_poses(covariance: Float[ndarray, "r r"], poses: Int[ndarray, " m"]) -> Float[ndarray, "s s"]:
    """Return the part of a covariance of poses for the poses of these indices, in their order.

    Both matrices have six rows and columns per pose.
    """
    rows = (6 * poses[:, None] + np.arange(6)).ravel()
    return covariance[np.ix_(rows, rows)]


NOISE_FLOOR = (2e-5, np.radians(0.002))
"""Random errors (m, rad) that are added to the estimated ones, because a perfect fit does not prove a perfect robot."""
TYPICAL = np.array([3e-4, np.radians(0.04), np.radians(0.1)])
"""Middle of the weak priors on σ_t (m), σ_r (rad) and σ_s (rad) of an arm."""
FACTOR_STD = np.log([10.0, 10.0, 3.0])
"""Prior standard deviations of log σ_t, log σ_r, log σ_s (data sheets: 0.03 to 0.1°, servo arms 1 to 2°)."""
CAMERA_FACTOR_STD = np.log(30.0)
"""Prior standard deviation of the logarithm of each size of the camera pose errors, about its typical value 1."""
GIVEN_SHARE = 0.3
"""Middle of the prior on random errors in addition to a given noise, as a share of it."""
SHOWN = 1.1
"""Factor on a given noise above which the noise is reported as estimated from the residuals."""
RATIO_STD = np.log(4.0)
"""Prior standard deviation of log(σ_t / (REACH · σ_r)); with log 2, 95 % regions of three images hold 80 to 90 %."""
LEVELS = tuple(1.5 * np.arange(-4, 5))
"""Grid of log sizes along each axis, in standard deviations from the mode; relative error of an average: 3e-4."""
GRID_RADIUS, SMALL_GRID_RADIUS = 21.0, 10.0
"""Largest squared distance (σ²) of grid points from the mode; with 7, 95 % regions of three images hold 81 %."""
FINE_GRID_BELOW, MOST_FOR_SIZES = 15, 50
"""Number of poses from which the grid is smaller, and above which the mode of the sizes replaces it."""
ELEMENTS_AT_ONCE = 4e6
"""Largest number of array elements for the grid points of the sizes that are solved together."""
MODE_SETTLED = 1e-4
"""Largest step of the log sizes at which the search of their mode ends."""
LogSizes = Float[ndarray, "*k c"]
"""c logarithms: for each arm random errors σ_t (m) and σ_r (rad) and systematic error σ_s (rad); then the sizes of
camera pose errors."""
OF_ARM = 3
"""Number of error sizes of one arm: σ_t, σ_r, σ_s."""
Each = Float[ndarray, "*k"] | np.floating
Covariance = Float[ndarray, "s s"]
Information = Float[ndarray, "c c"]
"""Expected Fisher information of the c log sizes at their mode."""


@dataclass(frozen=True, kw_only=True)
class Equations:
    """Linearised equations r + J θ = noise of n gripper poses: s = 6n residuals r, p unknowns θ with a normal prior."""

    residual: Float[ndarray, " s"]
    """r: step from the reported to the predicted pose, pose by pose: m, then rad; both in base axes."""
    jacobian: Float[ndarray, "s p"]
    """J: derivative of r by the unknowns."""
    prior_information: Float[ndarray, "p p"]
    """Information matrix of the prior on θ."""
    prior_gradient: Float[ndarray, " p"]
    """Gradient of the prior's half squared distance at θ = 0."""
    systematic: Covariance
    """G: covariance of the systematic part e for σ_s = 1 rad."""
    known: Covariance | None = None
    """Covariance of the residuals from errors of the camera poses; None: exact camera poses."""
    given: tuple[float, float] | None = None
    """Lower bounds of the random errors σ_t (m) and σ_r (rad) that the user gave; None: none."""
    camera_errors: tuple[Covariance, ...] = ()
    """Covariances of the residuals from components of the camera pose errors, each for a typical size."""
    confirmed: Covariance | None = None
    """Covariance of errors by confirmed effects (a strain of the arm, ...); it does not depend on the sizes."""
    arm: Int[ndarray, " n"] | None = None
    """Arm of each of n poses; each arm has error sizes of its own, and no systematic error is shared by two arms. None:
    one arm."""

    @property
    def least(self) -> Float[ndarray, "2"]:
        """Lower bounds of the random errors (m, rad): the user's, else NOISE_FLOOR.

        The squares of these bounds add to the estimated variances.
        """
        return np.array(self.given or NOISE_FLOOR)

    @cached_property
    def prior(self) -> tuple[Float[ndarray, "r c"], Float[ndarray, " r"], Float[ndarray, " c"]]:
        """Weak prior on the c log sizes x, as whitened residuals A x − b: A, b, and the standard deviation of each x.

        The last residuals are those of log(σ_t / (REACH · σ_r)) of each arm.
        """
        added, arms = np.ones(len(self.camera_errors)), self.arms
        of_arm, first = TYPICAL.copy(), OF_ARM * np.arange(arms)
        if self.given is not None:
            of_arm[:2] = GIVEN_SHARE * self.least
        typical = np.r_[np.tile(of_arm, arms), added]
        std = np.r_[np.tile(FACTOR_STD, arms), CAMERA_FACTOR_STD * added]
        every = np.eye(len(std))
        rows = np.concatenate([np.diag(1 / std), (every[first] - every[first + 1]) / RATIO_STD])
        return rows, np.r_[np.log(typical) / std, np.full(arms, np.log(REACH) / RATIO_STD)], std

    @property
    def typical(self) -> Float[ndarray, " c"]:
        """Middle of the prior on the log sizes, in the order of `LogSizes`."""
        middle, std = self.prior[1:]
        return middle[: len(std)] * std

    @property
    def arms(self) -> int:
        """Number of arms."""
        return 1 if self.arm is None else int(self.arm.max()) + 1

    @cached_property
    def size_of(self) -> tuple[Int[ndarray, " s"], Int[ndarray, " s"]]:
        """Index of the size of the random part, and of the systematic part, of each of s residuals in `LogSizes`."""
        arm = np.zeros(len(self.residual) // 6, int) if self.arm is None else self.arm
        first = OF_ARM * np.repeat(arm, 6)
        return first + np.tile(np.repeat([0, 1], 3), len(arm)), first + 2

    def of_poses(self, poses: Int[ndarray, " k"]) -> "Equations":
        """Return the equations of k of the n poses; `poses` are their numbers."""
        rows = (6 * poses[:, None] + np.arange(6)).ravel()
        return replace(
            self,
            residual=self.residual[rows],
            jacobian=self.jacobian[rows],
            systematic=of_poses(self.systematic, poses),
            known=None if self.known is None else of_poses(self.known, poses),
            camera_errors=tuple(of_poses(one, poses) for one in self.camera_errors),
            confirmed=None if self.confirmed is None else of_poses(self.confirmed, poses),
            arm=None if self.arm is None else self.arm[poses],
        )

    def variances(self, log_sizes: LogSizes) -> Float[ndarray, "*k c"]:
        """Return c variances, in the order of `LogSizes`: squares of the sizes.

        The random variances are σ_t² and σ_r² plus the squares of `least`.
        """
        variances = np.exp(2 * log_sizes)
        for first in range(0, OF_ARM * self.arms, OF_ARM):
            variances[..., first : first + 2] += self.least**2
        return variances

    def random(self, log_sizes: LogSizes) -> Float[ndarray, "*k s"]:
        """Return the variance of the random part of each of s residuals: m² for position, rad² for rotation."""
        return self.variances(log_sizes)[..., self.size_of[0]]

    def systematic_part(self, log_sizes: LogSizes) -> Float[ndarray, "*k s s"]:
        """Return the covariance (s,s) of the systematic part: G times the size σ_s² of each arm (m, rad)."""
        if self.arms == 1:
            return self.variances(log_sizes)[..., 2, None, None] * self.systematic
        size = np.exp(log_sizes[..., self.size_of[1]])
        return size[..., :, None] * self.systematic * size[..., None, :]

    def noise(self, log_sizes: LogSizes, arm: int = 0) -> RobotNoise:
        """Return the record of an arm's errors (random and systematic; m, rad) for one vector of c log sizes."""
        first = OF_ARM * arm
        metres, radians, systematic = np.sqrt(self.variances(log_sizes)[first : first + OF_ARM]).tolist()
        own = self.size_of[1] == first + 2
        # Of equal poses nothing is left, which rounding makes negative.
        left = systematic * np.sqrt(np.diag(self.systematic)[own].clip(0).reshape(-1, 2, 3).mean((0, 2)))
        shown = SHOWN * np.array(self.given or (0.0, 0.0))
        return RobotNoise(
            translation=metres,
            rotation=radians,
            estimated=bool((shown < (metres, radians)).any()),
            given=self.given,
            systematic=systematic,
            systematic_left=(float(left[0]), float(left[1])),
        )

    def covariance(self, log_sizes: LogSizes) -> Float[ndarray, "*k s s"]:
        """Return the covariance V (s,s) of the residuals (m, rad) for one vector of c log sizes, or k of them.

        V is the sum of the random part, the systematic part, camera pose errors and confirmed effects.
        """
        covariance, each = self.systematic_part(log_sizes), np.arange(len(self.residual))
        covariance[..., each, each] += self.random(log_sizes)
        variances = self.variances(log_sizes)[..., OF_ARM * self.arms :]
        for k, part in enumerate(self.camera_errors):
            covariance += variances[..., k, None, None] * part
        for part in (self.known, self.confirmed):
            if part is not None:
                covariance += part
        return covariance


@dataclass(frozen=True, kw_only=True)
class LinearSolution:
    """Generalised least-squares solution of `Equations` for given error sizes, or for each of k choices of the sizes."""

    log_posterior: Each
    """Restricted log likelihood of the sizes plus their log prior, up to a constant that the residuals' number sets."""
    step: Float[ndarray, "*k p"]
    """Estimate of the unknowns θ."""
    root: Float[ndarray, "*k s s"]
    """Lower Cholesky factor of V, the covariance of the s residuals."""
    information_root: Float[ndarray, "*k p p"]
    """Lower Cholesky factor of JᵀV⁻¹J + prior."""
    weighed: Float[ndarray, "*k s p"]
    """V⁻¹J, V being the covariance of the residuals."""
    weighed_left: Float[ndarray, "*k s"]
    """V⁻¹(r + Jθ): weighted residuals after the fit."""

    @property
    def gain(self) -> Float[ndarray, "*k p s"]:
        """C JᵀV⁻¹ for each of k sizes: minus the derivative of the p unknowns by the s residuals.

        C is the covariance of the unknowns, J the Jacobian and V the covariance of the residuals.
        """
        return over(self.information_root, np.swapaxes(self.weighed, -1, -2))

    @property
    def covariance(self) -> Float[ndarray, "*k p p"]:
        """Covariance C = (JᵀV⁻¹J + prior information)⁻¹ of the p unknowns, for each choice of the error sizes."""
        return over(self.information_root, np.eye(self.step.shape[-1]))

    @property
    def projection(self) -> Covariance:
        """Matrix P = V⁻¹ − V⁻¹J C JᵀV⁻¹ of the s residuals; only for a solution for one value of the error sizes.

        V is the covariance of the residuals, J the Jacobian and C the covariance of the unknowns.
        """
        return inverse_of(self.root) - self.weighed @ self.gain


def solve_equations(equations: Equations, log_sizes: LogSizes) -> LinearSolution:
    """Return the generalised least-squares solution for log sizes of the errors: (c,), or (k,c) for k solutions.

    The c logarithms are in the order of `LogSizes`.
    """
    root = cholesky(equations.covariance(log_sizes))
    whitened = lower(root, np.column_stack([equations.jacobian, equations.residual]))
    jacobian, residual = whitened[..., :-1], whitened[..., -1:]
    transposed = np.swapaxes(jacobian, -1, -2)
    information_root = cholesky(transposed @ jacobian + equations.prior_information)
    gradient = transposed @ residual + equations.prior_gradient[:, None]
    step = -over(information_root, gradient)
    squares = (residual**2).sum((-1, -2)) + (gradient * step).sum((-1, -2))
    determinants = log_root_determinant(root) + log_root_determinant(information_root)
    weighed, (of_prior, middle, _) = upper(root, whitened), equations.prior
    against = ((log_sizes @ of_prior.T - middle) ** 2).sum(-1)
    return LinearSolution(
        log_posterior=-determinants - (squares + against) / 2,
        step=step[..., 0],
        root=root,
        information_root=information_root,
        weighed=weighed[..., :-1],
        weighed_left=weighed[..., -1] + (weighed[..., :-1] @ step)[..., 0],
    )


def left_out(
    solution: LinearSolution, random: Float[ndarray, " s"]
) -> tuple[Float[ndarray, "m 6"], Float[ndarray, "m 6 6"]]:
    """Return the residual of each of m poses from a fit without that pose, and its covariance.

    The six components are position (m), then rotation (rad), in base axes. The results are P_ii⁻¹ (P r)_i and P_ii⁻¹
    for the block i of a pose, with P = `solution.projection` and the residuals r. The square root of `random` (m², rad²;
    `Equations.random`) scales the matrices before they are inverted, for numerical accuracy.
    """
    m = len(solution.root) // 6
    sigma = np.sqrt(random).reshape(m, 6)
    whitener = inverse_root(solution.root).reshape(-1, m, 6)
    fitted = lower(solution.information_root, solution.weighed.T).reshape(-1, m, 6)
    own = np.einsum("kia,kib->iab", whitener, whitener) - np.einsum("kia,kib->iab", fitted, fitted)
    without = np.linalg.inv(sigma[:, :, None] * own * sigma[:, None] + 1e-9 * np.eye(6))
    found = sigma * np.einsum("mij,mj->mi", without, sigma * solution.weighed_left.reshape(m, 6))
    return found, sigma[:, :, None] * without * sigma[:, None]


def most_likely(
    equations: Equations,
    start: LogSizes | None = None,
    settled: float = MODE_SETTLED,
) -> tuple[LogSizes, Information]:
    """Return the logarithms of the c error sizes at the mode of their posterior, and expected information (c,c) there.

    Sizes are in the order of `LogSizes`. The search begins at `start` (None: mode of the prior) and ends with a step
    below `settled`. If there are more than MOST_FOR_SIZES poses, MOST_FOR_SIZES of them are used, evenly spaced. Fisher
    scoring is corrected by the curvature along the last step (BFGS, Nocedal and Wright, "Numerical optimization", 2006,
    eq. 6.19), because steps oscillate where the expected information is half of the curvature.
    """
    if (poses := len(equations.residual) // 6) > MOST_FOR_SIZES:
        some = equations.of_poses(np.linspace(0, poses - 1, MOST_FOR_SIZES).astype(int))
        at, information = most_likely(some, start, settled)
        return at, poses / MOST_FOR_SIZES * information
    at = equations.typical if start is None else start
    value, gradient, information = score(equations, at)
    curvature = information
    for _ in range(40):
        step = np.linalg.solve(curvature, gradient)
        step /= max(1.0, float(np.abs(step).max()))
        while (scored := score(equations, at + step))[0] < value and np.abs(step).max() > settled:
            step = step / 2
        if scored[0] < value:
            break
        gained, fell = scored[0] - value, gradient - scored[1]
        at = at + step
        value, gradient, information = scored
        curvature = information
        if step @ fell > 0:
            along = information @ step
            shown = np.outer(fell, fell) / (step @ fell)
            curvature = information - np.outer(along, along) / (step @ along) + shown
        if np.abs(step).max() < settled or gained < 1e-9:
            break
    return at, information


def log_evidence(equations: Equations, at_mode: LinearSolution, information: Information) -> float:
    """Return the natural logarithm of (2π)^(s/2) times the marginal density of the s residuals, by Laplace's method.

    Unknowns and sizes are integrated out. `at_mode` is the solution at the mode of the log sizes, `information` their
    expected information there.
    """
    gradient = equations.prior_gradient
    against_prior = gradient @ np.linalg.lstsq(equations.prior_information, gradient, rcond=None)[0]
    volumes = np.linalg.slogdet(information)[1] / 2 + np.log(equations.prior[2]).sum()
    return float(at_mode.log_posterior - against_prior / 2 - volumes)


def over_sizes(
    equations: Equations,
    mode: LogSizes,
    information: Information,
    density: Callable[[LinearSolution], Each] = lambda solution: solution.log_posterior,
    arm: int = 0,
) -> list[tuple[Float[ndarray, " g"], Float[ndarray, "g c"], LinearSolution]]:
    """Return a grid of log sizes about their mode: groups of posterior weights, log sizes and solutions.

    All weights together sum to 1. `density` returns the log posterior of the sizes of a solution, up to a constant;
    `information` is that of `most_likely`. Grid axes are eigenvectors of the information. Each side of an axis has its
    own step length, because the posterior is skewed: sizes have longer tails on one side. With more than MOST_FOR_SIZES
    poses the mode is the only grid point. The sizes of arms other than `arm` stay at the mode.
    """
    poses = len(equations.residual) // 6
    sizes, log_volumes = mode[None], np.zeros(1)
    if poses <= MOST_FOR_SIZES:
        sizes_of_arm = np.arange(OF_ARM * arm, OF_ARM * (arm + 1))
        own = np.r_[sizes_of_arm, np.arange(OF_ARM * equations.arms, len(mode))] if arm == 0 else sizes_of_arm
        values, vectors = np.linalg.eigh(information[np.ix_(own, own)])
        axes, probe = np.eye(len(mode))[:, own] @ (vectors / np.sqrt(values)), 1.5
        beside = mode + probe * np.concatenate([-axes.T, axes.T])
        top, *others = (density(solve_equations(equations, at)) for at in (mode, *beside))
        drop = np.maximum(2 * (top - np.array(others)), 1e-3)
        shorter, longer = np.clip(probe / np.sqrt(drop), 0.3, 3.0).reshape(2, -1)
        z = np.array(list(product(LEVELS, repeat=len(own))))
        z = z[(z**2).sum(1) < (GRID_RADIUS if poses < FINE_GRID_BELOW else SMALL_GRID_RADIUS)]
        lengths = np.where(z < 0, shorter, longer)
        sizes, log_volumes = mode + (lengths * z) @ axes.T, np.log(lengths).sum(1)
    together = max(1, int(ELEMENTS_AT_ONCE / len(equations.residual) ** 2))
    groups = [sizes[at : at + together] for at in range(0, len(sizes), together)]
    solutions = [solve_equations(equations, group) for group in groups]
    log_weight = np.concatenate([density(each) for each in solutions]) + log_volumes
    weight = np.exp(log_weight - log_weight.max())
    shares = np.split(weight / weight.sum(), np.cumsum([len(group) for group in groups])[:-1])
    return list(zip(shares, groups, solutions, strict=True))


def score(equations: Equations, log_sizes: LogSizes) -> tuple[float, LogSizes, Information]:
    """Return the log posterior of c log error sizes (up to a constant), gradient (c,) and expected information (c,c).

    `log_sizes` (c,) has the order of `LogSizes`; derivatives are by the log sizes.
    """
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left
    arms, (of_random, of_systematic) = equations.arms, equations.size_of
    sizes = OF_ARM * np.arange(arms)
    masks = (of_random == np.stack([sizes, sizes + 1], 1).reshape(-1, 1)).astype(float)
    each = [equations.systematic]
    if arms > 1:
        each = [np.outer(own, own) * equations.systematic for own in of_systematic == (sizes + 2)[:, None]]
    parts = (*each, *equations.camera_errors)
    by = [projection @ part for part in parts]
    beside = np.stack([masks @ (one * projection).sum(1) for one in by], axis=1)
    own = np.array([[(one * other.T).sum() for other in by] for one in by])
    pairs = np.block([[masks @ projection**2 @ masks.T, beside], [beside.T, own]])
    squares = np.r_[masks @ left**2, [left @ part @ left for part in parts]]
    traces = np.r_[masks @ np.diagonal(projection), [np.trace(one) for one in by]]
    # The masks come first, then the parts; the log sizes of each arm are together.
    count = len(pairs)
    order = np.r_[
        np.column_stack([np.arange(2 * arms).reshape(-1, 2), 2 * arms + np.arange(arms)]).ravel(),
        np.arange(OF_ARM * arms, count),
    ]
    pairs, squares, traces = pairs[np.ix_(order, order)], squares[order], traces[order]
    growth = np.exp(2 * log_sizes)
    of_prior, middle, _ = equations.prior
    return (
        float(solution.log_posterior),
        growth * (squares - traces) - of_prior.T @ (of_prior @ log_sizes - middle),
        of_prior.T @ of_prior + 2 * np.outer(growth, growth) * pairs,
    )
