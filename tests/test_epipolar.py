"""The hand-eye transform from rough correspondences alone, and what it refuses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jcr.errors import InputError, NotTrustedError
from jcr.geometry import inverse, rotation_between_deg, transform
from jcr.reconstruct.dust3r.attended import of_pairs
from jcr.reconstruct.epipolar import EpipolarHandEye, Matches, hand_eye_from_matches
from jcr.records import Intrinsics

SIZE, FOCAL = (64, 48), 60.0
PINHOLE = Intrinsics(FOCAL, FOCAL, 31.5, 23.5, *SIZE)


def seen(seed: int, noise_px: float, wrong: float) -> tuple[Matches, np.ndarray, np.ndarray]:
    """Matches of 8 pictures of a table with things on it, poses of the gripper, and gripper_from_camera."""
    rng = np.random.default_rng(seed)
    gripper_from_camera = transform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 0.05)
    cameras = []
    for _ in range(8):
        eye = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.35, 0.6)])
        z = np.array([*rng.uniform(-0.05, 0.05, 2), 0]) - eye
        z /= np.linalg.norm(z)
        x = np.cross([np.sin(t := rng.uniform(-0.8, 0.8)), np.cos(t), 0], z)
        x /= np.linalg.norm(x)
        cameras.append(transform(np.stack([x, np.cross(z, x), z], 1), eye))
    base_from_camera = np.stack(cameras)
    points = np.concatenate([rng.uniform(-0.3, 0.3, (200, 2)), rng.uniform(0, 0.1, (200, 1))], 1)
    in_camera = np.einsum("nij,pj->npi", inverse(base_from_camera)[:, :3, :3], points)
    in_camera += inverse(base_from_camera)[:, None, :3, 3]
    px = FOCAL * in_camera[..., :2] / in_camera[..., 2:] + [31.5, 23.5]
    inside = ((px >= 0) & (px < SIZE)).all(-1)
    i, j, p = (inside[:, None] & inside[None]).nonzero()
    kept = rng.permutation(np.flatnonzero(i < j))[:2000]
    i, j, p = i[kept], j[kept], p[kept]
    first, second = px[i, p], px[j, p] + noise_px * rng.normal(size=(len(p), 2))
    lost = rng.random(len(p)) < wrong
    second[lost] = rng.uniform(0, SIZE, (lost.sum(), 2))
    matches = Matches(i, j, first, second, np.full(len(p), 0.5), SIZE)
    return matches, base_from_camera @ inverse(gripper_from_camera), gripper_from_camera


def off(found: EpipolarHandEye, true: np.ndarray) -> tuple[float, float]:
    x = found.gripper_from_camera
    return 1e3 * float(np.linalg.norm(x[:3, 3] - true[:3, 3])), float(
        rotation_between_deg(x[:3, :3], true[:3, :3])
    )


@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_give_the_truth_from_no_start(seed: int):
    matches, base_from_gripper, true = seen(seed, 0.0, 0.0)
    mm, deg = off(hand_eye_from_matches(matches, base_from_gripper, PINHOLE), true)
    # The prior of the offset pulls by less than this.
    assert mm < 3 and deg < 0.15
    free = hand_eye_from_matches(matches, base_from_gripper)
    assert off(free, true)[1] < 0.15 and free.focal_px[0] == pytest.approx(FOCAL, rel=0.005)
    assert free.rival_share < 0.6 < 0.99 < free.share


@pytest.mark.parametrize("seed", range(3))
def test_matches_pixels_off_and_wrong_by_a_third_do_too(seed: int):
    matches, base_from_gripper, true = seen(seed, 1.5, 0.3)
    mm, deg = off(hand_eye_from_matches(matches, base_from_gripper, PINHOLE), true)
    assert mm < 20 and deg < 2.5


def test_tokens_that_look_at_each_other_are_matches_and_others_are_not():
    """Two images of 4 x 5 tokens: 6 is seen as 12, a little towards 13; 7 looks where nobody looks back, 0 is at an
    edge."""
    there, back = np.full((1, 20, 20), 1e-3), np.full((1, 20, 20), 1e-3)
    there[0, 6, [12, 13]] = 0.75, 0.2
    back[0, 12, 6] = 0.95
    there[0, 7, 8] = 0.9
    there[0, 0, 11] = back[0, 11, 0] = 0.9
    first, second, place1, place2, weight = of_pairs(np.array([3]), np.array([7]), there, back, (4, 5))
    assert first.tolist() == [3, 3] and second.tolist() == [7, 7]
    np.testing.assert_allclose(weight, np.sqrt(0.75 * 0.95))
    assert place1[0].tolist() == [1, 1] and place2[1].tolist() == [2, 2]
    # Of 12 and the eight around it: (0.75 * 2 + 0.2 * 3) / 0.95, but for what the others have.
    np.testing.assert_allclose(place2[0], [2.21, 2.0], atol=0.01)
    np.testing.assert_allclose(place1[1], [1, 1], atol=0.01)


def test_what_does_not_fit_the_motion_is_refused():
    matches, base_from_gripper, _ = seen(0, 1.0, 0.9)
    with pytest.raises(NotTrustedError, match="fit the robot's motion"):
        hand_eye_from_matches(matches, base_from_gripper, PINHOLE)
    with pytest.raises(NotTrustedError, match="places were found again"):
        hand_eye_from_matches(matches.rows(np.arange(10)), base_from_gripper)
    with pytest.raises(InputError, match="3 or more"):
        hand_eye_from_matches(matches, base_from_gripper[:2])
