"""Which pairs are tried: those near each other, then those that see the same; how much of slow features is matched."""

import numpy as np
import pytest

from jcr.features.stage import ENOUGH
from points_of_a_table import IMAGES, PointsOfATable, matched_pairs_of


@pytest.mark.slow
def test_pairs_that_see_the_same_are_tried_and_no_others():
    """Of 435 pairs; each image sees what its five neighbours to either side see, too, in part."""
    features = PointsOfATable(minds_roll=False)
    found = matched_pairs_of(features, features.base_from_gripper)
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
    found = matched_pairs_of(features, features.base_from_gripper)
    few = {key for key in found.geometries if len(features.common(key, coarse=True)) < ENOUGH}
    assert 0 < len(few) < len(found.geometries)
    in_full = set(features.asked[False])
    assert few <= in_full
    # One or two of a pair's best matches are not of its geometry.
    assert all(len(features.common(key, coarse=True)) < 1.1 * ENOUGH for key in in_full)
    assert all(len(found.geometries[key].inlier_matches) > 0.8 * len(features.common(key)) for key in few)
