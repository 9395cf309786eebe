"""How well a point that the camera sees is placed: what a calibration is used for.

A pixel x at a distance d is the point p = d·u(K, x) in the camera, u being the unit ray, and X·p in the gripper. Its
error comes from the intrinsics K, from X and, where the distance is one of the reconstruction, from the scale; the
three were estimated together, and a principal point that is off by what a rotation of the camera makes good has
no effect where both are used. Each alone exaggerates, therefore; this is their joint covariance, carried to the point
(projection uncertainty, as mrcal has it for a camera by itself: Kogan, "mrcal", "Projection uncertainty").
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import NORMALIZED, by_parameters, by_point, parameters, unproject, with_thin_prism
from jcr.distributions import chi2
from jcr.estimation.model_error import second_moment_px2
from jcr.estimation.points import PointsPlaced
from jcr.geometry import apply, by_similarity, retract, skew
from jcr.records import (
    Estimate,
    Intrinsics,
    InUse,
    RobotNoise,
    SceneUncertainty,
    Seen,
    WithGivenIntrinsics,
)

Pixels = Float[ndarray, "*points 2"]
Distances = Float[ndarray, "*#points"] | float
Covariances = Float[ndarray, "*points 3 3"]


@dataclass(frozen=True)
class Scene:
    """What the camera sees, as far as the accuracy in use depends on it."""

    distance_m: float
    """Median distance from the camera."""
    uncertainty: SceneUncertainty | None = None


@dataclass(frozen=True, kw_only=True)
class SeenInBase:
    """Covariances (m²) of the place of points in the robot's base frame, along its axes, by what they come from."""

    calibration: Covariances
    """Intrinsics, X and scale together: common to all points that are seen from one gripper pose."""
    robot_random: Covariances
    """The random error of the gripper pose from which the points are seen."""
    robot_systematic: Covariances
    """Its systematic error, beside what the effective X has taken up; of poses in the region of the capture."""

    @property
    def together(self) -> Covariances:
        """Of the place as a whole."""
        return self.calibration + self.robot_random + self.robot_systematic


def seen_uncertainty(
    estimate: Estimate, intrinsics: Intrinsics, x_px: Pixels, distance_m: Distances
) -> Covariances:
    """Covariance (m²), in camera axes, of where on the gripper a point is that is seen at a pixel at a distance.

    `intrinsics` are those that belong to the estimate, `x_px` (...,2) pixels of the distorted image, `distance_m` (...)
    is along the ray, in the metres of the reconstruction. The robot's pose errors are not in it.
    """
    by = _derivatives(estimate, intrinsics, x_px, distance_m)
    by_pixel = _by_pixel(intrinsics, x_px, distance_m)
    of_model = by_pixel @ _model_error_px2(estimate, intrinsics, x_px) @ np.swapaxes(by_pixel, -1, -2)
    return by @ joint_covariance(estimate) @ np.swapaxes(by, -1, -2) + of_model


def point_in_base(
    estimate: Estimate,
    noise: RobotNoise,
    x_px: Pixels,
    depth_m: Distances,
    base_from_gripper: Float[ndarray, "4 4"],
) -> tuple[Float[ndarray, "*points 3"], SeenInBase]:
    """Return the base-frame coordinates (m) of points at pixels, z = `depth_m` in the camera, and their covariances.

    `noise` is that of the reported gripper pose, whose errors add to those of the calibration.
    """
    intrinsics, x = estimate.intrinsics, estimate.gripper_from_camera
    assert intrinsics is not None
    ray = unproject(intrinsics, x_px)
    distance_m = np.asarray(depth_m) * np.linalg.norm(ray, axis=-1) / ray[..., 2]
    p_in_gripper = apply(x, np.asarray(depth_m)[..., None] * ray / ray[..., 2:])
    base_from_camera_axes = base_from_gripper[:3, :3] @ x[:3, :3]
    in_camera = seen_uncertainty(estimate, intrinsics, x_px, distance_m)
    lever = skew(p_in_gripper @ base_from_gripper[:3, :3].T)
    square = lever @ np.swapaxes(lever, -1, -2)
    random, systematic = (
        metres**2 * np.eye(3) + radians**2 * square
        for metres, radians in ((noise.translation, noise.rotation), noise.systematic_left)
    )
    return apply(base_from_gripper, p_in_gripper), SeenInBase(
        calibration=base_from_camera_axes @ in_camera @ base_from_camera_axes.T,
        robot_random=random,
        robot_systematic=systematic,
    )


def seen(estimate: Estimate, intrinsics: Intrinsics, x_px: Float[ndarray, "2"], distance_m: float) -> Seen:
    """What 95 % of the errors of a point seen there are below: across the ray, along it, and in direction."""
    by = _derivatives(estimate, intrinsics, x_px, distance_m)
    ray = unproject(intrinsics, x_px)
    # Two directions across the ray, and the ray: rows.
    axes = np.linalg.svd(ray[None] / np.linalg.norm(ray))[2][[1, 2, 0]]
    joint = joint_covariance(estimate)
    by_pixel = axes @ _by_pixel(intrinsics, x_px, distance_m)
    of_model = by_pixel @ _model_error_px2(estimate, intrinsics, x_px) @ by_pixel.T
    moved = axes @ seen_uncertainty(estimate, intrinsics, x_px, distance_m) @ axes.T
    # Of the direction, what moves the camera as a whole is left out; the rotation about the ray stands beside.
    by_direction = axes @ by
    by_direction[:, :3] = 0.0
    by_direction /= distance_m
    by_direction[2] = 0.0
    by_direction[2, 3:6] = axes[2] @ estimate.gripper_from_camera[:3, :3].T
    rotated = by_direction @ joint @ by_direction.T + of_model / distance_m**2
    return Seen(
        distance_mm=1e3 * distance_m,
        within_95_mm=1e3 * within_95(moved),
        lateral_95_mm=1e3 * within_95(moved[:2, :2]),
        along_95_mm=1e3 * within_95(moved[2:, 2:]),
        ray_95_deg=float(np.degrees(within_95(rotated[:2, :2]))),
        rotation_95_deg=float(np.degrees(within_95(rotated))),
    )


def in_use(estimate: Estimate, scene: Scene) -> InUse:
    """How exact an estimate is where it is used: at the centre and the worst corner of the image, and in the scene.

    Of camera poses that were given there are no intrinsics: the ray along the optical axis is then exact.
    """
    camera, distance = estimate.intrinsics, scene.distance_m
    if camera is None:
        at_centre = seen(estimate, NORMALIZED, np.zeros(2), distance)
        return InUse(seen=at_centre, corners=at_centre)
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = [np.array([u, v]) for u in (0.0, right) for v in (0.0, bottom)]
    return InUse(
        seen=seen(estimate, camera, np.array([right, bottom]) / 2, distance),
        corners=max(
            (seen(estimate, camera, corner, distance) for corner in corners), key=lambda one: one.within_95_mm
        ),
        scene=scene.uncertainty,
    )


def with_given_intrinsics(
    estimate: Estimate, given: Intrinsics, distance_m: float
) -> WithGivenIntrinsics | None:
    """The pair with intrinsics that were given beside the estimated one, compared at the centre of the image.

    The transform is the mean of the joint distribution where the intrinsics are `given`, without a thin prism where they
    have none. What such a
    pair places elsewhere than the estimated one counts as uncertainty. None where nothing was estimated.
    """
    camera, cross = estimate.intrinsics, estimate.intrinsics_cross
    if camera is None or cross is None or estimate.intrinsics_covariance is None:
        return None
    same_model = with_thin_prism(given) if camera.model == "thin_prism" else given
    off = parameters(same_model) - parameters(camera)
    step = cross @ np.linalg.pinv(estimate.intrinsics_covariance, rcond=1e-12, hermitian=True) @ off
    # Who keeps the pair has distances of their own, and no scale.
    step[6] = 0.0
    pair = replace(
        estimate,
        covariance=estimate.covariance + np.outer(step, step),
        intrinsics_cross=cross + np.outer(step, off),
        intrinsics_covariance=estimate.intrinsics_covariance + np.outer(off, off),
    )
    x_px = np.array([camera.width - 1.0, camera.height - 1.0]) / 2
    apart = _derivatives(estimate, camera, x_px, distance_m) @ np.r_[step, off]
    return WithGivenIntrinsics(
        gripper_from_camera=retract(estimate.gripper_from_camera, step[:6]),
        covariance=pair.covariance,
        intrinsics=given,
        seen=seen(pair, camera, x_px, distance_m),
        differs_mm=1e3 * float(np.linalg.norm(apart)),
    )


def scene_uncertainty(points: PointsPlaced) -> SceneUncertainty:
    """Of a scene by some of its points: how it moves as a whole, and what is left of their errors."""
    middle, count = np.median(points.in_base, axis=0), len(points.in_base)
    by = by_similarity(points.in_base - middle).reshape(3 * count, 7)
    together = points.together.reshape(3 * count, 3 * count)
    fit = np.linalg.pinv(by)
    as_whole = fit @ together @ fit.T
    left = np.trace(together) - 2 * np.sum((fit @ together) * by.T) + np.sum((as_whole @ by.T) * by.T)
    each = points.together[np.arange(count), :, np.arange(count)] + points.own
    return SceneUncertainty(
        middle_in_base=middle,
        covariance=as_whole,
        shape_m=float(np.sqrt(max(left, 0.0) / (3 * count))),
        within_95_m=float(np.median([within_95(one) for one in each])),
    )


def joint_covariance(estimate: Estimate) -> Float[ndarray, "j j"]:
    """Of COVARIANCE_ORDER and the parameters of the intrinsics; of X and scale alone where no intrinsics were
    estimated."""
    if estimate.intrinsics_covariance is None or estimate.intrinsics_cross is None:
        return estimate.covariance
    cross = estimate.intrinsics_cross
    return np.block([[estimate.covariance, cross], [cross.T, estimate.intrinsics_covariance]])


def within_95(covariance: Float[ndarray, "n n"]) -> float:
    """The length that 95 % of normal errors of this covariance stay below, to 1 % (Imhof 1961, Pearson's moments)."""
    spread = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean, second, third = (float((spread**power).sum()) for power in (1, 2, 3))
    if third <= 0:
        return 0.0
    freedom = second**3 / third**2
    return float(np.sqrt(mean + (chi2.ppf(0.95, freedom) - freedom) * np.sqrt(second / freedom)))


def _in_camera(intrinsics: Intrinsics, x_px: Pixels, distance_m: Distances) -> Float[ndarray, "*points 3"]:
    ray = unproject(intrinsics, np.asarray(x_px, float))
    return np.asarray(distance_m)[..., None] * ray / np.linalg.norm(ray, axis=-1, keepdims=True)


def _model_error_px2(
    estimate: Estimate, intrinsics: Intrinsics, x_px: Pixels
) -> Float[ndarray, "*points 2 2"]:
    x_px = np.asarray(x_px, float)
    if estimate.model_error is None:
        return np.zeros((*x_px.shape, 2))
    return second_moment_px2(estimate.model_error, intrinsics, x_px)


def _by_pixel(intrinsics: Intrinsics, x_px: Pixels, distance_m: Distances) -> Float[ndarray, "*points 3 2"]:
    """By how much the point moves in the camera with its pixel."""
    ray = unproject(intrinsics, np.asarray(x_px, float))
    length = np.linalg.norm(ray, axis=-1)[..., None, None]
    unit = ray / length[..., 0]
    across = np.eye(3) - unit[..., :, None] * unit[..., None, :]
    of_ray = np.linalg.inv(by_point(intrinsics, ray)[..., :2])
    return np.asarray(distance_m)[..., None, None] * across[..., :2] @ of_ray / length


def _derivatives(
    estimate: Estimate, intrinsics: Intrinsics, x_px: Pixels, distance_m: Distances
) -> Float[ndarray, "*points 3 j"]:
    """Of the point on the gripper, in camera axes, by what `joint_covariance` is of."""
    camera_from_gripper_axes = estimate.gripper_from_camera[:3, :3].T
    p = _in_camera(intrinsics, x_px, distance_m)
    by_x = by_similarity(p)
    by_x[..., :3] = camera_from_gripper_axes
    by_x[..., 3:6] = by_x[..., 3:6] @ camera_from_gripper_axes
    if estimate.intrinsics_cross is None:
        return by_x
    # The pixel stays: what the parameters add to the projection, the ray takes back.
    by_parameter = by_parameters(intrinsics, unproject(intrinsics, np.asarray(x_px, float)))
    return np.concatenate([by_x, -_by_pixel(intrinsics, x_px, distance_m) @ by_parameter], axis=-1)
