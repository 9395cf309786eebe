"""Least-squares matching on a textured plane, whose images are computed exactly."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import Intrinsics, Tracks
from jcr.sfm.track_refinement import align_tracks

INTRINSICS = Intrinsics(300.0, 302.0, 158.0, 121.0, 320, 240, (-0.08, 0.05, 0.001, -0.001, 0.0))
DISTANCE = (0.85, 1.0, 1.2)
"""The second is the median: the reference of every track."""
ROTATION = rotation_exp(np.array([[0.25, 0.1, 0.3], [0.0, 0.0, 0.0], [-0.1, 0.3, -1.2]]))
RECON_FROM_CAMERA = transform(ROTATION, -np.array(DISTANCE)[:, None] * ROTATION[:, :, 2])
"""They look at the origin, and stand above the plane z = 0."""
GAIN, OFFSET, NOISE = (0.8, 1.0, 1.1), (20.0, 0.0, -15.0), 1.0


def texture(x: Float[ndarray, "*n 2"], seed: int) -> Float[ndarray, "*n"]:
    """Greys of the plane: waves of 5 to 40 pixels' length in the reference."""
    random = np.random.default_rng(seed)
    angle, length = random.uniform(0, np.pi, 60), random.uniform(5, 40, 60) / 300
    wave = 2 * np.pi / length * np.stack([np.cos(angle), np.sin(angle)])
    return 120 + 9 * np.sin(x @ wave + random.uniform(0, 2 * np.pi, 60)).sum(-1)


def image(camera: int, seed: int = 0) -> UInt8[ndarray, "h w"]:
    """What a camera sees of the plane, with its gain, offset and noise."""
    pose = RECON_FROM_CAMERA[camera]
    pixels = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1)
    ray = unproject(INTRINSICS, pixels) @ pose[:3, :3].T
    on_plane = pose[:3, 3] - (pose[2, 3] / ray[..., 2:]) * ray
    grey = GAIN[camera] * texture(on_plane[..., :2], seed) + OFFSET[camera]
    grey += NOISE * np.random.default_rng(camera).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def greys() -> UInt8[ndarray, "m h w"]:
    return np.stack([image(camera) for camera in range(3)])


@pytest.fixture(scope="module")
def exact() -> Tracks:
    """Points of the plane that all three cameras see, and where they see them."""
    points = np.random.default_rng(1).uniform(-0.35, 0.35, (300, 3)) * [1, 0.7, 0]
    seen = np.stack([project(INTRINSICS, apply(inverse(pose), points)) for pose in RECON_FROM_CAMERA])
    whole = ((seen > 14) & (seen < [305, 225])).all((0, 2))
    n = int(whole.sum())
    assert n > 100
    return Tracks(
        image=np.repeat(np.arange(3), n),
        x_px=seen[:, whole].reshape(-1, 2),
        point=np.tile(np.arange(n), 3),
        points_in_recon=points[whole],
    )


def disturbed(tracks: Tracks, px: float) -> Tracks:
    """Keypoints as features are found, those of the reference exact; and points as keypoints give them."""
    random = np.random.default_rng(2)
    error = px * random.standard_normal(tracks.x_px.shape) * (tracks.image != 1)[:, None]
    x = tracks.points_in_recon
    return replace(
        tracks, x_px=tracks.x_px + error, points_in_recon=x + 0.002 * random.standard_normal(x.shape)
    )


def test_observations_are_where_the_reference_is_seen(greys: UInt8[ndarray, "m h w"], exact: Tracks):
    start = disturbed(exact, 0.5)
    found = align_tracks(greys, start, RECON_FROM_CAMERA, INTRINSICS)
    other, error = exact.image != 1, found.x_px - exact.x_px
    moved = (found.x_px != start.x_px).any(1)
    assert not moved[~other].any()
    assert moved[other].mean() > 0.95
    assert np.sqrt(np.mean(error[moved] ** 2)) < 0.035
    for camera in (0, 2):  # half a pixel of a resized image, or a bend that is left out, would move all alike
        assert np.abs(error[moved & (exact.image == camera)].mean(0)).max() < 0.005


def test_what_shows_something_else_keeps_its_keypoint(greys: UInt8[ndarray, "m h w"], exact: Tracks):
    start = disturbed(exact, 0.5)
    occluded = np.stack([image(0, seed=5), greys[1], np.full_like(greys[2], 90)])
    found = align_tracks(occluded, start, RECON_FROM_CAMERA, INTRINSICS)
    kept = (found.x_px == start.x_px).all(1)
    assert kept[start.image == 0].mean() > 0.95
    assert kept[start.image == 2].all()
