"""Each adapter against a network that answers with the truth in its package's own convention.

The images' colours say where in the original image a pixel lies, so that the networks know what was done to them,
and nothing is taken from the adapter: a resize, a crop, a half pixel or a camera the wrong way round shows.
"""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.geometry import inverse, rotation_angle, transform
from jcr.records import Intrinsics
from places import ROOT

sys.path.append(str(ROOT / "examples" / "backend_mapanything"))
import jcr_mapanything  # noqa: E402

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


def points_of(matrices: ndarray, depth: ndarray) -> ndarray:
    v, u = np.mgrid[: depth.shape[1], : depth.shape[2]]
    rays = np.einsum("nij,hwj->nhwi", np.linalg.inv(matrices), np.stack([u, v, np.ones_like(u)], -1))
    return rays * depth[..., None]


def edges(matrices: ndarray) -> ndarray:
    return matrices + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def unnormalised(images: Any) -> ndarray:
    from jcr.pointmaps.any_view import IMAGENET_MEAN, IMAGENET_STD

    return images.double().numpy().transpose(0, 2, 3, 1) * IMAGENET_STD + IMAGENET_MEAN


def networks(scene: Scene, given_to_network: dict[str, Any]) -> dict[str, Callable[[Any], Any]]:
    """By adapter, the prediction of a network that knows the truth; `told` collects what it was shown beside images."""
    import torch
    from torch import nn

    from jcr.pointmaps import da3

    def tensor(values: ndarray) -> Any:
        return torch.tensor(np.asarray(values, np.float32))

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.anchor = nn.Parameter(torch.zeros(1))

    class Da3(Network):
        def forward(self, images: Any, extrinsics: Any, intrinsics: Any) -> Any:
            matrices, depth = scene.seen(unnormalised(images[0]))
            poses = inverse(scene.recon_from_camera)
            poses[:, :3, 3] /= UNIT
            return {
                "depth": tensor(depth / UNIT)[None],
                "depth_conf": torch.ones(1, *depth.shape),
                "extrinsics": tensor(poses[:, :3])[None],
                "intrinsics": tensor(edges(matrices))[None],
            }

    class MapAnything:
        def infer(self, views: list[dict[str, Any]], **options: Any) -> list[dict[str, Any]]:
            images = np.concatenate([unnormalised(view["img"]) for view in views])
            matrices, depth = scene.seen(images)
            given_to_network.update(matrices=matrices, views=views)
            points = points_of(matrices, depth)
            mask = torch.ones(1, *depth.shape[1:], 1)
            mask[0, 0, 0] = 0
            return [
                {
                    "pts3d": tensor(mine @ pose[:3, :3].T + pose[:3, 3])[None],
                    "camera_poses": tensor(pose)[None],
                    "conf": torch.ones(1, *depth.shape[1:]),
                    "mask": mask,
                    "intrinsics": tensor(matrix)[None],
                }
                for mine, pose, matrix in zip(points, scene.recon_from_camera, matrices, strict=True)
            ]

    return {
        "da3": lambda views: da3.predict_views(Da3(), views),
        "mapanything": lambda views: jcr_mapanything.predict(MapAnything(), views),
    }


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1000, 700)], ids=str)
@pytest.mark.parametrize("name", ["da3", "mapanything"])
def test_an_adapter_undoes_its_packages_conventions(name: str, size: tuple[int, int]) -> None:
    from jcr.camera import rays
    from jcr.pointmaps.any_view import Views

    scene = Scene(*size)
    found = networks(scene, {})[name](Views(scene.colors, None))
    grid = found.grid
    assert all(edge % 14 == 0 for edge in grid.size)
    unit = 1.0 if found.is_metric else UNIT
    assert found.is_metric == (name == "mapanything")

    # The grid is where the adapter says, so that the true intrinsics on it give the true rays and depth.
    known = grid.grid_intrinsics(scene.pinhole)
    depth = scene.depths(np.tile(known.matrix, (COUNT, 1, 1)), grid.size[1], grid.size[0])
    off = np.linalg.norm(unit * found.x_in_camera - rays(known) * depth[..., None], axis=-1) / depth
    there = found.confidence > 0
    assert np.median(off[there]) < 5e-4 and there.mean() > 0.99
    assert (found.confidence[0, 0, 0] == 0) == (name == "mapanything")

    rotated = found.recon_from_camera[:, :3, :3] @ np.swapaxes(scene.recon_from_camera[:, :3, :3], 1, 2)
    assert np.degrees(rotation_angle(rotated)).max() < 1e-3
    np.testing.assert_allclose(
        unit * found.recon_from_camera[:, :3, 3], scene.recon_from_camera[:, :3, 3], atol=1e-6
    )


def test_intrinsics_are_given_in_the_packages_convention() -> None:
    from jcr.pointmaps.any_view import Views

    scene, given_to_network = Scene(640, 480), {}
    networks(scene, given_to_network)["mapanything"](Views(scene.colors, scene.pinhole))
    given = np.concatenate([view["intrinsics"].numpy() for view in given_to_network["views"]])
    np.testing.assert_allclose(given, given_to_network["matrices"], rtol=2e-3, atol=0.06)


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


def packaged(images: ndarray) -> Any:
    """Images as the package of Depth Anything 3 prepares them; skips where its parts cannot be imported."""
    try:
        from depth_anything_3.utils.io.input_processor import InputProcessor  # type: ignore[import-not-found]
    except (ImportError, RuntimeError) as error:
        pytest.skip(f"the package's own reading of images cannot be imported: {error}")
    return InputProcessor()(list(images), num_workers=1)[0]


def test_depth_anything_3_agrees_with_its_package() -> None:
    """Its network with random weights, its preparation of images, its post-processing: ours gives the same."""
    pytest.importorskip("depth_anything_3")
    import torch

    from jcr.pointmaps import da3
    from jcr.pointmaps.any_view import Views, normalised

    images = np.random.default_rng(0).integers(0, 256, (2, 300, 410, 3), np.uint8)
    torch.manual_seed(0)
    network = da3.build("da3-small")
    grid = da3.grid_of((410, 300))
    theirs = packaged(images)
    ours = normalised(np.stack([da3.resized_for_grid(image, grid, da3.LONG_EDGE) for image in images]), "cpu")
    assert ours.shape == theirs.shape and torch.allclose(ours, theirs, atol=1e-5)

    from depth_anything_3.utils.io.output_processor import OutputProcessor  # type: ignore[import-not-found]

    with torch.inference_mode():
        answer = OutputProcessor()(network(theirs[None]))
    found = da3.predict_views(network, Views(images, None))
    there = found.confidence > 0
    assert there.mean() > 0.99
    np.testing.assert_allclose(found.x_in_camera[..., 2][there], answer.depth[there], rtol=1e-5)
    np.testing.assert_allclose(found.confidence[there], answer.conf[there], rtol=1e-5)
    expected = da3.rays_of_edges(answer.intrinsics, *answer.depth.shape[1:]) * answer.depth[..., None]
    np.testing.assert_allclose(found.x_in_camera[there], expected[there], rtol=1e-5)
    assert found.recon_from_camera is not None
    np.testing.assert_allclose(inverse(found.recon_from_camera)[:, :3], answer.extrinsics, atol=1e-5)
