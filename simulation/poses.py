"""Hand-eye transforms and patterns of gripper poses over a table.

A pattern is made of camera poses, since what must be in view is the table; the gripper follows from them.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.geometry import apply, inverse, rotation_exp, transform

Pattern = Literal["varied", "orbit", "translation", "one-axis", "planar", "pivot", "camera-centre", "two"]
Cameras = Float[ndarray, "n 4 4"]

# Azimuth and elevation (degrees, seen from the table; the robot stands at azimuth 180), distance (m) and roll
# (degrees; 0: the top of the image points away from the robot). High left and right, three along x, sides:
# any first few of them already rotate about several axes and overlap.
_VIEWS = np.array(
    [
        (150, 62, 0.52, -15),
        (-145, 60, 0.60, 20),
        (180, 74, 0.44, 5),
        (100, 66, 0.55, -25),
        (-95, 64, 0.47, 30),
        (0, 86, 0.64, -10),
        (135, 43, 0.50, -20),
        (-130, 42, 0.56, 15),
        (0, 72, 0.56, 10),
        (165, 48, 0.40, -35),
        (85, 48, 0.62, -40),
        (-80, 47, 0.58, 40),
    ]
)


def random_hand_eye(rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    """Draw a plausible gripper_from_camera (4,4): 3 to 12 cm away, tilted by up to 25°, any roll."""
    side, roll, toward = rng.uniform(0, 2 * np.pi, 3)
    aside, ahead = rng.uniform(0.03, 0.1), rng.uniform(-0.05, 0.06)
    tilt = np.radians(rng.uniform(5, 25)) * np.array([np.cos(toward), np.sin(toward), 0.0])
    rotation = rotation_exp(tilt) @ rotation_exp(np.array([0.0, 0.0, roll]))
    return transform(rotation, np.array([aside * np.cos(side), aside * np.sin(side), ahead]))


def looking_at(
    place: Float[ndarray, "3"], target: Float[ndarray, "3"], rng: np.random.Generator
) -> Float[ndarray, "4 4"]:
    """Draw base_from_camera at a place, the target nearly in the middle of its image, rolled at random."""
    z = target - place + 0.03 * rng.normal(size=3)
    z /= np.linalg.norm(z)
    x = np.cross(z, rng.normal(size=3))
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), place)


def gripper_poses(
    pattern: Pattern,
    count: int,
    target_in_base: Float[ndarray, "3"],
    gripper_from_camera: Float[ndarray, "4 4"],
    rng: np.random.Generator,
) -> Cameras:
    """Draw base_from_gripper (n,4,4) of the pattern about a target; `two` has 2 poses whatever `count`."""
    count, target = 2 if pattern == "two" else count, target_in_base
    camera_from_gripper = inverse(gripper_from_camera)

    def first(elevation_deg: float, distance: float, roll_deg: float) -> Float[ndarray, "4 4"]:
        """Draw the first view from the side of the robot, rolled by up to `roll_deg`."""
        roll = rng.uniform(-roll_deg, roll_deg)
        return _look_at(target[None], *np.array([[180.0], [elevation_deg], [distance], [roll]]))[0]

    def facing(rotation: Float[ndarray, "n 3 3"], spread: float) -> Cameras:
        """Draw cameras of given rotations, whose optical axes meet points on the table about the target."""
        aside = rng.uniform(-spread, spread, (count, 2))
        aim = target + np.column_stack([aside, rng.uniform(0, 0.05, count)])
        return transform(rotation, aim - rng.uniform(0.42, 0.68, count)[:, None] * rotation[..., 2])

    def yaws(size_deg: float, scatter_deg: float) -> Float[ndarray, " n"]:
        """Draw even angles (rad) with a scatter."""
        even = np.linspace(-size_deg, size_deg, count)
        return np.radians(even + rng.uniform(-scatter_deg, scatter_deg, count))

    if pattern in ("varied", "two"):
        # Row by row, so that fewer images are the first ones of more.
        jitter = rng.uniform(-1, 1, (count, 7))
        views = _VIEWS[np.arange(count) % len(_VIEWS)] + jitter[:, :4] * (12, 4, 0.04, 15)
        cameras = _look_at(target + jitter[:, 4:] * (0.04, 0.04, 0.025) + (0.0, 0.0, 0.025), *views.T)
    elif pattern == "orbit":
        azimuth = 180 + np.linspace(-100, 100, count) + rng.uniform(-5, 5, count)
        elevation, roll = rng.uniform(45, 75, count), rng.uniform(-40, 40, count)
        cameras = _look_at(np.tile(target, (count, 1)), azimuth, elevation, np.full(count, 0.5), roll)
    elif pattern == "one-axis":
        angles, about_target = yaws(80, 4), transform(np.eye(3), target)
        rotated = transform(rotation_exp(angles[:, None] * [0.0, 0.0, 1.0]), np.zeros(3))
        cameras = about_target @ rotated @ inverse(about_target) @ first(52.0, 0.55, 15)
    elif pattern == "translation":
        cameras = facing(np.tile(first(65.0, 0.55, 20)[:3, :3], (count, 1, 1)), 0.12)
    elif pattern == "planar":
        turned = rotation_exp(rng.permutation(yaws(70, 5))[:, None] * [0.0, 0.0, 1.0])
        cameras = facing(turned @ np.diag([1.0, -1.0, -1.0]) @ gripper_from_camera[:3, :3], 0.08)
    elif pattern == "pivot":
        start = first(75.0, 0.5, 20)
        about_tool = transform(np.eye(3), apply(start @ camera_from_gripper, np.array([0.0, 0.0, 0.2])))
        tilted = transform(_tilts(count, 20.0, 60.0, rng), np.zeros(3))
        cameras = about_tool @ tilted @ inverse(about_tool) @ start
    else:
        start = first(75.0, 0.6, 20)
        cameras = transform(_tilts(count, 12.0, 60.0, rng) @ start[:3, :3], start[:3, 3])
    return cameras @ camera_from_gripper


def _look_at(
    target: Float[ndarray, "n 3"],
    azimuth_deg: Float[ndarray, "n"],
    elevation_deg: Float[ndarray, "n"],
    distance: Float[ndarray, "n"],
    roll_deg: Float[ndarray, "n"],
) -> Cameras:
    """Return base_from_camera (n,4,4) of cameras that see `target` in the middle of the image."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    away = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    z = -away
    x = np.cross(z, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    upright = np.stack([x, np.cross(z, x), z], -1)
    roll = Rotation.from_euler("z", roll_deg[:, None], degrees=True).as_matrix()
    return transform(upright @ roll, target + distance[:, None] * away)


def _tilts(count: int, tilt_deg: float, yaw_deg: float, rng: np.random.Generator) -> Float[ndarray, "n 3 3"]:
    """Draw rotations about level axes all around by up to `tilt_deg`, after yaw by up to `yaw_deg`."""
    toward = 2 * np.pi * (np.arange(count) + rng.uniform(0, 1)) / count
    tilt = np.radians(rng.uniform(0.5, 1.0, count) * tilt_deg)
    yaw = np.radians(rng.uniform(-yaw_deg, yaw_deg, count))
    level = np.stack([np.cos(toward), np.sin(toward), 0 * toward], -1)
    return rotation_exp(tilt[:, None] * level) @ rotation_exp(yaw[:, None] * [0.0, 0.0, 1.0])
