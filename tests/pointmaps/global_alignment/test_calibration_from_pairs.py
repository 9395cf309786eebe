"""Test the calibration from aligned pairs: accuracy, calibrated covariance, scale of metric networks."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.record import Calibration
from jcr.camera import unproject
from jcr.estimation.point_uncertainty import point_covariance
from jcr.findings import FindingKind
from jcr.geometry import inverse, rotation_exp, rotation_log, transform
from jcr.pointmaps.global_alignment import align
from jcr.pointmaps.image_grid import ImageGrid, PreparedImages
from jcr.pointmaps.pair_predictions import PairPredictions, complete_pairs
from jcr.pointmaps.reconstruction import align_pairs, reconstruct_pointmaps
from jcr.records import Capture, Reconstruction
from jcr.records.reconstruction_npz import read_reconstruction, write_reconstruction
from scenes import capture_of
from simulation.pairs import PairErrors, synthetic_pairs

SIZE = (48, 36)
FEW_PIXELS = 432
NOISE = (5e-4, float(np.radians(0.1)))


@pytest.fixture(autouse=True, scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder of black images, in which nothing matches; the alignment uses a quarter of the pixels."""
    made = tmp_path_factory.getbasetemp() / "black"
    made.mkdir(exist_ok=True)
    for k in range(12):
        Image.new("RGB", SIZE).save(made / f"{k:02d}.png")
    Case.folder = made
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(align, "PIXELS", FEW_PIXELS)
        yield made


@dataclass(frozen=True)
class Case:
    """Predictions of what a camera on a gripper sees, and the truth."""

    folder: ClassVar[Path]
    capture: Capture
    images: PreparedImages
    predictions: PairPredictions
    base_from_camera: np.ndarray
    gripper_from_camera: np.ndarray
    scale: float
    """Metres per geometric mean of the pairs' units."""

    def reconstruction(self) -> Reconstruction:
        """Return the alignment as a reconstruction; the black images have no matches."""
        maps = align_pairs(self.predictions, self.images)
        return reconstruct_pointmaps(self.capture, self.images, maps, "predictions")

    def error(self, found: Calibration) -> np.ndarray:
        """True less found, in the order of the covariance."""
        rotation = self.gripper_from_camera[:3, :3] @ found.gripper_from_camera[:3, :3].T
        offset = self.gripper_from_camera[:3, 3] - found.gripper_from_camera[:3, 3]
        return np.concatenate([offset, rotation_log(rotation), [np.log(self.scale / found.scale)]])


def case(
    count: int, seed: int, noise: tuple[float, float] = (0.0, 0.0), errors: PairErrors | None = None
) -> Case:
    predictions, truth = synthetic_pairs(complete_pairs(count), SIZE, errors, seed)
    rng = np.random.default_rng(100 + seed)
    gripper_from_camera = transform(rotation_exp(rng.normal(0, 0.8, 3)), rng.uniform(-0.08, 0.08, 3))
    jitter = transform(
        rotation_exp(noise[1] * rng.normal(size=(count, 3))), noise[0] * rng.normal(size=(count, 3))
    )
    poses = truth.base_from_camera @ inverse(gripper_from_camera) @ jitter
    names = tuple(f"{k:02d}.png" for k in range(count))
    colors = np.zeros((count, SIZE[1], SIZE[0], 3), np.uint8)
    return Case(
        capture_of(poses, folder=Case.folder, images=names, image_size=SIZE, intrinsics=truth.intrinsics),
        PreparedImages(
            colors=colors,
            grid=ImageGrid(SIZE, SIZE, (0, 0), SIZE),
            intrinsics_of_capture=truth.intrinsics,
            pinhole=truth.intrinsics,
        ),
        replace(predictions, images=names, intrinsics=truth.intrinsics),
        truth.base_from_camera,
        gripper_from_camera,
        float(np.exp(-np.log(truth.pair_unit).mean())),
    )


def test_a_slip_is_named_beside_a_wrong_focal_length():
    made = case(12, 3, (1e-4, 3e-4), PairErrors(focal=0.03))
    gripper, x = made.capture.base_from_gripper, made.gripper_from_camera
    # By 6 mm and 2° after the fifth image.
    slip = transform(rotation_exp(np.radians([1.2, -1.2, 1.0])), np.array([0.004, -0.003, 0.003]))
    poses = np.concatenate([gripper[:5], gripper[5:] @ x @ inverse(x @ slip)])
    wrong = replace(made, capture=replace(made.capture, base_from_gripper=poses))
    assert (
        calibrate_reconstruction(wrong.capture, wrong.reconstruction()).findings[0].kind is FindingKind.SLIP
    )


@pytest.mark.parametrize(("off", "given"), [(0.03, False), (-0.1, True)])
def test_the_focal_length_of_a_network_is_a_measurement(off: float, given: bool):
    made = case(6, 2, NOISE, PairErrors(focal=off))
    truth = made.capture.intrinsics
    if not given:
        images = replace(made.images, pinhole=None, intrinsics_of_capture=None)
        made = replace(made, capture=replace(made.capture, intrinsics=None), images=images)
    reconstruction = made.reconstruction()
    found = calibrate_reconstruction(made.capture, reconstruction)
    assert found.converged
    error = made.error(found)
    assert error @ np.linalg.solve(found.covariance, error) < 18.5
    used = reconstruction.intrinsics
    assert used.fx / truth.fx - 1 == pytest.approx(0 if given else off, abs=5e-3)
    std = found.intrinsics.std[0] / used.fx
    contradicts = [one for one in found.findings if one.kind is FindingKind.INTRINSICS]
    assert len(contradicts) == (given and off == -0.1)
    if contradicts:
        assert contradicts[0].severity == "warns"
        assert "pointmaps show a focal length of 41 " in contradicts[0].text
    # A corner of the image, at a distance of one metre.
    corner = np.zeros(2)
    seen, true = (unproject(one, corner) for one in (used, truth))
    by = found.gripper_from_camera[:3, :3].T @ made.gripper_from_camera[:3, :3]
    offset = seen / np.linalg.norm(seen) - by @ true / np.linalg.norm(true)
    offset -= (
        found.gripper_from_camera[:3, :3].T @ (made.gripper_from_camera - found.gripper_from_camera)[:3, 3]
    )
    covariance = point_covariance(found.gripper_from_camera, found.uncertainty, used, corner, 1.0)
    assert offset @ np.linalg.solve(covariance + 1e-12 * np.eye(3), offset) < 11.3
    assert std == pytest.approx(0.05 if not given else 0.1 if contradicts else 0.005, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE])
def test_reported_sigmas_are_those_of_the_errors(noise: tuple[float, float]):
    # With an exact robot the network's errors are all there is; the robot's own noise is not known beforehand.
    squared = []
    for seed in range(10):
        made = case(4 + seed % 2, seed, noise)
        found = calibrate_reconstruction(made.capture, made.reconstruction())
        error = made.error(found)
        # The principal point is exact here, and the errors that it may have rotate the camera.
        of_pointmaps = found.covariance - found.uncertainty.budget.intrinsics
        squared.append(error @ np.linalg.solve(of_pointmaps, error))
    # Ten draws of a chi-squared with 7 degrees of freedom average 4.2 to 11.1 in 99 of 100 cases; covariances
    # widened for an estimated noise stay below.
    assert 2.0 < np.mean(squared) < 11.1
    assert np.sum(np.array(squared) > 14.07) <= 2


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "off_percent"), [(1.05, 5.0), (1000.0, 99900.0)])
def test_a_metric_network_is_fixed_against_the_robot(factor: float, off_percent: float):
    made = case(6, 3, (1e-4, 2e-4))
    network = replace(
        made.predictions,
        pts3d=made.predictions.pts3d * np.float32(factor * made.scale),
        pts3d_in_other_view=made.predictions.pts3d_in_other_view * np.float32(factor * made.scale),
        is_metric=True,
    )
    reconstruction = replace(made, predictions=network).reconstruction()
    found = calibrate_reconstruction(made.capture, reconstruction)
    (network,) = found.lengths
    assert network.name == "network"
    off, std_percent = 100 / (1 + network.robot_longer_percent / 100) - 100, 100 * found.uncertainty.std[6]
    assert abs(off - off_percent) < 4 * std_percent * factor
    assert std_percent < 0.2
    assert any("check the unit of the gripper poses" in text for text in found.warnings) == (factor > 10)


def test_evidence_survives_the_file(tmp_path: Path):
    made = case(3, 0).reconstruction()
    write_reconstruction(tmp_path / "reconstruction.npz", made)
    back = read_reconstruction(tmp_path / "reconstruction.npz")
    np.testing.assert_array_equal(back.evidence.recon_from_camera, made.evidence.recon_from_camera)
    np.testing.assert_array_equal(back.evidence.covariance, made.evidence.covariance)
    assert back.predicted_focal == made.predicted_focal is not None
