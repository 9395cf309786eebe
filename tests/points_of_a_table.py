"""Features of images along a table, matched without error, and the pairs that the search finds."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.features.gate import Key
from jcr.features.matchers import Matcher
from jcr.features.stage import Matched, match_with_robot
from jcr.geometry import Transforms, apply, inverse, rotation_exp, transform
from jcr.records import Intrinsics
from jcr.sfm.model import colmap_camera

INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
IMAGES, STEP_M, HEIGHT_M = 30, 0.1, 0.5
GRIPPER_FROM_CAMERA = transform(rotation_exp(np.array([0.1, -0.2, 0.4])), np.array([0.03, -0.05, 0.04]))


class PointsOfATable:
    """Features that match without error, of points along a table; a camera sees a fifth of its length."""

    every_pair, farthest = 12, 0.7

    def __init__(self, minds_roll: bool) -> None:
        rng = np.random.default_rng(0)
        self.minds_roll = minds_roll
        points = rng.uniform([-0.3, -0.3, -0.06], [3.2, 0.3, 0.06], (3600, 3))
        down = transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
        self.base_from_camera = np.stack(
            [
                transform(np.eye(3), np.array([STEP_M * k, 0.0, HEIGHT_M]))
                @ down
                @ transform(rotation_exp(rng.normal(scale=0.15, size=3)), np.zeros(3))
                for k in range(IMAGES)
            ]
        )
        self.ids: list[ndarray] = []
        self.x_px: list[Float[ndarray, "_ 2"]] = []
        for pose in self.base_from_camera:
            x_px = project(INTRINSICS, apply(inverse(pose), points))
            seen = np.flatnonzero(((x_px > 0) & (x_px < [639, 479])).all(1))
            self.ids.append(seen)
            self.x_px.append(x_px[seen] + rng.normal(scale=0.3, size=(len(seen), 2)))
        of_point = rng.normal(size=(len(points), 32)).astype(np.float32)
        of_point /= np.linalg.norm(of_point, axis=1, keepdims=True)
        self.descriptors = [of_point[seen] for seen in self.ids]
        self.asked: dict[bool, list[Key]] = {True: [], False: []}

        self.base_from_gripper: Transforms = self.base_from_camera @ inverse(GRIPPER_FROM_CAMERA)

    def common(self, key: Key) -> Int[ndarray, "m 2"]:
        """Return rows of the points that two images see."""
        first, second = (self.ids[k] for k in key)
        return np.stack(np.intersect1d(first, second, return_indices=True)[1:], 1)

    def matches(self, pairs: Sequence[Key], rolls: ndarray) -> list[ndarray]:
        return [self.common(key) for key in pairs]


def matcher_of_points(features: PointsOfATable) -> Matcher:
    """Return the matcher of these features."""
    return Matcher(features, np.ones(2), colmap_camera(INTRINSICS, True), True, 0)


def matched_pairs_of(features: PointsOfATable, base_from_gripper: Transforms) -> Matched:
    """Return the pairs of all images, by these gripper poses."""
    matcher = matcher_of_points(features)
    names = [f"{k}.png" for k in range(IMAGES)]
    return match_with_robot(matcher, base_from_gripper, INTRINSICS, names)
