"""Uncertainty of points in gripper and base frame: pixels at a known distance, and reconstructed points.

A pixel x at a distance d is the point p = d·u(K, x) in the camera, with unit ray u, and X·p in the gripper. Its error
comes from the intrinsics K and from X; the distance is exact. These errors are correlated, since a rotation of the
camera can compensate an error of the principal point, so the joint covariance is propagated (Kogan, mrcal, "Projection
uncertainty").
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.camera import NORMALIZED, by_parameters, by_point, parameters, unproject, with_thin_prism
from jcr.distributions import chi2
from jcr.estimation.elimination import cholesky, over, point_blocks
from jcr.estimation.intrinsics_prior import polynomials, rays_by_reach
from jcr.estimation.pose_equations import pose_by_pose, reported_poses
from jcr.estimation.problem import BASE_ROTATION, BASE_TRANSLATION, SCALE
from jcr.estimation.projection import derivatives
from jcr.estimation.solve import Solution
from jcr.geometry import Transform, across_lines, apply, by_similarity, retract, skew
from jcr.records import (
    GivenIntrinsicsResult,
    Intrinsics,
    PointUncertainty,
    PointUncertaintyOverImage,
    RobotNoise,
    SceneUncertainty,
    Uncertainty,
)

Pixels = Float[ndarray, "*points 2"]
Distances = Float[ndarray, "*#points"] | float
Covariances = Float[ndarray, "*points 3 3"]
ScenePoints = tuple[Float[ndarray, "p 3"], Float[ndarray, "p 3 p 3"], Float[ndarray, "p 3 3"]]
"""p points in the base frame (m); their covariance by camera poses (m²); covariance of each by triangulation (m²)."""
SCENE_POINTS = 300
"""Largest number of random points that represent a scene."""


def point_covariance(
    x: Transform,
    uncertainty: Uncertainty,
    intrinsics: Intrinsics,
    x_px: Pixels,
    distance_m: Distances,
) -> Covariances:
    """Return the covariance (m², in camera axes) of points relative to the gripper, without errors of gripper poses.

    `x` is gripper_from_camera; `uncertainty` is the joint one of `x`, scale and `intrinsics`. `x_px` (...,2) are pixels
    of the distorted image, `distance_m` (...) exact distances (m) along the ray.
    """
    by, covariance = _derivatives(x, uncertainty, intrinsics, x_px, distance_m)
    return by @ covariance @ np.swapaxes(by, -1, -2)


def point_in_base(  # noqa: PLR0913 (the parts of a calibration, a pixel and a gripper pose)
    x: Transform,
    uncertainty: Uncertainty,
    intrinsics: Intrinsics,
    noise: RobotNoise,
    x_px: Pixels,
    depth_m: Distances,
    base_from_gripper: Float[ndarray, "4 4"],
) -> tuple[Float[ndarray, "*points 3"], Covariances]:
    """Return base-frame coordinates (m) and covariance (m²) of points at pixels with z = `depth_m` in the camera frame.

    `x` is gripper_from_camera; `uncertainty` and `x_px` are those of `point_covariance`. The depths are exact, as if a
    depth camera had measured them. `noise` adds the errors of the gripper pose, for a pose in the workspace of the
    capture.
    """
    ray = unproject(intrinsics, x_px)
    distance_m = np.asarray(depth_m) * np.linalg.norm(ray, axis=-1) / ray[..., 2]
    p_in_gripper = apply(x, np.asarray(depth_m)[..., None] * ray / ray[..., 2:])
    base_from_camera_axes = base_from_gripper[:3, :3] @ x[:3, :3]
    in_camera = point_covariance(x, uncertainty, intrinsics, x_px, distance_m)
    lever = skew(p_in_gripper @ base_from_gripper[:3, :3].T)
    square = lever @ np.swapaxes(lever, -1, -2)
    covariance = base_from_camera_axes @ in_camera @ base_from_camera_axes.T
    for metres, radians in ((noise.translation, noise.rotation), noise.systematic_left):
        covariance = covariance + metres**2 * np.eye(3) + radians**2 * square
    return apply(base_from_gripper, p_in_gripper), covariance


def bounds_at(
    x: Transform,
    uncertainty: Uncertainty,
    intrinsics: Intrinsics,
    x_px: Float[ndarray, "2"],
    distance_m: float,
) -> PointUncertainty:
    """Return 95 % bounds of the error of the point at `distance_m` (m) along the ray of the pixel `x_px`.

    Bounds are of the position (mm; whole, across and along the ray), the ray's direction and the rotation (degrees).
    The error is relative to the gripper, for an exact distance. `x` is gripper_from_camera; `uncertainty` is that of
    `point_covariance`.
    """
    ray = unproject(intrinsics, x_px)
    # Rows: two axes perpendicular to the ray, then the ray.
    axes = np.linalg.svd(ray[None] / np.linalg.norm(ray))[2][[1, 2, 0]]
    by, covariance = _derivatives(x, uncertainty, intrinsics, x_px, distance_m)
    by = axes @ by
    moved = by @ covariance @ by.T
    # A translation does not change the direction. The third row becomes the rotation about the ray.
    by[:, :3] = by[2] = 0.0
    by[2, 3:6] = distance_m * axes[2] @ x[:3, :3].T
    rotated = by @ covariance @ by.T / distance_m**2
    return PointUncertainty(
        distance_mm=1e3 * distance_m,
        within_95_mm=1e3 * within_95(moved),
        lateral_95_mm=1e3 * within_95(moved[:2, :2]),
        along_95_mm=1e3 * within_95(moved[2:, 2:]),
        ray_95_deg=float(np.degrees(within_95(rotated[:2, :2]))),
        rotation_95_deg=float(np.degrees(within_95(rotated))),
    )


def seen_points(
    x: Transform,
    uncertainty: Uncertainty,
    camera: Intrinsics | None,
    distance_m: float,
) -> PointUncertaintyOverImage:
    """Return the point uncertainty at the centre and at the worst corner of the image, at `distance_m` along the ray.

    The worst corner has the largest 95 % bound of the position. `uncertainty` is that of `point_covariance`, `x` is
    gripper_from_camera. `camera` None (given camera poses): a point on the optical axis,
    without errors of intrinsics.
    """
    camera = camera or NORMALIZED  # whose image is one pixel, on the optical axis
    right, bottom = camera.width - 1.0, camera.height - 1.0
    centre, *corners = (
        bounds_at(x, uncertainty, camera, np.array(x_px), distance_m)
        for x_px in ((right / 2, bottom / 2), (0.0, 0.0), (0.0, bottom), (right, 0.0), (right, bottom))
    )
    return PointUncertaintyOverImage(**vars(centre), corners=max(corners, key=lambda one: one.within_95_mm))


def with_given_intrinsics(
    x: Transform, uncertainty: Uncertainty, camera: Intrinsics | None, given: Intrinsics, distance_m: float
) -> GivenIntrinsicsResult | None:
    """Return the gripper_from_camera to use with `given` intrinsics, and its uncertainty.

    The result is None if the calibration did not estimate intrinsics (`camera`). The transform is the conditional mean
    of X for the `given` intrinsics. Its difference from the estimated X (`x`) counts as uncertainty. Both are compared
    by a point at `distance_m` (m) along the ray of the image centre.
    """
    joint = uncertainty.joint
    if camera is None or joint is None:
        return None
    cross, of_camera = joint.covariance[:7, 7:], joint.covariance[7:, 7:]
    same_model = with_thin_prism(given) if camera.model == "thin_prism" else given
    off = parameters(same_model) - parameters(camera)
    step = cross @ np.linalg.pinv(of_camera, rcond=1e-12, hermitian=True) @ off
    # The scale is not changed: the pair is used with distances that do not depend on the reconstruction.
    step[6] = 0.0
    moved = np.r_[step, off]
    pair = uncertainty.with_error(np.outer(moved, moved))
    x_px = np.array([camera.width - 1.0, camera.height - 1.0]) / 2
    apart = _derivatives(x, uncertainty, camera, x_px, distance_m)[0][:, : len(moved)] @ moved
    return GivenIntrinsicsResult(
        gripper_from_camera=retract(x, step[:6]),
        covariance=pair.covariance,
        intrinsics=given,
        seen=bounds_at(x, pair, camera, x_px, distance_m),
        differs_mm=1e3 * float(np.linalg.norm(apart)),
    )


def within_95(covariance: Float[ndarray, "n n"]) -> float:
    """Return the length that 95 % of zero-mean normal errors of this covariance do not exceed, to 1 % (Imhof 1961)."""
    spread = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean, second, third = (float((spread**power).sum()) for power in (1, 2, 3))
    if third <= 0:
        return 0.0
    freedom = second**3 / third**2
    return float(np.sqrt(mean + (chi2.ppf(0.95, freedom) - freedom) * np.sqrt(second / freedom)))


def scene_uncertainty(points: ScenePoints) -> SceneUncertainty:
    """Return the uncertainty of the scene's pose and scale as a whole, and of its shape, from a sample of its points.

    The pose and scale are the similarity transform that fits the common errors of the points best; the shape is the rms
    of the remaining errors per coordinate (m). `points` are those of `scene_points`.
    """
    in_base, shared, own = points
    middle, count = np.median(in_base, axis=0), len(in_base)
    by_step = by_similarity(in_base - middle).reshape(3 * count, 7)
    together = shared.reshape(3 * count, 3 * count)
    fit = np.linalg.pinv(by_step)
    as_whole = fit @ together @ fit.T
    left = np.trace(together) - 2 * np.sum((fit @ together) * by_step.T)
    left += np.sum((as_whole @ by_step.T) * by_step.T)
    each = shared[np.arange(count), :, np.arange(count)] + own
    return SceneUncertainty(
        middle_in_base=middle,
        covariance=as_whole,
        shape_m=float(np.sqrt(max(left, 0.0) / (3 * count))),
        within_95_m=float(np.median([within_95(one) for one in each])),
    )


def scene_points(solution: Solution) -> ScenePoints:
    """Return up to SCENE_POINTS random points of a solution in the base frame (m), with two covariances.

    The first (p,3,p,3) is the joint covariance (m²) of all p points by errors of the unknowns and of the poses of rigs.
    The second (p,3,3) is that of each point by triangulation from exact cameras. Both are in base axes.
    """
    problem, likely, images = solution.problem, solution.most_likely, solution.images
    some = np.sort(np.random.default_rng(0).permutation(len(images.state.points_in_world))[:SCENE_POINTS])
    base_from_world, scale, count = likely.z[0][:3, :3], likely.scale, len(some)
    # Each point follows from its observations, given the columns (cameras, boards, rigs) of `Problem.columns`.
    _, rows_point, seen = problem.rows
    rows = np.flatnonzero(np.isin(rows_point, some))
    starts = np.flatnonzero(np.diff(rows_point[rows], prepend=-1))
    by = derivatives(problem, images.state, images.view, images.weight)
    by_point, first = by.by_point[rows], problem.columns.first_rig
    blocks = point_blocks(by_point, starts)
    columns = np.zeros((len(rows), 2, problem.columns.count))
    columns[:, :, :first] = by.shared[rows]
    own = first + 6 * seen.image[rows][:, None] + np.arange(6)
    columns[np.arange(len(rows))[:, None, None], np.arange(2)[:, None], own[:, None]] = by.own[rows]
    coupling = np.add.reduceat(np.swapaxes(by_point, 1, 2) @ columns, starts)
    by_column = -scale * base_from_world @ np.linalg.solve(blocks, coupling)
    # The columns are unknowns, except the rigs that arms move; these follow from images and reported poses.
    follow, _, rig_covariance = images.rigs
    shown = pose_by_pose(reported_poses(problem, likely)[2], rig_covariance)
    gain = over(cholesky(solution.equations.covariance(solution.log_sizes)), shown).T
    robots, free, by_arm = problem.arm_unknowns, problem.free, problem.by_arm
    by_unknown = np.zeros((problem.columns.count, problem.unknowns))
    by_unknown[free, robots + np.arange(len(free))] = 1.0
    by_unknown[by_arm] = -gain @ solution.equations.jacobian
    by_unknown[by_arm, robots:] -= follow
    j = by_column @ by_unknown
    in_base_axes = scale * images.state.points_in_world[some] @ base_from_world.T
    j[:, :, np.r_[BASE_TRANSLATION, BASE_ROTATION, SCALE]] += by_similarity(in_base_axes)
    j, by_rig = j.reshape(3 * count, -1), by_column[:, :, by_arm].reshape(3 * count, -1)
    together = j @ solution.covariance @ j.T + by_rig @ (rig_covariance - gain @ shown) @ by_rig.T
    triangulated = scale**2 * base_from_world @ np.linalg.inv(blocks) @ base_from_world.T
    return in_base_axes + likely.z[0][:3, 3], together.reshape(count, 3, count, 3), triangulated


def _derivatives(
    x: Transform,
    uncertainty: Uncertainty,
    intrinsics: Intrinsics,
    x_px: Pixels,
    distance_m: Distances,
) -> tuple[Float[ndarray, "*points 3 j"], Float[ndarray, "j j"]]:
    """Return derivatives of points relative to the gripper, in camera axes, by j unknowns, and their covariance.

    The unknowns are gripper_from_camera `x` (translation, rotation; gripper axes), log scale, the intrinsics if
    estimated, the coefficients of the distortion that the model cannot express, and the extrapolated part of the
    distortion. `distance_m` is along the ray, and the scale does not change it.
    """
    x_px, left = np.asarray(x_px, float), uncertainty.model_error
    ray = unproject(intrinsics, x_px)
    length = np.linalg.norm(ray, axis=-1)[..., None, None]
    unit, distance = ray / length[..., 0], np.asarray(distance_m)[..., None]
    by_ray = np.linalg.inv(by_point(intrinsics, ray)[..., :2])
    by_pixel = distance[..., None] * across_lines(unit)[..., :2] @ by_ray / length
    camera_from_gripper_axes = x[:3, :3].T
    by_unknown = by_similarity(distance * unit)
    by_unknown[..., SCALE] = 0.0
    by_unknown[..., :3] = camera_from_gripper_axes
    by_unknown[..., 3:6] = by_unknown[..., 3:6] @ camera_from_gripper_axes
    columns, covariance, by_intrinsics = [by_unknown], uncertainty.whole, by_parameters(intrinsics, ray)
    if uncertainty.joint is not None:
        # For a fixed pixel the ray compensates the change of the projection by the intrinsics.
        columns.append(-by_pixel @ by_intrinsics)
    if left is not None:
        by_coefficient = polynomials(x_px.reshape(-1, 2), intrinsics).reshape(*x_px.shape, -1)
        columns.append(by_pixel @ (by_coefficient - by_intrinsics @ left.expressed))
        # The squared mean is part of the error of a projection by the intrinsics alone.
        moment = left.covariance + np.outer(left.likeliest, left.likeliest)
        # Beyond the last observed pixel, the change of the distortion counts as one standard deviation of its error.
        kept = rays_by_reach(intrinsics, x_px, left.reach_px)
        columns.append((distance * (unit - kept / np.linalg.norm(kept, axis=-1, keepdims=True)))[..., None])
        covariance = block_diag(covariance, moment, 1.0)
    return np.concatenate(columns, axis=-1), np.asarray(covariance)
