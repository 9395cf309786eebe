"""The robot's gate: which verified pairs of images the gripper poses confirm, and X's rotation from those.

Whatever X is, the angle between two cameras is the angle between two grippers. A pair whose angle differs by more than
its own uncertainty and the robot's allow is not believed; before that its other readings are tried. Once enough pairs
agree, X's rotation is known, and the whole relative rotation must agree.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.features.rotation import RotationOfX, rotation_of_x
from jcr.features.two_view import Reading
from jcr.geometry import rotation_angle

ROBOT_STD = math.radians(0.3)
"""Standard deviation of a reported gripper rotation; an industrial arm errs by 0.05°, a servo arm by 1°."""
SYSTEMATIC = 0.015
"""Share of the angle by which cameras and robots disagree systematically; real captures show 0.001 to 0.021."""
SYSTEMATIC_OF_GUESS = 0.04
"""Systematic share where the focal length is estimated from the gripper's angles."""
SIGMAS = 3.0
LARGEST_STD = math.radians(3)
"""A pair that knows its rotation less well neither confirms nor contradicts."""
SURE_STD = math.radians(2.5)
"""X's rotation counts as known from here on."""
UPRIGHT_ENOUGH = math.radians(15)
"""An image is rotated by multiples of 90° where that leaves no more than this, for it costs no resampling."""
LEAST_PAIRS = 4
"""Least number of pairs that agree on X's rotation; three wrong ones can agree by chance."""


Key = tuple[int, int]
"""Rows of two images, the smaller first."""


@dataclass(frozen=True)
class Pair:
    """Matched keypoints of two images that one two-view geometry explains."""

    i: int
    j: int
    rows: Int[ndarray, "m 2"]
    """Rows of the matched keypoints of i and j."""
    readings: tuple[Reading, ...]
    """Best first; empty where none could be found."""

    @property
    def key(self) -> Key:
        """Rows of the two images."""
        return self.i, self.j


@dataclass(frozen=True)
class Gate:
    """Pairs of a capture, classified by the gripper's motions."""

    confirmed: tuple[Pair, ...]
    """Each with the reading that agrees best in front."""
    undecided: tuple[Pair, ...]
    """Too unsure of their rotation to be judged."""
    contradicted: tuple[Pair, ...]
    of_x: RotationOfX | None
    """None while too few pairs agree."""


def angle_tolerance(angle: float, std: float, systematic: float = SYSTEMATIC) -> float:
    """Return the largest difference (rad) between a pair's angle and the gripper's."""
    return SIGMAS * math.sqrt(std**2 + 2 * ROBOT_STD**2 + (systematic * angle) ** 2)


def judge(
    pairs: Sequence[Pair],
    motion: Float[ndarray, "n n 4 4"],
    systematic: float = SYSTEMATIC,
    known: RotationOfX | None = None,
) -> Gate:
    """Classify the pairs by the gripper's motions.

    First by angle alone; among those that pass, X's rotation is sought; with it, every reading of every pair is judged
    by its whole rotation. `known` is X's rotation where more pairs than these have spoken.
    """
    undecided = tuple(pair for pair in pairs if not any(_sure(reading) for reading in pair.readings))
    judged = [pair for pair in pairs if any(_sure(reading) for reading in pair.readings)]
    angle = np.asarray(rotation_angle(motion[..., :3, :3]))
    passing: list[tuple[Pair, Reading, float]] = []
    for pair in judged:
        of_gripper = float(angle[pair.key])
        for reading in filter(_sure, pair.readings):
            tolerance = angle_tolerance(of_gripper, reading.angle_std(), systematic)
            if abs(float(rotation_angle(reading.rotation)) - of_gripper) < tolerance:
                passing.append((pair, reading, tolerance))
    of_x = _common_rotation(passing, motion) or known
    if of_x is None:
        passed = {pair.key: pair for pair, _, _ in passing}
        best = {key: _led(pair, [r for p, r, _ in passing if p is pair][0]) for key, pair in passed.items()}
        against = tuple(pair for pair in judged if pair.key not in best)
        return Gate(tuple(best.values()), undecided, against, None)
    confirmed, contradicted = [], []
    for pair in judged:
        of_gripper = motion[pair.key][:3, :3]
        gaps = [
            float(rotation_angle((of_x.rotation @ r.rotation @ of_x.rotation.T).T @ of_gripper))
            for r in pair.readings
        ]
        best = int(np.argmin(gaps))
        if gaps[best] < rotation_tolerance(pair.readings[best], float(angle[pair.key]), of_x, systematic):
            confirmed.append(_led(pair, pair.readings[best]))
        else:
            contradicted.append(pair)
    return Gate(tuple(confirmed), undecided, tuple(contradicted), of_x)


def rotation_tolerance(reading: Reading, angle: float, of_x: RotationOfX, systematic: float) -> float:
    """Return the largest angle (rad) between a pair's rotation and the one that X predicts."""
    own = float(np.trace(reading.covariance[:3, :3]))
    of_mean = 4 * math.sin(min(angle, math.pi) / 2) ** 2 * float(np.trace(of_x.covariance))
    robot = 3 * max(2 * ROBOT_STD**2, of_x.sigma**2)
    return SIGMAS * math.sqrt(own + of_mean + robot + (systematic * angle) ** 2)


def _sure(reading: Reading) -> bool:
    return reading.angle_std() < LARGEST_STD


def _led(pair: Pair, reading: Reading) -> Pair:
    """Return the pair with one of its readings first."""
    return replace(pair, readings=(reading, *(other for other in pair.readings if other is not reading)))


def _common_rotation(
    passing: Sequence[tuple[Pair, Reading, float]], motion: Float[ndarray, "n n 4 4"]
) -> RotationOfX | None:
    """X's rotation where enough pairs agree and the images that they join are more than a few."""
    if len({pair.key for pair, _, _ in passing}) < LEAST_PAIRS:
        return None
    gripper = np.stack([motion[pair.key][:3, :3] for pair, _, _ in passing])
    camera = np.stack([reading.rotation for _, reading, _ in passing])
    # A wrong angle that passed by chance has an axis of its own; readings of one pair share its one vote.
    tolerance = np.array([1.5 * tolerance for _, _, tolerance in passing])
    found = rotation_of_x(gripper, camera, tolerance)
    if found is None or found.std() > SURE_STD:
        return None
    agreeing = {pair.key for (pair, _, _), agrees in zip(passing, found.agreeing, strict=True) if agrees}
    return found if len(agreeing) >= LEAST_PAIRS else None


def base_from_camera_rotations(
    base_from_gripper: Float[ndarray, "n 4 4"], of_x: RotationOfX
) -> Float[ndarray, "n 3 3"]:
    """Return the rotations base_from_camera of all images, shape (n, 3, 3)."""
    return base_from_gripper[:, :3, :3] @ of_x.rotation


def rolls(base_from_camera: Float[ndarray, "n 3 3"]) -> Float[ndarray, " n"]:
    """Angles (rad) by which images are to be rotated about the viewing axis so that none is rotated against another.

    The twist of each camera about the mean viewing direction (swing-twist decomposition, Dobrowolski 2015).
    """
    mean = base_from_camera[:, :, 2].sum(0)
    z = mean / max(float(np.linalg.norm(mean)), 1e-12)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    base_from_mean = np.stack([x, np.cross(z, x), z], 1)
    relative = base_from_mean.T @ base_from_camera
    # Of a quaternion: 2 atan2(q_z, q_w), which is atan2 of twice these (Shepperd 1978).
    twist = np.arctan2(relative[:, 1, 0] - relative[:, 0, 1], relative[:, 0, 0] + relative[:, 1, 1])
    # Most images as they are, for rotating costs sharpness.
    common = np.cos(twist[:, None] - twist)
    return twist - twist[int(np.argmax(np.maximum(common - 0.9, 0).sum(1)))]


def by_quarters(roll: float) -> float:
    """Return the nearest multiple of 90° if it is near, else the angle to a degree; rad in [0, 2π)."""
    quarters = round(roll / (math.pi / 2)) * math.pi / 2
    nearest = quarters if abs(roll - quarters) <= UPRIGHT_ENOUGH else math.radians(round(math.degrees(roll)))
    return nearest % (2 * math.pi)
