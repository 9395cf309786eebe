"""OpenCV's pinhole camera with five distortion coefficients, and its derivatives."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.records import Intrinsics

CAMERA_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


def parameters(intrinsics: Intrinsics) -> Float[ndarray, "9"]:
    """The camera as a vector in the order of CAMERA_PARAMETERS."""
    return np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, *intrinsics.distortion])


def project(x_in_camera: Float[ndarray, "k 3"], camera: Float[ndarray, "9"]) -> Float[ndarray, "k 2"]:
    """Pixels of points in front of the camera (OpenCV's calib3d model)."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera
    x, y = (x_in_camera[:, :2] / x_in_camera[:, 2:]).T
    rr = x * x + y * y
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (rr + 2 * x * x)
    yd = y * radial + p1 * (rr + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * xd + cx, fy * yd + cy], axis=1)


def project_derivatives(
    x_in_camera: Float[ndarray, "k 3"], camera: Float[ndarray, "9"]
) -> tuple[Float[ndarray, "k 2 3"], Float[ndarray, "k 2 9"]]:
    """Derivatives of `project` by the point and by the camera's parameters."""
    fx, fy, _, _, k1, k2, p1, p2, k3 = camera
    depth = x_in_camera[:, 2]
    x, y = x_in_camera[:, 0] / depth, x_in_camera[:, 1] / depth
    rr = x * x + y * y
    radial = 1 + rr * (k1 + rr * (k2 + rr * k3))
    slope = k1 + rr * (2 * k2 + 3 * rr * k3)  # derivative of `radial` by rr
    xd_x = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    yd_y = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    by_point = np.empty((len(x), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 1] = fx * xd_x / depth, fx * cross / depth
    by_point[:, 1, 0], by_point[:, 1, 1] = fy * cross / depth, fy * yd_y / depth
    by_point[:, :, 2] = -(by_point[:, :, 0] * x[:, None] + by_point[:, :, 1] * y[:, None])

    by_camera = np.zeros((len(x), 2, 9))
    by_camera[:, 0, 0] = x * radial + 2 * p1 * x * y + p2 * (rr + 2 * x * x)
    by_camera[:, 1, 1] = y * radial + p1 * (rr + 2 * y * y) + 2 * p2 * x * y
    by_camera[:, 0, 2], by_camera[:, 1, 3] = 1.0, 1.0
    powers = np.stack([rr, rr**2, rr**3], axis=1)
    by_camera[:, 0][:, [4, 5, 8]] = fx * x[:, None] * powers
    by_camera[:, 1][:, [4, 5, 8]] = fy * y[:, None] * powers
    by_camera[:, 0, 6], by_camera[:, 0, 7] = fx * 2 * x * y, fx * (rr + 2 * x * x)
    by_camera[:, 1, 6], by_camera[:, 1, 7] = fy * (rr + 2 * y * y), fy * 2 * x * y
    return by_point, by_camera
