"""X's translation from the directions in which cameras moved, and what X then says of every pair of images.

R_X t_B is known but for its length, so (R_A − I) t_X + t_A = s R_X t_B is linear in t_X once it is crossed with that
direction: no scale and no map are needed.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.features.gate import Gate
from jcr.features.rotation import linear_parts
from jcr.features.verify import View
from jcr.geometry import transform

PRIOR_STD_M = 0.2
"""Standard deviation of t_X around zero: a camera is mounted on the flange or near it."""
ROBOT_STD_M = 2e-3
LEAST_DIRECTION_STD = 0.01
"""rad; of a two-view translation, which forward motion and plane scenes leave loose."""
ROUNDS = 15
POINTS_OF_PAIR = 60


def translation_of_x(found: Gate, motion: Float[ndarray, "n n 4 4"]) -> Float[ndarray, "4 4"] | None:
    """Return gripper_from_camera from the confirmed pairs; None while its rotation is unknown."""
    if found.of_x is None or not found.confirmed:
        return None
    gripper = np.stack([motion[pair.key] for pair in found.confirmed])
    best = [pair.readings[0] for pair in found.confirmed]
    direction = np.stack([reading.direction for reading in best]) @ found.of_x.rotation.T
    loose = np.sqrt([max(np.trace(r.covariance[3:, 3:]) / 2, LEAST_DIRECTION_STD**2) for r in best])
    a, b = linear_parts(gripper[:, :3, :3], gripper[:, :3, 3], direction)
    t = np.zeros(3)
    prior = np.eye(3) / PRIOR_STD_M**2
    information = prior
    for _ in range(ROUNDS):
        way = (gripper[:, :3, :3] - np.eye(3)) @ t + gripper[:, :3, 3]
        std = np.hypot(ROBOT_STD_M, loose * np.linalg.norm(way, axis=1))
        residual = np.linalg.norm(a @ t + b, axis=1) / std
        weight = 1 / (1 + (residual / 3) ** 2) / std**2
        information = np.einsum("p,pki,pkj->ij", weight, a, a) + prior
        t = -np.linalg.solve(information, np.einsum("p,pki,pk->i", weight, a, b))
    return transform(found.of_x.rotation, t)


def scene_points(
    view: View, found: Gate, motion: Float[ndarray, "n n 4 4"], gripper_from_camera: Float[ndarray, "4 4"]
) -> Float[ndarray, "p 3"]:
    """Return points that confirmed pairs see, in the frame of the first gripper (m), as midpoints of two rays."""
    first_from_camera = motion[0] @ gripper_from_camera
    kept = [np.zeros((0, 3))]
    for pair in found.confirmed:
        rows = pair.rows[:: max(1, len(pair.rows) // POINTS_OF_PAIR)]
        points, good = midpoints(
            first_from_camera[pair.i],
            first_from_camera[pair.j],
            view.rays[pair.i][rows[:, 0]],
            view.rays[pair.j][rows[:, 1]],
        )
        kept.append(points[good])
    return np.concatenate(kept)


def midpoints(
    a_from_i: Float[ndarray, "4 4"],
    a_from_j: Float[ndarray, "4 4"],
    ray_i: Float[ndarray, "m 2"],
    ray_j: Float[ndarray, "m 2"],
) -> tuple[Float[ndarray, "m 3"], "np.ndarray"]:
    """Return the points nearest to both rays in frame a, and which are in front of both cameras with parallax."""
    d_i, d_j = (
        np.concatenate([ray, np.ones((len(ray), 1))], 1) @ pose[:3, :3].T
        for ray, pose in ((ray_i, a_from_i), (ray_j, a_from_j))
    )
    d_i, d_j = d_i / np.linalg.norm(d_i, axis=1)[:, None], d_j / np.linalg.norm(d_j, axis=1)[:, None]
    way = a_from_j[:3, 3] - a_from_i[:3, 3]
    cosine = (d_i * d_j).sum(1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s_i = (d_i @ way - cosine * (d_j @ way)) / sine2
    s_j = (cosine * (d_i @ way) - d_j @ way) / sine2
    points = (a_from_i[:3, 3] + s_i[:, None] * d_i + a_from_j[:3, 3] + s_j[:, None] * d_j) / 2
    return points, (s_i > 0.02) & (s_j > 0.02) & (sine2 > np.sin(np.radians(1)) ** 2)
