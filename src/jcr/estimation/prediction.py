"""Predicted uncertainty of a calibration before its images exist, and choice of the poses that reduce it most.

Simulated points lie on a surface with relief in front of the cameras, and all residuals are 0; the uncertainty hardly
depends on the scene. Poses are chosen one by one, each with the least predicted uncertainty (A-optimal design:
Pukelsheim, Optimal Design of Experiments, 1993, chapter 9).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import guessed_intrinsics, parameters, project, unproject, with_parameters
from jcr.estimation.covariance import blocks_of_poses
from jcr.estimation.image_equations import image_evidence
from jcr.estimation.intrinsics_prior import CameraPrior, camera_about
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.point_uncertainty import seen_points
from jcr.estimation.pose_equations import pose_equations, pose_residuals
from jcr.estimation.problem import ROTATION, TRANSLATION, pose_problem, scale_prior, wrist_arm, wrist_problem
from jcr.estimation.robot_noise import GIVEN_SHARE, TYPICAL, solve_equations
from jcr.estimation.solve import Solution, uncertainty_of, with_covariance
from jcr.geometry import (
    Poses,
    Transform,
    by_similarity,
    inverse,
    motion_length,
    nearest_to_lines,
    rotation_exp,
    transform,
)
from jcr.least_squares import one_blas_thread
from jcr.records import Intrinsics, RobotNoise, Tracks, Uncertainty

FEWEST = 3
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
    faults: Float[ndarray, "7 7"] | None = None
    """Covariance of X and scale that findings add; None: nothing."""


def assumed(
    base_from_gripper: Poses, camera: PredictedCamera | None, noise: tuple[float, float] | None = None
) -> Assumptions:
    """Return assumptions before any calibration: typical robot errors, and a camera at the gripper's origin.

    The recorded or planned poses `base_from_gripper` determine the axis along which the camera looks
    (`assumed_camera`) and the median distance of the scene. `camera` None: camera poses are given and exact. `noise`
    (m, rad) is a lower bound on the random errors of the robot.
    """
    x = assumed_camera(base_from_gripper)
    return Assumptions(
        gripper_from_camera=x,
        distance_m=median_distance(base_from_gripper @ x),
        noise=typical_noise(noise),
        camera=camera,
    )


def typical_noise(given: tuple[float, float] | None = None) -> RobotNoise:
    """Return typical errors of a robot; `given` is a lower bound (m, rad) on the random errors; None: no bound."""
    sizes = np.array(TYPICAL)
    if given is not None:
        sizes[:2] = np.hypot(1.0, GIVEN_SHARE) * np.array(given)
    metres, radians, systematic = sizes.tolist()
    return RobotNoise(
        translation=metres, rotation=radians, estimated=False, given=given, systematic=systematic
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
    if camera is None:
        covariance = predict_covariance(assumptions, base_from_gripper, systematic)
        uncertainty = Uncertainty(covariance=covariance)
    else:
        # Distortion is set to 0, since it may fold over outside the image; its value hardly matters for its uncertainty.
        straight = parameters(camera.camera.intrinsics)
        straight[4:] = 0.0
        intrinsics = with_parameters(camera.camera.intrinsics, straight)
        cameras = base_from_gripper @ x
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
    if assumptions.faults is not None:
        uncertainty = uncertainty.with_error(assumptions.faults)
    return replace(uncertainty, seen=seen_points(x, uncertainty, intrinsics, assumptions.distance_m))


def predict_covariance(
    assumptions: Assumptions,
    base_from_gripper: Poses,
    systematic: Float[ndarray, "s s"],
    averaged: bool = True,
) -> Float[ndarray, "7 7"]:
    """Return the predicted covariance of X (gripper_from_camera) and log scale for exact camera poses in metres.

    The order is that of geometry.retract for X (translation in m, rotation in rad; gripper axes), then log scale.
    `averaged`: average over the posterior of the robot's error sizes σ; else these are known, as in
    `assumptions.noise`. `systematic` is that of `predict`.
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
        return with_covariance(problem, state, None, expected=noise).covariance[:7, :7]
    poses = pose_equations(problem, state, None)
    equations, log_sizes = poses.equations, poses.equations.log_sizes_of(noise)
    systematic = equations.variances(log_sizes)[2] * equations.systematic
    covariance = solve_equations(equations, log_sizes).covariance
    return (covariance + poses.region.spread(blocks_of_poses(systematic)))[:7, :7]


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


CANDIDATES = 600
"""Number of candidate gripper poses."""
SCENE_DISTANCE = (0.1, 2.0)
"""Smallest and largest distance of a scene (m)."""
UNIT = np.array([1e-3] * 3 + [np.radians(0.1)] * 3 + [2e-3])
"""Errors of translation (m), rotation (rad) and log scale that have equal weight: 1 mm, 0.1°, 0.2 %."""


def choose_poses(
    count: int, candidates: int, uncertainty_of: Callable[[Int[ndarray, " c"]], float]
) -> list[int]:
    """Return the indices of up to `count` poses chosen among `candidates` poses, best first, by greedy selection.

    `candidates` is the number of poses. `uncertainty_of(indices)` returns the uncertainty if these poses are added;
    each choice reduces it most. Gains fall as poses are added, so only candidates with the largest earlier gains are
    evaluated again (accelerated greedy selection: Minoux, Optimization Techniques, 1978).
    """
    chosen, gain = list[int](), np.full(candidates, np.inf)
    last = uncertainty_of(np.zeros(0, dtype=int))
    while len(chosen) < min(count, candidates):
        evaluated = dict[int, float]()
        while (row := int(gain.argmax())) not in evaluated:
            evaluated[row] = uncertainty_of(np.array([*chosen, row]))
            gain[row] = last - evaluated[row]
        chosen.append(row)
        gain[row], last = -np.inf, evaluated[row]
    return chosen


def total_uncertainty(covariance: Float[ndarray, "7 7"], point: Float[ndarray, "3"] | None = None) -> float:
    """Return the sum of the variances of gripper_from_camera (6) and log scale in units of 1 mm, 0.1° and 0.2 % (UNIT).

    `covariance` has the order translation (m), rotation (rad), log scale. With a `point` (m, from the camera in gripper
    axes), the variances of the point's position and of the rotation are summed instead.
    """
    counted = np.eye(7) / UNIT[:, None]
    if point is not None:
        counted = np.concatenate([by_similarity(point) / UNIT[TRANSLATION, None], counted[ROTATION]])
    return float(np.einsum("ri,ij,rj->", counted, covariance, counted))


def pose_information(
    base_from_gripper: Poses, gripper_from_camera: Transform, noise: tuple[float, float]
) -> Float[ndarray, "n 13 13"]:
    """Return the information matrix of X (6), log scale and base_from_recon (6) by each of n gripper poses.

    X is gripper_from_camera. Both transforms have the order translation (m), rotation vector (rad). `noise` (m, rad)
    are the standard deviations of the random errors of a pose. The reconstruction frame is the base frame, in m.
    """
    # The frame of the reconstruction is arbitrary; here it is the base frame, in metres.
    camera = base_from_gripper @ gripper_from_camera
    _, j = pose_residuals(gripper_from_camera, 1.0, np.eye(4), base_from_gripper, camera)
    j /= np.repeat(noise, 3)[:, None]
    return np.swapaxes(j, 1, 2) @ j


def nearest(poses: Float[ndarray, "c 4 4"], existing: Poses) -> Int[ndarray, " c"]:
    """Return for each of c poses the index of the nearest `existing` pose, by translation (m) plus 0.3 m times angle."""
    return motion_length(inverse(existing) @ poses[:, None]).argmin(1)


def candidate_poses(
    base_from_gripper: Poses, x: Transform, reach: Float[ndarray, "2 3"] | None, rng: np.random.Generator
) -> Float[ndarray, "k 4 4"]:
    """Return k = CANDIDATES random poses base_from_gripper that look at the scene centre of `scene_of`, within 4 cm.

    Camera distances are 0.7 to 1.3 times those of the poses `base_from_gripper` of the capture. `x` is
    gripper_from_camera. `reach` is the box (min, max; m, base frame) of gripper positions; None: that of the capture,
    enlarged by a quarter, at least 5 cm, on each side. The box grows slowly until k poses are found.
    """
    camera = base_from_gripper @ x
    center = camera[:, :3, 3]
    scene, distance = scene_of(camera)
    if reach is None:
        low, high = base_from_gripper[:, :3, 3].min(0), base_from_gripper[:, :3, 3].max(0)
        slack = np.maximum(0.25 * (high - low), 0.05)
        reach = np.stack([low - slack, high + slack])
    kept = np.zeros((0, 4, 4))
    widening = 1.0
    while len(kept) < CANDIDATES:
        n = 4 * CANDIDATES
        like = rng.integers(len(camera), size=n)
        tilt = rotation_exp(rng.normal(size=(n, 3)) * np.radians(25))
        away = np.einsum("nij,nj->ni", tilt, (center - scene)[like] / distance[like, None])
        far = distance[like] * rng.uniform(0.7, 1.3, n)
        aim = scene + rng.uniform(-0.04, 0.04, (n, 3))
        position = aim + far[:, None] * away
        rotation = tilt @ camera[like, :3, :3]
        # The smallest rotation turns the z axis onto the line of sight.
        to_aim = (aim - position) / far[:, None]
        cross = np.cross(rotation[:, :, 2], to_aim)
        sine = np.linalg.norm(cross, axis=1, keepdims=True)
        angle = np.arctan2(sine, (rotation[:, :, 2] * to_aim).sum(1, keepdims=True))
        rotation = rotation_exp(cross / np.maximum(sine, 1e-12) * angle) @ rotation
        roll = rotation_exp(rng.uniform(-np.pi / 3, np.pi / 3, n)[:, None] * [0.0, 0.0, 1.0])
        gripper = transform(rotation @ roll, position) @ inverse(x)
        inside = ((gripper[:, :3, 3] >= reach[0]) & (gripper[:, :3, 3] <= reach[1])).all(1)
        # The box grows slowly, so that the search ends also in a box with hardly any possible pose.
        kept = np.concatenate([kept, gripper[inside]])
        widening *= 1.05
        reach = np.stack([reach[0] - 0.002 * widening, reach[1] + 0.002 * widening])
    return kept[:CANDIDATES]


def scene_of(camera: Poses) -> tuple[Float[ndarray, "3"], Float[ndarray, " n"]]:
    """Return the scene centre, the point nearest to all optical axes, and the distance (m) of each camera from it.

    `camera` are poses base_from_camera; the centre (m) is in the base frame. If the median distance is not between 0.1
    and 2 m (nearly parallel axes), the centre is the mean of the points 0.5 m ahead of the cameras.
    """
    axis, center = camera[:, :3, 2], camera[:, :3, 3]
    scene = nearest_to_lines(center, axis)
    distance = np.linalg.norm(center - scene, axis=1)
    # Parallel axes have no common point; the scene is then taken half a metre away.
    if not SCENE_DISTANCE[0] < np.median(distance) < SCENE_DISTANCE[1]:
        scene = (center + 0.5 * axis).mean(0)
        distance = np.linalg.norm(center - scene, axis=1)
    return scene, distance


def median_distance(camera: Poses) -> float:
    """Return the median distance (m) of the cameras (poses base_from_camera) from the scene centre of `scene_of`."""
    return float(np.median(scene_of(camera)[1]))


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
