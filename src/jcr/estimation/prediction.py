"""Predicted uncertainty of a calibration before its images exist.

Simulated points lie on a surface with relief in front of the cameras, and all residuals are 0; the uncertainty hardly
depends on the scene.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import guessed_intrinsics, parameters, project, unproject, with_parameters
from jcr.estimation.image_equations import image_evidence
from jcr.estimation.intrinsics_prior import camera_about
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.point_uncertainty import seen_points
from jcr.estimation.problem import wrist_arm, wrist_problem
from jcr.estimation.solve import uncertainty_of, with_covariance
from jcr.geometry import Poses, Transform, nearest_to_lines, transform
from jcr.least_squares import one_blas_thread
from jcr.records import Capture, Intrinsics, Tracks, Uncertainty

MIN_PREDICTED_IMAGES = 3
"""Smallest number of poses for a prediction."""
COLUMNS = 9
"""Number of columns of the pixel grid whose rays give the points of the simulated scene."""
MOST_POINTS = 400
"""Largest number of points of the simulated scene; with 1000 predictions change by 0.1 %."""
RELIEF = 0.1
"""Amplitude of the scene's relief over the working distance, as of objects on a table."""
TYPICAL_INFORMATION, TYPICAL_MODEL_ERROR = 5000.0, 1.2e-4
"""Information of an image (1/px²) and size of the remaining distortion (image widths): means of eleven captures."""
UNCONNECTED = 1e-2
"""Information (1/m², 1/rad²) added to all `Problem.columns`, against rounding for images without common points."""
SAME_FEATURE = np.radians(40.0), 2.0
"""Largest angle (rad) between lines of sight, and ratio of distances, at which a feature is matched again."""


@one_blas_thread
def predict(
    capture: Capture, noise: tuple[float, float] | None, systematic: Float[ndarray, "s s"]
) -> tuple[Transform, Uncertainty]:
    """Return an assumed gripper_from_camera, and the predicted uncertainty of a calibration from n images.

    The camera is at the gripper's origin (`assumed_camera`), the robot's errors are typical ones, and the images have
    typical information. `noise` (m, rad) is a lower bound on the random errors of the robot; None: no bound.
    `systematic` (6n,6n) is the covariance of the poses' systematic errors for a size σ_s of 1 rad. Its order is pose by
    pose: translation (m), then rotation vector (rad), in base axes.
    """
    gripper = capture.base_from_gripper
    intrinsics = capture.intrinsics or guessed_intrinsics(capture.image_size)
    # Distortion is set to 0, since it may fold over outside the image; its value hardly matters for its uncertainty.
    straight = parameters(intrinsics)
    straight[4:] = 0.0
    prior = camera_about(intrinsics, capture.intrinsics is not None, capture.intrinsics_std)
    prior = replace(prior, intrinsics=with_parameters(intrinsics, straight))
    x = assumed_camera(gripper)
    cameras = gripper @ x
    distance_m = median_distance(cameras)
    problem, state = wrist_problem(
        wrist_arm(gripper, systematic),
        (x, 1.0, np.eye(4)),
        cameras,
        prior,
        _observed_points(cameras, prior.intrinsics, distance_m),
        noise=noise,
    )
    assert problem.observations is not None
    per_image = len(problem.observations.point) / len(cameras)
    state = replace(
        state,
        model_error_std=np.array([TYPICAL_MODEL_ERROR]),
        pixel_noise=PixelNoise(np.array([np.sqrt(per_image / TYPICAL_INFORMATION)])),
    )
    images = image_evidence(problem, state)
    images.information[np.diag_indices(len(images.information))] += UNCONNECTED
    found = with_covariance(problem, state, images, expected=True)
    uncertainty = uncertainty_of(found)
    seen = seen_points(x, uncertainty, found.problem.intrinsics(found.state)[0], distance_m)
    return x, replace(uncertainty, seen=seen)


def _observed_points(cameras: Poses, intrinsics: Intrinsics, distance_m: float) -> Tracks:
    """Return simulated points, where the rays of a pixel grid in each image meet the scene, and their observations.

    An image also observes a point of another image if the lines of sight differ by less than 40° and the distances by
    less than a factor 2 (SAME_FEATURE). `cameras` are base_from_camera; `distance_m` is along the optical axis. The
    points are in the base frame (m).
    """
    size = np.array([intrinsics.width, intrinsics.height])
    rows = max(2, round(COLUMNS * intrinsics.height / intrinsics.width))
    grid = np.stack(np.meshgrid(np.arange(COLUMNS) + 0.5, np.arange(rows) + 0.5), axis=-1).reshape(-1, 2)
    rays = unproject(intrinsics, grid / [COLUMNS, rows] * size)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The surface is perpendicular to the mean optical axis; no ray is longer than twice the distance. The relief is the
    # same function of the ray in all images.
    centre, axis = cameras[:, :3, 3], cameras[:, :3, 2]
    normal = axis.mean(0)
    normal = normal / max(float(np.linalg.norm(normal)), 1e-9)
    middle = (centre + distance_m * axis).mean(0)
    direction = rays @ np.swapaxes(cameras[:, :3, :3], 1, 2)
    depth = ((middle - centre) @ normal)[:, None] / np.maximum(direction @ normal, 1e-9)
    relief = RELIEF * distance_m * np.cos(2.4 * np.arange(len(rays)))
    depth = np.clip(depth, 0.3 * distance_m, 2 * distance_m) + relief
    points = (centre[:, None] + depth[..., None] * direction).reshape(-1, 3)
    source = np.repeat(np.arange(len(cameras)), len(rays))
    chosen = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).round().astype(int)
    points, source = points[chosen], source[chosen]
    to_camera = centre[:, None] - points
    x_in_camera = -to_camera @ cameras[:, :3, :3]
    x_px = project(intrinsics, x_in_camera)
    distance = np.linalg.norm(to_camera, axis=2)
    of_source = source, np.arange(len(points))
    cosine = (to_camera * to_camera[of_source]).sum(2) / (distance * distance[of_source])
    apart = np.abs(np.log(distance / distance[of_source]))
    visible = ((x_px > 0) & (x_px < size)).all(2) & (x_in_camera[..., 2] > 0)
    visible &= (cosine > np.cos(SAME_FEATURE[0])) & (apart < np.log(SAME_FEATURE[1]))
    visible[of_source] = True
    image, point = np.nonzero(visible)
    return Tracks(image=image, x_px=x_px[image, point], point=point, points_in_recon=points)


SCENE_DISTANCE = (0.1, 2.0)
"""Smallest and largest distance of a scene (m)."""


def median_distance(camera: Poses) -> float:
    """Return the median distance (m) of the cameras from the scene centre, the point nearest to all optical axes.

    `camera` are poses base_from_camera. If the median distance is not between 0.1 and 2 m (nearly parallel axes), the
    centre is the mean of the points 0.5 m ahead of the cameras.
    """
    axis, center = camera[:, :3, 2], camera[:, :3, 3]
    distance = np.median(np.linalg.norm(center - nearest_to_lines(center, axis), axis=1))
    # Parallel axes have no common point; the scene is then taken half a metre away.
    if not SCENE_DISTANCE[0] < distance < SCENE_DISTANCE[1]:
        scene = (center + 0.5 * axis).mean(0)
        distance = np.median(np.linalg.norm(center - scene, axis=1))
    return float(distance)


def assumed_camera(base_from_gripper: Poses) -> Transform:
    """Return an assumed gripper_from_camera: a camera at the gripper's origin that looks along one of ±x, ±y, ±z.

    All views look at one scene, so the axis is chosen whose lines over all poses pass nearest to a common point,
    relative to the distance of the point. The result is +z if no axis has a point 0.1 to 2 m ahead.
    """
    center, best, least = base_from_gripper[:, :3, 3], np.eye(3)[2], np.inf
    for axis in np.concatenate([np.eye(3)[::-1], -np.eye(3)[::-1]]):
        along = base_from_gripper[:, :3, :3] @ axis
        to_scene = nearest_to_lines(center, along) - center
        ahead = (to_scene * along).sum(1)
        off = np.linalg.norm(to_scene - ahead[:, None] * along, axis=1)
        if (
            SCENE_DISTANCE[0] < np.median(ahead) < SCENE_DISTANCE[1]
            and (miss := float(np.median(off / ahead.clip(1e-3)))) < least
        ):
            best, least = axis, miss
    across = np.roll(best, 1)
    return transform(np.stack([across, np.cross(best, across), best], axis=1), np.zeros(3))
