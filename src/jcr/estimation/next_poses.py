"""Which gripper poses to add: those that show most of a seen point, the rotation and the scale, before any image.

The information of a pose depends on where it is, not on what it shows, so candidates in reach that look at
the scene are added one by one, each time the one that leaves the least uncertainty (A-optimal design). That is of random
errors of the gripper poses alone; calibration/expected.py compares a few with what systematic ones leave.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.equation import Poses, most_informative, point_ahead, pose_information
from jcr.geometry import Transform, inverse, motion_length, nearest_to_lines, rotation_exp, transform

CANDIDATES = 600
SCENE_AHEAD = (0.1, 2.0)
"""m: nearest and farthest that a scene is taken to be."""


def next_poses(
    base_from_gripper: Poses,
    possible: Float[ndarray, "k 4 4"],
    count: int,
    x: Transform,
    noise: tuple[float, float],
    distance_m: float,
) -> Float[ndarray, "c 4 4"]:
    """The `count` of the possible gripper poses to add, best first.

    They are best for a point so far ahead of the camera, where the gripper poses have that noise (m, rad).
    """
    known = pose_information(base_from_gripper, x, noise).sum(0)
    information = pose_information(possible, x, noise)
    return possible[most_informative(known, information, count, point_ahead(x, distance_m))]


def nearest(poses: Float[ndarray, "c 4 4"], existing: Poses) -> Int[ndarray, " c"]:
    """The existing pose that each pose is nearest to."""
    return motion_length(inverse(existing) @ poses[:, None]).argmin(1)


def candidates(
    base_from_gripper: Poses, x: Transform, reach: Float[ndarray, "2 3"] | None, rng: np.random.Generator
) -> Float[ndarray, "k 4 4"]:
    """Gripper poses whose cameras look at the scene from about as far as the capture did.

    `reach` is the box (m, base) that gripper positions stay in; None: that of the capture and a quarter more.
    """
    camera = base_from_gripper @ x
    center = camera[:, :3, 3]
    scene, distance = looked_at(camera)
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
        rotation = _facing(tilt @ camera[like, :3, :3], aim - position)
        roll = rotation_exp(rng.uniform(-np.pi / 3, np.pi / 3, n)[:, None] * [0.0, 0.0, 1.0])
        gripper = transform(rotation @ roll, position) @ inverse(x)
        inside = ((gripper[:, :3, 3] >= reach[0]) & (gripper[:, :3, 3] <= reach[1])).all(1)
        # A box that hardly any view fits in would search for ever; it is let out little by little.
        kept = np.concatenate([kept, gripper[inside]])
        widening *= 1.05
        reach = np.stack([reach[0] - 0.002 * widening, reach[1] + 0.002 * widening])
    return kept[:CANDIDATES]


def looked_at(camera: Poses) -> tuple[Float[ndarray, "3"], Float[ndarray, " n"]]:
    """The point that the optical axes meet in, and how far each camera is from it (m)."""
    axis, center = camera[:, :3, 2], camera[:, :3, 3]
    scene = nearest_to_lines(center, axis)
    distance = np.linalg.norm(center - scene, axis=1)
    # Parallel axes meet nowhere; the scene is then taken half a metre ahead.
    if not SCENE_AHEAD[0] < np.median(distance) < SCENE_AHEAD[1]:
        scene = (center + 0.5 * axis).mean(0)
        distance = np.linalg.norm(center - scene, axis=1)
    return scene, distance


def assumed_camera(base_from_gripper: Poses) -> Transform:
    """gripper_from_camera before anything is known of it: a camera at the gripper that looks along one of its axes.

    Along the one whose lines pass nearest to one point ahead, by their distance from it over the way to it: views of a
    scene do.
    """
    center, best, least = base_from_gripper[:, :3, 3], np.array([0.0, 0.0, 1.0]), np.inf
    for axis in np.concatenate([np.eye(3)[::-1], -np.eye(3)[::-1]]):
        along = base_from_gripper[:, :3, :3] @ axis
        to_scene = nearest_to_lines(center, along) - center
        ahead = (to_scene * along).sum(1)
        off = np.linalg.norm(to_scene - ahead[:, None] * along, axis=1)
        if (
            SCENE_AHEAD[0] < np.median(ahead) < SCENE_AHEAD[1]
            and (miss := float(np.median(off / ahead.clip(1e-3)))) < least
        ):
            best, least = axis, miss
    across = np.roll(best, 1)
    return transform(np.stack([across, np.cross(best, across), best], axis=1), np.zeros(3))


def _facing(rotation: Float[ndarray, "n 3 3"], toward: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
    """The rotations with their z axis brought onto a direction by the shortest rotation."""
    z, goal = rotation[:, :, 2], toward / np.linalg.norm(toward, axis=1, keepdims=True)
    cross = np.cross(z, goal)
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    angle = np.arctan2(sine, (z * goal).sum(1, keepdims=True))
    return rotation_exp(cross / np.maximum(sine, 1e-12) * angle) @ rotation
