"""Hand-eye bundle adjustment: reprojection error over X, the lens, the points and the gripper poses.

The robot's poses are measurements with the robot's own noise, so metric scale comes from the robot and the
camera's sub-millimetre geometry from the images. Points are eliminated by the Schur complement and the rest
is a small dense system, solved by Levenberg-Marquardt: least_squares.py without that elimination would hold a matrix
of thousands of points. Between solutions the robot's and the images' noise are estimated.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.stats import chi2

from jcr.camera import PARAMETERS, by_parameters, by_point, parameters, project, with_parameters
from jcr.geometry import apply, fit_similarity, inverse, retract, step_between
from jcr.handeye.noise import noise_share, robot_noise, widened
from jcr.least_squares import loss_weight
from jcr.records import Intrinsics, Tracks

POINTS_AT_ONCE = 4096
"""Points whose coupling to the cameras is held in memory together."""
MIN_SIGMA_PX = 0.05
FAR_OFF = 6.0
"""Median residuals; seven sigma."""
LOSS_SCALE = 2.0
"""Cauchy loss: observations count half at this many sigma."""
LENS_STD = {"cx": 0.02, "cy": 0.02, "k1": 0.3, "k2": 0.3}
"""Prior of what a cheap camera's lens may be: principal point relative to the width, distortion absolute."""
MIN_OBSERVATIONS_FOR_LENS = 500


@dataclass(frozen=True)
class Bundle:
    """The unknowns of the adjustment."""

    gripper_from_camera: Float[ndarray, "4 4"]
    base_from_gripper: Float[ndarray, "m 4 4"]
    """Where the images say the gripper was, against the robot's word."""
    points_in_base: Float[ndarray, "p 3"]
    camera: Intrinsics


@dataclass(frozen=True)
class Adjusted:
    """The adjusted bundle and what it knows about itself."""

    bundle: Bundle
    scale: float
    """Metres per recon unit."""
    base_from_recon: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "7 7"]
    """In records.COVARIANCE_ORDER, widened for an estimated noise."""
    noise: tuple[float, float]
    given_noise: tuple[float, float] | None
    """As `adjust` was told it."""
    sigma_px: float
    robot_residual: Float[ndarray, "m 6"]
    """Steps from the reported to the adjusted gripper poses (m, rad), base axes."""
    robot_hat: Float[ndarray, "m 6 6"]
    """Posterior covariance of those in units of the noise."""
    problem: "_Problem"
    iterations: int


@dataclass(frozen=True)
class _Problem:
    """What stays fixed: measurements sorted by point, priors, and how the lens may move."""

    reported: Float[ndarray, "m 4 4"]
    image: Int[ndarray, " k"]
    point: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    lens: Float[ndarray, "q c"]
    """Free parameters of the camera, which is start + lens · c in the order of camera.parameters."""
    lens_start: Float[ndarray, " q"]
    lens_std: Float[ndarray, " c"]
    rows_of_image: list[Int[ndarray, "..."]]
    median_square: Float[ndarray, " p"]
    """Median of a point's sum of squared residuals where an image coordinate's variance is 1: of the 2n errors of n
    views its position takes up 3."""


@dataclass(frozen=True)
class _View:
    """Every observation's point as one bundle has it."""

    in_gripper: Float[ndarray, "k 3"]
    in_camera: Float[ndarray, "k 3"]
    residual: Float[ndarray, "k 2"]
    """Projected minus observed, px."""


@dataclass(frozen=True)
class _Normal:
    """The normal equations after the points are eliminated; cameras are X (6), lens (c), grippers (6m)."""

    schur: Float[ndarray, "d d"]
    right: Float[ndarray, " d"]
    point_steps: list
    """Per chunk of points: Cholesky of V, W and its right side, to step the points back."""


def adjust(
    base_from_gripper: Float[ndarray, "m 4 4"],
    start: tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]],
    recon_from_camera: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
    tracks: Tracks,
    noise: tuple[float, float] | None = None,
    refine_lens: bool = False,
    max_iterations: int = 60,
) -> Adjusted:
    """Adjust from a pose fit's (gripper_from_camera, scale, base_from_recon).

    `noise` is the robot's (m, rad), at least; it is estimated with the rest (restricted maximum likelihood). The
    lens moves only when `refine_lens`: one focal length, principal point, two radial terms.
    """
    x, scale, z = start
    order = _usable(tracks)
    kept, point = np.unique(tracks.point[order], return_inverse=True)
    lens, lens_std = _free_lens(intrinsics, refine_lens and len(order) >= MIN_OBSERVATIONS_FOR_LENS)
    problem = _Problem(
        base_from_gripper,
        tracks.image[order],
        point,
        tracks.x_px[order],
        lens,
        parameters(intrinsics),
        lens_std,
        [np.flatnonzero(tracks.image[order] == i) for i in range(len(base_from_gripper))],
        chi2.ppf(0.5, 2 * np.bincount(point) - 3),
    )
    recon_scaled = recon_from_camera.copy()
    recon_scaled[:, :3, 3] *= scale
    bundle = Bundle(
        x,
        z @ recon_scaled @ inverse(x),
        apply(z, scale * tracks.points_in_recon[kept].astype(np.float64)),
        intrinsics,
    )
    robot = noise or (1e-3, np.radians(0.2))
    view = _view(bundle, problem)
    sigma_px = _sigma_px(view, problem)
    damping, total = 1e-4, 0
    for _ in range(12):
        before = (*robot, sigma_px)
        weights = _weights(view, sigma_px)
        bundle, view, damping, used = _minimise(
            bundle, view, problem, weights, robot, damping, max_iterations
        )
        total += used
        sigma_px = _sigma_px(view, problem)
        normal = _normal_equations(bundle, view, problem, _weights(view, sigma_px), robot, 0.0)
        robot = _robot_noise(bundle, problem, np.linalg.inv(normal.schur), robot, noise)
        change = np.abs(np.log(np.array([*robot, sigma_px]) / before)).max()
        if change < 0.01:
            break
    return _summary(bundle, problem, robot, noise, sigma_px, tracks.points_in_recon[kept], total)


def _usable(tracks: Tracks) -> Int[ndarray, " k"]:
    """Observations sorted by point: one per image and point, and at least two per point."""
    order = np.lexsort((tracks.image, tracks.point))
    point, image = tracks.point[order], tracks.image[order]
    first = np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)]
    order = order[first]
    return order[np.bincount(tracks.point[order])[tracks.point[order]] >= 2]


def _free_lens(intrinsics: Intrinsics, refine: bool) -> tuple[Float[ndarray, "q c"], Float[ndarray, " c"]]:
    count = len(parameters(intrinsics))
    if not refine:
        return np.zeros((count, 0)), np.zeros(0)
    width = intrinsics.width
    # One focal length moves by a share of itself.
    moves = {"fx": (0, intrinsics.fx), "fy": (0, intrinsics.fy), "cx": (1, width), "cy": (2, width)}
    moves |= {"k1": (3, 1.0), "k2": (4, 1.0)}
    lens = np.zeros((count, 5))
    for name, (column, unit) in moves.items():
        lens[PARAMETERS.index(name), column] = unit
    return lens, np.array([0.5, LENS_STD["cx"], LENS_STD["cy"], LENS_STD["k1"], LENS_STD["k2"]])


def _minimise(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    robot: tuple[float, float],
    damping: float,
    max_iterations: int,
) -> tuple[Bundle, _View, float, int]:
    """Levenberg-Marquardt with the weights held."""
    cost = _cost(bundle, view, problem, weights, robot)
    for iteration in range(1, max_iterations + 1):
        normal = _normal_equations(bundle, view, problem, weights, robot, damping)
        moved = _moved(bundle, problem, normal)
        moved_view = _view(moved, problem)
        new_cost = _cost(moved, moved_view, problem, weights, robot)
        if new_cost <= cost:
            gained = cost - new_cost
            bundle, view, cost, damping = moved, moved_view, new_cost, max(damping / 10, 1e-10)
            if gained < 1e-6 * cost + 1e-9:
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
    for i, rows in enumerate(problem.rows_of_image):
        points = bundle.points_in_base[problem.point[rows]]
        in_gripper[rows] = (points - gripper[i, :3, 3]) @ gripper[i, :3, :3]
    in_camera = (in_gripper - x_offset) @ x_rotation
    return _View(in_gripper, in_camera, project(bundle.camera, in_camera) - problem.x_px)


def _sigma_px(view: _View, problem: _Problem) -> float:
    """Noise of an image coordinate, from the median point none of whose observations is far off."""
    square = (view.residual**2).sum(1)
    far = square > FAR_OFF**2 * np.median(square)
    squares = np.bincount(problem.point, square) / problem.median_square
    clean = np.bincount(problem.point, far) == 0
    return max(float(np.sqrt(np.median(squares[clean] if clean.any() else squares))), MIN_SIGMA_PX)


def _weights(view: _View, sigma_px: float) -> Float[ndarray, " k"]:
    """Inverse variances under a Cauchy loss; points behind the camera count nothing."""
    squared = (view.residual**2).sum(1) / sigma_px**2
    return (view.in_camera[:, 2] > 1e-6) * loss_weight("cauchy", squared / LOSS_SCALE**2) / sigma_px**2


def _cost(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    robot: tuple[float, float],
) -> float:
    seen = float(weights @ (view.residual**2).sum(1))
    told = float(
        ((step_between(problem.reported, bundle.base_from_gripper) / np.repeat(robot, 3)) ** 2).sum()
    )
    return seen + told + float(((_lens_step(bundle, problem) / problem.lens_std) ** 2).sum())


def _lens_step(bundle: Bundle, problem: _Problem) -> Float[ndarray, " c"]:
    """How far the free lens parameters have moved from where they began."""
    return np.linalg.pinv(problem.lens) @ (parameters(bundle.camera) - problem.lens_start)


def _normal_equations(
    bundle: Bundle,
    view: _View,
    problem: _Problem,
    weights: Float[ndarray, " k"],
    robot: tuple[float, float],
    damping: float,
) -> _Normal:
    m, c = len(bundle.base_from_gripper), problem.lens.shape[1]
    shared, size = 6 + c, 6 + c + 6 * m
    root = np.sqrt(weights)
    residual = view.residual * root[:, None]
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
        by_lens = by_parameters(bundle.camera, view.in_camera) @ problem.lens
        common[:, :, 6:] = by_lens * root[:, None, None]
    own = np.empty((len(root), 2, 6))

    hessian, right = np.zeros((size, size)), np.zeros(size)
    for i, rows in enumerate(problem.rows_of_image):
        from_base = bundle.base_from_gripper[i, :3, :3].T
        by_base_axes[rows] = by_gripper_axes[rows] @ from_base
        own[rows, :, :3] = -by_base_axes[rows]
        own[rows, :, 3:] = np.cross(by_base_axes[rows], (view.in_gripper[rows] @ from_base)[:, None])
        block = np.concatenate([common[rows], own[rows]], axis=2).reshape(-1, shared + 6)
        columns = np.r_[0:shared, shared + 6 * i : shared + 6 * i + 6]
        hessian[np.ix_(columns, columns)] += block.T @ block
        right[columns] -= block.T @ residual[rows].ravel()
    told = step_between(problem.reported, bundle.base_from_gripper)
    precision = np.repeat(np.asarray(robot) ** -2.0, 3)
    diagonal = np.arange(size)
    hessian[diagonal[shared:], diagonal[shared:]] += np.tile(precision, m)
    right[shared:] -= (told * precision).ravel()
    hessian[diagonal[6:shared], diagonal[6:shared]] += problem.lens_std**-2.0
    right[6:shared] -= _lens_step(bundle, problem) / problem.lens_std**2
    hessian[diagonal, diagonal] *= 1 + damping

    chunks = []
    bounds = np.searchsorted(problem.point, np.arange(0, len(bundle.points_in_base), POINTS_AT_ONCE))
    for begin, end in zip(bounds, [*bounds[1:], len(problem.point)], strict=True):
        first = int(problem.point[begin])
        local = problem.point[begin:end] - first
        count = int(local[-1]) + 1
        starts = np.searchsorted(local, np.arange(count))
        j_point = by_base_axes[begin:end]
        transposed = np.swapaxes(j_point, 1, 2)
        v = np.add.reduceat(transposed @ j_point, starts)
        v[:, range(3), range(3)] *= 1 + damping
        v[:, range(3), range(3)] += 1e-9 * np.trace(v, axis1=1, axis2=2)[:, None] + 1e-12
        w = np.zeros((count, 3, size))
        w[:, :, :shared] = np.add.reduceat(transposed @ common[begin:end], starts)
        columns = shared + 6 * problem.image[begin:end, None] + np.arange(6)
        w[local[:, None, None], np.arange(3)[None, :, None], columns[:, None, :]] = (
            transposed @ own[begin:end]
        )
        g = np.add.reduceat((transposed @ residual[begin:end, :, None])[..., 0], starts)
        factor = np.linalg.cholesky(v)
        half = np.linalg.solve(factor, np.concatenate([w, g[..., None]], axis=2)).reshape(3 * count, size + 1)
        hessian -= half[:, :size].T @ half[:, :size]
        right += half[:, :size].T @ half[:, size]
        chunks.append((first, count, v, w, g))
    return _Normal(hessian, right, chunks)


def _moved(bundle: Bundle, problem: _Problem, normal: _Normal) -> Bundle:
    """The bundle after one Gauss-Newton step."""
    step = np.linalg.solve(normal.schur, normal.right)
    points = bundle.points_in_base.copy()
    for first, count, v, w, g in normal.point_steps:
        points[first : first + count] += np.linalg.solve(v, -(g + w @ step)[..., None])[..., 0]
    c = problem.lens.shape[1]
    return Bundle(
        retract(bundle.gripper_from_camera, step[:6]),
        retract(bundle.base_from_gripper, step[6 + c :].reshape(-1, 6)),
        points,
        with_parameters(bundle.camera, parameters(bundle.camera) + problem.lens @ step[6 : 6 + c]),
    )


def _robot_noise(
    bundle: Bundle,
    problem: _Problem,
    covariance: Float[ndarray, "d d"],
    robot: tuple[float, float],
    given: tuple[float, float] | None,
) -> tuple[float, float]:
    """Restricted maximum likelihood of the robot's noise, one step."""
    told = step_between(problem.reported, bundle.base_from_gripper)
    m = len(told)
    spread = np.diag(covariance)[-6 * m :].reshape(m, 6)
    squares = float((told[:, :3] ** 2).sum()), float((told[:, 3:] ** 2).sum())
    dof = (
        max(3 * m - float(spread[:, :3].sum()) / robot[0] ** 2, 0.1),
        max(3 * m - float(spread[:, 3:].sum()) / robot[1] ** 2, 0.1),
    )
    return robot_noise(squares, dof, robot, given)


def _summary(
    bundle: Bundle,
    problem: _Problem,
    robot: tuple[float, float],
    given: tuple[float, float] | None,
    sigma_px: float,
    points_in_recon: Float[ndarray, "p 3"],
    iterations: int,
) -> Adjusted:
    view = _view(bundle, problem)
    normal = _normal_equations(bundle, view, problem, _weights(view, sigma_px), robot, 0.0)
    camera_covariance = np.linalg.inv(normal.schur)
    m = len(problem.reported)

    # Scale is that of the adjusted points against the reconstruction's, so its error is theirs along the
    # outward direction: d log λ = Σ a·dp, with points weighed down where the two disagree.
    points = bundle.points_in_base
    weight = np.ones(len(points))
    recon = points_in_recon.astype(np.float64)
    base_from_recon, scale = fit_similarity(points, recon, weight)
    for _ in range(5):
        gap = np.linalg.norm(apply(base_from_recon, scale * recon) - points, axis=1)
        weight = 1 / (1 + (gap / max(float(np.median(gap)), 1e-9)) ** 2)
        base_from_recon, scale = fit_similarity(points, recon, weight)
    outward = points - np.average(points, axis=0, weights=weight)
    outward *= (weight / (weight @ (outward**2).sum(1)))[:, None]
    variance, coupling = 0.0, np.zeros(len(camera_covariance))
    for first, count, v, w, _ in normal.point_steps:
        a = outward[first : first + count]
        solved = np.linalg.solve(v, a[..., None])[..., 0]
        variance += float((a * solved).sum())
        coupling += np.einsum("pi,pij->j", solved, w)
    cross = -camera_covariance @ coupling
    covariance = np.zeros((7, 7))
    covariance[:6, :6] = camera_covariance[:6, :6]
    covariance[:6, 6] = covariance[6, :6] = cross[:6]
    covariance[6, 6] = variance - coupling @ cross

    gain, told = _passed_on(camera_covariance, robot, m)
    gain = np.concatenate([gain[:6], -coupling[None] @ gain])

    hat = np.stack(
        [camera_covariance[i : i + 6, i : i + 6] for i in range(len(cross) - 6 * m, len(cross), 6)]
    )
    sigma = np.repeat(robot, 3)
    return Adjusted(
        bundle,
        scale,
        base_from_recon,
        widened(covariance, noise_share(gain, told, robot, given)),
        robot,
        given,
        sigma_px,
        step_between(problem.reported, bundle.base_from_gripper),
        hat / sigma[:, None] / sigma[None],
        problem,
        iterations,
    )


def _passed_on(
    covariance: Float[ndarray, "d d"], robot: tuple[float, float], m: int
) -> tuple[Float[ndarray, "d r"], Float[ndarray, "r r"]]:
    """How errors of the m reported poses pass into the unknowns, and P of noise.noise_share."""
    precision = np.tile(np.repeat(np.asarray(robot) ** -2.0, 3), m)
    gain = covariance[:, -6 * m :] * precision
    return gain, np.diag(precision) - precision[:, None] * gain[-6 * m :]


def free_lens(
    adjusted: Adjusted, intrinsics: Intrinsics
) -> tuple[Float[ndarray, " q"], Float[ndarray, "q q"]] | None:
    """The camera one Gauss-Newton step on, with its lens free and before it at `intrinsics`, and the covariance.

    In the order of camera.PARAMETERS; the covariance is widened for an estimated noise. None where there
    are too few observations to free a lens.
    """
    problem, bundle = adjusted.problem, adjusted.bundle
    if len(problem.image) < MIN_OBSERVATIONS_FOR_LENS:
        return None
    lens, lens_std = _free_lens(intrinsics, True)
    problem = replace(problem, lens=lens, lens_std=lens_std)
    view = _view(bundle, problem)
    weights = _weights(view, adjusted.sigma_px)
    normal = _normal_equations(bundle, view, problem, weights, adjusted.noise, 0.0)
    covariance, free = np.linalg.inv(normal.schur), slice(6, 6 + lens.shape[1])
    step = covariance[free] @ normal.right
    gain, told = _passed_on(covariance, adjusted.noise, len(problem.reported))
    share = noise_share(gain[free], told, adjusted.noise, adjusted.given_noise)
    return parameters(bundle.camera) + lens @ step, lens @ widened(covariance[free, free], share) @ lens.T


def median_reprojection(
    adjusted: Adjusted, base_from_gripper: Float[ndarray, "m 4 4"] | None = None
) -> Float[ndarray, " m"]:
    """Median reprojection error (px) of every image, with the gripper where adjusted or where told."""
    bundle = adjusted.bundle
    if base_from_gripper is not None:
        bundle = replace(bundle, base_from_gripper=base_from_gripper)
    length = np.linalg.norm(_view(bundle, adjusted.problem).residual, axis=1)
    return np.array(
        [np.median(length[rows]) if len(rows) else np.nan for rows in adjusted.problem.rows_of_image]
    )
