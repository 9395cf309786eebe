"""Support plane of a scene, such as the table: RANSAC, then least squares with the weights of Geman and McClure."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

PLANES, SAMPLE = 400, 20_000
"""Number of planes through three random points that are tried, and number of points on which each is tested."""
LEAST_SHARE, FEWEST_ON_PLANE = 0.1, 10
"""Least share and least number of the points tested that must lie on the plane."""
LEAST_LEVEL, LEVEL_WEIGHT = 0.9, 5
"""Smallest cosine between a level plane's normal and the z axis, and weight of the points of level planes."""


def support_plane(
    points: Float[ndarray, "n 3"], camera_centers: Float[ndarray, "m 3"], far: float, z_is_up: bool
) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"], float] | None:
    """Fit the plane with most of n points that has all cameras on one side; None if no plane has a tenth of the points.

    Returns the unit normal towards the cameras, the weighted mean of the plane's points, and the robust standard
    deviation of their distances from it. `far` is the typical distance of points from the cameras, in the unit of the
    points. A point is on a plane within 0.5 % of `far`. With `z_is_up`, points of planes within 26° of level count five
    times; z is that of the points' frame. Level planes are preferred because most arms stand upright and a wall may
    have more points than the table.
    """
    draw = np.random.default_rng(0)
    some = points[draw.choice(len(points), min(SAMPLE, len(points)), replace=False)]
    a, b, c = some[draw.integers(len(some), size=(3, PLANES))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, where=length > 1e-9, out=np.zeros_like(normal))
    offset = (normal * a).sum(1)
    side = np.sign(camera_centers @ normal.T - offset)
    one_sided = (np.abs(side.sum(0)) == len(side)) & (length[:, 0] > 1e-9)
    count = np.zeros(PLANES, int)
    for k in np.flatnonzero(one_sided):  # one at a time, so that the data stay in the processor's cache
        # The noise of a table's points is the noise of depth, which grows with the distance of the cameras.
        count[k] = np.count_nonzero(np.abs(some @ normal[k] - offset[k]) < 0.005 * far)
    level = z_is_up & (np.abs(normal[:, 2]) > LEAST_LEVEL)
    best = int((count * np.where(level, LEVEL_WEIGHT, 1)).argmax())
    if count[best] < max(LEAST_SHARE * len(some), FEWEST_ON_PLANE):
        return None
    # By these weights, a sheet of board or a tray that lies on the table does not lift the plane.
    up, middle = normal[best] * side[0, best], a[best]
    distance, noise = (points - middle) @ up, 0.002 * far
    for _ in range(10):
        near = np.abs(distance) < 3 * noise
        weight = 1 / (1 + (distance[near] / noise) ** 2) ** 2
        middle = weight @ points[near] / weight.sum()
        _, axes = np.linalg.eigh(np.cov((points[near] - middle).T, aweights=weight))
        up = axes[:, 0] * np.sign(axes[:, 0] @ up)
        distance = (points - middle) @ up
        noise = max(robust_std(distance[np.abs(distance) < 3 * noise]), 1e-5 * far)
    return up, middle, noise


def robust_std(values: Float[ndarray, " n"]) -> float:
    """Return the robust standard deviation of values: 1.4826 times their median absolute deviation from the median."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
