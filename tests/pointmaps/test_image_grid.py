"""Preprocessing against the published one, and the path of a pixel through resize, crop and intrinsics."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from jcr.capture.images import read_image
from jcr.pointmaps.image_grid import image_grid, prepare_images, resize_and_crop
from jcr.records import Intrinsics
from places import SHARED
from scenes import capture_of

FIXTURES = SHARED / "dust3r" / "fixtures"
SIZES = ("vga", "hd", "portrait", "square", "small", "odd", "k4", "wide")


@pytest.mark.parametrize("long_edge", [512, 224])
@pytest.mark.parametrize("name", SIZES)
def test_images_equal_the_published_preprocessing(name: str, long_edge: int) -> None:
    if not FIXTURES.is_dir():
        pytest.skip(f"the published preprocessing's outputs are not in {FIXTURES}")
    image = read_image(FIXTURES / "preprocess_in" / f"{name}.png")
    published = np.load(FIXTURES / "preprocess.npz")
    ours = resize_and_crop(image, image_grid((image.shape[1], image.shape[0]), long_edge))
    assert np.array_equal(ours.transpose(2, 0, 1), published[f"{name}_{long_edge}_u8"])
    assert np.array_equal([ours.shape[:2]], published[f"{name}_{long_edge}_shape"])


def test_grid_intrinsics_project_a_point_to_where_the_pixel_goes() -> None:
    intrinsics = Intrinsics(905.3, 911.8, 655.2, 348.9, 1283, 727)
    grid = image_grid((1283, 727))
    seen = grid.grid_intrinsics(intrinsics)
    x_in_camera = np.array([0.12, -0.07, 0.9])
    original = (intrinsics.matrix @ x_in_camera)[:2] / x_in_camera[2]
    on_grid = (seen.matrix @ x_in_camera)[:2] / x_in_camera[2]
    np.testing.assert_allclose(grid.grid_from_original(original), on_grid, atol=1e-10)
    back = grid.original_intrinsics(seen)
    np.testing.assert_allclose(back.matrix, intrinsics.matrix, atol=1e-10)


def test_a_distorted_capture_is_undistorted_and_pixels_find_their_way_back(tmp_path: Path) -> None:
    intrinsics = Intrinsics(600.0, 605.0, 322.0, 236.0, 640, 480, (-0.21, 0.08, 0.001, -0.0007, 0.0))
    x_in_camera = np.array([[-0.31, -0.2, 1.0], [0.28, 0.21, 1.0], [0.02, -0.18, 1.0]])
    spots, _ = cv2.projectPoints(
        x_in_camera, np.zeros(3), np.zeros(3), intrinsics.matrix, np.array(intrinsics.distortion)
    )
    spots = spots[:, 0]
    v, u = np.mgrid[:480, :640]
    image = sum(np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * 5.0**2)) for x, y in spots)
    Image.fromarray(np.repeat((255 * image).astype(np.uint8)[..., None], 3, 2)).save(tmp_path / "0.png")
    capture = capture_of(np.eye(4)[None], folder=tmp_path, images=("0.png",), intrinsics=intrinsics)

    prepared = prepare_images(capture)
    on_grid = x_in_camera @ prepared.intrinsics.matrix.T
    on_grid = on_grid[:, :2] / on_grid[:, 2:]
    np.testing.assert_allclose(prepared.grid_px(spots), on_grid, atol=1e-6)
    y, x = np.mgrid[: prepared.colors.shape[1], : prepared.colors.shape[2]]
    for spot in on_grid:
        near = prepared.colors[0, ..., 0] * (np.hypot(x - spot[0], y - spot[1]) < 14)
        centroid = np.array([(x * near).sum(), (y * near).sum()]) / near.sum()
        np.testing.assert_allclose(centroid, spot, atol=0.1)
