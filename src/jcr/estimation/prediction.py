"""Predicted uncertainty of a calibration before its images exist.

Simulated points lie on a surface with relief in front of the cameras, and all residuals are 0; the uncertainty hardly
depends on the scene.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import guessed_intrinsics, parameters, project, unproject, with_parameters
from jcr.estimation.image_equations import image_evidence
from jcr.estimation.intrinsics_prior import CameraPrior, camera_about
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.point_uncertainty import seen_points
from jcr.estimation.problem import PoseModel, pose_problem, scale_prior, wrist_arm, wrist_problem
from jcr.estimation.robot_noise import GIVEN_SHARE, TYPICAL
from jcr.estimation.solve import Solution, uncertainty_of, with_covariance
from jcr.geometry import Poses, Transform, nearest_to_lines, transform
from jcr.least_squares import one_blas_thread
from jcr.records import Intrinsics, RobotNoise, Tracks, Uncertainty

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
LEAST_MODEL_ERROR = 1e-9
"""Lower bound of the size of the remaining distortion, in image widths."""
UNCONNECTED = 1e-2
"""Information (1/m², 1/rad²) added to all `Problem.columns`, against rounding for images without common points."""
SAME_FEATURE = np.radians(40.0), 2.0
"""Largest angle (rad) between lines of sight, and ratio of distances, at which a feature is matched again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedCamera:
    """Camera of a prediction: prior of its intrinsics, and information per image."""

    camera: CameraPrior
    information_per_px2: float = TYPICAL_INFORMATION
    """Sum of the weights (1/px²) of an image's observations, mean over the images."""
    model_error: float = TYPICAL_MODEL_ERROR
    """Size of the remaining distortion of the camera's model, in image widths."""

    @staticmethod
    def of(solution: Solution) -> "PredictedCamera":
        """Return the first camera of a solution, with the mean information (1/px²) and model error of its images."""
        images, problem = solution.images, solution.problem
        own = problem.columns.model_error[0]
        return PredictedCamera(
            camera=replace(problem.cameras[0], intrinsics=images.view.cameras[0]),
            information_per_px2=float(images.weight.sum()) / problem.n_images,
            model_error=float(images.state.model_error_std[0]) if own.stop > own.start else 0.0,
        )


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """Assumptions of a prediction, apart from the gripper poses: hand-eye transform, distance, noise, camera, scale."""

    gripper_from_camera: Float[ndarray, "4 4"]
    distance_m: float
    """Distance from the camera to the scene."""
    noise: RobotNoise
    """Errors of the gripper poses."""
    camera: PredictedCamera | None = None
    """Camera whose images are simulated; None: the camera poses are given and exact."""
    scale_std: float | None = None
    """Relative standard deviation of a known scale; None: the scale is unknown."""
    shifts: tuple[Float[ndarray, " k"], ...] = ()
    """Changes of the calibration that found faults explain, in COVARIANCE_ORDER and then of the intrinsics, which more
    images do not reduce."""


def assumed(
    base_from_gripper: Poses, camera: PredictedCamera | None, noise: tuple[float, float] | None
) -> Assumptions:
    """Return assumptions before any calibration: typical robot errors, and a camera at the gripper's origin.

    The recorded or planned poses `base_from_gripper` determine the axis along which the camera looks
    (`assumed_camera`) and the median distance of the scene. `camera` None: camera poses are given and exact. `noise`
    (m, rad) is a lower bound on the random errors of the robot; None: no bound.
    """
    x, sizes = assumed_camera(base_from_gripper), np.array(TYPICAL)
    if noise is not None:
        sizes[:2] = np.hypot(1.0, GIVEN_SHARE) * np.array(noise)
    metres, radians, systematic = sizes.tolist()
    return Assumptions(
        gripper_from_camera=x,
        distance_m=median_distance(base_from_gripper @ x),
        noise=RobotNoise(
            translation=metres, rotation=radians, estimated=False, given=noise, systematic=systematic
        ),
        camera=camera,
    )


def typical_camera(
    intrinsics: Intrinsics | None, size: tuple[int, int], std: Float[ndarray, " q"] | None = None
) -> PredictedCamera:
    """Return the camera of a prediction before any images are matched, with typical image information.

    `intrinsics` None: guessed from `size`, the (width, height) in px. `std` are standard deviations of given
    `intrinsics` in the order of camera.parameters; None: MEASURED.
    """
    camera = intrinsics or guessed_intrinsics(size)
    return PredictedCamera(camera=camera_about(camera, intrinsics is not None, std))


@one_blas_thread
def predict(
    assumptions: Assumptions, base_from_gripper: Poses, systematic: Float[ndarray, "s s"]
) -> Uncertainty:
    """Return the predicted uncertainty of a calibration from n gripper poses.

    `systematic` (6n,6n) is the covariance of the poses' systematic errors for a size σ_s of 1 rad. Its order is pose by
    pose: translation (m), then rotation vector (rad), in base axes. The images of `assumptions.camera` are simulated.
    """
    x, noise, camera = assumptions.gripper_from_camera, assumptions.noise, assumptions.camera
    intrinsics = None
    cameras = base_from_gripper @ x
    if camera is None:
        known = () if assumptions.scale_std is None else (scale_prior(1.0, assumptions.scale_std),)
        model = PoseModel(error_covariance=systematic, noise_floor=noise.given, priors=known)
        problem, state = pose_problem(base_from_gripper, cameras, (x, 1.0, np.eye(4)), model)
        found = with_covariance(problem, state, None, expected=noise)
        uncertainty = Uncertainty(covariance=found.covariance[:7, :7])
    else:
        # Distortion is set to 0, since it may fold over outside the image; its value hardly matters for its uncertainty.
        straight = parameters(camera.camera.intrinsics)
        straight[4:] = 0.0
        intrinsics = with_parameters(camera.camera.intrinsics, straight)
        problem, state = wrist_problem(
            wrist_arm(base_from_gripper, systematic),
            (x, 1.0, np.eye(4)),
            cameras,
            replace(camera.camera, intrinsics=intrinsics),
            _observed_points(cameras, intrinsics, assumptions.distance_m),
            noise=noise.given,
        )
        assert problem.observations is not None
        per_image = len(problem.observations.point) / len(cameras)
        state = replace(
            state,
            model_error_std=np.array([max(camera.model_error, LEAST_MODEL_ERROR)]),
            pixel_noise=PixelNoise(np.array([np.sqrt(per_image / camera.information_per_px2)])),
        )
        images = image_evidence(problem, state)
        images.information[np.diag_indices(len(images.information))] += UNCONNECTED
        found = with_covariance(problem, state, images, expected=noise)
        uncertainty, intrinsics = uncertainty_of(found), found.problem.intrinsics(found.state)[0]
    for shift in assumptions.shifts:
        shift = shift if uncertainty.joint is not None else shift[:7]
        uncertainty = uncertainty.with_error(np.outer(shift, shift))
    return replace(uncertainty, seen=seen_points(x, uncertainty, intrinsics, assumptions.distance_m))


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
