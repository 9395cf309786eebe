"""The calibration stage on simulated observations: how many of them it adjusts, and in how many steps."""

from dataclasses import replace

import numpy as np

from jcr.calibration.stage import calibrate
from jcr.estimation.hand_eye import fit_hand_eye
from jcr.geometry import retract, step_between
from simulation.faults import faulty_capture, reconstructed


def test_the_adjustment_replaces_a_rejected_fit_from_poses():
    """Camera poses that are 40 mm and 5° off, as structure from motion without intrinsics can leave them: the fit from
    poses alone is rejected, and the images that follow from the true poses correct them."""
    rng = np.random.default_rng(2)
    capture, reconstruction = reconstructed(faulty_capture(rng, 12), estimated=False)
    errors = rng.normal(size=(12, 6)) * np.repeat([0.04, np.radians(5.0)], 3)
    found = replace(reconstruction, recon_from_camera=retract(reconstruction.recon_from_camera, errors))
    assert not fit_hand_eye(capture.base_from_gripper, found.recon_from_camera).converged
    calibrated, right = calibrate(capture, found), calibrate(capture, reconstruction)
    assert calibrated.converged and calibrated.inliers.all()
    step = step_between(right.gripper_from_camera, calibrated.gripper_from_camera)
    assert (np.abs(step) < 0.1 * np.sqrt(np.diag(right.covariance)[:6])).all()
