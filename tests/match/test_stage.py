"""Which pairs are tried: those near each other, then those that see the same; how much of slow features is matched."""

import numpy as np
import pytest
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import project
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.match.gate import Key
from jcr.match.matchers import Matcher
from jcr.match.stage import ENOUGH, Matched, match_with_robot
from jcr.reconstruct.sfm import camera_of
from jcr.records import Intrinsics

INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
IMAGES, STEP_M, HEIGHT_M = 30, 0.1, 0.5
GRIPPER_FROM_CAMERA = transform(rotation_exp(np.array([0.1, -0.2, 0.4])), np.array([0.03, -0.05, 0.04]))


class PointsOfATable:
    """Features that match without error, of points along a table; a camera sees a fifth of its length."""

    every_pair = 12

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
        self.asked: dict[bool, list[Key]] = {True: [], False: []}

    def common(self, key: Key, coarse: bool = False) -> Float[ndarray, "m 2"] | ndarray:
        """Rows of the points that two images see; coarse: of every third."""
        first, second = (self.ids[k] for k in key)
        both, i, j = np.intersect1d(first, second, return_indices=True)
        some = both % 3 == 0 if coarse else np.full(len(both), True)
        return np.stack([i, j], 1)[some]

    def matches(self, pairs: list[Key], rolls: ndarray, coarse: bool = False) -> list[ndarray]:
        self.asked[coarse] += pairs
        return [self.common(key, coarse) for key in pairs]

    def descriptors(self, row: int, roll: float) -> tuple[int, ndarray]:
        raise NotImplementedError


def searched(features: PointsOfATable) -> Matched:
    matcher = Matcher(features, np.ones(2), camera_of(INTRINSICS, True), True, 0)
    poses = features.base_from_camera @ inverse(GRIPPER_FROM_CAMERA)
    names = [f"{k}.png" for k in range(IMAGES)]
    return match_with_robot(matcher, poses, INTRINSICS, True, names, (640, 480))


@pytest.mark.slow
def test_pairs_that_see_the_same_are_tried_and_no_others():
    """Of 435 pairs; each image sees what its five neighbours to either side see, too, in part."""
    features = PointsOfATable(minds_roll=False)
    found = searched(features)
    tried = set(features.asked[False])
    assert len(features.asked[False]) == len(tried) <= 6 * IMAGES
    blind = [key for key in tried if len(features.common(key)) < 25]
    assert len(blind) <= 2, (
        "among the nearest, before X is known; then the robot's poses show what sees the same"
    )
    partners = np.bincount(np.array(list(found.geometries)).ravel(), minlength=IMAGES)
    assert partners.min() >= 3, "of the images at the ends; those between have more"
    assert {(k, k + 2) for k in range(IMAGES - 2)} <= set(found.geometries)


@pytest.mark.slow
def test_all_keypoints_are_matched_of_pairs_alone_that_few_of_the_best_tie():
    features = PointsOfATable(minds_roll=True)
    found = searched(features)
    few = {key for key in found.geometries if len(features.common(key, coarse=True)) < ENOUGH}
    assert 0 < len(few) < len(found.geometries)
    in_full = set(features.asked[False])
    assert few <= in_full
    # One or two of a pair's best matches are not of its geometry.
    assert all(len(features.common(key, coarse=True)) < 1.1 * ENOUGH for key in in_full)
    assert all(len(found.geometries[key].inlier_matches) > 0.8 * len(features.common(key)) for key in few)
