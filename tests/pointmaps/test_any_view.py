"""Any-view networks: the adapter's conventions, refinement by matches, and the calibration on a printed plane."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy import ndarray
from PIL import Image
from scipy.spatial.transform import Rotation

from jcr.camera import rays
from jcr.geometry import (
    Similarity,
    fit_similarity,
    inverse,
    retract,
    rotation_angle,
    rotation_between_deg,
    transform,
)
from jcr.hub import Weights
from jcr.records import Capture, Intrinsics, Reconstruction
from scenes import capture_of

pytestmark = pytest.mark.slow  # draws, and torch
COUNT, INTRINSICS = 6, Intrinsics(420.0, 420.0, 199.5, 149.5, 400, 300)
X = transform(
    Rotation.from_euler("xyz", [10, -20, 40], degrees=True).as_matrix(), np.array([0.03, -0.05, 0.08])
)


def base_from_camera() -> ndarray:
    """Cameras around a place on the plane z = 0."""
    rng = np.random.default_rng(2)
    azimuth = np.linspace(0, 1.5 * np.pi, COUNT)
    far = np.array([0.4, 0.65, 0.5, 0.7, 0.45, 0.6])
    eyes = far[:, None] * np.stack([0.45 * np.cos(azimuth), 0.45 * np.sin(azimuth), np.full(COUNT, 0.9)], -1)
    target = np.column_stack([rng.uniform(-0.05, 0.05, (COUNT, 2)), np.zeros(COUNT)])
    forward = (target - eyes) / np.linalg.norm(target - eyes, axis=1, keepdims=True)
    right = (
        np.cross(forward, [0.0, 0.0, 1.0])
        / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]), axis=1)[:, None]
    )
    level = np.stack([right, np.cross(forward, right), forward], -1)
    return transform(level @ Rotation.from_euler("z", rng.uniform(-1, 1, (COUNT, 1))).as_matrix(), eyes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a printed plane."""
    place = tmp_path_factory.mktemp("plane")
    rng = np.random.default_rng(0)
    layers = [
        cv2.resize(rng.uniform(0, 1, (n, n)), (1500, 1500), interpolation=cv2.INTER_CUBIC)
        for n in (40, 100, 250)
    ]
    print_ = np.sum(layers, axis=0)
    print_ = (255 * (print_ - print_.min()) / np.ptp(print_)).astype(np.uint8)
    # Print pixels from metres on the plane: 1500 over 1.5 m, its middle at the origin.
    pixel_from_plane = np.array([[1000.0, 0, 749.5], [0, 1000.0, 749.5], [0, 0, 1]])
    for k, pose in enumerate(base_from_camera()):
        camera_from_plane = inverse(pose)[:3][:, [0, 1, 3]]
        image_from_print = INTRINSICS.matrix @ camera_from_plane @ np.linalg.inv(pixel_from_plane)
        image = cv2.warpPerspective(
            print_, image_from_print, (INTRINSICS.width, INTRINSICS.height), flags=cv2.INTER_AREA
        )
        image = np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
        Image.fromarray(image).convert("RGB").save(place / f"{k}.png")
    return place


@pytest.fixture(scope="module")
def capture(folder: Path) -> Capture:
    rng = np.random.default_rng(5)
    noise = rng.normal(0, 1, (COUNT, 6)) * ([2e-4] * 3 + [4e-4] * 3)
    gripper = retract(base_from_camera() @ inverse(X), noise)
    return capture_of(gripper, folder=folder, image_size=(400, 300), intrinsics=INTRINSICS)


class Fake:
    """Model that predicts the truth with errors."""

    def __init__(self, rotation_deg: float = 0.8, bend: float = 0.02) -> None:
        self.errors = rotation_deg, bend

    def __call__(self, views):
        from jcr.pointmaps.da3 import grid_of
        from jcr.pointmaps.posed_pointmaps import PosedPointmaps

        rotation_deg, bend = self.errors
        rng = np.random.default_rng(1)
        grid = grid_of(views.size)
        intrinsics = grid.grid_intrinsics(INTRINSICS)
        poses, ray = base_from_camera(), rays(intrinsics)
        y, x = np.mgrid[-1 : 1 : 1j * grid.size[1], -1 : 1 : 1j * grid.size[0]]
        depth = np.stack([-pose[2, 3] / (ray @ pose[2, :3]) for pose in poses])
        depth *= np.stack([1 + bend * (a * x + b * y + c * x * y) for a, b, c in rng.normal(size=(COUNT, 3))])
        step = rng.normal(size=(COUNT, 6)) * ([0.01] * 3 + [np.radians(rotation_deg)] * 3)
        recon = inverse(poses[0]) @ retract(poses, step)
        recon[:, :3, 3] *= 2
        points = (2 * depth[..., None] * ray).astype(np.float32)
        return PosedPointmaps(
            grid=grid, x_in_camera=points, confidence=np.ones(depth.shape, np.float32),
            recon_from_camera=recon, is_metric=False,
        )  # fmt: skip


def reconstructed(capture: Capture, predict) -> Reconstruction:
    from jcr.pointmaps.any_view import reconstruct_any_view

    weights = Weights(Path("weights"), "weights", "Apache-2.0")
    return reconstruct_any_view(capture, lambda weights, device: predict, weights, "cpu", "da3")


def test_matches_by_colour_put_predicted_cameras_right(capture: Capture) -> None:
    from jcr.calibration.calibrate import calibrate_reconstruction

    found = reconstructed(capture, Fake())
    assert found.evidence is None and "refined" in found.notes[-1]
    truth = base_from_camera()
    base, scale = fit_similarity(truth[:, :3, 3], found.recon_from_camera[:, :3, 3])
    assert scale == pytest.approx(0.5, rel=0.02), "the model's own unit stays"
    off = Similarity(base, scale)(found.recon_from_camera[:, :3, 3]) - truth[:, :3, 3]
    assert np.linalg.norm(off, axis=1).max() < 5e-4, "10 mm as predicted"
    rotated = rotation_between_deg(base[:3, :3] @ found.recon_from_camera[:, :3, :3], truth[:, :3, :3])
    assert np.max(rotated) < 0.05, "0.8° as predicted"

    # The depth is bent back: the plane is one plane.
    in_base = Similarity(base, scale)(found.dense.points_in_recon.reshape(-1, 3).astype(float))
    assert np.abs(in_base[:, 2]).max() < 4e-3, "20 mm as predicted"

    hand_eye = calibrate_reconstruction(capture, found)
    assert hand_eye.converged and hand_eye.uncertainty.joint is not None
    assert np.linalg.norm(hand_eye.gripper_from_camera[:3, 3] - X[:3, 3]) < 2e-3
    assert rotation_between_deg(hand_eye.gripper_from_camera[:3, :3], X[:3, :3]) < 0.1
    assert len(found.tracks.image) > 1000 and not found.tracks.from_pointmaps


def test_an_unknown_focal_length_is_adjusted(capture: Capture) -> None:
    from jcr.pointmaps.any_view import Views
    from jcr.pointmaps.image_grid import ImageGrid, prepare_images
    from jcr.pointmaps.reconstruction import refine

    unknown = replace(capture, intrinsics=None)
    images = prepare_images(unknown, lambda size: ImageGrid.uncropped(size, size))
    predicted = Fake(rotation_deg=0.3, bend=0.0)(Views(images.colors, None))
    guess = replace(INTRINSICS, fx=INTRINSICS.fx * 1.03, fy=INTRINSICS.fy * 1.03)
    refined = refine(unknown, images, predicted.on_rays(predicted.grid.grid_intrinsics(guess)), guess)
    assert refined[0].intrinsics.fx == pytest.approx(INTRINSICS.fx, rel=0.01)


def test_without_matches_the_cameras_have_the_published_errors(capture: Capture, tmp_path: Path) -> None:
    for name in capture.images:
        Image.new("RGB", capture.image_size, (40, 0, 0)).save(tmp_path / name)
    found = reconstructed(replace(capture, folder=tmp_path, intrinsics=None), Fake())
    assert "too few matches" in found.notes[-1] and len(found.tracks.image) == 0
    assert "known to 5 % only" in found.warnings[-1]
    std = np.sqrt(np.diag(found.evidence.covariance)).reshape(-1, 6)
    assert (std[0] == 0).all() and np.degrees(std[1:, 3:]).min() > 1
    assert found.predicted_focal[0] == pytest.approx(INTRINSICS.fx, rel=1e-3)


VIEWS = 3
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
        noise = np.random.default_rng(0).uniform(0, 1, (VIEWS, height, width, 3))
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
    depth = scene.depths(np.tile(known.matrix, (VIEWS, 1, 1)), grid.size[1], grid.size[0])
    off = np.linalg.norm(UNIT * found.x_in_camera - rays(known) * depth[..., None], axis=-1) / depth
    there = found.confidence > 0
    assert np.median(off[there]) < 5e-4 and there.mean() > 0.99
    rotated = found.recon_from_camera[:, :3, :3] @ np.swapaxes(scene.recon_from_camera[:, :3, :3], 1, 2)
    assert np.degrees(rotation_angle(rotated)).max() < 1e-3
    np.testing.assert_allclose(
        UNIT * found.recon_from_camera[:, :3, 3], scene.recon_from_camera[:, :3, 3], atol=1e-6
    )
