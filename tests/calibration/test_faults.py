"""What looks like nothing and moves the answer is named with its size, and counts as uncertainty."""

import re
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import benchmarks.faults
from benchmarks.faults import outcome
from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.bundle_adjustment import adjusted
from jcr.calibration.calibrate import calibrate_pose_pairs, calibrate_reconstruction, fitted_case
from jcr.calibration.checks.effects import _is_plausible, as_remark, check_effects, examined_case
from jcr.calibration.options import CalibrateOptions
from jcr.estimation import hypotheses
from jcr.estimation.arms import arm_named
from jcr.estimation.hypotheses import camera_effects
from jcr.estimation.intrinsics_prior import ESTIMATED, camera_with_prior
from jcr.estimation.problem import Effect
from jcr.findings import Finding, FindingKind, kinds_of, sentence
from jcr.geometry import inverse, step_between
from jcr.records import CameraEvidence
from scenes import capture_of, pairs_of, reconstruction_of
from simulation.faults import INTRINSICS, Faults, faulty_capture, reconstructed
from simulation.problems import INTRINSICS as OBSERVED_BY
from simulation.problems import bent_problem, hand_eye_problem, observed

pytestmark = pytest.mark.slow

calibrated = cache(benchmarks.faults.calibrated)

SLIPPED = r"moved on the gripper, or the TCP to have changed, by ([\d.]+) mm and ([\d.]+)° after 05.png"
NAMED: dict[str, tuple[Faults, str, list[float], float]] = {
    # Simulated as linear in the distance, named by its logarithm.
    "focus follows distance": (Faults(focal_by_distance=0.02),
        r"the focal length grows by ([\d.]+) ± \S+ % from the nearest view", [2.0], 0.3),
    "focus scatters": (Faults(focal_scatter=0.01),
        r"the focal length differs between images by ([\d.]+) % \(rms", [1.0], 0.6),
    "zoom": (Faults(zoom=0.03), r"changes by \+([\d.]+) ± \S+ % after 05.png", [3.0], 0.2),
    "focal length": (Faults(intrinsics=(("fx", 30.0), ("fy", 30.0))),
        r"focal lengths of \(([\d.]+), [\d.]+\) ± \S+ px where \(620.0, 620.0\)", [INTRINSICS.fx + 30], 6.0),
    "principal point": (Faults(intrinsics=(("cx", 12.0),)), r"a principal point of \(([\d.]+), ([\d.]+)\)",
        [INTRINSICS.cx + 12, INTRINSICS.cy], 3.0),
    "rolling shutter": (Faults(rolling_px=15.0), r"sheared by ([\d.]+) ± \S+ px", [15.0], 0.5),
    "thin prism": (Faults(prism=(0.02, 0.0, 0.01, 0.0)),
        r"a thin-prism distortion of up to ([\d.]+) ± \S+ px", [5.6], 0.6),
    "slight slip": (Faults(slip=(3.6e-3, np.radians(0.8))), SLIPPED, [3.6, 0.8], 0.6),
    # Another TCP: the adjustment takes it for robot pose noise.
    "tool changed": (Faults(slip=(0.03, 0.0), robot_noise=(1e-4, 2e-4)), SLIPPED, [30.0, 0.0], 1.0),
    "lift too long": (Faults(lengths=(0.0, 0.0, 0.02)),
        r"along the base's z axis the robot's positions are ([\d.]+) ± \S+ % too long", [2.0], 0.5),
    "stand leans": (Faults(tilt_by_reach=float(np.radians(4))),
        r"the robot's base leans towards the gripper by ([\d.]+) ± \S+° per metre of reach", [4.0], 0.3),
    "tool sags": (Faults(sag=0.02), r"the gripper rotates by ([\d.]+) ± \S+° where it is level, as by a tool",
        [np.degrees(0.02)], 0.1),
    "camera drifts": (Faults(drift=(6e-3, np.radians(2.0))),
        r"drift on the gripper by ([\d.]+) mm and ([\d.]+)° from the first image to the last", [6.0, 2.0], 0.6),
    # The rotation is about the base's origin, and moves the scene with it.
    "base pushed": (Faults(base_moved=(0.01, np.radians(0.5))),
        r"moved against each other by ([\d.]+) mm and ([\d.]+)° after 05.png", [10.0, 0.5], 4.0),
    "delay": (Faults(delay_s=0.1, view_s=4.0),
        r"as if read ([\d.]+) ± \S+ of the time from one image to the next too late", [0.025], 0.003),
}  # fmt: skip
"""Faults of a capture, words that name them, their sizes, and how far the named sizes may be off."""


OF_CAMERA = [*NAMED][:7]


@pytest.mark.parametrize("name", NAMED)
def test_a_silent_fault_is_named_with_its_size_and_counts_as_uncertainty(name: str):
    faults, words, sizes, within = NAMED[name]
    found, hand_eye = calibrated(faults, 3)
    said = [match for text in hand_eye.warnings if (match := re.search(words, text))]
    assert said, hand_eye.warnings
    assert [float(size) for size in said[0].groups()] == pytest.approx(sizes, abs=within)
    assert outcome(found, hand_eye).is_sound
    parts = np.sum(list(vars(hand_eye.uncertainty.budget).values()), axis=0)
    assert np.allclose(parts, hand_eye.covariance, rtol=0, atol=1e-9)
    # An effect on the camera is part of the calibration, and its uncertainty is not that of a fault.
    assert (np.trace(hand_eye.uncertainty.budget.faults) > 0) == (name not in OF_CAMERA)
    if (
        name == "thin prism"
    ):  # without it in the model, the rotation is 2.3° off: it looks like a rotated camera
        camera = hand_eye.intrinsics
        assert camera is not None and camera.model == "thin_prism" and camera.std is not None
        off = np.array(camera.distortion[-4:]) - NAMED[name][0].prism
        assert (np.abs(off) < 3 * np.array(camera.std[-4:])).all()
    # No one result is right on both sides of a motion beyond the requirement, and a delay of that size leaves ± 10 mm.
    assert hand_eye.converged is (name not in ("tool changed", "base pushed", "delay"))


def test_what_given_intrinsics_may_be_off_is_within_sigma_unsaid():
    found, hand_eye = calibrated(Faults(intrinsics=(("k1", -0.03),)), 0)
    assert hand_eye.converged and outcome(found, hand_eye).is_sound


@pytest.mark.parametrize(("images", "given"), [(8, True), (16, False)])
def test_nothing_is_named_where_nothing_is_wrong(images: int, given: bool):
    assert calibrated(Faults(), 0, images, given)[1].warnings == ()


def test_joint_offsets_and_link_errors_are_not_named_as_a_bent_robot():
    problem = bent_problem(arm_named("panda"), "low-cost", 12, 2)
    capture = capture_of(problem.base_from_gripper, intrinsics=OBSERVED_BY)
    reconstruction = reconstruction_of(
        problem.recon_from_camera, tracks=observed(problem, np.random.default_rng(2), 300, 0.4)
    )
    assert not kinds_of("strain") & {
        one.kind for one in calibrate_reconstruction(capture, reconstruction).findings
    }


def test_the_parts_of_the_uncertainty_of_a_fixed_camera_are_the_whole_with_its_faults():
    """The same images, as of a fixed camera before which the gripper carries the scene; its zoom was moved."""
    found, moving = calibrated(NAMED["zoom"][0], 3)
    seen, reconstruction = reconstructed(found, estimated=False)
    capture = replace(seen, base_from_gripper=inverse(seen.base_from_gripper), mount="base")
    hand_eye = calibrate_reconstruction(capture, reconstruction)
    assert hand_eye.converged and hand_eye.uncertainty.budget is not None
    parts = np.sum(list(vars(hand_eye.uncertainty.budget).values()), axis=0)
    assert np.allclose(parts, hand_eye.covariance, rtol=0, atol=1e-9)
    # The zoom is part of the calibration, and adds no uncertainty of a fault.
    assert hand_eye.findings[0].kind is FindingKind.ZOOM and np.trace(hand_eye.uncertainty.budget.faults) == 0
    error = step_between(hand_eye.base_from_camera, moving.gripper_from_camera)
    assert error @ np.linalg.solve(hand_eye.covariance[:6, :6], error) < 16.8  # 99 % of chi2 of 6


def test_an_adopted_effect_keeps_earlier_findings_and_states_whether_its_adjustment_settled(monkeypatch):
    capture, reconstruction = reconstructed(
        faulty_capture(np.random.default_rng(3), 8, NAMED["zoom"][0]), estimated=False
    )
    robot, options = errors_of(capture.base_from_gripper), CalibrateOptions()
    start = fitted_case(capture, reconstruction, options, robot)
    case = adjusted(start)
    case = case.found(Finding.of(FindingKind.FEW_USED, "warns", "reconstruction", value=12.0, of=20.0))
    kinds = {one.kind for one in check_effects(case).calibration.findings}
    assert kinds >= {FindingKind.FEW_USED, FindingKind.ZOOM} and FindingKind.NOT_SETTLED not in kinds
    monkeypatch.setattr("jcr.estimation.solve.MAX_ROUNDS", 1)
    kinds = {one.kind for one in check_effects(adjusted(start)).calibration.findings}
    assert kinds >= {FindingKind.ZOOM, FindingKind.NOT_SETTLED}


def test_points_behind_a_camera_give_no_numpy_warning():
    capture, reconstruction = reconstructed(faulty_capture(np.random.default_rng(3), 6, Faults()), False)
    options, robot = CalibrateOptions(), errors_of(capture.base_from_gripper)
    model = examined_case(adjusted(fitted_case(capture, reconstruction, options, robot)))
    images, observations = model.solution.images, model.solution.problem.observations
    x_in_camera = images.view.in_camera * np.where(observations.image == 2, -1.0, 1.0)[:, None]
    behind = replace(images, view=replace(images.view, in_camera=x_in_camera))
    model = replace(model, solution=replace(model.solution, evidence=behind))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(np.isfinite(row.columns).all() for row in camera_effects(model, 6))


def test_joint_offsets_follow_from_adjusted_images_and_from_the_stated_covariance_of_given_cameras():
    """Camera poses counted as exact: those that images correct doubled the ±, stated errors were left out."""
    problem = bent_problem(arm_named("ur5e"), "factory-calibrated", 10, 2, (1e-3, np.radians(0.2)))
    capture = capture_of(
        problem.base_from_gripper, intrinsics=OBSERVED_BY, robot="ur5e", joints=problem.joints
    )
    seen = observed(problem, np.random.default_rng(2), 150, 0.5)
    by_images = calibrate_reconstruction(capture, reconstruction_of(problem.recon_from_camera, tracks=seen))
    std = np.tile(np.repeat([1e-3 / problem.scale, np.radians(0.2)], 3), 10)
    stated = CameraEvidence(recon_from_camera=problem.recon_from_camera, covariance=np.diag(std**2))
    by_poses = calibrate_reconstruction(
        capture, reconstruction_of(problem.recon_from_camera, evidence=stated)
    )
    for found, least, most in ((by_images, 0.01, 0.03), (by_poses, 0.03, 0.1)):
        off = problem.bent.errors[1:5] - found.joint_offsets.offset[1:5]
        assert (np.abs(off) < 3 * found.joint_offsets.std[1:5]).all()
        assert least < np.degrees(found.joint_offsets.std[1:5]).max() < most


@pytest.mark.parametrize(("preset", "images", "is_named"), [("low-cost", 40, True), ("typical", 24, False)])
def test_smooth_errors_that_leave_one_out_does_not_show_are_a_finding(preset, images, is_named):
    problem = bent_problem(arm_named("ur5e"), preset, images, 2)
    capture = capture_of(problem.base_from_gripper, intrinsics=OBSERVED_BY)
    tracks = observed(problem, np.random.default_rng(2), 100, 0.4)
    found = calibrate_reconstruction(capture, reconstruction_of(problem.recon_from_camera, tracks=tracks))
    assert found.converged and (FindingKind.SMOOTH_ERRORS in {one.kind for one in found.findings}) is is_named


def test_a_change_of_the_tool_in_translation_alone_is_named_in_few_images_however_large():
    """The fit takes it for noise of all translations, beside which it was lost the more the larger it was."""
    problem = hand_eye_problem(np.random.default_rng(0), 8, robot_noise=(3e-4, 1e-3))
    gripper = problem.base_from_gripper.copy()
    gripper[4:, :3, 3] += 0.1 * gripper[4:, :3, 0]
    pairs = pairs_of(gripper, problem.recon_from_camera, images=tuple("abcdefgh"))
    found = next(one for one in calibrate_pose_pairs(pairs).findings if one.kind is FindingKind.SLIP)
    assert found.images == ("d", "e")
    assert found.value == pytest.approx(0.1, abs=1e-3)


def test_positions_that_are_all_too_long_are_beyond_what_images_show_and_a_metric_unit_contradicts_them():
    found = faulty_capture(np.random.default_rng(5), 12, Faults(pose_scale=1.05))
    capture, reconstruction = reconstructed(found, False)
    unknown = calibrate_reconstruction(capture, reconstruction)
    assert unknown.converged and not unknown.warnings
    (alone,) = (sentence(one) for one in unknown.findings if one.kind is FindingKind.SCALE_FROM_ROBOT)
    assert alone in unknown.notes
    # Simulated observations are metric as the scene is; the robot's positions are not.
    metric = calibrate_reconstruction(capture, replace(reconstruction, is_metric=True, metric_std=0.002))
    assert "4.8 ± 0.15 %" in metric.warnings[0] and "larger than given" in metric.warnings[0]
    assert alone not in metric.notes


def test_a_given_distortion_that_folds_over_is_unknown():
    """The images "show a distortion k1, k2 where (0, 0) is given", which nobody gave."""
    found = faulty_capture(np.random.default_rng(6), 6, Faults())
    capture, reconstruction = reconstructed(found, False)
    assert capture.intrinsics is not None
    folds = replace(capture.intrinsics, distortion=(0.05, 0.85, 0.0, 0.0, -3.7))
    robot = errors_of(capture.base_from_gripper)
    stds = []
    for intrinsics in (capture.intrinsics, folds):
        capture = replace(capture, intrinsics=intrinsics)
        prior = fitted_case(capture, reconstruction, CalibrateOptions(), robot).model.camera
        stds.append(prior.parameter_std)
    assert np.array_equal(stds[0][:4], stds[1][:4])
    usual = camera_with_prior(folds, ESTIMATED).parameter_std
    assert stds[0][4] < 0.5 * usual[4] and stds[1][4] == usual[4] > 0.1


@pytest.mark.parametrize(
    ("share", "moved_m", "severity"), [(3e-4, 1e-4, "informs"), (3e-3, 1e-4, "warns"), (3e-4, 1e-3, "warns")]
)
def test_a_tiny_difference_of_focal_lengths_is_a_remark(share: float, moved_m: float, severity: str):
    """300 images warned of a focal length that scatters by 0.031 %, 0.12 px in the corner of 640x480."""
    found = Finding.of(FindingKind.FOCUS_BY_IMAGE, "warns", "images", value=share, std=1e-5)
    moved = np.array([moved_m, 0, 0, 0, 0, 0])
    assert as_remark(found, moved, (640, 480)).severity == severity


def test_optics_that_no_camera_has_are_no_explanation():
    """A fixed camera before a plain object was accepted with p2 of -1.5 and images sheared by 40 px."""
    capture, reconstruction = reconstructed(faulty_capture(np.random.default_rng(3), 6, Faults()), False)
    case = adjusted(
        fitted_case(capture, reconstruction, CalibrateOptions(), errors_of(capture.base_from_gripper))
    )
    model, facts = examined_case(case), {"log_p": -50.0, "shift": np.zeros(7)}
    for kind, size, std, plausible in (
        (FindingKind.ZOOM, 0.1, 0.01, True),
        (FindingKind.ZOOM, 0.4, 0.01, False),
        (FindingKind.ROLLING_SHUTTER, 0.05, 0.002, True),
        (FindingKind.ROLLING_SHUTTER, 0.05, 0.06, False),
        (FindingKind.THIN_PRISM, 0.5, 0.01, False),
    ):
        effect, covariance = Effect(kind=kind, columns=np.ones((4, 1))), np.array([[std**2]])
        facts |= {"covariance": covariance, "noise": case.numbers.robot_noise}
        test = hypotheses.Test(effect=effect, estimate=np.array([size]), **facts)
        assert _is_plausible(test, model) is plausible, (kind, size, std)
