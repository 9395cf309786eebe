"""Kinematic alignment: the true hand-eye transform and scale, gain over free alignment, honest spread."""

from dataclasses import dataclass

import numpy as np
import pytest

from benchmarks.synthetic_pairs import PairErrors, synthetic_pairs
from jcr.errors import InputError
from jcr.geometry import apply, inverse, rotation_exp, rotation_log, transform
from jcr.handeye.closed_form import initial_estimate
from jcr.reconstruct.dust3r.pair_graph import complete_pairs
from jcr.reconstruct.global_alignment.align import AlignOptions, align
from jcr.reconstruct.global_alignment.kinematic import (
    KinematicAlignment,
    KinematicOptions,
    align_kinematic,
)
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


def hand_eye_error(truth: Truth, found: KinematicAlignment) -> np.ndarray:
    """Translation (m), rotation vector (rad), log scale: true less found, as `covariance` orders them."""
    turn = truth.gripper_from_camera[:3, :3] @ found.gripper_from_camera[:3, :3].T
    return np.concatenate(
        [
            truth.gripper_from_camera[:3, 3] - found.gripper_from_camera[:3, 3],
            rotation_log(turn),
            [np.log(truth.scale / found.scale)],
        ]
    )


def test_exact_input_gives_the_hand_eye_transform_metres_and_the_base_frame():
    truth = robot(3, 0, PairErrors(pixel=0.0, warp=0.0, outliers=0.0))
    found = align_kinematic(truth.predictions, truth.base_from_gripper, KinematicOptions((0.0, 0.0)))
    # Three views of 48x36 float32 points.
    assert np.abs(hand_eye_error(truth, found)).max() < 1e-4
    np.testing.assert_allclose(found.alignment.recon_from_camera, truth.base_from_camera, atol=1e-4)
    np.testing.assert_allclose(found.alignment.depth, truth.depth, rtol=1e-4)
    np.testing.assert_array_equal(found.base_from_gripper, truth.base_from_gripper)


@pytest.mark.slow
def test_few_images_give_more_than_free_alignment_and_hand_eye_after_it():
    free, kinematic = [], []
    for seed in range(8):
        truth = robot(4, seed)
        alignment = align(truth.predictions, FEW_PIXELS)
        guess, scale, _ = initial_estimate(truth.base_from_gripper, alignment.recon_from_camera)
        found = align_kinematic(
            truth.predictions, truth.base_from_gripper, KinematicOptions((0.0, 0.0), FEW_PIXELS)
        )
        free.append(
            [np.linalg.norm(guess[:3, 3] - truth.gripper_from_camera[:3, 3]), abs(scale / truth.scale - 1)]
        )
        error = hand_eye_error(truth, found)
        kinematic.append([np.linalg.norm(error[:3]), abs(error[6])])
    (free_translation, free_scale), (translation, scale) = (
        np.median(free, axis=0),
        np.median(kinematic, axis=0),
    )
    assert translation < 0.7 * free_translation
    assert scale < free_scale
    assert translation < 2e-3


@pytest.mark.slow
def test_covariance_covers_the_error():
    noise = 0.0005, 0.0017
    squared = []
    for seed in range(8):
        truth = robot(5, seed, noise=noise)
        found = align_kinematic(
            truth.predictions, truth.base_from_gripper, KinematicOptions(noise, FEW_PIXELS)
        )
        error = hand_eye_error(truth, found)
        squared.append(error @ np.linalg.solve(found.covariance, error))
    # 8 draws of a chi-squared with 7 degrees of freedom: their mean is outside once in 1000 times.
    assert 3.3 < np.mean(squared) < 12.5


def test_gripper_poses_move_only_within_the_robots_noise():
    noise = 0.002, 0.006
    truth = robot(6, 3, noise=noise)
    found = align_kinematic(truth.predictions, truth.base_from_gripper, KinematicOptions(noise, FEW_PIXELS))
    moved = inverse(truth.base_from_gripper) @ found.base_from_gripper
    assert 0.2 * noise[0] < np.abs(moved[:, :3, 3]).mean() < 2 * noise[0]
    assert 0.2 * noise[1] < np.abs(rotation_log(moved[:, :3, :3])).mean() < 2 * noise[1]
    np.testing.assert_allclose(
        found.alignment.recon_from_camera, found.base_from_gripper @ found.gripper_from_camera, atol=1e-12
    )


def test_a_wrong_gripper_pose_is_named():
    truth = robot(6, 1)
    poses = truth.base_from_gripper.copy()
    poses[2, :3, 3] += [0.02, 0.0, 0.0]
    found = align_kinematic(truth.predictions, poses, KinematicOptions((0.0005, 0.0017), FEW_PIXELS))
    assert len(found.alignment.warnings) == 1
    assert "#2" in found.alignment.warnings[0]


def test_motions_without_rotation_leave_the_translation_open_and_say_so():
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
    still = PairPredictions(predictions.edges, first_view, predictions.conf, second_view, predictions.conf2)
    found = align_kinematic(still, poses, KinematicOptions((0.0005, 0.0017), FEW_PIXELS))
    assert np.sqrt(np.diag(found.covariance)[:3]).max() > 1.0
    assert np.sqrt(found.covariance[6, 6]) < 0.05


def _ray(predictions: PairPredictions) -> np.ndarray:
    height, width = predictions.conf.shape[1:]
    y, x = np.mgrid[:height, :width]
    focal = 0.95 * width
    return np.stack([(x - width / 2) / focal, (y - height / 2) / focal, np.ones_like(x, float)], axis=-1)


def test_bad_input_is_refused():
    truth = robot(3, 0)
    with pytest.raises(InputError, match="2 gripper poses for 3 images"):
        align_kinematic(truth.predictions, truth.base_from_gripper[:2])
    with pytest.raises(InputError, match="3 images or more"):
        align_kinematic(robot(2, 0).predictions, truth.base_from_gripper[:2])
