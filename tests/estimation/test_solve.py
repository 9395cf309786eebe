"""The calibration from poses: known answers, gauges of the closed form, outliers, coverage, degenerate motions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.options import CalibrateOptions
from jcr.estimation.closed_form import closed_form
from jcr.estimation.pose_equations import PRIOR_STD, pose_residuals
from jcr.estimation.problem import pose_problem
from jcr.estimation.robot_noise import Equations, left_out, smooth_errors, solve_equations
from jcr.estimation.solve import solve
from jcr.findings import FindingKind
from jcr.geometry import inverse, retract, rotation_exp, scale_translation, step_between, transform
from refusal import refused
from scenes import pairs_of
from simulation.poses import random_hand_eye
from simulation.problems import HandEyeProblem, disturbed, error, hand_eye_problem

NOISE = (5e-4, np.radians(0.1))


@pytest.mark.parametrize("count", [3, 5, 10])
def test_exact_poses_give_the_exact_answer(count):
    for seed in range(2):
        problem = hand_eye_problem(np.random.default_rng(seed), count)
        x, scale, _ = closed_form(problem.base_from_gripper, problem.recon_from_camera)
        assert np.abs(error(problem, x, scale)).max() < 1e-7
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        assert np.abs(error(problem, solved.gripper_from_camera, solved.scale)).max() < 1e-8


def test_a_similarity_of_the_reconstruction_changes_nothing_but_scale():
    rng = np.random.default_rng(4)
    problem = hand_eye_problem(rng, 9, robot_noise=NOISE)
    before = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    factor = float(np.exp(rng.uniform(-3, 3)))
    other_from_recon = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    moved = inverse(other_from_recon) @ scale_translation(problem.recon_from_camera, factor)
    after = solve_hand_eye(problem.base_from_gripper, moved)
    assert np.allclose(before.gripper_from_camera, after.gripper_from_camera, atol=1e-8)
    assert after.scale * factor == pytest.approx(before.scale, rel=1e-8)
    assert np.allclose(before.covariance, after.covariance, rtol=1e-4, atol=1e-12)


def test_the_order_of_images_does_not_matter_to_the_last_bit():
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 12, robot_noise=NOISE)
    problem.base_from_gripper[4, :3, 3] += 0.05
    before = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    order = rng.permutation(12)
    after = solve_hand_eye(problem.base_from_gripper[order], problem.recon_from_camera[order])
    assert (before.gripper_from_camera == after.gripper_from_camera).all()
    assert before.scale == after.scale
    assert (before.inliers[order] == after.inliers).all()


@pytest.mark.parametrize(
    ("count", "wrong", "kind"),
    [
        *((10, 3, kind) for kind in ("shuffled", "stale", "mirrored")),
        pytest.param(20, 6, "stale", marks=pytest.mark.slow),
        # More poses than robot_noise.MOST_FOR_SIZES: images only join those that agree.
        pytest.param(60, 15, "shuffled", marks=pytest.mark.slow),
    ],
)
def test_wrong_poses_are_named_and_no_others(count, wrong, kind):
    for seed in range(2 if count < 60 else 1):
        rng = np.random.default_rng([seed, count])
        problem = hand_eye_problem(rng, count, robot_noise=NOISE)
        clean = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
        bad = rng.choice(count, wrong, replace=False)
        gripper = problem.base_from_gripper.copy()
        if kind == "shuffled":
            gripper[bad] = problem.base_from_gripper[np.roll(bad, 1)]
        elif kind == "stale":
            gripper[bad] = problem.base_from_gripper[(bad - 1) % count]
        else:
            mirror = np.diag([1.0, -1.0, 1.0, 1.0])
            gripper[bad] = mirror @ gripper[bad] @ mirror
        solved = solve_hand_eye(gripper, problem.recon_from_camera)
        assert sorted(np.flatnonzero(~solved.inliers)) == sorted(bad)
        assert [image.reason is not None for image in solved.images] == list(~solved.inliers)
        assert solved.converged
        # Fewer images know less, but the wrong ones must not pull.
        both = solved.covariance + clean.covariance
        gap = error(problem, solved.gripper_from_camera, solved.scale) - error(
            problem, clean.gripper_from_camera, clean.scale
        )
        assert gap @ np.linalg.solve(both, gap) < chi2.ppf(0.999, 7)


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, pytest.param(True, marks=pytest.mark.long)])
def test_the_95_percent_ellipsoid_covers_95_percent(given):
    inside, larger = np.zeros(2), []
    runs = 60 if given else 40
    for seed in range(runs):
        problem = hand_eye_problem(np.random.default_rng([7, seed]), 10, robot_noise=NOISE)
        solved = solve_hand_eye(
            problem.base_from_gripper, problem.recon_from_camera, robot_noise=NOISE if given else None
        )
        errors = error(problem, solved.gripper_from_camera, solved.scale)
        for k, part in enumerate((slice(0, 7), slice(0, 6))):
            squared = errors[part] @ np.linalg.solve(solved.covariance[part, part], errors[part])
            inside[k] += squared < chi2.ppf(0.95, part.stop)
        _, jacobian = pose_residuals(
            solved.gripper_from_camera, solved.scale, solved.base_from_recon.rigid, problem.base_from_gripper,
            problem.recon_from_camera,
        )  # fmt: skip
        whitened = jacobian.reshape(-1, 13) / np.tile(np.repeat(NOISE, 3), 10)[:, None]
        straight = np.linalg.inv(whitened.T @ whitened)[:7, :7]
        larger.append(np.sqrt(np.diag(solved.covariance) / np.diag(straight)))
    assert (inside / runs >= 0.90).all()
    if given:
        # That a robot repeats so well does not say that it is straight: sigma stays larger than that of a straight one.
        assert np.median(larger) < 1.2
    else:
        assert (inside / runs <= 0.98).all()


@pytest.mark.slow
def test_a_robot_noise_that_the_poses_contradict_is_not_believed():
    given, inside, runs = (1e-4, np.radians(0.02)), 0, 20
    for seed in range(runs):
        problem = hand_eye_problem(np.random.default_rng([8, seed]), 6, "varied", given, NOISE)
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera, robot_noise=given)
        errors = error(problem, solved.gripper_from_camera, solved.scale)
        inside += errors @ np.linalg.solve(solved.covariance, errors) < chi2.ppf(0.95, 7)
        # Whether at random or alike, six images hardly tell.
        assert min(np.divide(solved.robot_noise.together, given)) > 1.5
        assert any("more than the given robot noise" in warning for warning in solved.warnings)
    # Binomial: 19 ± 1; none where the given noise is believed.
    assert inside >= 16


def test_leave_one_out_error_is_that_of_a_fit_without_the_image():
    """Of errors that poses near each other share, the others tell a part of the one that is left out."""
    problem = hand_eye_problem(np.random.default_rng(9), 8, robot_noise=NOISE)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    full = solve_hand_eye(gripper, camera)
    unknowns = full.gripper_from_camera, full.scale, full.base_from_recon.rigid
    residual, jacobian = (of.reshape(48, -1) for of in pose_residuals(*unknowns, gripper, camera))
    prior = np.diag(np.r_[PRIOR_STD**-2.0, np.zeros(6)])
    alike, sizes = smooth_errors(gripper), np.log([4e-4, 2e-3, 2e-3])

    def of_rows(rows):
        return Equations(
            residual=residual[rows, 0], jacobian=jacobian[rows], prior_information=prior,
            prior_gradient=np.zeros(13), systematic=alike[np.ix_(rows, rows)],
        )  # fmt: skip

    everything = of_rows(np.arange(48))
    errors, covariance = left_out(solve_equations(everything, sizes), everything.random(sizes))
    v = everything.covariance(sizes)
    for k in range(8):
        mine, others = np.arange(6 * k, 6 * k + 6), np.delete(np.arange(48), np.arange(6 * k, 6 * k + 6))
        without = solve_equations(of_rows(others), sizes)
        gain = v[np.ix_(mine, others)] @ np.linalg.inv(v[np.ix_(others, others)])
        by_unknown = jacobian[mine] - gain @ jacobian[others]
        expected = residual[mine, 0] - gain @ residual[others, 0] + by_unknown @ without.step
        own = v[np.ix_(mine, mine)] - gain @ v[np.ix_(others, mine)]
        spread = own + by_unknown @ without.covariance @ by_unknown.T
        assert np.allclose(errors[k], expected, rtol=1e-4, atol=1e-9)
        assert np.allclose(covariance[k], spread, rtol=1e-4, atol=1e-4 * np.abs(spread).max())
    assert 0.5 * 1e3 * np.sqrt(3) * NOISE[0] < full.held_out.translation_mm < 4 * 1e3 * np.sqrt(3) * NOISE[0]


def test_the_error_of_an_unused_image_is_its_leave_one_out_error_beside_the_used_ones():
    problem = hand_eye_problem(np.random.default_rng(10), 9, robot_noise=NOISE)
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    x, scale, z = closed_form(gripper, camera)
    poses, start = pose_problem(gripper, camera, (x, float(scale), z))
    used = np.arange(9) != 4
    found = solve(replace(poses, used=used), start, averaged=False)
    every, sizes = found.poses.every, found.log_sizes
    expected, spread = left_out(solve_equations(every, sizes), every.random(sizes))
    errors, covariance = found.leave_one_out
    assert np.allclose(errors[4], expected[4], rtol=1e-4, atol=1e-9)
    assert np.allclose(covariance[4], spread[4], rtol=1e-4, atol=1e-4 * np.abs(spread[4]).max())


UNSEEN = {
    "two": "two images share",
    "translation": "pure translation",
    "one-axis": "one fixed axis",
    "planar": "planar or SCARA",
    "orbit": "look-at orbit",
    # A tool point that happens to lie on the optical axis makes an orbit of the pivot.
    "pivot": "all views rotate about one",
    "camera-centre": "its own centre",
}


@pytest.mark.parametrize("pattern", UNSEEN)
@pytest.mark.parametrize(("noise", "deviation_deg"), [((0.0, 0.0), 0.0), (NOISE, 3.0)])
def test_motions_that_show_too_little_are_named(pattern, deviation_deg, noise):
    problem = hand_eye_problem(
        np.random.default_rng(0), 10, pattern, noise, deviation=np.radians(deviation_deg)
    )
    solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    assert UNSEEN[pattern] in " ".join(solved.observability.unobservable)
    assert solved.observability.advice
    nearly = solved.observability.observable
    assert nearly == all("nearly" in name for name in solved.observability.unobservable)
    assert nearly or deviation_deg == 0.0 or pattern == "two"
    assert solved.verdict == "rejected" or (nearly and solved.warnings)
    if nearly:
        std = np.sqrt(np.diag(solved.covariance))
        too_uncertain = bool((std > [0.02] * 3 + [np.radians(3)] * 3 + [0.05]).any())
        assert too_uncertain == any(finding.kind is FindingKind.UNCERTAIN for finding in solved.findings)


def test_a_known_offset_cures_planar_motion_and_a_known_scale_cures_an_orbit():
    planar, orbit = (
        hand_eye_problem(np.random.default_rng(seed), 10, pattern, NOISE)
        for seed, pattern in ((10, "planar"), (11, "orbit"))
    )
    down = planar.true_base_from_gripper[0, 2, :3]  # the base's z axis in the gripper frame
    height = float(down @ planar.gripper_from_camera[:3, 3])
    for problem, known in (
        (planar, {"offset": (down, height, 1e-3)}),
        (orbit, {"scale": orbit.scale, "scale_std": 1e-3}),
    ):
        solved = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera, **known)
        assert solved.converged
        assert np.linalg.norm(error(problem, solved.gripper_from_camera, solved.scale)[:3]) < 5e-3


@pytest.mark.parametrize("is_metric", [True, False])
def test_a_known_height_is_part_of_the_stated_uncertainty(is_metric: bool):
    """Heights that were given to 1 mm were stated to ±47 mm and more: none of these draws was accepted."""
    noise = {"robot_noise": (1e-4, np.radians(0.02)), "camera_noise": (2e-4, np.radians(0.03))}
    for seed in range(4):
        problem = hand_eye_problem(np.random.default_rng(seed), 12, "planar", **noise)
        up = problem.true_base_from_gripper[0, 2, :3]
        height = CalibrateOptions(known_height=1e3 * float(up @ problem.gripper_from_camera[:3, 3]))
        camera = scale_translation(problem.recon_from_camera, problem.scale if is_metric else 1.0)
        pairs = pairs_of(problem.base_from_gripper, camera, is_metric=is_metric)
        solved = calibrate_pose_pairs(pairs, height)
        assert solved.verdict == "accepted", (seed, solved.doubt)
        step = step_between(solved.gripper_from_camera, problem.gripper_from_camera)
        assert step @ np.linalg.solve(solved.covariance[:6, :6], step) < 16.8  # 99 % of chi2 of 6
        assert solved.uncertainty.std[:3].max() < 1.2e-3


def test_a_flange_that_turns_about_one_axis_gives_the_rotation_that_its_positions_show():
    """Of 30 such arms 9 were told that their poses contradict the images, and rotations were up to 27° off."""
    for seed in range(5):
        rng, x = np.random.default_rng(seed), random_hand_eye(np.random.default_rng(seed))
        yaw = transform(
            rotation_exp(rng.uniform(-2.8, 2.8, (12, 1)) * np.array([0.0, 0.0, 1.0])), np.zeros(3)
        )
        gripper = transform(np.diag([1.0, -1.0, -1.0]), rng.uniform(-0.15, 0.15, (12, 3))) @ yaw
        recon_from_base = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
        camera = disturbed(recon_from_base @ gripper @ x, (2e-4, np.radians(0.03)), rng)
        reported = disturbed(gripper, (5e-5, np.radians(0.01)), rng)
        solved = solve_hand_eye(reported, camera, scale=1.0, camera_errors="none")
        assert solved.findings[0].kind is FindingKind.UNOBSERVABLE, (seed, solved.findings)
        step = step_between(solved.gripper_from_camera, x)
        assert np.degrees(np.linalg.norm(step[3:])) < 0.3, seed


@pytest.mark.parametrize(("gripper", "camera", "words"), [
    (np.eye(4), np.eye(4), "shape"),
    (np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(4), (4, 1, 1)), "4 camera poses for 3"),
    (np.tile(np.eye(4), (1, 1, 1)), np.tile(np.eye(4), (1, 1, 1)), "1 pose"),
    (np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), "0 pose"),
    (np.full((3, 4, 4), np.nan), np.tile(np.eye(4), (3, 1, 1)), "NaN"),
    ("poses", "poses", "not numbers"),
])  # fmt: skip
def test_what_cannot_be_poses_is_an_input_error(gripper, camera, words):
    with refused(words):
        solve_hand_eye(gripper, camera)


@pytest.mark.parametrize(("factor", "options", "words"), [
    (1e3, {}, "up to .* m from the base; these look like millimetres"),
    (1, {"names": ["a"]}, "names: 1 name for 8 poses"),
    (1, {"robot_noise": (1.0, 0.0)}, "robot_noise: .*must be two positive numbers"),
])  # fmt: skip
def test_wrong_units_and_arguments_are_input_errors(factor, options, words):
    problem = hand_eye_problem(np.random.default_rng(3), 8)
    gripper = problem.base_from_gripper * np.array([1, 1, 1, factor])
    gripper[:, 3, 3] = 1
    with refused(words):
        solve_hand_eye(gripper, problem.recon_from_camera, **options)


def test_equal_poses_are_rejected_without_a_warning_of_numpy():
    for seed in range(6):
        problem = hand_eye_problem(np.random.default_rng(seed), 2)
        gripper, camera = (
            np.stack([poses[0]] * 4) for poses in (problem.base_from_gripper, problem.recon_from_camera)
        )
        assert solve_hand_eye(gripper, camera).verdict == "rejected"


GROWTH = (3e-3, 3e-3)
"""m, rad per image."""


def drifting(seed: int, count: int = 20) -> tuple[HandEyeProblem, np.ndarray]:
    """Camera poses whose motions from one to the next have errors, as visual odometry has them."""
    rng = np.random.default_rng([seed, 8])
    problem = hand_eye_problem(rng, count, robot_noise=(2e-4, 5e-4))
    true = problem.recon_from_camera
    found = [true[0]]
    for before, after in zip(true[:-1], true[1:], strict=True):
        error_of_motion = transform(
            rotation_exp(GROWTH[1] * rng.normal(size=3)), GROWTH[0] / problem.scale * rng.normal(size=3)
        )
        found.append(found[-1] @ np.linalg.inv(before) @ after @ error_of_motion)
    return problem, np.stack(found)


def test_growing_errors_are_weighed_and_in_the_uncertainty():
    squared, metres = list[float](), dict[str, list[float]]()
    for seed in range(3):
        problem, camera = drifting(seed)
        for errors in ("independent", "in sequence"):
            solved = solve_hand_eye(problem.base_from_gripper, camera, camera_errors=errors)
            off = error(problem, solved.gripper_from_camera, solved.scale)[:6]
            metres.setdefault(errors, []).append(float(np.linalg.norm(off[:3])))
        squared.append(float(off @ np.linalg.solve(solved.covariance[:6, :6], off)))
    assert np.median(metres["in sequence"]) < 0.5 * np.median(metres["independent"])
    assert np.median(squared) < 12.6 and max(squared) < 25


def test_errors_of_camera_positions_do_not_bias_the_scale():
    """A fit that leaves the camera poses as given finds scales that are 6 % too small here, in the mean."""
    off, noise = list[float](), np.array([0.01] * 3 + [1e-4] * 3)
    for seed in range(10):
        rng = np.random.default_rng([seed, 10])
        problem = hand_eye_problem(rng, 20, robot_noise=(2e-4, 5e-4))
        camera = problem.recon_from_camera.copy()
        noise_in_recon = noise / np.repeat([problem.scale, 1.0], 3)
        camera[:, :3, 3] += noise_in_recon[:3] * rng.normal(size=(20, 3))
        covariance = np.diag(np.tile(noise_in_recon**2, 20))
        solved = solve_hand_eye(problem.base_from_gripper, camera, camera_covariance=covariance)
        off.append(float(np.log(solved.scale / problem.scale)))
    assert abs(np.mean(off)) < 0.02


repeatable = settings(derandomize=True, deadline=None, max_examples=30)
seeds = st.integers(0, 2**32 - 1)


def any_rigid(rng: np.random.Generator, angle: float):
    """A transform that rotates by `angle` about some axis."""
    axis = rng.normal(size=3)
    return transform(rotation_exp(angle * axis / np.linalg.norm(axis)), rng.normal(size=3))


def assert_same(found, expected, tolerance: float):
    (x, scale, z), (x_expected, scale_expected, z_expected) = found, expected
    assert np.abs(step_between(x, x_expected)).max() < tolerance
    assert scale == pytest.approx(scale_expected, rel=tolerance)
    assert np.abs(step_between(z, z_expected)).max() < 10 * tolerance


@repeatable
@given(seeds, st.integers(4, 9), st.sampled_from([0.0, 1e-12, 1e-7, 1e-3]))
def test_half_rotates_between_images_are_like_any_other_motion(seed, count, short_of):
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, count)
    gripper, x = problem.base_from_gripper.copy(), problem.gripper_from_camera
    for k in range(1, count, 2):
        gripper[k] = gripper[k - 1] @ any_rigid(rng, np.pi - short_of)
    z = any_rigid(rng, 1.0)
    camera = scale_translation(inverse(z) @ gripper @ x, 1 / problem.scale)
    assert_same(closed_form(gripper, camera), (x, problem.scale, z), 1e-6)


@repeatable
@given(seeds)
def test_half_rotates_alone_are_solved(seed):
    """About axes at right angles, which makes all motions rotations by 180°: the sines of all vanish together."""
    rotations = np.pi * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    rng = np.random.default_rng(seed)
    gripper = any_rigid(rng, 1.0) @ transform(rotation_exp(rotations), rng.normal(size=(3, 3)))
    x, z = any_rigid(rng, rng.uniform(0, np.pi)), any_rigid(rng, 1.0)
    camera = inverse(z) @ gripper @ x
    gripper = retract(gripper, 1e-6 * rng.normal(size=(3, 6)))
    found, _, base = closed_form(gripper, camera)
    # A rotation by 180° has an axis without a sign: an answer must explain the rotations, and may be another.
    assert np.abs((gripper @ found - base @ camera)[:, :3, :3]).max() < 5e-6
