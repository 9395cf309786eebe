"""Matches along epipolar lines that are predicted."""

import numpy as np
import pytest
from numpy import ndarray

from jcr.features.guided import guided_rows
from jcr.features.verify import View
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Intrinsics

INTRINSICS = Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480)
I_FROM_J = transform(rotation_exp(np.array([0.05, 0.2, 0.1])), np.array([0.1, 0.02, 0.03]))
SEEN = 40


def _projected(x: ndarray) -> ndarray:
    return 600.0 * x[:, :2] / x[:, 2:] + [319.5, 239.5]


def _unit(v: ndarray) -> ndarray:
    return v / np.linalg.norm(v)


def _two_images(rng: np.random.Generator) -> tuple[list[ndarray], list[ndarray]]:
    """Keypoints of SEEN points in both images, row by row, and their descriptors, alike."""
    points = rng.uniform([-0.3, -0.2, 0.9], [0.3, 0.2, 1.1], (SEEN, 3))
    descriptors = rng.normal(size=(SEEN, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return [_projected(points), _projected(apply(inverse(I_FROM_J), points))], [
        descriptors,
        descriptors.copy(),
    ]


def _found(x_px: list[ndarray], descriptors: list[ndarray]) -> set[tuple[int, int]]:
    view = View.of(x_px, INTRINSICS)
    rows = guided_rows(view, 0, 1, descriptors[0], descriptors[1], I_FROM_J, 4.0)
    return {(int(i), int(j)) for i, j in rows}


def test_points_on_their_lines_match_and_those_off_them_do_not() -> None:
    x_px, descriptors = _two_images(np.random.default_rng(0))
    assert _found(x_px, descriptors) == {(k, k) for k in range(SEEN)}
    # Across its line, by five times the band.
    line = np.cross(np.r_[(x_px[0][7] - [319.5, 239.5]) / 600.0, 1.0], I_FROM_J[:3, 3]) @ I_FROM_J[:3, :3]
    x_px[1][7] += 20.0 * line[:2] / np.linalg.norm(line[:2])
    assert _found(x_px, descriptors) == {(k, k) for k in range(SEEN) if k != 7}


@pytest.mark.parametrize(("away_px", "is_rival"), [(1.0, False), (2.9, False), (3.1, True)])
def test_a_keypoint_found_twice_is_no_rival_of_itself(away_px: float, is_rival: bool) -> None:
    x_px, descriptors = _two_images(np.random.default_rng(1))
    line = np.cross(np.r_[(x_px[0][3] - [319.5, 239.5]) / 600.0, 1.0], I_FROM_J[:3, 3]) @ I_FROM_J[:3, :3]
    along = np.array([-line[1], line[0]]) / np.linalg.norm(line[:2])
    x_px[1] = np.vstack([x_px[1], x_px[1][3] + away_px * along])
    one, other = descriptors[1][3], descriptors[1][5]
    descriptors[0][3] = _unit(one + 0.1 * other)
    descriptors[1] = np.vstack([descriptors[1], _unit(one - 0.01 * other)])
    assert ((3, 3) in _found(x_px, descriptors)) is not is_rival
