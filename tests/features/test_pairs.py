"""Pairs of images: near viewpoints, one image of each, all repeats tied together."""

import numpy as np

from jcr.estimation.closed_form import motions
from jcr.features.pairs import near_pairs, viewpoints
from jcr.geometry import rotation_exp, transform


def repeated(places: int, repeats: int) -> np.ndarray:
    """Return gripper poses of viewpoints on a line of 5 cm steps, each taken again and again within 0.1 mm."""
    rng = np.random.default_rng(0)
    x = np.column_stack([0.05 * np.arange(places), np.zeros((places, 2))])
    x = np.tile(x, (repeats, 1)) + rng.normal(scale=1e-4, size=(places * repeats, 3))
    return transform(rotation_exp(rng.normal(scale=1e-3, size=(places * repeats, 3))), x)


def test_images_of_one_viewpoint_are_no_partners():
    viewpoint = viewpoints(motions(repeated(16, 12)))
    assert np.array_equal(viewpoint, np.tile(np.arange(16), 12))
    pairs = np.array(near_pairs(motions(repeated(16, 12)), 4))
    assert (viewpoint[pairs[:, 0]] != viewpoint[pairs[:, 1]]).all()
    for image in range(16 * 12):
        partners = pairs[(pairs == image).any(1)]
        others = viewpoint[np.where(partners[:, 0] == image, partners[:, 1], partners[:, 0])]
        assert len(set(others.tolist())) >= 4


def test_all_repeats_are_tied_together_in_proportion_to_their_number():
    pairs = near_pairs(motions(repeated(16, 12)), 4)
    assert len(pairs) <= 4 * 16 * 12
    group = np.arange(16 * 12)
    for i, j in pairs:
        group[group == group[j]] = group[i]
    assert (group == group[0]).all()


def test_single_viewpoints_have_their_nearest_neighbours():
    poses = repeated(10, 1)
    assert {(k, k + 1) for k in range(9)} <= set(near_pairs(motions(poses), 2))
    assert np.array_equal(viewpoints(motions(poses)), np.arange(10))
