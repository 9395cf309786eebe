"""The calibration stage on simulated observations: how many of them it adjusts, and in how many steps."""

from dataclasses import replace

import cv2
import numpy as np

from jcr.calibration.checks.capture import REPETITIVE, share_of_twins
from jcr.calibration.hand_eye import solve_hand_eye
from jcr.calibration.stage import calibrate_reconstruction
from jcr.capture.images import read_image
from jcr.geometry import retract, step_between
from places import ROOT
from simulation.faults import faulty_capture, reconstructed


def test_the_adjustment_replaces_a_rejected_fit_from_poses():
    """Camera poses that are 40 mm and 5° off, as structure from motion without intrinsics can leave them: the fit from
    poses alone is rejected, and the images that follow from the true poses correct them."""
    rng = np.random.default_rng(2)
    capture, reconstruction = reconstructed(faulty_capture(rng, 12), estimated=False)
    errors = rng.normal(size=(12, 6)) * np.repeat([0.04, np.radians(5.0)], 3)
    found = replace(reconstruction, recon_from_camera=retract(reconstruction.recon_from_camera, errors))
    assert not solve_hand_eye(capture.base_from_gripper, found.recon_from_camera).converged
    calibrated, right = (
        calibrate_reconstruction(capture, found),
        calibrate_reconstruction(capture, reconstruction),
    )
    assert calibrated.converged and calibrated.inliers.all()
    step = step_between(right.gripper_from_camera, calibrated.gripper_from_camera)
    assert (np.abs(step) < 0.1 * np.sqrt(np.diag(right.covariance)[:6])).all()


def test_a_regular_tiling_is_repetitive_and_a_table_with_objects_is_not():
    rng = np.random.default_rng(0)
    tile = cv2.GaussianBlur(rng.uniform(0, 255, (60, 60, 3)), (0, 0), 2.0)
    tiled = 5 * (np.tile(tile, (8, 10, 1)) - tile.mean()) + rng.normal(scale=4, size=(480, 600, 3)) + 128
    assert share_of_twins(tiled.clip(0, 255).astype(np.uint8)) > REPETITIVE
    table = read_image(ROOT / "examples/tabletop/images/00.jpg")
    assert share_of_twins(table) < 0.5
