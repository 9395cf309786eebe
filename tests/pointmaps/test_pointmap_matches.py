"""Correspondences from pointmaps against the true geometry."""

import importlib.util
import sys

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.geometry import apply, inverse, transform
from jcr.pointmaps.dust3r.pair_graph import complete_pairs
from jcr.pointmaps.pairs import PairPredictions, pairs_from_arrays
from jcr.pointmaps.pointmap_matches import tracks_from_pairs, tracks_from_pointmaps
from jcr.records import Tracks
from places import SHARED

ALIGN = SHARED / "align"
FOCAL, HEIGHT, WIDTH = 90.0, 72, 96


def pixel_errors(
    tracks: Tracks, recon_from_camera: ndarray, focal: float, center: tuple[float, float]
) -> ndarray:
    """Distance of each observation from where the track's point projects."""
    x_in_camera = np.array(
        [
            apply(inverse(recon_from_camera[image]), tracks.points_in_recon[point])
            for image, point in zip(tracks.image, tracks.point, strict=True)
        ]
    )
    projected = focal * x_in_camera[:, :2] / x_in_camera[:, 2:] + center
    return np.linalg.norm(projected - tracks.x_px, axis=1)


@pytest.fixture
def table() -> tuple[ndarray, ndarray]:
    """Cameras over the plane z = 0, and the points of their pixels in the recon frame."""
    rng = np.random.default_rng(0)
    tilt = Rotation.from_rotvec(rng.normal(scale=0.25, size=(4, 3)) + [0, 0, 0.5])
    rotation = (tilt * Rotation.from_euler("x", 180, degrees=True)).as_matrix()
    recon_from_camera = transform(
        rotation, np.append(rng.uniform(-0.1, 0.1, (4, 2)), np.full((4, 1), 0.8), 1)
    )
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones((HEIGHT, WIDTH))], -1)
    points = []
    for camera in recon_from_camera:
        depth = -camera[2, 3] / (rays @ camera[2, :3])
        points.append(apply(camera, rays * depth[..., None]))
    return recon_from_camera, np.array(points)


def assert_sound(tracks: Tracks) -> None:
    observations = np.stack([tracks.image, tracks.point], 1)
    assert len(np.unique(observations, axis=0)) == len(observations), "an image sees a point once"
    assert (np.bincount(tracks.point, minlength=len(tracks.points_in_recon)) >= 2).all()


def test_exact_pointmaps_give_matches_exact_below_a_pixel(table: tuple[ndarray, ndarray]) -> None:
    recon_from_camera, points = table
    confidence = np.ones(points.shape[:3])
    tracks = tracks_from_pointmaps(recon_from_camera, points, confidence, lambda x_px: 2 * x_px + 3)
    assert_sound(tracks)
    errors = pixel_errors(
        Tracks(
            image=tracks.image,
            x_px=(tracks.x_px - 3) / 2,
            point=tracks.point,
            points_in_recon=tracks.points_in_recon,
        ),
        recon_from_camera,
        FOCAL,
        (WIDTH / 2, HEIGHT / 2),
    )
    assert len(tracks.points_in_recon) > 800 and len(errors) > 2500
    assert errors.max() < 0.02


def test_pairs_at_any_scale_give_the_same_tracks(table: tuple[ndarray, ndarray]) -> None:
    recon_from_camera, points = table
    edges, rng = complete_pairs(4), np.random.default_rng(1)
    scale = rng.uniform(0.2, 5, len(edges))
    own, other = (
        np.array(
            [
                s * apply(inverse(recon_from_camera[edge[0]]), points[edge[side]])
                for s, edge in zip(scale, edges, strict=True)
            ],
            np.float32,
        )
        for side in (0, 1)
    )
    one = np.ones(own.shape[:3], np.float32)
    tracks = tracks_from_pairs(
        PairPredictions(edges=edges, pts3d=own, conf=one, pts3d_in_other_view=other, conf2=one),
        points,
        lambda x_px: x_px,
    )
    alone = tracks_from_pointmaps(recon_from_camera, points, np.ones(points.shape[:3]), lambda x_px: x_px)
    # A second order of a pair can only veto.
    assert 0.98 * len(alone.image) < len(tracks.image) <= len(alone.image)
    assert_sound(tracks)
    assert pixel_errors(tracks, recon_from_camera, FOCAL, (WIDTH / 2, HEIGHT / 2)).max() < 0.02


def test_what_one_image_alone_sees_and_what_nobody_trusts_is_not_matched(
    table: tuple[ndarray, ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    recon_from_camera, points = table
    points = points.copy()
    points[0, :, : WIDTH // 2] += [0, 0, 0.5]  # another surface, half a metre above the table
    confidence = np.ones(points.shape[:3])
    confidence[1, : HEIGHT // 2] = 0.1
    monkeypatch.setattr("jcr.pointmaps.pointmap_matches.LEAST_CONFIDENCE", 0.6)
    tracks = tracks_from_pointmaps(recon_from_camera, points, confidence, lambda x_px: x_px)
    x, y = tracks.x_px.T
    assert not ((tracks.image == 0) & (x < WIDTH // 2 - 3)).any()
    assert not ((tracks.image == 1) & (y < HEIGHT // 2 - 3)).any()
    assert ((tracks.image == 0) & (x > WIDTH // 2)).sum() > 50


def test_noisy_predictions_of_a_table_with_objects() -> None:
    if not ALIGN.is_dir():
        pytest.skip(f"the generator of synthetic predictions is not in {ALIGN}")
    spec = importlib.util.spec_from_file_location("make_synthetic", ALIGN / "make_synthetic.py")
    assert spec is not None and spec.loader is not None
    generator = importlib.util.module_from_spec(spec)
    sys.modules["make_synthetic"] = generator
    spec.loader.exec_module(generator)
    truth = generator.make(128, 96, 6)
    v, u = np.mgrid[:96, :128]
    rays = np.stack([(u - 64) / truth["gt_focal"], (v - 48) / truth["gt_focal"], np.ones((96, 128))], -1)
    points = np.array(
        [
            apply(camera, rays * z[..., None])
            for camera, z in zip(truth["gt_poses"], truth["gt_depth"], strict=True)
        ]
    )
    predictions = pairs_from_arrays({k: v for k, v in truth.items() if not k.startswith("gt_")}, "synthetic")
    tracks = tracks_from_pairs(predictions, points, lambda x_px: x_px)
    assert_sound(tracks)
    errors = pixel_errors(tracks, truth["gt_poses"], truth["gt_focal"], (64, 48))
    matched = errors[errors > 1e-6]
    # The predictions are warped by 1 % of the depth, which is over a pixel here.
    assert len(matched) > 500 and np.median(matched) < 0.5 and (matched < 2).mean() > 0.98
