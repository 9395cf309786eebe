"""What is kept of a capture's images is what was found, and nothing else."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy import ndarray

from jcr.camera import project
from jcr.features.kept import KeepingMatcher, KeptFeatures
from jcr.features.matchers import Matcher
from jcr.features.verify import Geometries
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Intrinsics
from jcr.sfm.mapping import camera_of

INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)
PAIRS = [(0, 1), (0, 2), (1, 2)]


class Points:
    """Points that two images see from two places; a third image sees others."""

    minds_roll, every_pair = False, 24

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        x = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.6], (120, 3))
        second = transform(rotation_exp(np.array([0.0, 0.2, 0.1])), np.array([-0.3, 0.0, 0.0]))
        self.x_px = [
            project(INTRINSICS, x),
            project(INTRINSICS, apply(inverse(second), x)),
            rng.uniform(0, 480, (120, 2)),
        ]
        self.matched: list[tuple[int, int]] = []

    def matches(self, pairs, rolls: ndarray, coarse: bool = False) -> list[ndarray]:
        self.matched += pairs
        return [np.repeat(np.arange(120)[:, None], 2, 1) for _ in pairs]

    def descriptors(self, row: int, roll: float) -> tuple[int, ndarray]:
        raise NotImplementedError


def in_numbers(found: Geometries) -> dict:
    """Every number of the geometries, for comparison."""
    return {
        key: {
            name: np.asarray(value).tolist() for name, value in geometry.todict().items() if value is not None
        }
        for key, geometry in found.items()
    }


@pytest.mark.parametrize("known", [True, False])
def test_pairs_are_read_as_they_were_found_while_images_and_intrinsics_are_the_same(
    tmp_path: Path, known: bool
):
    camera, rolls = camera_of(INTRINSICS, known), np.zeros((3, 2))
    wanted = Matcher(Points(), np.ones(2), camera, known, 0).geometries(PAIRS, rolls)
    assert list(wanted) == [(0, 1)]

    def found(
        camera: pycolmap.Camera, digests: str, writes: bool = True
    ) -> tuple[Points, KeepingMatcher, dict]:
        points, kept = Points(), KeptFeatures(tmp_path, writes, list(digests), [(0.0,), (1.0,), (2.0,)])
        matcher = KeepingMatcher(points, camera, known, 0, kept)
        return points, matcher, in_numbers(matcher.geometries(PAIRS, rolls))

    assert found(camera, "abc", writes=False)[0].matched == PAIRS
    assert found(camera, "abc")[0].matched == PAIRS
    points, matcher, again = found(camera, "abc")
    assert not points.matched and again == in_numbers(wanted)
    assert [len(matcher.raw[key]) for key in PAIRS] == [120] * 3
    assert found(camera, "abd")[0].matched == [(0, 2), (1, 2)]
    other = camera_of(Intrinsics(510.0, 510.0, 319.5, 239.5, 640, 480), known)
    assert found(other, "abc")[0].matched == PAIRS


def test_features_are_those_of_the_same_file_at_the_same_size(tmp_path: Path):
    kept = KeptFeatures(tmp_path, True, ["a", "b"])
    x_px, descriptors = np.array([[1.5, 2.25]]), np.full((1, 128), 0.1, np.float32)
    kept.keep_features(0, (640, 480), (x_px, descriptors))
    same = KeptFeatures(tmp_path, False, ["c", "a"])
    there = same.features(1, (640, 480))
    assert there is not None and np.array_equal(there[0], x_px) and np.array_equal(there[1], descriptors)
    assert same.features(0, (640, 480)) is None and same.features(1, (320, 240)) is None


def test_a_pair_is_matched_from_the_image_whose_pose_comes_first_whichever_row_it_has(tmp_path: Path):
    camera, rolls = camera_of(INTRINSICS, True), np.zeros((1, 2))
    keys = [(1.0,), (0.0,), (2.0,)]
    wanted = Matcher(Points(), np.ones(2), camera, True, 0)
    found = KeepingMatcher(Points(), camera, True, 0, KeptFeatures(tmp_path, True, list("abc"), keys))
    geometry, there = wanted.geometries([(1, 0)], rolls)[1, 0], found.geometries([(0, 1)], rolls)[0, 1]
    assert list(found.raw) == [(0, 1)]
    assert np.array_equal(there.inlier_matches, np.asarray(geometry.inlier_matches)[:, ::-1])
    assert there.E is not None and np.array_equal(there.E, np.asarray(geometry.E).T)
    # A reconstruction in the order of the poses finds the pair as it would match it.
    points, kept = Points(), KeptFeatures(tmp_path, False, list("bac"), sorted(keys))
    points.x_px[:2] = points.x_px[1::-1]
    again = KeepingMatcher(points, camera, True, 0, kept).geometries([(0, 1)], rolls)
    assert not points.matched
    assert in_numbers(again) == in_numbers({(0, 1): geometry})
