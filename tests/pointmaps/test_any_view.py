"""Test the refinement of an any-view prediction and its calibration on a printed plane with known cameras."""

from dataclasses import replace
from pathlib import Path

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
        from jcr.pointmaps.posed import PosedPointmaps

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
            grid=grid,
            x_in_camera=points,
            confidence=np.ones(depth.shape, np.float32),
            recon_from_camera=recon,
            is_metric=False,
        )


def reconstructed(capture: Capture, predict) -> Reconstruction:
    from jcr.pointmaps.any_view import reconstruct_any_view

    weights = Weights(Path("weights"), "weights", "Apache-2.0")
    return reconstruct_any_view(capture, lambda weights, device: predict, weights, "cpu", "da3")


@pytest.fixture(scope="module")
def found(capture: Capture) -> Reconstruction:
    """By one pass of the model."""
    return reconstructed(capture, Fake())


def test_matches_by_colour_put_predicted_cameras_right(capture: Capture, found: Reconstruction) -> None:
    from jcr.calibration.stage import calibrate_reconstruction

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
    from jcr.pointmaps.grid import ImageGrid, prepare_images
    from jcr.pointmaps.refine import refine

    unknown = replace(capture, intrinsics=None)
    images = prepare_images(unknown, lambda size: ImageGrid.uncropped(size, size))
    predicted = Fake(rotation_deg=0.3, bend=0.0)(Views(images.colors, None))
    guess = replace(INTRINSICS, fx=INTRINSICS.fx * 1.03, fy=INTRINSICS.fy * 1.03)
    refined = refine(unknown, images, predicted.on_rays(predicted.grid.grid_intrinsics(guess)), guess)
    assert refined is not None
    assert refined[0].intrinsics.fx == pytest.approx(INTRINSICS.fx, rel=0.01)


def test_without_matches_the_cameras_have_the_published_errors(capture: Capture, tmp_path: Path) -> None:
    for name in capture.images:
        Image.new("RGB", capture.image_size, (40, 0, 0)).save(tmp_path / name)
    found = reconstructed(replace(capture, folder=tmp_path, intrinsics=None), Fake())
    assert "too few matches" in found.notes[-1] and len(found.tracks.image) == 0
    assert found.evidence is not None and found.predicted_focal is not None
    assert "known to 5 % only" in found.warnings[-1]
    std = np.sqrt(np.diag(found.evidence.covariance)).reshape(-1, 6)
    assert (std[0] == 0).all() and np.degrees(std[1:, 3:]).min() > 1
    assert found.predicted_focal[0] == pytest.approx(INTRINSICS.fx, rel=1e-3)
