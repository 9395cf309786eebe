"""The adapter of Depth Anything 3 against a network that answers with the truth in its package's own convention.

The images' colours say where in the original image a pixel lies, so that the network knows what was done to them, and
nothing is taken from the adapter: a resize, a crop, a half pixel or a camera the wrong way round shows. The adapter of
the example is in tests/test_backend_package.py.
"""

from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.geometry import inverse, rotation_angle, transform
from jcr.records import Intrinsics

pytestmark = pytest.mark.slow  # torch
COUNT = 3
UNIT = 0.37
"""Metres that a network without a metric scale calls one."""


class Scene:
    """Views of the plane z = 0 in the recon frame, in images that say where their pixels lie."""

    def __init__(self, width: int, height: int) -> None:
        middle = (width - 1) / 2, (height - 1) / 2
        self.pinhole = Intrinsics(0.9 * width, 0.9 * width, *middle, width, height)
        eyes = np.array([[0.2, 0.1, -0.7], [-0.2, 0.2, -0.6], [0.0, -0.3, -0.8]])
        rotations = Rotation.from_euler("xyz", [[8, 15, 20], [-14, -16, -40], [20, 2, 70]], degrees=True)
        self.recon_from_camera = transform(rotations.as_matrix(), eyes)
        v, u = np.mgrid[:height, :width]
        ramp = np.stack([(u + 0.5) / width, (v + 0.5) / height, np.zeros((height, width))], -1)
        # Dithered: eight bits alone are steps of four pixels.
        noise = np.random.default_rng(0).uniform(0, 1, (COUNT, height, width, 3))
        self.colors = np.clip(np.floor(255 * ramp + noise), 0, 255).astype(np.uint8)

    def seen(self, images: ndarray) -> tuple[ndarray, ndarray]:
        """K of images (n,h,w,3) in [0, 1] from their colours, pixel (0, 0) a centre, and depth along z (n,h,w)."""
        count, height, width = images.shape[:3]
        intrinsics = self.pinhole
        matrices = np.tile(np.eye(3), (count, 1, 1))
        inner = slice(2, -2)
        for k, image in enumerate(images):
            v, u = np.mgrid[:height, :width]
            for axis, (pixel, size, focal, centre) in enumerate(
                (
                    (u, intrinsics.width, intrinsics.fx, intrinsics.cx),
                    (v, intrinsics.height, intrinsics.fy, intrinsics.cy),
                )
            ):
                there = image[inner, inner, axis] * size - 0.5
                slope, start = np.polyfit(pixel[inner, inner].ravel(), there.ravel(), 1)
                matrices[k, axis, axis], matrices[k, axis, 2] = focal / slope, (centre - start) / slope
        return matrices, self.depths(matrices, height, width)

    def depths(self, matrices: ndarray, height: int, width: int) -> ndarray:
        v, u = np.mgrid[:height, :width]
        pixels = np.stack([u, v, np.ones_like(u)], -1)
        rays = np.einsum("nij,hwj->nhwi", np.linalg.inv(matrices), pixels)
        pose = self.recon_from_camera
        return -pose[:, 2, 3, None, None] / np.einsum("nj,nhwj->nhw", pose[:, 2, :3], rays)


def knowing(scene: Scene) -> Any:
    """Return a network of Depth Anything 3 that answers with the truth, its pixels counted from their edges."""
    import torch

    from jcr.pointmaps.any_view import IMAGENET_MEAN, IMAGENET_STD

    def tensor(values: ndarray) -> Any:
        return torch.tensor(np.asarray(values, np.float32))[None]

    class Da3(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.anchor = torch.nn.Parameter(torch.zeros(1))

        def forward(self, images: Any, extrinsics: Any, intrinsics: Any) -> Any:
            pixels = images[0].double().numpy().transpose(0, 2, 3, 1)
            matrices, depth = scene.seen(pixels * IMAGENET_STD + IMAGENET_MEAN)
            poses = inverse(scene.recon_from_camera)
            poses[:, :3, 3] /= UNIT
            return {
                "depth": tensor(depth / UNIT),
                "depth_conf": tensor(np.ones(depth.shape)),
                "extrinsics": tensor(poses[:, :3]),
                "intrinsics": tensor(matrices + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),
            }

    return Da3()


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1000, 700)], ids=str)
def test_an_adapter_undoes_its_packages_conventions(size: tuple[int, int]) -> None:
    from jcr.camera import rays
    from jcr.pointmaps import da3
    from jcr.pointmaps.any_view import Views

    scene = Scene(*size)
    found = da3.predict_views(knowing(scene), Views(scene.colors, None))
    grid = found.grid
    assert all(edge % 14 == 0 for edge in grid.size) and not found.is_metric
    # The grid is where the adapter says, so that the true intrinsics on it give the true rays and depth.
    known = grid.grid_intrinsics(scene.pinhole)
    depth = scene.depths(np.tile(known.matrix, (COUNT, 1, 1)), grid.size[1], grid.size[0])
    off = np.linalg.norm(UNIT * found.x_in_camera - rays(known) * depth[..., None], axis=-1) / depth
    there = found.confidence > 0
    assert np.median(off[there]) < 5e-4 and there.mean() > 0.99
    rotated = found.recon_from_camera[:, :3, :3] @ np.swapaxes(scene.recon_from_camera[:, :3, :3], 1, 2)
    assert np.degrees(rotation_angle(rotated)).max() < 1e-3
    np.testing.assert_allclose(
        UNIT * found.recon_from_camera[:, :3, 3], scene.recon_from_camera[:, :3, 3], atol=1e-6
    )


def test_a_network_of_another_release_is_named() -> None:
    from torch import nn

    from jcr.errors import InputError
    from jcr.pointmaps import da3
    from jcr.pointmaps.any_view import Views

    class Other(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.anchor = nn.Linear(1, 1)

        def forward(self, *arguments: Any) -> Any:
            return {}

    scene = Scene(640, 480)
    with pytest.raises(InputError, match="gave no depth of shape"):
        da3.predict_views(Other(), Views(scene.colors, None))
