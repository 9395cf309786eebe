"""Dense depth on a scene whose depth is known: a box on a table, drawn by casting rays."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from scipy.ndimage import gaussian_filter, map_coordinates

from jcr.camera import rays
from jcr.capture.images import encode_png
from jcr.depth.densify import choose_neighbours, dense_pointmaps, densify, sweep_planes
from jcr.depth.depth_npz import read_depth, write_depth
from jcr.depth.options import DepthOptions
from jcr.geometry import apply, inverse, rotation_exp, transform
from jcr.records import BOTH, MATCHED, NO_DEPTH, PRIOR, Intrinsics, Pointmaps, Tracks
from scenes import capture_of, reconstruction_of

pytestmark = pytest.mark.slow

PINHOLE = Intrinsics(150.0, 150.0, 79.5, 59.5, 160, 120)
BOX_HEIGHT, BOX_HALF_WIDTH = 0.06, 0.05
BLANK_X = 0.11
"""The table has one colour beyond this x."""
PATCH_XY, PATCH_HALF_WIDTH = (-0.02, 0.11), 0.035
"""And on this square."""


@dataclass(frozen=True)
class Scene:
    """Seven views of the table z = 0, from above, 0.4 to 0.5 m away."""

    images: UInt8[ndarray, "m h w 3"]
    recon_from_camera: Float[ndarray, "m 4 4"]
    depth: Float[ndarray, "m h w"]
    blank: Bool[ndarray, "m h w"]
    patch: Bool[ndarray, "m h w"]
    tracks: Tracks


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(3)
    texture = np.stack([gaussian_filter(rng.normal(size=(600, 600)), 2.0) for _ in range(3)], axis=-1)
    texture = np.clip(128 + 60 * texture / texture.std(), 0, 255)
    cameras, images, masks = [], [], []
    for k in range(7):
        azimuth, tilt = 2 * np.pi * k / 7, 0.25 + 0.1 * (k % 3)
        centre = (0.42 + 0.03 * (k % 2)) * np.array(
            [np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)]
        )
        z = -centre / np.linalg.norm(centre)
        x = np.cross([np.sin(0.4 * k), np.cos(0.4 * k), 0.0], z)
        x /= np.linalg.norm(x)
        recon_from_camera = transform(np.stack([x, np.cross(z, x), z], axis=-1), centre)
        direction = rays(PINHOLE) @ recon_from_camera[:3, :3].T
        on_table = -centre[2] / direction[..., 2]
        corners = np.array([[-1, -1, 0], [1, 1, 1]]) * [BOX_HALF_WIDTH, BOX_HALF_WIDTH, BOX_HEIGHT]
        walls = (corners[:, None, None] - centre) / direction
        enter, leave = walls.min(0).max(-1), walls.max(0).min(-1)
        depth = np.where(enter < leave, np.minimum(enter, on_table), on_table)
        point = centre + depth[..., None] * direction
        place = 300 + 1000 * (point[..., :2] + [[0.4, 0.1]] * point[..., 2:])
        color = np.stack(
            [map_coordinates(texture[..., c], place.reshape(-1, 2).T, mode="reflect") for c in range(3)]
        )
        color = color.T.reshape(*depth.shape, 3)
        blank = point[..., 0] > BLANK_X
        patch = (np.abs(point[..., :2] - PATCH_XY) < PATCH_HALF_WIDTH).all(-1) & (point[..., 2] < 1e-6)
        cameras.append(recon_from_camera)
        images.append(np.where((blank | patch)[..., None], 140, np.clip(color, 0, 255)).astype(np.uint8))
        masks.append((depth, blank, patch))
    recon_from_camera = np.stack(cameras)
    points = np.concatenate(
        [
            np.column_stack([rng.uniform(-0.12, 0.1, (300, 2)), np.zeros(300)]),
            np.column_stack([rng.uniform(-0.05, 0.05, (60, 2)), np.full(60, BOX_HEIGHT)]),
        ]
    )
    image, point, x_px = [], [], []
    for k, camera_from_recon in enumerate(inverse(recon_from_camera)):
        x = apply(camera_from_recon, points)
        u, v = (PINHOLE.matrix @ x.T)[:2] / x[:, 2]
        (seen,) = np.nonzero((u > 0) & (u < PINHOLE.width - 1) & (v > 0) & (v < PINHOLE.height - 1))
        image.append(np.full(len(seen), k))
        point.append(seen)
        x_px.append(np.stack([u, v], axis=-1)[seen])
    image, x_px, point = map(np.concatenate, (image, x_px, point))
    tracks = Tracks(image=image, x_px=x_px, point=point, points_in_recon=points)
    return Scene(np.stack(images), recon_from_camera, *map(np.stack, zip(*masks, strict=True)), tracks)


@pytest.fixture(scope="module")
def dense(scene: Scene) -> Pointmaps:
    return _dense(scene, scene.recon_from_camera, scene.tracks)


def _dense(scene: Scene, recon_from_camera: ndarray, tracks: Tracks, **options: Any) -> Pointmaps:
    neighbours = choose_neighbours(tracks, recon_from_camera, 6)
    planes = sweep_planes(tracks, recon_from_camera)
    images = scene.images
    return dense_pointmaps(
        images, recon_from_camera, PINHOLE, neighbours, planes, lambda stage, fraction: None, **options
    )


def _z(scene: Scene, dense: Pointmaps, recon_from_camera: ndarray | None = None) -> ndarray:
    cameras = scene.recon_from_camera if recon_from_camera is None else recon_from_camera
    pairs = zip(inverse(cameras), dense.points_in_recon, strict=True)
    return np.stack([apply(camera_from_recon, x)[..., 2] for camera_from_recon, x in pairs])


def test_memory_that_ends_in_a_worker_thread_ends_the_stage(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    """The threads are fewer than the images: one that waits for another would block the stage for ever."""

    def exhausted(*arguments: object) -> None:
        raise MemoryError("Unable to allocate 5.62 MiB")

    monkeypatch.setattr("jcr.depth.patch_match_stereo.spread_planes", exhausted)
    monkeypatch.setattr("jcr.depth.densify.MOST_THREADS", 2)
    with pytest.raises(MemoryError, match="Unable to allocate"):
        _dense(scene, scene.recon_from_camera, scene.tracks)


def test_depth_is_found_and_reasons_and_sigmas_are_honest(scene: Scene, dense: Pointmaps) -> None:
    depth = _z(scene, dense)
    assert np.isfinite(depth).all() and (depth > 0).all()
    np.testing.assert_array_equal(dense.confidence > 0, dense.reason != NO_DEPTH)
    error = np.abs(depth - scene.depth)
    matched = np.isin(dense.reason, (MATCHED, BOTH))
    textured = ~scene.blank & ~scene.patch
    believed = dense.confidence > 0
    assert believed[textured].mean() > 0.75
    assert np.median((error / scene.depth)[matched & textured]) < 5e-4
    assert (error / scene.depth > 0.02)[believed & textured].mean() < 0.02
    for reason in (MATCHED, PRIOR, BOTH):
        of_reason = dense.reason == reason
        assert of_reason.sum() > 200
        assert (error < 2 * dense.depth_std)[of_reason].mean() > 0.8


def test_neighbours_are_first_those_that_see_the_points_from_15_degrees_away() -> None:
    """The cameras stand on a circle about the only point, at these angles from the first."""
    angle = np.radians([0.0, 3.0, 15.0, 20.0, 60.0])
    cameras = transform(np.eye(3), np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1))
    tracks = Tracks(
        image=np.arange(5), x_px=np.zeros((5, 2)), point=np.zeros(5, int), points_in_recon=np.zeros((1, 3))
    )
    assert choose_neighbours(tracks, cameras, 4)[0].tolist() == [2, 3, 1, 4]


def test_only_a_confirmed_depth_sees_through_a_point() -> None:
    """A wall at 1 m before four cameras side by side; the last one found 2 m, by chance or because it is so."""
    from jcr.depth.consistency import agreement, inverse_depth_evidence
    from jcr.depth.patch_match_stereo import grid, relative

    poses = transform(np.eye(3), np.array([[x, 0.0, 0.0] for x in (0.0, 0.02, -0.02, 0.01)]))
    inverse_depth = np.ones((4, PINHOLE.height, PINHOLE.width), np.float32)
    inverse_depth[3] = 0.5
    known = np.ones(inverse_depth.shape, bool)
    chance = known & (np.arange(4) != 3)[:, None, None]
    view = relative(0, np.arange(1, 4), poses, PINHOLE)
    for confirmed, seeing in ((chance, 0), (known, 1)):
        compared = inverse_depth_evidence(inverse_depth, known, confirmed)
        sums = np.zeros((4, *inverse_depth.shape[1:]), np.float32)
        mean, count, through, information = agreement(sums, 0, compared, *view, grid(PINHOLE), 0.01)
        middle = np.s_[10:-10, 10:-10]
        assert (count[middle] == 2).all() and (through[middle] == seeing).all()
        np.testing.assert_allclose(mean[middle], 1.0, rtol=1e-6)
        np.testing.assert_allclose(information[middle], 2 * (0.02 * PINHOLE.fx) ** 2, rtol=1e-4)


def test_one_colour_is_filled_within_its_plane_and_nowhere_matched(scene: Scene, dense: Pointmaps) -> None:
    without = _dense(scene, scene.recon_from_camera, scene.tracks, priors=False)
    assert not np.isin(without.reason, (PRIOR, BOTH)).any()
    inner = _inner(scene.patch, 6)
    assert inner.sum() > 300
    for result in (dense, without):
        assert np.isin(result.reason, (MATCHED, BOTH))[inner].mean() < 0.01
    filled = inner & (dense.reason == PRIOR)
    assert filled.sum() > 0.8 * inner.sum()
    assert (np.abs(_z(scene, dense) / scene.depth - 1) < 0.005)[filled].mean() > 0.99
    # One colour that goes on beyond the last texture may be the floor beside the table.
    beyond = _inner(scene.blank, 12)
    assert beyond.sum() > 500 and (dense.confidence[beyond] == 0).mean() > 0.99


def _inner(mask: Bool[ndarray, "m h w"], margin: int) -> Bool[ndarray, "m h w"]:
    """What lies so far (px) from the others in rows and columns."""
    inner = mask.copy()
    for axis in (1, 2):
        inner &= np.roll(mask, margin, axis) & np.roll(mask, -margin, axis)
    return inner


def test_the_gauge_changes_nothing_but_the_unit(scene: Scene, dense: Pointmaps) -> None:
    scale, motion = 7.3, transform(rotation_exp(np.array([0.3, -1.1, 0.7])), np.array([2.0, -3.0, 1.0]))
    moved = motion @ scene.recon_from_camera
    moved[:, :3, 3] *= scale
    tracks = replace(scene.tracks, points_in_recon=scale * apply(motion, scene.tracks.points_in_recon))
    other = _dense(scene, moved, tracks)
    both = (dense.confidence > 0) & (other.confidence > 0)
    assert both.sum() > 0.97 * (dense.confidence > 0).sum()
    ratio = _z(scene, other, moved) / scale / _z(scene, dense)
    assert np.quantile(np.abs(ratio - 1)[both], 0.95) < 1e-3
    assert np.median(np.abs(other.depth_std[both] / scale / dense.depth_std[both] - 1)) < 1e-2


def test_the_stage_estimates_depth_in_any_order_of_the_frames(scene: Scene, dense: Pointmaps, tmp_path: Path):
    """Of images whose names sort otherwise than the capture's frames; and what has pointmaps is left as it is."""
    order = np.array([3, 0, 6, 1, 5, 2, 4])  # row k of the capture is row order[k] by name
    names = tuple(f"{k}.png" for k in order)
    for name, image in zip(names, scene.images[order], strict=True):
        (tmp_path / name).write_bytes(encode_png(image))
    size = PINHOLE.width, PINHOLE.height
    capture = capture_of(scene.recon_from_camera[order], folder=tmp_path, images=names, image_size=size)
    by_name = np.argsort(order)
    sparse = reconstruction_of(
        scene.recon_from_camera[order],
        intrinsics=PINHOLE,
        tracks=replace(scene.tracks, image=by_name[scene.tracks.image]),
    )
    made = densify(capture, sparse, DepthOptions(pointmap_size_px=PINHOLE.width))
    assert made.dense.intrinsics == PINHOLE and not made.dense.is_predicted
    np.testing.assert_array_equal(made.dense.colors, scene.images[order])
    np.testing.assert_array_equal(made.tracks.image, sparse.tracks.image)
    for name in ("points_in_recon", "confidence", "reason", "depth_std"):
        np.testing.assert_array_equal(getattr(made.dense, name)[by_name], getattr(dense, name))
    assert densify(capture, made) is made
    # Its file gives it back.
    file = tmp_path / "depth.npz"
    write_depth(file, made)
    found = read_depth(file, sparse, capture)
    for name in ("points_in_recon", "confidence", "reason", "depth_std", "colors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made.dense, name))
    assert (read_depth(file, sparse, None).colors == 128).all()
