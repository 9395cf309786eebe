"""The lens: distortion against OpenCV, its inverse, where it folds over, the half pixels of resampling."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jcr.camera import (
    distort,
    fold_distance_px,
    pinhole_inside,
    rays,
    resized,
    undistort,
    undistort_image,
)
from jcr.records import Intrinsics

WIDE = Intrinsics(634.6, 634.1, 641.95, 358.99, 1280, 720, (-0.0606, 0.0727, -0.00025, 0.00053, -0.0236))
BARREL = Intrinsics(300.0, 310.0, 322.0, 236.0, 640, 480, (-0.22, 0.04, 0.001, -0.002, -0.002))
PINCUSHION = Intrinsics(500.0, 500.0, 310.0, 245.0, 640, 480, (0.15, 0.05, -0.001, 0.001, 0.01))
FOLDING = Intrinsics(898.3, 901.1, 649.4, 362.5, 1280, 720, (0.0119, 0.7232, 0.00036, -0.00038, -2.4673))
"""A published calibration of a real camera: points near the corners had no weight in it."""


@pytest.mark.parametrize("lens", [WIDE, BARREL, PINCUSHION, FOLDING])
def test_distortion_is_opencvs(lens: Intrinsics) -> None:
    x = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    points = np.concatenate([x, np.ones((200, 1))], axis=1)
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix, np.array(lens.distortion))[0]
    np.testing.assert_allclose(distort(lens, x), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", [WIDE, BARREL, PINCUSHION])
def test_every_pixel_of_the_frame_has_its_ray(lens: Intrinsics) -> None:
    u, v = np.meshgrid(np.linspace(-0.5, lens.width - 0.5, 33), np.linspace(-0.5, lens.height - 0.5, 25))
    x_px = np.stack([u, v], axis=-1)
    np.testing.assert_allclose(distort(lens, undistort(lens, x_px)), x_px, atol=1e-8)
    assert fold_distance_px(lens) is None


def test_fold_is_found_where_the_radius_stops_growing() -> None:
    # r(1 - k r²) is largest at r = 1/√(3k), where it is two thirds of that.
    lens = Intrinsics(400.0, 400.0, 639.5, 359.5, 1280, 720, (-0.4, 0.0, 0.0, 0.0, 0.0))
    fold = fold_distance_px(lens)
    assert fold == pytest.approx(400 * 2 / 3 / np.sqrt(1.2), rel=1e-3)
    # The same fold is harmless when it lies outside the frame: a crop of the same camera.
    assert fold_distance_px(replace(lens, width=300, height=200, cx=149.5, cy=99.5)) is None


def test_fold_of_a_published_calibration() -> None:
    radius = np.linspace(0, 1, 100_001)
    k1, k2, _, _, k3 = FOLDING.distortion
    distorted = radius * (1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6)
    expected = FOLDING.fx * distorted[np.argmax(np.diff(distorted) < 0)]
    fold = fold_distance_px(FOLDING)
    assert fold is not None and expected < np.hypot(640, 360)
    assert fold == pytest.approx(expected, rel=0.01)


def test_a_frame_wider_than_the_model_reaches_counts_as_folded() -> None:
    # Its corners are seen at 87°, beyond the 84° to which rays are followed.
    lens = Intrinsics(20.0, 20.0, 319.5, 239.5, 640, 480)
    assert fold_distance_px(lens) is not None


@pytest.mark.parametrize("lens", [WIDE, BARREL, PINCUSHION])
def test_pinhole_grid_stays_inside_the_frame_and_touches_it(lens: Intrinsics) -> None:
    pinhole = pinhole_inside(lens, 320)
    assert max(pinhole.width, pinhole.height) == 320
    edges = [-0.5, pinhole.width - 0.5], [-0.5, pinhole.height - 0.5]
    u, v = np.meshgrid(np.linspace(*edges[0], 50), np.linspace(*edges[1], 50))
    x = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy], axis=-1)
    x_px = distort(lens, x)
    room = np.minimum(x_px + 0.5, [lens.width - 0.5, lens.height - 0.5] - x_px)
    assert room.min() > -0.01
    assert room.min() < 0.5


def test_without_distortion_the_grid_is_the_frame_resized() -> None:
    lens = Intrinsics(600.0, 590.0, 300.0, 250.0, 640, 480)
    assert pinhole_inside(lens, 320) == pytest.approx(resized(lens, 320, 240))


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_resampled_pixels_show_what_their_rays_see(factor: int) -> None:
    lens = Intrinsics(220.0, 220.0, 120.0, 90.0, 252, 192, (-0.1, 0.02, 0.001, 0.001, 0.0))
    u, v = np.meshgrid(np.arange(252), np.arange(192))
    image = np.stack([u, v, 255 - u], axis=-1).astype(np.uint8)  # every pixel says where it is
    pinhole = pinhole_inside(lens, 252 // factor)
    seen = undistort_image(image, lens, pinhole).astype(float)
    expected = distort(lens, rays(pinhole)[..., :2])
    difference = (seen[..., :2] - expected)[2:-2, 2:-2]
    assert np.abs(difference.mean((0, 1))).max() < 0.05
    assert np.abs(difference).max() < 0.6
