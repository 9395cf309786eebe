"""Absolute camera poses against the truth: accuracy, calibrated covariance, outliers, planes, free focal length."""

import numpy as np
import pytest
from numpy import ndarray

from jcr.camera import project
from jcr.estimation.absolute_pose import absolute_pose
from jcr.geometry import apply, inverse, rotation_between_deg, rotation_exp, step_between, transform
from jcr.records import Intrinsics

CAMERA = Intrinsics(600.0, 605.0, 322.0, 238.0, 640, 480, (0.08, -0.12, 1e-3, -5e-4, 0.0))
TRUE = transform(rotation_exp(np.array([0.3, -2.4, 0.5])), np.array([0.4, -0.2, 0.6]))


def points_in_view(rng: np.random.Generator, count: int, depth: tuple[float, float]) -> ndarray:
    """Return points in frame a that the true camera sees."""
    x_in_camera = np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)), np.ones(count)])
    return apply(TRUE, rng.uniform(*depth, (count, 1)) * x_in_camera)


def pixels(points: ndarray, camera: Intrinsics = CAMERA) -> ndarray:
    return project(camera, apply(inverse(TRUE), points))


@pytest.mark.parametrize("camera", [
    CAMERA,
    Intrinsics(600.0, 600.0, 319.5, 239.5, 640, 480),
    Intrinsics(300.0, 300.0, 319.5, 239.5, 640, 480, (0.02, -0.01, 0.0, 0.0), model="fisheye"),
])  # fmt: skip
def test_exact_pixels_give_the_exact_pose(camera: Intrinsics):
    points = points_in_view(np.random.default_rng(0), 30, (0.4, 1.0))
    found = absolute_pose(pixels(points, camera), points, camera)
    assert found is not None and found.inlier.all() and found.rival is None
    assert np.abs(step_between(TRUE, found.a_from_camera)).max() < 1e-7


def test_half_of_the_points_may_be_wrong():
    rng = np.random.default_rng(1)
    points = points_in_view(rng, 100, (0.4, 1.0))
    x_px = pixels(points) + rng.normal(scale=0.5, size=(100, 2))
    wrong = np.arange(100) % 2 == 1
    x_px[wrong] = rng.uniform([0, 0], [640, 480], (50, 2))
    found = absolute_pose(x_px, points, CAMERA)
    assert found.inlier[~wrong].mean() > 0.95 and found.inlier[wrong].sum() < 3
    assert np.abs(step_between(TRUE, found.a_from_camera) / np.sqrt(np.diag(found.covariance))).max() < 4
    assert 0.35 < found.std_px < 0.65


@pytest.mark.slow
@pytest.mark.parametrize(("point_std", "noise_px"), [(2e-4, 0.3)])
def test_the_covariance_holds_with_that_of_the_points(point_std: float, noise_px: float):
    """Squared distances from the truth in the stated covariance have the mean of chi squared with 6 degrees."""
    rng = np.random.default_rng(3)
    points = points_in_view(rng, 60, (0.4, 1.0))
    shape = rng.normal(size=(60, 3, 3))
    spread = point_std**2 * shape @ np.swapaxes(shape, 1, 2)
    roots = np.linalg.cholesky(spread + 1e-18 * np.eye(3))
    squared, noise = [], []
    for _ in range(150):
        moved = points + (roots @ rng.normal(size=(60, 3, 1)))[..., 0]
        x_px = pixels(points) + rng.normal(scale=noise_px, size=(60, 2))
        found = absolute_pose(x_px, moved, CAMERA, spread if point_std else None, gate_px=3.0)
        step = step_between(found.a_from_camera, TRUE)
        squared.append(step @ np.linalg.solve(found.covariance, step))
        noise.append(found.std_px)
    # The mean of 150 has a standard deviation of sqrt(12 / 150) = 0.28.
    assert 5.0 < np.mean(squared) < 7.5
    assert np.median(noise) == pytest.approx(noise_px, rel=0.1)


def test_a_far_plane_has_two_poses():
    rng = np.random.default_rng(4)
    corners = np.array([[x, y, 0.0] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
    for side, distance, is_ambiguous in ((0.08, 0.4, False), (0.01, 0.8, True)):
        a_from_camera = inverse(
            transform(rotation_exp(np.array([0.35, 0.1, 0.2])), np.array([0, 0, distance]))
        )
        x_px = project(CAMERA, apply(inverse(a_from_camera), side * corners)) + rng.normal(
            scale=0.1, size=(9, 2)
        )
        found = absolute_pose(x_px, side * corners, CAMERA, planar=True)
        assert found is not None and (found.rival is not None) == is_ambiguous
        poses = [found.a_from_camera, *([found.rival] if found.rival is not None else [])]
        apart = min(rotation_between_deg(pose[:3, :3], a_from_camera[:3, :3]) for pose in poses)
        assert apart < (0.5 if not is_ambiguous else 12)


def test_a_focal_length_is_found_with_the_pose():
    rng = np.random.default_rng(5)
    points = points_in_view(rng, 120, (0.3, 1.2))
    x_px = pixels(points) + rng.normal(scale=0.3, size=(120, 2))
    x_px[::6] = rng.uniform([0, 0], [640, 480], (20, 2))
    guess = Intrinsics(1000.0, 1000.0 * 605 / 600, 322.0, 238.0, 640, 480, CAMERA.distortion)
    found = absolute_pose(x_px, points, guess, focal="free")
    assert found is not None and found.covariance.shape == (7, 7)
    std = np.sqrt(np.diag(found.covariance))
    assert abs(np.log(found.camera.fx / 600)) < 4 * std[6] and std[6] < 0.01
    assert np.abs(step_between(TRUE, found.a_from_camera) / std[:6]).max() < 4


def test_corners_that_no_pose_fits_give_none():
    """A detector returned these corners beside the board; the pose went to infinity, where its matrix is singular."""
    x_px = np.array([
        [1248.2, 350.3], [1241.2, 392.9], [1232.5, 432.6], [1224.1, 471.3], [1161.8, 333.2], [1158.6, 376.7],
        [1151.0, 416.1], [1143.5, 454.7], [1112.6, 344.9], [1118.2, 369.3], [1110.6, 408.1], [1077.2, 484.6],
    ])  # fmt: skip
    corners = np.column_stack([*(0.05 * one.ravel() for one in np.indices((3, 4))[::-1]), np.zeros(12)])
    camera = Intrinsics(1371.02278154, 1371.02278154, 960.5, 540.5, 1920, 1080)
    assert absolute_pose(x_px, corners, camera, gate_px=10.0, planar=True) is None
