"""Global alignment against the truth of synthetic pairs: accuracy, gauge, wrong pairs, graphs, bad input."""

from dataclasses import replace

import numpy as np
import pytest

from jcr.camera import rays
from jcr.errors import RejectedError
from jcr.geometry import Similarity, fit_similarity, rotation_between_deg
from jcr.paper.alignment import align
from jcr.pointmaps.global_alignment.align import Alignment, global_align
from jcr.pointmaps.pair_predictions import complete_pairs, window_pairs
from refusal import refused
from simulation.pairs import PairErrors, PairTruth, synthetic_pairs

SMALL = (48, 36)
NO_ERRORS = PairErrors(pixel=0.0, warp=0.0, outliers=0.0)


def errors(result: Alignment, truth: PairTruth) -> tuple[float, float]:
    """Mean error of the cameras, mm and degrees, after the best similarity."""
    true, found = truth.base_from_camera, result.recon_from_camera
    base_from_recon, scale = fit_similarity(true[:, :3, 3], found[:, :3, 3])
    centers = Similarity(base_from_recon, scale)(found[:, :3, 3])
    rotation = rotation_between_deg(base_from_recon[:3, :3] @ found[:, :3, :3], true[:, :3, :3])
    return 1e3 * float(np.linalg.norm(centers - true[:, :3, 3], axis=1).mean()), float(rotation.mean())


def test_exact_predictions_give_the_exact_scene():
    predictions, truth = synthetic_pairs(complete_pairs(5), SMALL, NO_ERRORS)
    result = global_align(predictions)
    mm, deg = errors(result, truth)
    assert mm < 1e-3
    assert deg < 1e-4
    np.testing.assert_allclose(result.focal_px, truth.intrinsics.fx, rtol=1e-6)
    # Metres per recon unit, from the pairs' units and scales, from the depth: one and the same.
    unit = 1 / (result.pair_scale * truth.pair_unit)
    np.testing.assert_allclose(unit, unit[0], rtol=1e-5)
    np.testing.assert_allclose(result.depth * unit[0], truth.depth, rtol=1e-4)
    surface = truth.depth[..., None] * rays(truth.intrinsics)
    np.testing.assert_allclose(result.x_in_camera() * unit[0], surface, atol=2e-4)
    assert np.prod(result.pair_scale) == pytest.approx(1, rel=1e-6)
    np.testing.assert_array_equal(result.recon_from_camera[0], np.eye(4))
    assert result.pair_residual.max() < 2e-4
    assert result.notes == ()


@pytest.mark.slow
def test_fast_beats_adam_and_both_are_near_the_truth():
    predictions, truth = synthetic_pairs(complete_pairs(4), (32, 24), seed=1)
    fast, published = (errors(method(predictions), truth) for method in (global_align, align))
    assert published[0] < 4 and published[1] < 0.4
    assert fast[0] < published[0] / 2 and fast[1] < published[1]


@pytest.mark.parametrize("spoil", [{"wrong_pairs": 5}, {"noise_pairs": 5}])
def test_wrong_pairs_are_outvoted_and_named(spoil):
    spoilt, truth = synthetic_pairs(complete_pairs(6), SMALL, PairErrors(**spoil), seed=2)
    result = global_align(replace(spoilt, images=tuple("abcdef")))
    mm, deg = errors(result, truth)
    assert mm < 1
    assert deg < 0.1
    worst = np.argsort(result.pair_residual)[-5:]
    assert set(worst) == set(truth.spoilt)
    assert len(result.notes) == 1
    assert result.notes[0].startswith("5 of 30 pairs")


@pytest.mark.parametrize(
    "edges",
    [window_pairs(8, 2), window_pairs(6, 1), np.array([(i, j) for i in range(5) for j in range(i + 1, 5)])],
    ids=["window", "chain", "one way"],
)
def test_incomplete_graphs(edges):
    # One way: the last image is never first, so that its depth comes from other cameras' views alone.
    predictions, truth = synthetic_pairs(edges, SMALL, seed=4)
    mm, deg = errors(global_align(predictions), truth)
    assert mm < 2
    assert deg < 0.2


def test_images_that_no_pair_reaches_are_named():
    edges = np.array([[0, 1], [1, 0], [2, 3], [3, 2]])
    predictions, _ = synthetic_pairs(edges, SMALL)
    with refused("no chain of pairs joins c, d "):
        global_align(replace(predictions, images=tuple("abcd")))


@pytest.mark.parametrize("network", ["from 1 up", "from 0 to 1"])
def test_pixels_without_confidence_do_not_count(network):
    # More than half of each image is rubbish, as sky is.
    predictions, truth = synthetic_pairs(complete_pairs(4), SMALL)
    rubbish = np.random.default_rng(0).normal(0, 1, (12, 36, 28, 3)).astype(np.float32)
    nothing = 1.0 if network == "from 1 up" else 0.0
    for points, conf in (
        (predictions.pts3d, predictions.conf),
        (predictions.pts3d_in_other_view, predictions.conf2),
    ):
        points[:, :, :28] = rubbish
        if nothing == 0.0:
            conf /= conf.max() * 1.01
        conf[:, :, :28] = nothing
    result = global_align(predictions)
    mm, deg = errors(result, truth)
    assert mm < 1.5
    assert deg < 0.15
    assert np.isfinite(result.depth).all()
    assert result.confidence[:, :, :28].max() <= nothing + 1e-6
    assert result.confidence[:, :, 28:].mean() > nothing + 0.1


def test_pixels_beside_edges_that_lie_nowhere_are_outvoted():
    predictions, truth = synthetic_pairs(complete_pairs(4), SMALL)
    draw = np.random.default_rng(0)
    for points in (predictions.pts3d, predictions.pts3d_in_other_view):
        astray = draw.random(points.shape[:3]) < 0.1
        points[astray] *= draw.uniform(1.0, 2.0, (astray.sum(), 1)).astype(np.float32)
    mm, deg = errors(global_align(predictions), truth)
    assert mm < 1 and deg < 0.1


def test_predictions_that_are_noise_are_called_useless():
    predictions, _ = synthetic_pairs(complete_pairs(3), SMALL, PairErrors(noise_pairs=6))
    try:
        said = global_align(predictions).warnings
    except RejectedError as refusal:
        said = (str(refusal),)
    assert any("nothing can be built on them" in note or "too little in common" in note for note in said)
