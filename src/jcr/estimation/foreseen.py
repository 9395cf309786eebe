"""The adjustment of a capture before its images are matched: the equations of a scene that its cameras would see.

What a calibration leaves unknown depends on where the gripper is, on what is known of the camera beforehand and on how
exact images and robot are, but hardly on what the scene is. So points are put where the cameras look, on a surface with
some relief, and seen where a matcher would find them again. The equations are those of robots.py at residuals of 0; the
sizes of the errors are given.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import parameters, project, unproject, with_parameters
from jcr.estimation.image_robots import Adjusted, ArmPoses, Given, Placed, equations_of
from jcr.estimation.images import evidence, posed
from jcr.estimation.intrinsics_prior import IntrinsicsPrior
from jcr.estimation.pixel_noise import PixelNoise
from jcr.estimation.pose_equations import Poses
from jcr.estimation.posterior import expected_posterior
from jcr.estimation.scene import Freedom, Observations, Scene
from jcr.geometry import apply, inverse
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


@dataclass(frozen=True, kw_only=True)
class ForeseenCamera:
    """A camera, what is known of it beforehand, and how much its images will show."""

    intrinsics: Intrinsics
    prior: IntrinsicsPrior
    information_per_px2: float = TYPICAL_INFORMATION
    """Of an image, on average: the inverse variances of its observations' x, or y, added up."""
    model_error: float = TYPICAL_MODEL_ERROR
    """Size of each displacement that the camera's model leaves, in widths of the image."""

    @staticmethod
    def of(adjusted: Adjusted) -> "ForeseenCamera":
        """The first camera of an adjustment, its next images being as those were."""
        images = adjusted.given.evidence
        problem, left = images.problem, images.problem.freedom.model_error_std
        return ForeseenCamera(
            intrinsics=images.scene.cameras[0],
            prior=problem.freedom.intrinsics[0],
            information_per_px2=float(images.weight.sum()) / len(problem.observations.rig),
            model_error=float(left[0]) if len(left) else 0.0,
        )


def foreseen(arm: ArmPoses, camera: ForeseenCamera, noise: RobotNoise, distance_m: float) -> Adjusted:
    """What the adjustment of images from an arm's poses is expected to come to, where its errors are of this size.

    The arm's start is its X and the identity; the scene is `distance_m` from the cameras, in metres.
    """
    x, z = arm.start
    # Far outside the image a distortion may fold; how large it is hardly matters to how well it becomes known.
    straight = parameters(camera.intrinsics)
    straight[4:] = 0.0
    intrinsics = with_parameters(camera.intrinsics, straight)
    tracks = _seen_points(arm.base_from_gripper @ x, intrinsics, distance_m)
    scene = Scene(
        world_from_rig=arm.base_from_gripper @ x,
        rig_from_camera=np.eye(4)[None],
        cameras=(intrinsics,),
        points_in_world=tracks.points_in_recon,
    )
    freedom = Freedom.of((intrinsics,), (camera.prior,), len(arm.rigs))
    scene, problem = posed(scene, Observations.of_one_camera(tracks, len(arm.rigs)), freedom)
    sizes = np.full(len(problem.freedom.model_error_std), max(camera.model_error, LEAST_MODEL_ERROR))
    problem = problem.with_model_error(sizes)
    # The images' own information is shared by these observations.
    an_image = len(problem.observations.point) / len(arm.rigs)
    pixels = PixelNoise(np.array([np.sqrt(an_image / camera.information_per_px2)]))
    images = evidence(scene, problem, pixels)
    images.information[np.diag_indices(len(images.information))] += LOST
    given = Given(evidence=images, arms=(arm,), noise=noise.given)
    placed = Placed(x=x[None], scale=1.0, z=z[None], scene=scene)
    equations, region = equations_of(placed, given)
    found = expected_posterior(equations, noise, region)
    return Adjusted(
        placed=placed,
        covariance=found.covariance,
        budget=found.budget,
        most_likely=placed,
        log_sizes=found.log_sizes,
        equations=equations,
        given=given,
    )


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
