"""Angles by which images are rotated about their viewing axes, so that all have one upright side."""

import math

import numpy as np
from jaxtyping import Float
from numpy import ndarray

UPRIGHT_ENOUGH = math.radians(15)
"""Largest remaining roll (rad) at which an image is rotated by a multiple of 90° instead, which needs no resampling."""


def rolls(base_from_camera: Float[ndarray, "n 3 3"]) -> Float[ndarray, " n"]:
    """Return the angle (rad) by which to rotate each image about its viewing axis, so that all have one upright side.

    A positive angle rotates the image from its x axis towards its y axis, clockwise on the screen. The angle is the
    twist of each camera about the mean viewing direction (swing-twist decomposition, Dobrowolski 2015). The largest
    group of images with one orientation is rotated least.
    """
    mean = base_from_camera[:, :, 2].sum(0)
    z = mean / max(float(np.linalg.norm(mean)), 1e-12)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    relative = np.stack([x, np.cross(z, x), z]) @ base_from_camera
    # The twist of a quaternion is 2 atan2(q_z, q_w), which equals this expression (Shepperd 1978).
    twist = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
    # Most images keep their orientation, because rotation costs sharpness.
    return twist - twist[int(np.argmax(np.maximum(np.cos(twist[:, None] - twist) - 0.9, 0).sum(1)))]


def by_quarters(roll: float) -> float:
    """Return an angle (rad) rounded to a multiple of 90° if this is within UPRIGHT_ENOUGH, else to 1°; in [0, 2π)."""
    quarters = round(roll / (math.pi / 2)) * math.pi / 2
    nearest = quarters if abs(roll - quarters) <= UPRIGHT_ENOUGH else math.radians(round(math.degrees(roll)))
    return nearest % (2 * math.pi)
