"""Choice of the gripper poses whose images add most to a calibration, before these images exist.

Candidates are gripper poses in reach whose cameras look at the scene. They are added one by one, each time the one that
leaves the least predicted uncertainty (A-optimal design: Pukelsheim, Optimal Design of Experiments, 1993, chapter 9).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.equation import ROTATION, TRANSLATION, Poses, residuals
from jcr.geometry import (
    Transform,
    by_similarity,
    inverse,
    motion_length,
    nearest_to_lines,
    rotation_exp,
    transform,
)

CANDIDATES = 600
"""Number of candidate poses."""
SCENE_DISTANCE = (0.1, 2.0)
"""Smallest and largest distance of a scene (m)."""
UNIT = np.array([1e-3] * 3 + [np.radians(0.1)] * 3 + [2e-3])
"""Errors that count alike: 1 mm, 0.1°, 0.2 % of scale."""


def choose(count: int, candidates: int, uncertainty_of: Callable[[Int[ndarray, " c"]], float]) -> list[int]:
    """Return the rows of `count` candidates, chosen one by one, best first.

    `uncertainty_of` returns the uncertainty that some rows leave, which the next row reduces most. A candidate gains
    less after others are chosen, so only those with the largest earlier gains are evaluated again (accelerated greedy
    selection: Minoux, Optimization Techniques, 1978).
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
    """Return the sum of the variances of camera, rotation and scale in UNIT.

    With a `point` (m, from the camera in gripper axes) its place, which the scale moves, counts instead of camera and
    scale.
    """
    counted = np.eye(7) / UNIT[:, None]
    if point is not None:
        counted = np.concatenate([by_similarity(point) / UNIT[TRANSLATION, None], counted[ROTATION]])
    return float(np.einsum("ri,ij,rj->", counted, covariance, counted))


def pose_information(
    base_from_gripper: Poses, gripper_from_camera: Transform, noise: tuple[float, float]
) -> Float[ndarray, "n 13 13"]:
    """Return the Fisher information of each gripper pose about the 13 unknowns, for random errors (m, rad)."""
    # The frame and unit of the reconstruction are arbitrary: those of the base, in metres.
    camera = base_from_gripper @ gripper_from_camera
    _, j = residuals(gripper_from_camera, 1.0, np.eye(4), base_from_gripper, camera)
    j /= np.repeat(noise, 3)[:, None]
    return np.swapaxes(j, 1, 2) @ j


def nearest(poses: Float[ndarray, "c 4 4"], existing: Poses) -> Int[ndarray, " c"]:
    """Return the row of the existing pose that each pose is nearest to."""
    return motion_length(inverse(existing) @ poses[:, None]).argmin(1)


def candidates(
    base_from_gripper: Poses, x: Transform, reach: Float[ndarray, "2 3"] | None, rng: np.random.Generator
) -> Float[ndarray, "k 4 4"]:
    """Return gripper poses whose cameras look at the scene from about as far as the capture did.

    `reach` is the box (m, base) that gripper positions stay in; None: the box of the capture enlarged by a quarter.
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
        rotation = _facing(tilt @ camera[like, :3, :3], aim - position)
        roll = rotation_exp(rng.uniform(-np.pi / 3, np.pi / 3, n)[:, None] * [0.0, 0.0, 1.0])
        gripper = transform(rotation @ roll, position) @ inverse(x)
        inside = ((gripper[:, :3, 3] >= reach[0]) & (gripper[:, :3, 3] <= reach[1])).all(1)
        # In a box that hardly any view fits in the search would not end, so the box grows little by little.
        kept = np.concatenate([kept, gripper[inside]])
        widening *= 1.05
        reach = np.stack([reach[0] - 0.002 * widening, reach[1] + 0.002 * widening])
    return kept[:CANDIDATES]


def scene_of(camera: Poses) -> tuple[Float[ndarray, "3"], Float[ndarray, " n"]]:
    """Return the point nearest to all optical axes, and the distance of each camera from it (m)."""
    axis, center = camera[:, :3, 2], camera[:, :3, 3]
    scene = nearest_to_lines(center, axis)
    distance = np.linalg.norm(center - scene, axis=1)
    # Parallel axes have no common point; the scene is then taken half a metre away.
    if not SCENE_DISTANCE[0] < np.median(distance) < SCENE_DISTANCE[1]:
        scene = (center + 0.5 * axis).mean(0)
        distance = np.linalg.norm(center - scene, axis=1)
    return scene, distance


def median_distance(camera: Poses) -> float:
    """Return the median distance (m) of cameras in the base frame from the scene."""
    return float(np.median(scene_of(camera)[1]))


def assumed_camera(base_from_gripper: Poses) -> Transform:
    """Return an assumed gripper_from_camera: a camera at the gripper that looks along one of the gripper's axes.

    The axis is the one whose lines over all poses pass nearest to a common point, relative to the distance of that
    point: views of one scene have such a point.
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


def _facing(rotation: Float[ndarray, "n 3 3"], toward: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3 3"]:
    """Return the rotations after the shortest rotation that takes their z axis onto a direction."""
    z, goal = rotation[:, :, 2], toward / np.linalg.norm(toward, axis=1, keepdims=True)
    cross = np.cross(z, goal)
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    angle = np.arctan2(sine, (z * goal).sum(1, keepdims=True))
    return rotation_exp(cross / np.maximum(sine, 1e-12) * angle) @ rotation
