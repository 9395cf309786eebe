"""Kinematic alignment: the true hand-eye transform, scale and noise of the robot."""

from dataclasses import dataclass

import numpy as np

from benchmarks.synthetic_pairs import PairErrors, synthetic_pairs
from jcr.geometry import apply, inverse, rotation_exp, rotation_log, transform
from jcr.reconstruct.dust3r.pair_graph import complete_pairs
from jcr.reconstruct.global_alignment.alignment import AlignOptions, pinhole_of
from jcr.reconstruct.global_alignment.gauss_newton import Problem, Solution, solve_free
from jcr.reconstruct.global_alignment.kinematic import HandEyeCameras, solve_kinematic
from jcr.reconstruct.global_alignment.observations import weight_is_log
from jcr.reconstruct.global_alignment.pairs import PairPredictions

SMALL = (48, 36)
FEW_PIXELS = AlignOptions(pixels=432)


@dataclass(frozen=True)
class Truth:
    """A camera on a gripper, and predictions of what it sees."""

    predictions: PairPredictions
    base_from_gripper: np.ndarray
    """As the robot reports it."""
    gripper_from_camera: np.ndarray
    scale: float
    """Metres per geometric mean of the pairs' units."""
    depth: np.ndarray
    base_from_camera: np.ndarray


def robot(images: int, seed: int, errors: PairErrors | None = None, noise: tuple[float, float] = (0.0, 0.0)):
    """A random hand-eye transform under a synthetic scene; `noise` in metres and radians per axis."""
    predictions, truth = synthetic_pairs(complete_pairs(images), SMALL, errors, seed)
    rng = np.random.default_rng(100 + seed)
    gripper_from_camera = transform(rotation_exp(rng.normal(0, 0.8, 3)), rng.uniform(-0.08, 0.08, 3))
    exact = truth.base_from_camera @ inverse(gripper_from_camera)
    jitter = transform(
        rotation_exp(noise[1] * rng.normal(size=(images, 3))), noise[0] * rng.normal(size=(images, 3))
    )
    scale = float(np.exp(-np.log(truth.pair_unit).mean()))
    return Truth(predictions, exact @ jitter, gripper_from_camera, scale, truth.depth, truth.base_from_camera)


def tied(predictions: PairPredictions, base_from_gripper: np.ndarray) -> tuple[Solution, HandEyeCameras]:
    problem = Problem(predictions, pinhole_of(predictions, FEW_PIXELS), weight_is_log(predictions))
    return solve_kinematic(problem, solve_free(problem, FEW_PIXELS), base_from_gripper)


def test_exact_input_gives_the_hand_eye_transform_metres_and_the_base_frame():
    truth = robot(6, 0, PairErrors(pixel=0.0, warp=0.0, outliers=0.0))
    found, cameras = tied(truth.predictions, truth.base_from_gripper)
    # Six views of 48x36 float32 points.
    np.testing.assert_allclose(cameras.gripper_from_camera, truth.gripper_from_camera, atol=1e-4)
    assert abs(found.state.log_pair_scale.mean() - np.log(truth.scale)) < 1e-4
    np.testing.assert_allclose(found.state.recon_from_camera, truth.base_from_camera, atol=1e-4)
    np.testing.assert_allclose(cameras.base_from_gripper, truth.base_from_gripper, atol=1e-4)


def test_gripper_poses_move_only_within_the_robots_noise():
    noise = 0.002, 0.006
    truth = robot(6, 3, noise=noise)
    found, cameras = tied(truth.predictions, truth.base_from_gripper)
    moved = inverse(truth.base_from_gripper) @ cameras.base_from_gripper
    assert 0.2 * noise[0] < np.abs(moved[:, :3, 3]).mean() < 2 * noise[0]
    assert 0.2 * noise[1] < np.abs(rotation_log(moved[:, :3, :3])).mean() < 2 * noise[1]
    np.testing.assert_allclose(
        found.state.recon_from_camera, cameras.base_from_gripper @ cameras.gripper_from_camera, atol=1e-12
    )


def test_motions_without_rotation_leave_the_translation_open_and_the_scale_known():
    truth = robot(4, 0)
    rng = np.random.default_rng(0)
    # All cameras look the same way, so that gripper motions are translations.
    poses = truth.base_from_gripper.copy()
    poses[:, :3, :3] = poses[0, :3, :3]
    poses[:, :3, 3] = poses[0, :3, 3] + rng.uniform(-0.1, 0.1, (4, 3))
    cameras = poses @ truth.gripper_from_camera
    relative = inverse(cameras)[:, None] @ cameras[None]
    predictions = truth.predictions
    first_view = predictions.pts3d.copy()
    second_view = np.empty_like(first_view)
    for e, (n, m) in enumerate(predictions.edges):
        second_view[e] = apply(relative[n, m], truth.depth[m][..., None] * _ray(predictions)).astype(
            np.float32
        )
        first_view[e] = (truth.depth[n][..., None] * _ray(predictions)).astype(np.float32)
    still = PairPredictions(
        edges=predictions.edges,
        pts3d=first_view,
        conf=predictions.conf,
        pts3d_in_other_view=second_view,
        conf2=predictions.conf2,
    )
    found, cameras = tied(still, poses)
    sigma = np.sqrt(np.linalg.inv(cameras.normal).diagonal()[:3])
    assert sigma.max() > 1.0
    assert abs(found.state.log_pair_scale.mean()) < 0.05


def _ray(predictions: PairPredictions) -> np.ndarray:
    height, width = predictions.conf.shape[1:]
    y, x = np.mgrid[:height, :width]
    focal = 0.95 * width
    return np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x, float)], axis=-1)
