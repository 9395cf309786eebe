"""Two-view geometry among wrong matches: what is right is found."""

import numpy as np
import pytest
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.features.matchers import matched
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Intrinsics
from jcr.sfm.model import colmap_camera

INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)


def keypoints(seed: int) -> list[Float[ndarray, "400 2"]]:
    """Of 400 points in two images; row k of one is row k of the other."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.7], (400, 3))
    second = transform(rotation_exp(np.array([0.05, 0.25, 0.1])), np.array([-0.3, 0.05, 0.0]))
    return [
        project(INTRINSICS, apply(inverse(pose), points)) + rng.normal(scale=0.5, size=(400, 2))
        for pose in (np.eye(4), second)
    ]


def rows_of(right: int, seed: int) -> Int[ndarray, "400 2"]:
    """Matches, the first `right` of them right."""
    rows = np.repeat(np.arange(400)[:, None], 2, axis=1)
    rows[right:, 1] = right + np.random.default_rng(seed).permutation(400 - right)
    return rows


@pytest.mark.parametrize("seed", range(3))
def test_three_right_matches_of_ten_are_found_and_none_make_no_pair(seed: int):
    x_px, camera = keypoints(seed), colmap_camera(INTRINSICS, True)
    found = matched(x_px, camera, (0, 1), rows_of(120, seed), 0, True)
    assert found is not None
    inside = np.asarray(found.inlier_matches)[:, 0]
    assert (inside < 120).sum() > 0.93 * 120
    assert (inside >= 120).sum() < 0.06 * 280, "only by chance near their epipolar line"
    nothing = matched(x_px, camera, (0, 1), rows_of(0, seed), 0, True)
    assert nothing is None or len(nothing.inlier_matches) < 0.1 * 400
