"""Predicted uncertainty of a calibration whose images do not exist yet, by the equations of a simulated scene.

The uncertainty depends on the gripper poses, on the prior of the intrinsics and on the errors of images and robot, but
hardly on the scene. Points are put on a surface with relief where the cameras look, and are observed where a matcher
would find them again. The equations are those of pose_equations.py at residuals of 0.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import parameters, project, unproject, with_parameters
from jcr.estimation.covariance import expected_covariance_at
from jcr.estimation.equation import Poses
from jcr.estimation.image_equations import evidence
from jcr.estimation.intrinsics_prior import CameraPrior, camera_about
from jcr.estimation.next_poses import assumed_camera, median_distance
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.point_uncertainty import in_use
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import scale_prior
from jcr.estimation.robot_noise import GIVEN_SHARE, TYPICAL
from jcr.estimation.solve import Solution, expected_solution
from jcr.estimation.wrist import estimate_in, pose_problem, wrist_arm, wrist_problem
from jcr.geometry import apply, inverse
from jcr.least_squares import one_blas_thread
from jcr.records import Estimate, Intrinsics, InUse, RobotNoise, Tracks

FEWEST = 3
"""Smallest number of poses from which a calibration is predicted."""
COLUMNS = 9
"""Columns of the grid of rays of an image that end in points of the scene."""
MOST_POINTS = 400
"""Largest number of points of a scene. With 1000 the predictions differ by 0.1 % (after eleven more poses by 5 %), and
take twice as long."""
RELIEF = 0.1
"""Relief of the scene to either side of its surface, as a share of the working distance: objects on a table."""
TYPICAL_INFORMATION, TYPICAL_MODEL_ERROR = 5000.0, 1.2e-4
"""Information (1/px²) of an image and size of the camera-model error (image widths) before images are matched: about
the geometric mean over eleven real captures."""
LEAST_MODEL_ERROR = 1e-9
"""Size of the camera-model error of an exact model, image widths."""
UNCONNECTED = 1e-2
"""Information (1/m², 1/rad²) added to the pose of each image. Without it, an image that shares hardly a point with
others loses its information in the rounding of the elimination."""
SAME_FEATURE = np.radians(40.0), 2.0
"""Largest rotation of the line of sight and largest ratio of distances at which a matcher finds a feature again."""
USUAL_FOCAL = 0.8
"""Focal length of an unknown camera in image widths: a horizontal field of view of 64°."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictedCamera:
    """A camera with the prior of its intrinsics, and the information of its images."""

    camera: CameraPrior
    information_per_px2: float = TYPICAL_INFORMATION
    """Mean over the images of the sum of the inverse variances of the observations of one coordinate."""
    model_error: float = TYPICAL_MODEL_ERROR
    """Size of the remaining distortion of the camera's model, in widths of the image."""

    @staticmethod
    def of(solution: Solution) -> "PredictedCamera":
        """Return the first camera of a solution, whose next images are like those of the solution."""
        images, problem = solution.images, solution.problem
        own = problem.columns.model_error[0]
        return PredictedCamera(
            camera=replace(problem.cameras[0], intrinsics=images.view.cameras[0]),
            information_per_px2=float(images.weight.sum()) / problem.n_images,
            model_error=float(images.state.model_error_std[0]) if own.stop > own.start else 0.0,
        )


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """Quantities besides the gripper poses that determine the uncertainty of a calibration."""

    gripper_from_camera: Float[ndarray, "4 4"]
    distance_m: float
    """Distance from the camera to the scene."""
    noise: RobotNoise
    camera: PredictedCamera | None = None
    """None: the camera poses are given, and exact."""
    scale_std: float | None = None
    """Relative standard deviation of a scale that is known beforehand; None: unknown."""
    faults: Float[ndarray, "7 7"] | None = None
    """Covariance that findings add; None: nothing."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Result that a calibration is predicted to report."""

    estimate: Estimate
    in_use: InUse

    @property
    def std(self) -> Float[ndarray, "7"]:
        """Standard deviations, in COVARIANCE_ORDER."""
        return np.sqrt(np.diag(self.estimate.covariance))


def assumed(
    base_from_gripper: Poses, camera: PredictedCamera | None, noise: tuple[float, float] | None = None
) -> Assumptions:
    """Return assumptions before any result: a usual robot, and a camera at its gripper.

    `noise` (m, rad) is a lower bound on the random errors of the robot.
    """
    x = assumed_camera(base_from_gripper)
    return Assumptions(
        gripper_from_camera=x,
        distance_m=median_distance(base_from_gripper @ x),
        noise=typical_noise(noise),
        camera=camera,
    )


def typical_noise(given: tuple[float, float] | None = None) -> RobotNoise:
    """Return typical errors of a robot; `given` (m, rad) is a lower bound on the random ones."""
    metres, radians, systematic = TYPICAL
    if given is not None:
        metres, radians = np.hypot(1.0, GIVEN_SHARE) * np.array(given)
    return RobotNoise(
        translation=float(metres),
        rotation=float(radians),
        estimated=False,
        given=given,
        systematic=float(systematic),
    )


def typical_camera(
    intrinsics: Intrinsics | None, size: tuple[int, int], std: Float[ndarray, " q"] | None = None
) -> PredictedCamera:
    """Return a camera whose images are not matched yet.

    `size` is width and height (px), `std` the standard deviations that `camera_about` takes.
    """
    width, height = size
    focal, centre = USUAL_FOCAL * width, ((width - 1) / 2, (height - 1) / 2)
    camera = intrinsics or Intrinsics(focal, focal, *centre, width, height)
    return PredictedCamera(camera=camera_about(camera, intrinsics is not None, std))


@one_blas_thread
def predict(
    assumptions: Assumptions, base_from_gripper: Poses, systematic: Float[ndarray, "s s"]
) -> Prediction:
    """Return the predicted result of a calibration from these gripper poses.

    `systematic` is the covariance of their systematic errors at 1 rad.
    """
    if assumptions.camera is None:
        estimate = Estimate(
            gripper_from_camera=assumptions.gripper_from_camera,
            scale=1.0,
            base_from_recon=np.eye(4),
            covariance=predict_covariance(assumptions, base_from_gripper, systematic),
        )
    else:
        found = _predicted_solution(assumptions, assumptions.camera, base_from_gripper, systematic)
        estimate = estimate_in(found, 1.0, np.eye(4))
    if assumptions.faults is not None:
        estimate = estimate.with_fault(assumptions.faults)
    return Prediction(estimate=estimate, in_use=in_use(estimate, assumptions.distance_m))


def predict_covariance(
    assumptions: Assumptions,
    base_from_gripper: Poses,
    systematic: Float[ndarray, "s s"],
    averaged: bool = True,
) -> Float[ndarray, "7 7"]:
    """Return the predicted covariance of X and scale from exact, metric camera poses.

    Without `averaged` it is the covariance where the sizes of the robot's errors are known.
    """
    x, noise = assumptions.gripper_from_camera, assumptions.noise
    problem, state = pose_problem(
        base_from_gripper,
        base_from_gripper @ x,
        (x, 1.0, np.eye(4)),
        error_covariance=systematic,
        noise_floor=noise.given,
        priors=() if assumptions.scale_std is None else (scale_prior(1.0, assumptions.scale_std),),
    )
    if averaged:
        return expected_solution(problem, state, None, noise).covariance[:7, :7]
    poses = pose_equations(problem, state, None)
    return expected_covariance_at(poses.equations, noise, poses.region)[:7, :7]


def _predicted_solution(
    assumptions: Assumptions,
    camera: PredictedCamera,
    base_from_gripper: Poses,
    systematic: Float[ndarray, "s s"],
) -> Solution:
    """Return the predicted solution of a problem with images of a simulated scene."""
    # Far outside the image a distortion may fold; its size hardly changes how well it becomes known.
    straight = parameters(camera.camera.intrinsics)
    straight[4:] = 0.0
    intrinsics = with_parameters(camera.camera.intrinsics, straight)
    x, noise = assumptions.gripper_from_camera, assumptions.noise
    cameras, count = base_from_gripper @ x, len(base_from_gripper)
    problem, state = wrist_problem(
        wrist_arm(base_from_gripper, systematic),
        (x, 1.0, np.eye(4)),
        cameras,
        replace(camera.camera, intrinsics=intrinsics),
        _observed_points(cameras, intrinsics, assumptions.distance_m),
        noise=noise.given,
    )
    assert problem.observations is not None
    per_image = len(problem.observations.point) / count
    state = replace(
        state,
        model_error_std=np.array([max(camera.model_error, LEAST_MODEL_ERROR)]),
        pixel_noise=PixelNoise(np.array([np.sqrt(per_image / camera.information_per_px2)])),
    )
    images = evidence(problem, state)
    images.information[np.diag_indices(len(images.information))] += UNCONNECTED
    return expected_solution(problem, state, images, noise)


def _observed_points(cameras: Poses, intrinsics: Intrinsics, distance_m: float) -> Tracks:
    """Return points where the rays of a grid in each image meet the scene, and their observations."""
    rows = max(2, round(COLUMNS * intrinsics.height / intrinsics.width))
    u, v = np.meshgrid(
        (np.arange(COLUMNS) + 0.5) / COLUMNS * intrinsics.width,
        (np.arange(rows) + 0.5) / rows * intrinsics.height,
    )
    rays = unproject(intrinsics, np.stack([u.ravel(), v.ravel()], axis=1))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The surface is across the mean optical axis; rays along it end at twice its distance. The relief is a pattern of
    # the rays, alike in all images.
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
    image, point = np.nonzero(_visible(cameras, intrinsics, points, source))
    x_px = np.empty((len(image), 2))
    for i, pose in enumerate(cameras):
        mine = image == i
        x_px[mine] = project(intrinsics, apply(inverse(pose), points[point[mine]]))
    return Tracks(image=image, x_px=x_px, point=point, points_in_recon=points)


def _visible(
    cameras: Poses, intrinsics: Intrinsics, points: Float[ndarray, "p 3"], source: Int[ndarray, " p"]
) -> Bool[ndarray, "n p"]:
    """Return the images in which a matcher finds each point: inside, and from about where its source camera is."""
    visible = np.zeros((len(cameras), len(points)), bool)
    to_source = cameras[source, :3, 3] - points
    source_distance = np.linalg.norm(to_source, axis=1)
    angle, ratio = SAME_FEATURE
    for i, pose in enumerate(cameras):
        x_px = project(intrinsics, x_in_camera := apply(inverse(pose), points))
        inside = ((x_px > 0) & (x_px < [intrinsics.width, intrinsics.height])).all(1) & (
            x_in_camera[:, 2] > 0
        )
        to_camera = pose[:3, 3] - points
        distance = np.linalg.norm(to_camera, axis=1)
        alike = (to_source * to_camera).sum(1) > np.cos(angle) * source_distance * distance
        near = (distance < ratio * source_distance) & (source_distance < ratio * distance)
        visible[i] = (inside & alike & near) | (source == i)
    return visible
