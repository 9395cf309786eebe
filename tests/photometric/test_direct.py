"""Direct alignment finds the camera on plain tables, says how surely, and refuses what it cannot tell."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.camera import rays
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.geometry import apply, rotation_between_deg, rotation_exp, transform
from jcr.photometric.coarse_to_fine import after_step
from jcr.photometric.direct import exposure_gains, pyramid, reconstruct_direct
from jcr.photometric.residuals import (
    Cameras,
    Level,
    energy,
    equations,
    make_level,
    search_depths,
    strong_edges,
)
from jcr.records import Intrinsics
from simulation.capture import SimulateOptions, simulate
from simulation.truth import read_truth

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A capture without any texture, and its truth."""
    folder = tmp_path_factory.mktemp("direct") / "plain"
    simulate(
        folder, SimulateOptions(images=6, seed=315, texture=False, truth="scene", unknown_intrinsics=True)
    )
    return read_capture(folder), read_truth(folder)


def test_a_plain_table_calibrates_the_camera_from_nothing(plain):
    capture, truth = plain
    reconstruction = reconstruct_direct(capture)
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    assert hand_eye.converged and hand_eye.inliers.all()
    errors = hand_eye.gripper_from_camera[:3, 3] - truth.gripper_from_camera[:3, 3]
    assert np.linalg.norm(errors) < 3e-3
    assert rotation_between_deg(hand_eye.gripper_from_camera[:3, :3], truth.gripper_from_camera[:3, :3]) < 0.3
    assert (np.abs(errors) < 4 * np.sqrt(np.diag(hand_eye.covariance)[:3])).all()
    assert reconstruction.intrinsics.fx == pytest.approx(truth.intrinsics.fx, rel=0.01)
    # The tracks are points of the table and the objects, in the unit that the calibration found.
    x = hand_eye.scale * reconstruction.tracks.points_in_recon
    height = apply(truth.base_from_camera[0], x)[:, 2] - truth.table_height
    assert np.mean((height > -0.01) & (height < 0.25)) > 0.8


@pytest.mark.long
def test_a_image_of_another_pose_is_left_out_and_named(plain):
    capture, truth = plain
    poses = capture.base_from_gripper.copy()
    poses[4] = poses[0]
    reconstruction = reconstruct_direct(replace(capture, base_from_gripper=poses))
    assert reconstruction.image_index.tolist() == [0, 1, 2, 3, 5]
    assert f"fit nowhere near their poses: {capture.images[4]}" in " ".join(reconstruction.notes)
    x = calibrate_reconstruction(
        replace(capture, base_from_gripper=poses), reconstruction
    ).gripper_from_camera
    assert np.linalg.norm(x[:3, 3] - truth.gripper_from_camera[:3, 3]) < 5e-3


def test_images_of_different_exposure_are_evened(plain):
    capture, truth = plain
    images = [read_image(capture.folder / name) for name in capture.images]
    level = pyramid(images, truth.intrinsics)[60]
    cameras = Cameras(truth.base_from_camera)
    np.testing.assert_array_equal(exposure_gains(level, cameras), 1)  # what differs is shading
    factor = np.array([0.75, 1.3, 1.0, 0.9, 1.1, 1.0])
    found = exposure_gains(level.times(factor), cameras) * factor
    left = np.abs(np.log(found) - np.log(found).mean()).max()
    assert left < 0.1 < 0.25 < np.abs(np.log(factor)).max()


def test_images_of_nothing_are_refused(plain, tmp_path):
    capture, _ = plain
    for name in capture.images:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        Image.new("RGB", capture.image_size, (120, 110, 100)).save(tmp_path / name)
    with pytest.raises(RejectedError, match="one colour"):
        reconstruct_direct(replace(capture, folder=tmp_path))


GRID = Intrinsics(70.0, 70.0, 39.5, 29.5, 80, 60)


def cameras_over_a_plane() -> Cameras:
    """Four cameras half a metre above z = 0, which look at the origin."""
    rng = np.random.default_rng(1)
    rotation = rotation_exp(rng.normal(0, 0.15, (4, 3))) @ np.diag([1.0, -1.0, -1.0])
    return Cameras(transform(rotation, -0.5 * rotation[..., 2]))


def painted(cameras: Cameras) -> Level:
    """What they see of a smooth painting on that plane."""
    pose = cameras.base_from_camera
    ray = np.einsum("nij,hwj->nhwi", pose[:, :3, :3], rays(GRID))
    center = pose[:, None, None, :3, 3]
    x = center - center[..., 2:] / ray[..., 2:] * ray
    wave = np.stack(
        [np.sin(30 * x[..., 0]), np.sin(25 * x[..., 1] + 1), np.cos(20 * (x[..., 0] + x[..., 1]))], -1
    )
    return make_level((0.5 + 0.3 * wave).astype(np.float32), GRID, GRID.height)


@pytest.mark.parametrize("tied", [True, False])
def test_gradient_is_that_of_the_energy(tied):
    cameras = cameras_over_a_plane()
    level = painted(cameras)
    rng = np.random.default_rng(2)
    off = Cameras(
        cameras.base_from_camera @ transform(rotation_exp(rng.normal(0, 0.01, (4, 3))), np.zeros(3)), 1.02
    )
    host, x_px = strong_edges(level, 50)
    points, _ = search_depths(level, off, host, x_px, np.full((1, 4), 0.5), 0.2, 2.0)
    system = equations(level, off, points, 0.2, tied)
    # Without the depths' elimination.
    gradient = (
        system.gradient + system.by_depth * (system.depth_gradient / system.depth_information)[:, None]
    ).sum(0)
    step = 1e-3
    slope = np.zeros_like(gradient)
    for k, direction in enumerate(step * np.eye(len(gradient))):
        ahead, behind = (energy(level, after_step(off, sign * direction), points, 0.2) for sign in (1, -1))
        slope[k] = (ahead - behind) / (2 * step)
    cosine = slope @ gradient / (np.linalg.norm(slope) * np.linalg.norm(gradient))
    assert cosine > 0.99
