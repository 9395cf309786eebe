"""Hand-eye bundle adjustment: reprojection error over X, the intrinsics, the points and the gripper poses.

The robot's poses are measurements with the robot's own errors, random and systematic, so metric scale comes from the
robot and the camera's sub-millimetre geometry from the images. Points are eliminated (elimination.py) and the rest
is a small dense system, solved by Levenberg-Marquardt: least_squares.py without that elimination would hold a matrix of
thousands of points. What the images alone say of the cameras, as a normal distribution about the adjusted
ones, then goes into the same mixed model as poses do (handeye/components.py): it tells the sizes of the robot's errors,
and the answer is averaged over them.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.stats import chi2

from jcr.adjust.elimination import Derivatives, Normal, Sightings, with_points_held, without_points
from jcr.adjust.intrinsics_prior import HELD, IntrinsicsPrior, off_by, prior_of
from jcr.camera import by_parameters, by_point, parameters, project, with_parameters
from jcr.geometry import apply, fit_similarity, inverse, retract, scale_translation, step_between
from jcr.handeye.components import Equations, most_likely, posterior, solve
from jcr.handeye.equation import PRIOR_STD, residuals
from jcr.handeye.fit import left_out
from jcr.handeye.systematic import Region, smooth_errors
from jcr.least_squares import loss_weight, one_blas_thread
from jcr.records import Budget, Intrinsics, Tracks

MIN_SIGMA_PX = 0.05
FAR_OFF = 6.0
"""Median residuals; seven sigma."""
LOSS_SCALE = 2.0
"""Cauchy loss: observations count half at this many sigma."""
CELLS = 8
"""Across the width of an image: so near each other features share errors, of a texture, a shadow or what the distortion
model leaves."""
ENOUGH = 1e-5
"""Of the cost, which is in squared standard deviations: what less than it would gain, nobody sees."""
SIZES_SETTLED = 0.01
"""Relative change of the sizes of errors, of pixels and of the robot, from one round to the next that ends them."""
START_NOISE = (1e-3, np.radians(0.2))
"""m, rad; of gripper poses, until it is estimated."""


@dataclass(frozen=True)
class Bundle:
    """The unknowns of the adjustment."""

    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "m 4 4"]
    """Where the images say the gripper was, against the reported pose."""
    points_in_base: Float[ndarray, "p 3"]
    camera: Intrinsics


@dataclass(frozen=True)
class PixelErrors:
    """Errors of image observations."""

    sigma_px: float
    """Of one coordinate."""
    inflation: float = 1.0
    """Of the variance of what many observations say together, because neighbours share errors."""


@dataclass(frozen=True)
class Adjusted:
    """The adjusted bundle and what it knows about itself."""

    bundle: Bundle
    scale: float
    """Metres per recon unit."""
    base_from_recon: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "7 7"]
    """In records.COVARIANCE_ORDER, widened for an estimated noise."""
    budget: Budget
    """Parts of it."""
    noise: tuple[float, float]
    """σ_t (m) and σ_r (rad) of the random errors of gripper poses."""
    systematic: float
    """σ_s (rad) of their systematic errors."""
    systematic_left: tuple[float, float]
    """m, rad per axis: what of these is left in the poses."""
    given_noise: tuple[float, float] | None
    """As `adjust` was given it."""
    intrinsics_covariance: Float[ndarray, "q q"]
    """In the order of camera.parameters."""
    pixels: PixelErrors
    missed: Float[ndarray, "m 6"]
    """Steps from the reported to the adjusted gripper poses (m, rad), each by an adjustment that does not use it."""
    log_sizes: Float[ndarray, "3"]
    """Of the robot's errors, as most likely (components.py)."""
    precision: Float[ndarray, "s s"]
    """Inverse covariance of the gripper poses' errors."""
    problem: "_Problem"
    iterations: int


@dataclass(frozen=True)
class _Problem:
    """What stays fixed: measurements sorted by point, priors, and how the intrinsics may move."""

    reported: Float[ndarray, "m 4 4"]
    image: Int[ndarray, " k"]
    point: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    intrinsics: Intrinsics
    """Where the camera's parameters start."""
    free: IntrinsicsPrior
    systematic: Float[ndarray, "s s"]
    """Covariance of systematic errors of the gripper poses at 1 rad."""
    given_noise: tuple[float, float] | None
    median_square: Float[ndarray, " p"]
    """Median of a point's sum of squared residuals where an image coordinate's variance is 1: of the 2n errors of n
    views its position takes up 3."""
    seen: Sightings


@dataclass(frozen=True)
class _View:
    """Every observation's point as one bundle has it."""

    in_gripper: Float[ndarray, "k 3"]
    in_camera: Float[ndarray, "k 3"]
    residual: Float[ndarray, "k 2"]
    """Projected minus observed, px."""


@one_blas_thread
def adjust(
    base_from_gripper: Float[ndarray, "m 4 4"],
    start: tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]],
    recon_from_camera: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
    tracks: Tracks,
    noise: tuple[float, float] | None = None,
    free: IntrinsicsPrior | None = None,
    systematic: Float[ndarray, "s s"] | None = None,
    max_iterations: int = 60,
) -> Adjusted:
    """Adjust from a pose fit's (gripper_from_camera, scale, base_from_recon).

    `noise` is the robot's (m, rad), at least; it is estimated with the rest. `systematic` is the covariance of its
    systematic errors at 1 rad; None: that of errors smooth over the poses. `free` is what is known of the
    intrinsics; None: that they are exact.
    """
    x, scale, z = start
    free = prior_of(intrinsics, HELD) if free is None else free
    order = _usable(tracks)
    kept, point = np.unique(tracks.point[order], return_inverse=True)
    problem = _Problem(
        base_from_gripper,
        tracks.image[order],
        point,
        tracks.x_px[order],
        intrinsics,
        free,
        smooth_errors(base_from_gripper) if systematic is None else systematic,
        noise,
        chi2.ppf(0.5, 2 * np.bincount(point) - 3),
        Sightings.of(point, tracks.image[order], len(base_from_gripper)),
    )
    recon_scaled = recon_from_camera.copy()
    recon_scaled[:, :3, 3] *= scale
    bundle = Bundle(
        x,
        z @ recon_scaled @ inverse(x),
        apply(z, scale * tracks.points_in_recon[kept].astype(np.float64)),
        intrinsics,
    )
    precision = np.diag(np.tile(np.repeat(noise or START_NOISE, 3) ** -2.0, len(base_from_gripper)))
    view = _view(bundle, problem)
    pixels, log_sizes = _pixel_errors(view, problem), None
    damping, total = 1e-4, 0
    for _ in range(12):
        before = pixels, log_sizes
        weights = _weights(view, pixels)
        bundle, view, damping, used = _minimise(
            bundle, view, problem, weights, precision, damping, max_iterations
        )
        total += used
        pixels = _pixel_errors(view, problem)
        equations, _ = _equations(bundle, view, problem, pixels, precision)
        log_sizes, _ = most_likely(equations, log_sizes, SIZES_SETTLED / 3)
        precision = np.linalg.inv(replace(equations, known=None).covariance(log_sizes))
        change = np.inf if before[1] is None else float(np.abs(log_sizes - before[1]).max())
        if max(change, abs(np.log(pixels.sigma_px / before[0].sigma_px))) < SIZES_SETTLED:
            break
    equations, region = _equations(bundle, view, problem, pixels, precision)
    log_sizes, information = most_likely(equations, log_sizes)
    found = posterior(equations, log_sizes, information, region)
    sigma_t, sigma_r, sigma_s = np.sqrt(equations.variances(log_sizes)).tolist()
    missed, _ = left_out(equations, solve(equations, log_sizes), (sigma_t, sigma_r))
    by_intrinsics = _by_intrinsics(found.covariance)
    off = off_by(free, intrinsics)
    more = by_intrinsics @ off @ by_intrinsics.T
    bundle, scale, base_from_recon = _settled(bundle, found.step, tracks.points_in_recon[kept])
    return Adjusted(
        bundle,
        scale,
        base_from_recon,
        found.covariance[:7, :7] + more,
        replace(found.budget, intrinsics=found.budget.intrinsics + more),
        (sigma_t, sigma_r),
        sigma_s,
        equations.systematic_left(log_sizes),
        noise,
        free.directions @ (found.covariance[13:, 13:] + off) @ free.directions.T,
        pixels,
        missed,
        log_sizes,
        precision,
        problem,
        total,
    )


def _usable(tracks: Tracks) -> Int[ndarray, " k"]:
    """Observations sorted by point: one per image and point, and at least two per point."""
    order = np.lexsort((tracks.image, tracks.point))
    point, image = tracks.point[order], tracks.image[order]
    first = np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)]
    order = order[first]
    return order[np.bincount(tracks.point[order])[tracks.point[order]] >= 2]


def _minimise(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    precision: Float[ndarray, "s s"],
    damping: float,
    max_iterations: int,
) -> tuple[Bundle, _View, float, int]:
    """Levenberg-Marquardt with the weights held."""
    cost = _cost(bundle, view, problem, weights, precision)
    for iteration in range(1, max_iterations + 1):
        normal = _normal_equations(bundle, view, problem, weights, precision, damping)
        moved = _moved(bundle, problem, normal)
        moved_view = _view(moved, problem)
        new_cost = _cost(moved, moved_view, problem, weights, precision)
        if new_cost <= cost:
            gained = cost - new_cost
            bundle, view, cost, damping = moved, moved_view, new_cost, max(damping / 10, 1e-10)
            if gained < ENOUGH:
                return bundle, view, damping, iteration
        else:
            damping *= 10
            if damping > 1e8:
                return bundle, view, 1e-4, iteration
    return bundle, view, damping, max_iterations


def _view(bundle: Bundle, problem: _Problem) -> _View:
    gripper = bundle.base_from_gripper
    x_rotation, x_offset = bundle.gripper_from_camera[:3, :3], bundle.gripper_from_camera[:3, 3]
    in_gripper = np.empty((len(problem.image), 3))
    for i, rows in enumerate(problem.seen.rows):
        points = bundle.points_in_base[problem.point[rows]]
        in_gripper[rows] = (points - gripper[i, :3, 3]) @ gripper[i, :3, :3]
    in_camera = (in_gripper - x_offset) @ x_rotation
    return _View(in_gripper, in_camera, project(bundle.camera, in_camera) - problem.x_px)


def _pixel_errors(view: _View, problem: _Problem) -> PixelErrors:
    """From the median point none of whose observations is far off, and from cells of the images.

    Were errors independent, the squared sum over a cell of what each observation pulls would be, on average, the sum of
    the squares; what it is times that is what the errors that neighbours share cost of the images' information (the
    variance inflation of cluster sampling; Liang and Zeger, Biometrika 73, 1986).
    """
    square = (view.residual**2).sum(1)
    far = square > FAR_OFF**2 * np.median(square)
    squares = np.bincount(problem.point, square) / problem.median_square
    clean = np.bincount(problem.point, far) == 0
    sigma_px = max(float(np.sqrt(np.median(squares[clean] if clean.any() else squares))), MIN_SIGMA_PX)
    pull = _weights(view, PixelErrors(sigma_px))[:, None] * view.residual
    column, row = (CELLS * problem.x_px / problem.intrinsics.width).astype(int).T
    _, cell = np.unique(np.stack([problem.image, row, column]), axis=1, return_inverse=True)
    sums = sum(np.bincount(cell, along) ** 2 for along in pull.T)
    # Of points that are all behind their cameras nothing pulls.
    return PixelErrors(sigma_px, max(1.0, float(np.sum(sums) / max((pull**2).sum(), 1e-300))))


def _weights(view: _View, pixels: PixelErrors) -> Float[ndarray, " k"]:
    """Inverse variances under a Cauchy loss; points behind the camera count nothing."""
    squared = (view.residual**2).sum(1) / pixels.sigma_px**2
    weight = loss_weight("cauchy", squared / LOSS_SCALE**2) / (pixels.sigma_px**2 * pixels.inflation)
    return (view.in_camera[:, 2] > 1e-6) * weight


def _cost(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    precision: Float[ndarray, "s s"],
) -> float:
    seen = float(weights @ (view.residual**2).sum(1))
    told = step_between(problem.reported, bundle.base_from_gripper).ravel()
    return (
        seen
        + float(told @ precision @ told)
        + float(((_lens_step(bundle, problem) / problem.free.std) ** 2).sum())
    )


def _lens_step(bundle: Bundle, problem: _Problem) -> Float[ndarray, " c"]:
    """How far the free intrinsics parameters have moved from where they began."""
    return np.linalg.pinv(problem.free.directions) @ (
        parameters(bundle.camera) - parameters(problem.intrinsics)
    )


def _normal_equations(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    precision: Float[ndarray, "s s"],
    damping: float,
) -> Normal:
    """Of X (6), the intrinsics that are free (c) and the grippers (6m)."""
    c, root = len(problem.free.std), np.sqrt(weights)
    shared = 6 + c
    x_rotation = bundle.gripper_from_camera[:3, :3]
    by_gripper_axes = (by_point(bundle.camera, view.in_camera) * root[:, None, None]) @ x_rotation.T
    by_base_axes = np.empty_like(by_gripper_axes)
    # X and the grippers move by steps of geometry.retract, in gripper and in base axes.
    common = np.empty((len(root), 2, shared))
    common[:, :, 0:3] = -by_gripper_axes
    common[:, :, 3:6] = np.cross(
        by_gripper_axes, (view.in_gripper - bundle.gripper_from_camera[:3, 3])[:, None]
    )
    if c:
        by_lens = by_parameters(bundle.camera, view.in_camera) @ problem.free.directions
        common[:, :, 6:] = by_lens * root[:, None, None]
    own = np.empty((len(root), 2, 6))

    for i, rows in enumerate(problem.seen.rows):
        from_base = bundle.base_from_gripper[i, :3, :3].T
        by_base_axes[rows] = by_gripper_axes[rows] @ from_base
        own[rows, :, :3] = -by_base_axes[rows]
        own[rows, :, 3:] = np.cross(by_base_axes[rows], (view.in_gripper[rows] @ from_base)[:, None])
    weighted = Derivatives(common, own, by_base_axes, view.residual * root[:, None])
    hessian, right = with_points_held(weighted, problem.seen)
    hessian[shared:, shared:] += precision
    right[shared:] -= precision @ step_between(problem.reported, bundle.base_from_gripper).ravel()
    hessian[range(6, shared), range(6, shared)] += problem.free.std**-2.0
    right[6:shared] -= _lens_step(bundle, problem) / problem.free.std**2
    hessian[np.diag_indices(len(right))] *= 1 + damping
    return without_points(hessian, right, weighted, problem.seen, damping)


def _moved(bundle: Bundle, problem: _Problem, normal: Normal) -> Bundle:
    """The bundle after one Gauss-Newton step."""
    step = np.linalg.solve(normal.hessian, normal.right)
    c = len(problem.free.std)
    return Bundle(
        retract(bundle.gripper_from_camera, step[:6]),
        retract(bundle.base_from_gripper, step[6 + c :].reshape(-1, 6)),
        normal.stepped(bundle.points_in_base, step),
        with_parameters(bundle.camera, parameters(bundle.camera) + problem.free.directions @ step[6 : 6 + c]),
    )


def _equations(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    pixels: PixelErrors,
    precision: Float[ndarray, "s s"],
) -> tuple[Equations, Region]:
    """What the images alone say of the cameras, as linear equations of X, a similarity and the intrinsics.

    The recon frame is here the base frame in which the cameras were adjusted; the unknowns are those of equation.py,
    then the free parameters of the camera. Images see cameras, not X and grippers apart: with X where it is, they say
    how each gripper would move, up to one similarity.
    """
    normal = _normal_equations(bundle, view, problem, _weights(view, pixels), precision, 0.0)
    told = step_between(problem.reported, bundle.base_from_gripper).ravel()
    c = len(problem.free.std)
    of_lens, of_poses = slice(6, 6 + c), slice(6 + c, None)
    seen = normal.hessian[of_poses, of_poses] - precision
    by_images = normal.right[of_poses] + precision @ told
    x = bundle.gripper_from_camera
    _, by_unknown = residuals(x, 1.0, np.eye(4), problem.reported, bundle.base_from_gripper @ x)
    by_unknown = by_unknown.reshape(-1, 13)
    unseen = np.linalg.qr(by_unknown[:, 6:])[0]  # the similarity
    known = np.linalg.inv(seen + float(np.trace(seen)) / len(seen) * unseen @ unseen.T)
    known = (known + known.T) / 2
    coupling = normal.hessian[of_lens, of_poses]
    by_lens = -known @ coupling.T
    prior = np.zeros((13 + c, 13 + c))
    prior[range(7), range(7)] = PRIOR_STD**-2.0
    prior[13:, 13:] = normal.hessian[of_lens, of_lens] + coupling @ by_lens
    gradient = np.concatenate([np.zeros(13), coupling @ (known @ by_images) - normal.right[of_lens]])
    jacobian = np.concatenate([by_unknown, by_lens], axis=1)
    region = Region.of_poses(jacobian)
    return (
        Equations(
            told + known @ by_images,
            jacobian,
            prior,
            gradient,
            known,
            region.left(problem.systematic),
            problem.given_noise,
        ),
        region,
    )


def _settled(
    bundle: Bundle, step: Float[ndarray, " p"], points_in_recon: Float[ndarray, "k 3"]
) -> tuple[Bundle, float, Float[ndarray, "4 4"]]:
    """The bundle after a step of X, a similarity and the intrinsics, and scale and frame of the reconstruction in it.

    The step is what averaging over the sizes of the robot's errors moves; the intrinsics keep the most likely value.
    """
    base_from_adjusted, grown = retract(np.eye(4), step[7:13]), float(np.exp(step[6]))
    x = retract(bundle.gripper_from_camera, step[:6])
    cameras = scale_translation(bundle.base_from_gripper @ bundle.gripper_from_camera, grown)
    points = apply(base_from_adjusted, grown * bundle.points_in_base)
    # Scale is that of the adjusted points against the reconstruction's, weighed down where the two disagree.
    recon, weight = points_in_recon.astype(np.float64), np.ones(len(points))
    base_from_recon, scale = fit_similarity(points, recon, weight)
    for _ in range(5):
        gap = np.linalg.norm(apply(base_from_recon, scale * recon) - points, axis=1)
        weight = 1 / (1 + (gap / max(float(np.median(gap)), 1e-9)) ** 2)
        base_from_recon, scale = fit_similarity(points, recon, weight)
    settled = Bundle(x, base_from_adjusted @ cameras @ inverse(x), points, bundle.camera)
    return settled, float(scale), base_from_recon


def _by_intrinsics(covariance: Float[ndarray, "p p"]) -> Float[ndarray, "7 c"]:
    """How X and scale follow the intrinsics, from the joint covariance."""
    return np.linalg.solve(covariance[13:, 13:], covariance[13:, :7]).T


def freed_intrinsics(
    adjusted: Adjusted, free: IntrinsicsPrior
) -> tuple[Float[ndarray, " q"], Float[ndarray, "q q"]]:
    """The camera one Gauss-Newton step on, with another prior about where its parameters started, and the covariance.

    In the order of camera.parameters.
    """
    problem, bundle = replace(adjusted.problem, free=free), adjusted.bundle
    view = _view(bundle, problem)
    equations, _ = _equations(bundle, view, problem, adjusted.pixels, adjusted.precision)
    solution = solve(equations, adjusted.log_sizes)
    covariance = solution.covariance[13:, 13:] + off_by(free, problem.intrinsics)
    covariance = free.directions @ covariance @ free.directions.T
    return parameters(bundle.camera) + free.directions @ solution.step[13:], covariance


def median_reprojection(
    adjusted: Adjusted, base_from_gripper: Float[ndarray, "m 4 4"] | None = None
) -> Float[ndarray, " m"]:
    """Median reprojection error (px) of every image, with the gripper where adjusted or as reported."""
    bundle = adjusted.bundle
    if base_from_gripper is not None:
        bundle = replace(bundle, base_from_gripper=base_from_gripper)
    length = np.linalg.norm(_view(bundle, adjusted.problem).residual, axis=1)
    return np.array([np.median(length[rows]) if len(rows) else np.nan for rows in adjusted.problem.seen.rows])
