"""The calibration stage on simulated observations: how many of them it adjusts, and in how many steps."""

from dataclasses import replace

import numpy as np
import pytest

from jcr.calibration import adjust as adjust_stage
from jcr.calibration import case
from jcr.calibration.stage import calibrate
from jcr.estimation import image_equations
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.estimation.wrist import adjust_wrist
from jcr.findings import FindingKind
from jcr.geometry import retract, step_between
from jcr.records import Tracks
from simulation.faults import faulty_capture, reconstructed


@pytest.mark.slow
def test_of_many_observations_whole_tracks_are_adjusted_up_to_a_number(monkeypatch):
    count = 8
    found = faulty_capture(np.random.default_rng(3), count)
    capture, reconstruction = reconstructed(found, estimated=False)
    most = len(found.tracks.image) // 3
    used: list[Tracks] = []

    def watched(*arguments, **options):
        used.append(arguments[4])
        return adjust_wrist(*arguments, **options)

    monkeypatch.setattr(case, "MOST_OBSERVATIONS", most)
    monkeypatch.setattr(adjust_stage, "adjust_wrist", watched)
    hand_eye, again = (calibrate(capture, reconstruction) for _ in range(2))
    tracks, given = used[0], found.tracks
    assert hand_eye.inliers.all()
    assert 0.95 * most < len(tracks.image) <= most
    assert all(len(other.image) <= most for other in used)
    assert (np.bincount(tracks.image, minlength=count) > 0.5 * most / count).all()
    chosen = np.unique(tracks.point)
    assert np.array_equal(np.bincount(tracks.point)[chosen], np.bincount(given.point)[chosen])
    assert np.array_equal(hand_eye.gripper_from_camera, again.gripper_from_camera)
    errors = step_between(hand_eye.gripper_from_camera, found.gripper_from_camera)
    assert hand_eye.before is not None
    assert (np.abs(errors) < 3 * np.sqrt(np.diag(hand_eye.covariance)[:6])).all()


def test_the_adjustment_replaces_a_rejected_fit_from_poses():
    """Camera poses that are 40 mm and 5° off, as structure from motion without intrinsics can leave them: the fit from
    poses alone is rejected, and the images that follow from the true poses correct them."""
    rng = np.random.default_rng(2)
    capture, reconstruction = reconstructed(faulty_capture(rng, 12), estimated=False)
    errors = rng.normal(size=(12, 6)) * np.repeat([0.04, np.radians(5.0)], 3)
    found = replace(reconstruction, recon_from_camera=retract(reconstruction.recon_from_camera, errors))
    assert not solve_hand_eye(capture.base_from_gripper, found.recon_from_camera).converged
    calibrated, right = calibrate(capture, found), calibrate(capture, reconstruction)
    assert calibrated.converged and calibrated.inliers.all()
    step = step_between(right.gripper_from_camera, calibrated.gripper_from_camera)
    assert (np.abs(step) < 0.1 * np.sqrt(np.diag(right.covariance)[:6])).all()


def test_images_of_contradictory_poses_take_few_steps(monkeypatch):
    """Begun bent to the poses, to 1 mm, they took 177 normal equations; an accepted calibration takes 13."""
    rng, solved = np.random.default_rng(1), list[int]()
    capture, reconstruction = reconstructed(faulty_capture(rng, 12), estimated=False)
    shuffled = capture.base_from_gripper[np.random.default_rng(0).permutation(12)]
    equations = image_equations._normal_equations
    monkeypatch.setattr(
        image_equations, "_normal_equations", lambda *given: solved.append(1) or equations(*given)
    )
    hand_eye = calibrate(replace(capture, base_from_gripper=shuffled), reconstruction)
    assert FindingKind.POSES_CONTRADICT_IMAGES in {one.kind for one in hand_eye.findings}
    assert len(solved) <= 40
