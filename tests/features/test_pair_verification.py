"""Pairs of images: two-view geometries, agreement with the robot's motions, rotation of X, and which are matched."""

import numpy as np
import pycolmap
import pytest
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.estimation.closed_form import motions
from jcr.features.matchers import estimate_geometry, hidden, still_cells
from jcr.features.pair_choice import hand_eye_of_pairs
from jcr.features.pair_verification import Pair, classify_pairs, rotation_of_x
from jcr.features.two_view import CameraMotion, camera_motions
from jcr.geometry import apply, inverse, rotation_angle, rotation_exp, transform
from jcr.records import Intrinsics
from jcr.sfm.model import colmap_camera
from simulation.problems import HandEyeProblem, hand_eye_problem

N = 8
FOCAL = 600.0
NORMAL = np.array([-0.48, 0.36, 0.8])
DISTANCE = 0.4
"""Of the plane in camera i, m."""


def seen(
    i_from_j: np.ndarray, plane: bool, rng: np.random.Generator, noise_px: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of points half a metre ahead in two cameras."""
    x_in_i = np.column_stack([rng.uniform(-0.1, 0.1, (200, 2)), np.zeros(200)])
    x_in_i[:, 2] = (DISTANCE - x_in_i[:, :2] @ NORMAL[:2]) / NORMAL[2]
    if not plane:
        x_in_i[:, 2] += rng.uniform(-0.1, 0.2, 200)
    x_in_j = (x_in_i - i_from_j[:3, 3]) @ i_from_j[:3, :3]
    noise = noise_px / FOCAL
    rays = [x[:, :2] / x[:, 2:] + rng.normal(scale=noise, size=(200, 2)) for x in (x_in_i, x_in_j)]
    return rays[0], rays[1]


def homography(i_from_j: np.ndarray) -> np.ndarray:
    """j from i, of the plane."""
    r, t = i_from_j[:3, :3].T, -i_from_j[:3, :3].T @ i_from_j[:3, 3]
    return r + np.outer(t, NORMAL) / DISTANCE


def essential(i_from_j: np.ndarray) -> np.ndarray:
    r, t = i_from_j[:3, :3].T, -i_from_j[:3, :3].T @ i_from_j[:3, 3]
    return np.cross(np.eye(3), -t / np.linalg.norm(t)) @ r


GEOMETRY = pycolmap.TwoViewGeometry()
MOTION = transform(rotation_exp(np.array([0.1, -0.3, 0.2])), np.array([0.15, 0.02, 0.03]))


def test_a_reading_is_the_motion_as_surely_as_it_shows():
    errors, stds = [], []
    for seed in range(25):
        ray_i, ray_j = seen(MOTION, False, np.random.default_rng(seed))
        best = camera_motions(ray_i, ray_j, FOCAL, essential(MOTION), None)[0]
        errors.append(float(rotation_angle(best.rotation) - rotation_angle(MOTION[:3, :3])))
        stds.append(best.angle_std())
    # Half of 200 matches are counted as independent, so that it promises less than these have.
    assert 0.4 < np.std(errors) / np.mean(stds) < 1.2


def test_a_plane_has_two_readings_and_one_is_right():
    toward = transform(MOTION[:3, :3], np.array([0.05, 0.02, 0.12]))
    ray_i, ray_j = seen(toward, True, np.random.default_rng(0))
    found = camera_motions(ray_i, ray_j, FOCAL, None, homography(toward))
    gaps = [np.degrees(rotation_angle(r.rotation.T @ toward[:3, :3])) for r in found]
    assert len(found) == 2
    assert min(gaps) < 1 and max(gaps) > 5


def problem_and_pairs(seed: int) -> tuple[HandEyeProblem, list[Pair]]:
    problem = hand_eye_problem(np.random.default_rng(seed), N)
    camera = motions(problem.base_from_gripper @ problem.gripper_from_camera)
    sure = np.diag([1e-5] * 3 + [1e-4] * 2)
    rows = np.zeros((30, 2), dtype=int)

    def unit(v: np.ndarray) -> np.ndarray:
        return v / np.linalg.norm(v)

    return problem, [
        Pair(
            (i, j),
            rows,
            (CameraMotion(camera[i, j, :3, :3], unit(camera[i, j, :3, 3]), sure, 0.5),),
            GEOMETRY,
        )
        for i in range(N)
        for j in range(i + 1, N)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_wrong_pairs_are_contradicted_and_right_ones_are_not(seed: int):
    rng = np.random.default_rng(seed)
    problem, pairs = problem_and_pairs(seed)
    wrong = set(rng.permutation(len(pairs))[:12].tolist())
    for k in wrong:
        motion = pairs[k].motions[0]
        bad = CameraMotion(rotation_exp(rng.normal(size=3)), motion.direction, motion.covariance, 0.5)
        pairs[k] = Pair(pairs[k].key, pairs[k].rows, (bad,), GEOMETRY)
    gate = classify_pairs(pairs, motions(problem.base_from_gripper))
    assert rotation_angle(gate.of_x.rotation.T @ problem.gripper_from_camera[:3, :3]) < 0.01
    assert {pair.key for pair in gate.contradicted} == {pairs[k].key for k in wrong}
    x = hand_eye_of_pairs(gate, motions(problem.base_from_gripper))
    assert np.linalg.norm(x[:3, 3] - problem.gripper_from_camera[:3, 3]) < 5e-3


def test_the_second_reading_of_a_plane_is_tried():
    problem, pairs = problem_and_pairs(0)
    right = pairs[3].motions[0]
    other = CameraMotion(
        rotation_exp(np.array([0.5, 0.0, 0.0])) @ right.rotation, right.direction, right.covariance, 0.4
    )
    pairs[3] = Pair(pairs[3].key, pairs[3].rows, (other, right), GEOMETRY)
    gate = classify_pairs(pairs, motions(problem.base_from_gripper))
    assert not gate.contradicted
    assert next(pair for pair in gate.confirmed if pair.key == pairs[3].key).motions[0] is right


def test_what_keeps_its_pixel_while_the_gripper_moves_is_hidden():
    rng = np.random.default_rng(0)
    fixed = rng.uniform([200, 300], [280, 470], (60, 2))
    images = [np.concatenate([fixed, rng.uniform(0, [640, 480], (300, 2))]) for _ in range(6)]
    raw = {(i, j): np.column_stack([np.arange(360)] * 2) for i in range(6) for j in range(i + 1, 6)}
    still = still_cells(images, raw, (640, 480), raw)
    assert hidden(fixed, still).mean() > 0.9
    assert still.mean() < 0.12
    moving = [rng.uniform(0, [640, 480], (300, 2)) for _ in range(6)]
    few = {key: rows[:300] for key, rows in raw.items()}
    assert not still_cells(moving, few, (640, 480), few).any()


def test_one_axis_fixes_nothing():
    x = rotation_exp(np.array([0.3, -0.2, 1.0]))
    gripper = rotation_exp(np.linspace(0.2, 1.5, 10)[:, None] * np.array([0.0, 0.0, 1.0]))
    assert rotation_of_x(gripper, x.T @ gripper @ x, np.full(10, 0.02)) is None


INTRINSICS = Intrinsics(500.0, 500.0, 319.5, 239.5, 640, 480)


def keypoints(seed: int) -> list[Float[ndarray, "400 2"]]:
    """Of 400 points in two images; row k of one is row k of the other."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.7], (400, 3))
    second = transform(rotation_exp(np.array([0.05, 0.25, 0.1])), np.array([-0.3, 0.05, 0.0]))
    return [
        project(INTRINSICS, apply(inverse(pose), points)) + rng.normal(scale=0.5, size=(400, 2))
        for pose in (np.eye(4), second)
    ]


def rows_of(right: int, seed: int) -> Int[ndarray, "400 2"]:
    """Matches, the first `right` of them right."""
    rows = np.repeat(np.arange(400)[:, None], 2, axis=1)
    rows[right:, 1] = right + np.random.default_rng(seed).permutation(400 - right)
    return rows


@pytest.mark.parametrize("seed", range(3))
def test_three_right_matches_of_ten_are_found_and_none_make_no_pair(seed: int):
    x_px, camera = keypoints(seed), colmap_camera(INTRINSICS, True)
    found = estimate_geometry(x_px, camera, (0, 1), rows_of(120, seed), 0, True)
    inside = np.asarray(found.inlier_matches)[:, 0]
    assert (inside < 120).sum() > 0.93 * 120
    assert (inside >= 120).sum() < 0.06 * 280, "only by chance near their epipolar line"
    nothing = estimate_geometry(x_px, camera, (0, 1), rows_of(0, seed), 0, True)
    assert nothing is None or len(nothing.inlier_matches) < 0.1 * 400
