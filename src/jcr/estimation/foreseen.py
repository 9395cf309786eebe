"""The adjustment of a capture before its images are matched: the equations of a scene that its cameras would see.

What a calibration leaves unknown depends on where the gripper is, on what is known of the camera beforehand and on
how exact images and robot are, but hardly on what the scene is. So points are put where the cameras look, on a
surface with some relief, and seen where a matcher would find them again. The equations are those of pose_equations.py
at residuals of 0; the sizes of the errors are given.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import parameters, project, unproject, with_parameters
from jcr.estimation.covariance import expected_covariance_at
from jcr.estimation.image_equations import evidence
from jcr.estimation.intrinsics_prior import Camera
from jcr.estimation.observations import Observations
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import Arm, LinearPrior, Problem, State, with_observations
from jcr.estimation.solve import Solution, expected_solution
from jcr.estimation.wrist import pose_problem
from jcr.geometry import Poses, Transform, apply, inverse
from jcr.records import Intrinsics, RobotNoise, Tracks

COLUMNS = 9
"""Across the width of an image, of the grid whose rays end in points of the scene."""
MOST_POINTS = 400
"""Of a scene; of many images every few rays end in one. With 1000, what is expected differs by 0.1 %, after eleven more
poses by 5 %, and takes twice as long."""
RELIEF = 0.1
"""Of the working distance, to either side of the surface: what stands on a table."""
TYPICAL_INFORMATION, TYPICAL_MODEL_ERROR = 5000.0, 1.2e-4
"""Of images that are not matched yet: about the geometric mean over eleven real captures."""
LEAST_MODEL_ERROR = 1e-9
"""Widths of the image; an exact model's."""
LOST = 1e-2
"""1/m², 1/rad²: of the place of an image that shares hardly a point with others, whose information is otherwise lost in
the rounding of the points' elimination."""
SAME_FEATURE = np.radians(40.0), 2.0
"""Rotation of the line of sight, and ratio of distances, up to which a matcher finds a feature again."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeseenCamera:
    """A camera with the prior of its intrinsics, and the information of its images."""

    camera: Camera
    information_per_px2: float = TYPICAL_INFORMATION
    """Sum of the inverse variances of an image's observations of x, or of y, on average."""
    model_error: float = TYPICAL_MODEL_ERROR
    """Size of the remaining distortion of the camera's model, in widths of the image."""

    @staticmethod
    def of(solution: Solution) -> "ForeseenCamera":
        """Return the first camera of a solution, its next images being like those."""
        images, problem = solution.images, solution.problem
        own = problem.columns.model_error[0]
        return ForeseenCamera(
            camera=replace(problem.cameras[0], intrinsics=images.view.cameras[0]),
            information_per_px2=float(images.weight.sum()) / problem.n_images,
            model_error=float(images.state.model_error_std[0]) if own.stop > own.start else 0.0,
        )


def foreseen(
    arm: Arm, x: Transform, camera: ForeseenCamera, noise: RobotNoise, distance_m: float
) -> Solution:
    """Return the expected solution of a problem with images from an arm's poses, its errors having these sizes.

    `x` is gripper_from_camera; the scene is `distance_m` from the cameras, in metres.
    """
    # Far outside the image a distortion may fold; its size hardly changes how well it becomes known.
    straight = parameters(camera.camera.intrinsics)
    straight[4:] = 0.0
    intrinsics = with_parameters(camera.camera.intrinsics, straight)
    cameras, count = arm.base_from_gripper @ x, len(arm.rigs)
    tracks = _seen_points(cameras, intrinsics, distance_m)
    problem = Problem(
        arms=(arm,),
        n_rigs=count,
        cameras=(replace(camera.camera, intrinsics=intrinsics),),
        robot_noise_floor=noise.given,
    )
    state = State(
        x=x[None],
        scale=1.0,
        z=np.eye(4)[None],
        world_from_rig=cameras,
        points_in_world=tracks.points_in_recon,
    )
    problem, state = with_observations(problem, state, Observations.of_one_camera(tracks, count))
    assert problem.observations is not None
    an_image = len(problem.observations.point) / count
    state = replace(
        state,
        model_error_std=np.array([max(camera.model_error, LEAST_MODEL_ERROR)]),
        pixel_noise=PixelNoise(np.array([np.sqrt(an_image / camera.information_per_px2)])),
    )
    images = evidence(problem, state)
    images.information[np.diag_indices(len(images.information))] += LOST
    return expected_solution(problem, state, images, noise)


def expected_pose_covariance(
    base_from_gripper: Poses,
    x: Transform,
    noise: RobotNoise,
    error_covariance: Float[ndarray, "s s"],
    priors: tuple[LinearPrior, ...] = (),
    averaged: bool = True,
) -> Float[ndarray, "7 7"]:
    """Return the covariance that a solution with exact, metric camera poses is expected to report.

    Without `averaged` it is the covariance where the sizes of the robot's errors are known.
    """
    start = x, 1.0, np.eye(4)
    problem, state = pose_problem(
        base_from_gripper,
        base_from_gripper @ x,
        start,
        error_covariance=error_covariance,
        noise_floor=noise.given,
        priors=priors,
    )
    if averaged:
        return expected_solution(problem, state, None, noise).covariance[:7, :7]
    poses = pose_equations(problem, state, None)
    return expected_covariance_at(poses.equations, noise, poses.region)[:7, :7]


def _seen_points(cameras: Poses, intrinsics: Intrinsics, distance_m: float) -> Tracks:
    """Points where the rays of a grid in each image meet the scene, in the cameras' frame, and the images of each."""
    rows = max(2, round(COLUMNS * intrinsics.height / intrinsics.width))
    u, v = np.meshgrid(
        (np.arange(COLUMNS) + 0.5) / COLUMNS * intrinsics.width,
        (np.arange(rows) + 0.5) / rows * intrinsics.height,
    )
    rays = unproject(intrinsics, np.stack([u.ravel(), v.ravel()], axis=1))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points, seen_from = _on_surface(cameras, rays, distance_m)
    chosen = np.linspace(0, len(points) - 1, min(len(points), MOST_POINTS)).round().astype(int)
    points, seen_from = points[chosen], seen_from[chosen]
    image, point = np.nonzero(_shown(cameras, intrinsics, points, seen_from))
    x_px = np.empty((len(image), 2))
    for i, pose in enumerate(cameras):
        mine = image == i
        x_px[mine] = project(intrinsics, apply(inverse(pose), points[point[mine]]))
    return Tracks(image=image, x_px=x_px, point=point, points_in_recon=points)


def _on_surface(
    cameras: Poses, rays: Float[ndarray, "r 3"], distance_m: float
) -> tuple[Float[ndarray, "p 3"], Int[ndarray, " p"]]:
    """Points of a surface across the mean optical axis, and the camera whose ray led to each; p = n · r.

    Its relief is a pattern of the rays, alike in all images; rays along the surface end at twice its distance.
    """
    centre, axis = cameras[:, :3, 3], cameras[:, :3, 2]
    normal = axis.mean(0)
    normal = normal / max(float(np.linalg.norm(normal)), 1e-9)
    middle = (centre + distance_m * axis).mean(0)
    direction = rays @ np.swapaxes(cameras[:, :3, :3], 1, 2)
    ahead = ((middle - centre) @ normal)[:, None] / np.maximum(direction @ normal, 1e-9)
    relief = RELIEF * distance_m * np.cos(2.4 * np.arange(len(rays)))
    ahead = np.clip(ahead, 0.3 * distance_m, 2 * distance_m) + relief
    points = centre[:, None] + ahead[..., None] * direction
    return points.reshape(-1, 3), np.repeat(np.arange(len(cameras)), len(rays))


def _shown(
    cameras: Poses, intrinsics: Intrinsics, points: Float[ndarray, "p 3"], seen_from: Int[ndarray, " p"]
) -> Bool[ndarray, "n p"]:
    """Which images a matcher would find each point in: inside, and from about where its first camera is."""
    shown = np.zeros((len(cameras), len(points)), bool)
    away = cameras[seen_from, :3, 3] - points
    far = np.linalg.norm(away, axis=1)
    angle, ratio = SAME_FEATURE
    for i, pose in enumerate(cameras):
        x_px = project(intrinsics, x_in_camera := apply(inverse(pose), points))
        inside = ((x_px > 0) & (x_px < [intrinsics.width, intrinsics.height])).all(1) & (
            x_in_camera[:, 2] > 0
        )
        to = pose[:3, 3] - points
        distance = np.linalg.norm(to, axis=1)
        alike = (away * to).sum(1) > np.cos(angle) * far * distance
        near = (distance < ratio * far) & (far < ratio * distance)
        shown[i] = (inside & alike & near) | (seen_from == i)
    return shown
