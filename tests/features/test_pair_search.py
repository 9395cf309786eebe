"""Search for image pairs before the hand-eye rotation is known."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.features.matchers import Matcher
from jcr.features.pair_search import match_with_robot
from jcr.features.pair_verification import Key
from jcr.geometry import rotation_angle, rotation_exp, transform
from jcr.records import Intrinsics
from jcr.sfm.model import colmap_camera

INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)


class NothingMatches:
    """Features that need upright images and never match; they record the rotations (rad) that each pair is tried at."""

    needs_upright, every_pair, farthest = True, 12, 0.7

    def __init__(self, images: int) -> None:
        self.x_px = [np.zeros((0, 2)) for _ in range(images)]
        self.descriptors = [np.zeros((0, 8), np.float32) for _ in range(images)]
        self.tried: dict[Key, list[float]] = {}

    def matches(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> list[ndarray]:
        for key, (first, second) in zip(pairs, rolls, strict=True):
            self.tried.setdefault(key, []).append(float(second - first))
        return [np.zeros((0, 2), int) for _ in pairs]


def test_images_are_rotated_by_no_more_than_the_gripper_rotated():
    angles = np.radians([0.0, 10.0, 70.0, 100.0, 170.0])
    axis = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    poses = np.stack([transform(rotation_exp(a * axis), np.array([0.1 * a, 0.0, 0.5])) for a in angles])
    features = NothingMatches(len(poses))
    matcher = Matcher(features, colmap_camera(INTRINSICS, True), True, 0)
    match_with_robot(matcher, poses, INTRINSICS, [f"{k}.png" for k in range(len(poses))])
    assert len(features.tried) == 10
    for (i, j), rolls in features.tried.items():
        gripper = float(rotation_angle(poses[i, :3, :3].T @ poses[j, :3, :3]))
        # A pair is tried at each quarter that is at most 45° from a roll between 0 and the gripper's angle, once.
        possible = [q for q in (0, 90, 180, 270) if min(q, 360 - q) <= np.degrees(gripper) + 45]
        assert sorted(round(np.degrees(roll)) % 360 for roll in rolls) == possible
