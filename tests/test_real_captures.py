"""Real captures with a reference that someone else measured; skipped where they are not at hand."""

from pathlib import Path

import numpy as np
import pytest

import jcr
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.capture.images import read_image
from jcr.findings import FindingKind
from jcr.geometry import rotation_between_deg, step_between
from jcr.sfm.colmap import reconstruct_colmap
from scenes import center_errors, reference_of


@pytest.mark.parametrize(
    ("name", "max_mm", "max_deg", "count"),
    [pytest.param("franka_wood_table", 4.0, 0.5, 12, marks=pytest.mark.long), ("doosan_bench", 5.0, 0.7, 15)],
)
def test_near_the_marker_reference(real_captures: Path, name: str, max_mm: float, max_deg: float, count: int):
    """And the cameras follow the gripper."""
    capture = jcr.read_capture(real_captures / name)
    found = reconstruct_colmap(capture)
    solved, reference = calibrate_reconstruction(capture, found), reference_of(capture.folder)
    assert solved.converged and solved.inliers.sum() == len(found.image_index) == count
    assert 1e3 * np.linalg.norm(solved.gripper_from_camera[:3, 3] - reference[:3, 3]) < max_mm
    assert rotation_between_deg(solved.gripper_from_camera[:3, :3], reference[:3, :3]) < max_deg
    assert solved.held_out is not None and solved.held_out.translation_mm < 6.0
    assert any("folds over" in text for text in found.warnings) == (name == "doosan_bench")
    # To within the few millimetres to which the references are good, and the poses of both robots.
    off_m = center_errors(capture, found)
    assert np.median(off_m) < 3e-3 and off_m.max() < 0.01


@pytest.mark.long
def test_nominal_intrinsics_are_contradicted_by_their_images(real_captures: Path):
    """The reference of this capture was made with them, and belongs to them."""
    capture = jcr.read_capture(real_captures / "franka_tabletop")
    solved = calibrate_reconstruction(capture, reconstruct_colmap(capture))
    assert solved.converged and any(one.kind is FindingKind.INTRINSICS for one in solved.findings)
    found, given = solved.intrinsics, solved.with_given_intrinsics
    assert found is not None and found.fx == pytest.approx(found.fy, rel=2e-3)
    assert capture.intrinsics is not None and capture.intrinsics.fx > 1.005 * capture.intrinsics.fy
    assert solved.held_out is not None and solved.held_out.translation_mm < 2.0
    reference, both = reference_of(capture.folder), (given.gripper_from_camera, solved.gripper_from_camera)
    off_mm = [1e3 * np.linalg.norm(x[:3, 3] - reference[:3, 3]) for x in both]
    assert off_mm[0] < 10 < off_mm[1]


def test_a_plain_background_is_rejected(real_captures: Path):
    capture = jcr.read_capture(real_captures / "franka_plain_background")
    with pytest.raises(jcr.RejectedError, match=r"0 of 8 images \(too little texture"):
        reconstruct_colmap(capture)


@pytest.mark.long
@pytest.mark.parametrize(("name", "least"), [("elephant_floor", 15), ("ur_black_cloth", 18)])
def test_another_pair_is_tried_where_the_first_bends_intrinsics(real_captures: Path, name: str, least: int):
    """Three images of the first register in one model alone, four of the second by the strict thresholds alone."""
    capture = jcr.read_capture(real_captures / name)
    assert capture.intrinsics is None
    assert len(reconstruct_colmap(capture).image_index) >= least


@pytest.mark.long
def test_images_that_are_added_live_have_the_findings_of_a_batch(real_captures: Path, tmp_path: Path):
    """Thirteen images: "camera moved on the gripper" was reported live, and gone at the sixteenth."""
    whole = jcr.read_capture(real_captures / "ur_snack_table")
    capture = whole.of_rows(range(13))
    batch = calibrate_reconstruction(capture, reconstruct_colmap(capture))
    live = jcr.LiveCalibration(tmp_path / "live", intrinsics=capture.intrinsics)
    for k, (name, pose) in enumerate(zip(capture.images, capture.base_from_gripper, strict=True)):
        live.live.add(read_image(capture.folder / name), pose)
        if k % 4 == 0:
            live.update()
    progress = live.progress
    live.close()
    assert progress.hand_eye is not None and batch.verdict == progress.hand_eye.verdict == "accepted"
    kinds = [
        [one.kind for one in found if one.severity != "informs"]
        for found in (batch.findings, progress.findings)
    ]
    assert kinds[0] == kinds[1]
    off = step_between(batch.gripper_from_camera, progress.hand_eye.gripper_from_camera)
    assert (np.abs(off) < 2 * np.sqrt(np.diag(batch.covariance)[:6])).all()
