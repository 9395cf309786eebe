"""The adjustment: derivatives, accuracy and noise on simulated observations, and the uncertainty of points."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.cameras import answered
from benchmarks.references import placed as points_along
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.record import Calibration
from jcr.camera import parameters, unproject, with_parameters
from jcr.estimation import elimination
from jcr.estimation.arms import arm_named
from jcr.estimation.elimination import Derivatives, Sightings, with_fixed_points, without_points
from jcr.estimation.intrinsics_prior import (
    ESTIMATED,
    FIXED,
    MEASURED,
    TYPICAL,
    CameraPrior,
    camera_with_prior,
    size_of,
)
from jcr.estimation.point_uncertainty import (
    bounds_at,
    point_covariance,
    point_in_base,
    scene_points,
    scene_uncertainty,
    within_95,
)
from jcr.estimation.problem import (
    OF_IMAGE,
    PRISM,
    stepped,
    with_observations,
    wrist_arm,
    wrist_problem,
)
from jcr.estimation.projection import derivatives, view_of
from jcr.estimation.solve import Solution, solve, uncertainty_of
from jcr.geometry import apply, inverse, retract
from jcr.records import Intrinsics, RobotNoise, Tracks, Uncertainty
from simulation.cells import Kind, cell_problem
from simulation.problems import INTRINSICS, HandEyeProblem, bent_problem, error, hand_eye_problem, observed

EXACT_CAMERA = camera_with_prior(INTRINSICS, FIXED)


def solved(
    problem: HandEyeProblem, tracks: Tracks, camera: CameraPrior = EXACT_CAMERA, **options
) -> Solution:
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    return solve(
        *wrist_problem(
            wrist_arm(problem.base_from_gripper),
            (start.gripper_from_camera, start.scale, start.base_from_recon.rigid),
            problem.recon_from_camera,
            camera,
            tracks,
            **options,
        )
    )


@pytest.mark.parametrize("views", [2, 3, 8])
def test_noise_of_the_images_is_found_from_short_tracks_too(views: int):
    # A point seen twice takes up three of its four errors.
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 8, robot_noise=(1e-4, np.radians(0.01)))
    tracks = observed(problem, rng, 400, 0.3)
    order = rng.permutation(len(tracks.image))
    few = np.zeros(len(order), dtype=bool)
    for point in np.unique(tracks.point):
        few[order[tracks.point[order] == point][:views]] = True
    tracks = tracks.only(few)
    assert solved(problem, tracks).images.state.pixel_noise.sigma_px[0] == pytest.approx(0.3, rel=0.1)


def test_intrinsics_go_as_far_from_what_was_given_as_their_standard_deviation_lets_them():
    rng = np.random.default_rng(5)
    problem = hand_eye_problem(rng, 8, robot_noise=(2e-4, np.radians(0.03)))
    tracks = observed(problem, rng, 300, 0.3)
    off = with_parameters(INTRINSICS, parameters(INTRINSICS) + np.r_[3.0, 3.0, 4.0, 4.0, np.zeros(5)])
    exact, usual = (solved(problem, tracks, camera_with_prior(off, std)) for std in (np.zeros(9), MEASURED))
    assert exact.problem.intrinsics(exact.state)[0] == off
    std = np.sqrt(np.diag(usual.intrinsics_covariance(0)))
    assert (
        abs(usual.problem.intrinsics(usual.state)[0].fx - INTRINSICS.fx)
        < 3 * std[0]
        < abs(off.fx - INTRINSICS.fx) * 3
    )
    errors = [error(problem, found.state.x[0], problem.scale)[:6] for found in (exact, usual)]
    sigmas = [
        np.abs(gap / np.sqrt(np.diag(found.covariance)[:6])).max()
        for gap, found in zip(errors, (exact, usual), strict=True)
    ]
    assert sigmas[1] < 3 < sigmas[0]
    assert usual.budget.intrinsics[2, 2] > 0 and not exact.budget.intrinsics.any()


@cache
def warped(warp_px: float) -> Solution:
    """Of images whose pixels a wave over the image displaces, which no coefficient describes."""
    rng = np.random.default_rng(3)
    problem = hand_eye_problem(rng, 12, robot_noise=(1e-4, np.radians(0.01)))
    tracks = observed(problem, rng, 400, 0.1)
    u, v = (2 * np.pi * tracks.x_px / [INTRINSICS.width, INTRINSICS.height]).T
    tracks = replace(tracks, x_px=tracks.x_px + warp_px * np.stack([np.sin(v), np.sin(u)], axis=1))
    return solved(
        problem, tracks, camera_with_prior(Intrinsics(619.0, 619.0, 319.5, 239.5, 640, 480), ESTIMATED)
    )


WIDE = Intrinsics(458.7, 457.3, 375.5, 239.5, 752, 480, (-0.2834, 0.0740, 1.9e-4, 1.8e-5, 0.0))
"""Left camera of EuRoC, with a distortion of -20 % of the radius in the corners."""


@pytest.mark.slow
def test_estimated_distortion_of_a_wide_lens_is_not_extrapolated_beyond_its_usual_size():
    """Features within half of the corner radius left corners 26 mm off, with a stated 95 % bound of up to 1 m."""
    off = with_parameters(WIDE, parameters(WIDE) * np.r_[1.003, 1.003, np.ones(7)])
    middle = np.array([WIDE.width - 1.0, WIDE.height - 1.0]) / 2
    x_px = middle * (1 + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]))
    for seed in (300, 301):
        problem = bent_problem(arm_named("ur5e"), "white", 12, seed)
        tracks = observed(problem, np.random.default_rng([seed, 9]), 600, 0.3, WIDE)
        inner = np.linalg.norm(tracks.x_px - middle, axis=1) < np.linalg.norm(middle) / 2
        found = solved(problem, tracks.only(inner), camera_with_prior(off, ESTIMATED))
        x, camera = found.state.x[0], found.problem.intrinsics(found.state)[0]
        covariance = point_covariance(x, uncertainty_of(found), camera, x_px, DISTANCE_M)
        bounds = np.array([within_95(one) for one in covariance])
        ours, truth = (
            points_along(pose, lens, x_px, DISTANCE_M)
            for pose, lens in ((x, camera), (problem.gripper_from_camera, WIDE))
        )
        lengths = np.linalg.norm(ours - truth, axis=1)
        assert lengths.max() < 0.02 and (lengths < bounds).all() and bounds.max() < 0.2


def test_a_point_beyond_the_reach_of_the_images_is_as_uncertain_as_the_given_distortion_is_wrong():
    """The image corner is displaced by 15 % of its radius by the given distortion, and by 3 % by the lens."""
    nominal = with_parameters(INTRINSICS, parameters(INTRINSICS) * np.r_[np.ones(4), np.zeros(5)])
    middle = np.array([nominal.width - 1.0, nominal.height - 1.0]) / 2
    scale = (np.linalg.norm(middle) / nominal.fx) ** -np.array([2, 4, 6])
    truth, given = (
        replace(nominal, distortion=(k[0], k[1], 0.0, 0.0, k[2]))
        for k in (scale * (0.03, -0.02, 0.02), scale * (0.05, -0.1, 0.2))
    )
    problem = bent_problem(arm_named("ur5e"), "white", 12, 3)
    tracks = observed(problem, np.random.default_rng(3), 400, 0.2, truth)
    inner = np.linalg.norm(tracks.x_px - middle, axis=1) < np.linalg.norm(middle) / 2
    found = solved(problem, tracks.only(inner), camera_with_prior(given))
    x, camera = found.state.x[0], found.problem.intrinsics(found.state)[0]
    x_px = middle * (1 + np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]]))
    covariance = point_covariance(x, uncertainty_of(found), camera, x_px, DISTANCE_M)
    bounds = np.array([within_95(one) for one in covariance])
    ours, there = (
        points_along(pose, lens, x_px, DISTANCE_M)
        for pose, lens in ((x, camera), (problem.gripper_from_camera, truth))
    )
    assert (np.linalg.norm(ours - there, axis=1) < bounds).all() and bounds[4] < 3e-3


@pytest.mark.slow
def test_the_error_that_the_model_leaves_has_its_size_and_makes_the_intrinsics_uncertain():
    exact, some, much = (warped(warp_px) for warp_px in (0.0, 0.3, 1.0))
    size = [one.state.model_error_std[0] for one in (exact, some, much)]
    assert size[0] < 0.5 * TYPICAL
    assert size[2] / size[1] == pytest.approx(1.0 / 0.3, rel=0.3)
    std = [np.sqrt(np.diag(one.intrinsics_covariance(0)))[2] for one in (exact, some, much)]
    assert std[0] < std[1] < std[2]


def test_the_error_that_the_model_leaves_is_not_taken_for_pixel_noise():
    noise = warped(0.3).images.state.pixel_noise
    assert noise is not None and noise.sigma_px[0] == pytest.approx(0.1, rel=0.15) and noise.inflation < 1.5


@pytest.mark.slow
def test_derivatives_are_those_of_the_residuals():
    """Two cameras on one wrist, whose intrinsics and mounts are free, and parameters of single images."""
    cell = cell_problem("wrists", "typical", 6, seed=1, points=60)
    images = len(cell.observations.rig)
    own, second = (camera_with_prior(camera, MEASURED) for camera in cell.cameras)
    problem, state = cell.unsolved([own, replace(second, mount_free=True)])
    freed = np.eye(18 + OF_IMAGE * images + PRISM)[:, 18:]
    std = np.r_[np.repeat([0.05, 0.3], images), np.full(PRISM, 0.1)]
    problem, state = with_observations(replace(problem, freed=freed, freed_std=std), state)
    rng = np.random.default_rng(0)
    # Off the start, where images differ from their cameras and the cameras from their priors.
    begun = np.zeros(problem.columns.count)
    std = problem.prior_std(state)
    begun[: len(std)] = 0.02 * std * rng.normal(size=len(std))
    state = stepped(problem, state, None, begun)
    view = view_of(problem, state)
    found = derivatives(problem, state, view, np.ones(len(view.residual_px)))
    rig = problem.observations.rig[problem.observations.image]
    first = problem.columns.first_rig
    for column in range(len(begun)):
        step = np.zeros(len(begun))
        step[column] = 1e-6
        ahead, behind = (view_of(problem, stepped(problem, state, None, sign * step)) for sign in (1, -1))
        numeric = (ahead.residual_px - behind.residual_px) / 2e-6
        if column < first:
            analytic = found.shared[:, :, column]
        else:
            moved = (column - first) // 6
            analytic = np.where((rig == moved)[:, None], found.own[:, :, (column - first) % 6], 0.0)
        assert numeric == pytest.approx(analytic, rel=1e-4, abs=0.01), column
    for axis in range(3):
        away = np.zeros(3)
        away[axis] = 1e-6
        ahead, behind = (
            view_of(problem, replace(state, points_in_world=state.points_in_world + sign * away))
            for sign in (1, -1)
        )
        numeric = (ahead.residual_px - behind.residual_px) / 2e-6
        assert numeric == pytest.approx(found.by_point[:, :, axis], rel=1e-4, abs=0.05)


@pytest.mark.parametrize(("kind", "seed"), [("fixed", 0), ("wrists", 0), ("arms", 2)])
def test_rounds_settle_from_a_scale_that_is_several_times_too_small(kind: Kind, seed: int):
    """Steps that are cut short must not lead the rounds to a scale that shrinks."""
    found = answered(cell_problem(kind, "typical", 8, seed), seed)
    assert found.settled and found.iterations < 12


SHARED, OWN, IMAGES, POINTS = 4, 3, 5, 12


@pytest.mark.parametrize("together", [5, 1024])
def test_the_step_is_that_of_the_whole_system(monkeypatch, together: int):
    monkeypatch.setattr(elimination, "POINTS_AT_ONCE", together)
    rng = np.random.default_rng(1)
    # Each point in some of the images; in one of them twice, as by two cameras on one wrist.
    drawn = [np.sort(np.r_[i := rng.permutation(IMAGES)[:3], i[0]]) for _ in range(POINTS)]
    image, point = np.concatenate(drawn), np.repeat(np.arange(POINTS), 4)
    shared, own, by_point = (rng.normal(size=(len(image), 2, n)) for n in (SHARED, OWN, 3))
    residual = rng.normal(size=(len(image), 2))
    rows = Derivatives(shared=shared, own=own, by_point=by_point, residual=residual)
    seen = Sightings.of(point, image, IMAGES)
    size = SHARED + OWN * IMAGES
    whole = np.zeros((len(image), 2, size + 3 * POINTS))
    for k in range(len(image)):
        whole[k, :, :SHARED] = rows.shared[k]
        whole[k, :, SHARED + OWN * image[k] :][:, :OWN] = rows.own[k]
        whole[k, :, size + 3 * point[k] :][:, :3] = rows.by_point[k]
    expected = -np.linalg.lstsq(whole.reshape(-1, whole.shape[2]), rows.residual.ravel(), rcond=None)[0]
    normal = without_points(*with_fixed_points(rows, seen), rows, seen)
    step = np.linalg.solve(normal.hessian, normal.right)
    assert step == pytest.approx(expected[:size], rel=1e-5, abs=1e-6)
    moved = normal.stepped(np.zeros((POINTS, 3)), step)
    assert moved.ravel() == pytest.approx(expected[size:], rel=1e-5, abs=1e-6)


X_PX = np.array([[319.5, 239.5], [40.0, 30.0], [600.0, 450.0]])
DISTANCE_M = 0.45


def adjusted(problem: HandEyeProblem, seed: int) -> tuple[Solution, Tracks, Calibration]:
    tracks = observed(problem, np.random.default_rng([seed, 1]), 300, 0.3)
    start = solve_hand_eye(problem.base_from_gripper, problem.recon_from_camera)
    return solved(problem, tracks, camera_with_prior(INTRINSICS, ESTIMATED)), tracks, start


@cache
def estimated(seed: int = 0) -> tuple[np.ndarray, Uncertainty, Intrinsics, RobotNoise]:
    rng = np.random.default_rng(seed)
    problem = hand_eye_problem(rng, 10, robot_noise=(5e-4, np.radians(0.05)))
    found, tracks, start = adjusted(problem, seed)
    camera = found.problem.intrinsics(found.state)[0]
    return found.state.x[0], uncertainty_of(found), camera, start.robot_noise


def placed(x: np.ndarray, camera: Intrinsics) -> np.ndarray:
    ray = unproject(camera, X_PX)
    return apply(x, DISTANCE_M * ray / np.linalg.norm(ray, axis=1, keepdims=True))


def test_covariance_of_a_seen_point_is_that_of_draws_of_all_that_places_it():
    """Its depth is exact: the error of the scale, which draws of the calibration have, too, does not move it."""
    x, uncertainty, camera, _ = estimated()
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(16), uncertainty.whole, 2000, method="eigh")
    drawn = np.array(
        [
            placed(retract(x, step[:6]), with_parameters(camera, parameters(camera) + step[7:]))
            for step in steps
        ]
    )
    in_camera = drawn @ x[:3, :3]
    for k, covariance in enumerate(point_covariance(x, uncertainty, camera, X_PX, DISTANCE_M)):
        assert np.cov(in_camera[:, k].T) == pytest.approx(covariance, abs=0.06 * np.trace(covariance))


def test_a_rotation_about_the_ray_of_a_pixel_moves_neither_its_point_nor_the_ray():
    x, ray = hand_eye_problem(np.random.default_rng(0), 3).gripper_from_camera, unproject(INTRINSICS, X_PX[1])
    step = np.r_[np.zeros(3), 1e-3 * x[:3, :3] @ ray / np.linalg.norm(ray), 0.0]
    found = bounds_at(x, Uncertainty(covariance=np.outer(step, step)), INTRINSICS, X_PX[1], DISTANCE_M)
    assert (found.within_95_mm, found.ray_95_deg) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert found.rotation_95_deg == pytest.approx(np.degrees(1.96e-3), rel=0.01)


def test_errors_of_the_gripper_pose_stand_beside_those_of_the_calibration():
    x, uncertainty, camera, noise = estimated()
    noise = replace(noise, systematic_left=(1e-3, np.radians(0.1)))
    pose = inverse(np.linalg.inv(x))
    ray = unproject(camera, X_PX)
    depth_m = DISTANCE_M * ray[:, 2] / np.linalg.norm(ray, axis=1)
    x_in_base, found = point_in_base(x, uncertainty, camera, noise, X_PX, depth_m, pose)
    assert x_in_base == pytest.approx(apply(pose, placed(x, camera)))
    here = point_covariance(x, uncertainty, camera, X_PX, DISTANCE_M)
    on_gripper = placed(x, camera)[1]
    rng, drawn = np.random.default_rng(0), np.zeros((4000, 3))
    for metres, radians in ((noise.translation, noise.rotation), noise.systematic_left):
        steps = rng.normal(size=(4000, 6)) * np.repeat((metres, radians), 3)
        drawn += [apply(retract(pose, step), on_gripper) for step in steps]
    to_base = pose[:3, :3] @ x[:3, :3]
    expected = to_base @ here[1] @ to_base.T + np.cov(drawn.T)
    assert found[1] == pytest.approx(expected, abs=0.06 * np.trace(found[1]))


@pytest.mark.slow
def test_points_of_the_scene_are_where_they_are_said_to_be():
    inside, sizes = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        problem = hand_eye_problem(rng, 10, robot_noise=(5e-4, np.radians(0.05)))
        found, _, _ = adjusted(problem, seed)
        in_base, together, own = points = scene_points(found)
        # The tracks are of points that the problem drew first, in the base.
        true = np.random.default_rng([seed, 1]).uniform([0.25, -0.25, 0.0], [0.75, 0.25, 0.12], (300, 3))
        nearest = np.linalg.norm(in_base[:, None] - true, axis=2).min(1)
        n = np.arange(len(nearest))
        covariance = together[n, :, n] + own
        inside.append(nearest < np.array([within_95(one) for one in covariance]))
        scene = scene_uncertainty(points)
        sizes.append(np.trace(scene.covariance_at(in_base), axis1=1, axis2=2).mean())
        assert sizes[-1] == pytest.approx(np.trace(together[n, :, n], axis1=1, axis2=2).mean(), rel=0.1)
    assert np.concatenate(inside).mean() > 0.8


def test_a_distortion_that_the_images_do_not_determine_has_a_finite_size():
    """Far from the solution their information may be negative; the size of the distortion then grew without end."""
    likeliest, variance = np.r_[0.5, np.full(9, 1e-4)], np.r_[0.2, np.full(9, 1e-9)]
    assert size_of(likeliest, np.diag(variance), std=0.1) < 0.1
