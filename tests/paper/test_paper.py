"""The published method: exact answers for exact data, misprints, parity of the alignment, and a run by one switch."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jcr
from jcr.calibration.record import PublishedCalibration, read_calibration
from jcr.errors import RejectedError
from jcr.geometry import rotation_exp, step_between, transform
from jcr.records import Intrinsics
from places import SHARED
from refusal import refused
from scenes import pairs_of
from simulation.capture import SimulateOptions, simulate
from simulation.pairs import PairErrors, pairs_of_capture, write_pairs
from simulation.problems import hand_eye_problem

pytest.importorskip("torch")

from jcr.paper.hand_eye import SCALES, hand_eye_rotation, motions, solve, translation_and_scale
from jcr.paper.run import calibrate_published

FIXTURES = SHARED / "align"


@pytest.mark.parametrize("seed", range(5))
def test_exact_poses_give_the_exact_transform_and_scale(seed: int):
    problem = hand_eye_problem(np.random.default_rng(seed), 6)
    x, scale = solve(problem.base_from_gripper, problem.recon_from_camera)
    np.testing.assert_allclose(x, problem.gripper_from_camera, atol=1e-9)
    assert scale == pytest.approx(problem.scale, rel=1e-9)


def test_hand_made_motions_about_two_axes_give_the_exact_transform():
    x = transform(rotation_exp(np.array([0.3, -0.2, 0.5])), np.array([0.02, -0.05, 0.1]))
    shifts = np.array([[0.1, 0.2, -0.1], [0.3, -0.1, 0.2]])
    quarter = transform(rotation_exp(np.pi / 2 * np.eye(3)[:2]), shifts)
    gripper = np.stack([np.eye(4), quarter[0], quarter[0] @ quarter[1]])
    camera = gripper @ x
    camera[:, :3, 3] /= 2.5
    a, b = motions(gripper), motions(camera)
    np.testing.assert_allclose(hand_eye_rotation(a, b), x[:3, :3], atol=1e-12)
    translation, scale = translation_and_scale(a, b, x[:3, :3])
    np.testing.assert_allclose(translation, x[:3, 3], atol=1e-12)
    assert scale == pytest.approx(2.5, rel=1e-12)
    # The search of the paper, in steps of 3/20000, and not beyond its range.
    translation, scale = translation_and_scale(a, b, x[:3, :3], SCALES)
    assert abs(scale - 2.5) <= SCALES[1] - SCALES[0] and np.abs(translation - x[:3, 3]).max() < 1e-3
    camera[:, :3, 3] /= 10
    assert translation_and_scale(a, motions(camera), x[:3, :3], SCALES)[1] == pytest.approx(4.0)


def test_too_few_poses_and_no_motion_are_rejected():
    problem = hand_eye_problem(np.random.default_rng(0), 4)
    with pytest.raises(RejectedError, match="2 images"):
        solve(problem.base_from_gripper[:2], problem.recon_from_camera[:2])


def test_the_record_has_residuals_and_no_covariance_and_is_read_back(tmp_path: Path):
    noisy = hand_eye_problem(np.random.default_rng(1), 8, robot_noise=(1e-3, 2e-3))
    pairs = pairs_of(noisy.base_from_gripper, noisy.recon_from_camera)
    found = calibrate_published(pairs, pairs)
    assert found.method == "paper" and found.uncertainty is None and found.robot_noise is None
    assert found.residuals.translation > 1e-4 and found.residuals.rotation > 1e-4
    assert "checks nothing" in found.warnings[0]
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(found.as_json()))
    again = read_calibration(path)
    assert isinstance(again, PublishedCalibration) and again == found
    difference = jcr.compare(path, found)
    assert difference.chi2 is None and not difference.translation_m.any()
    with refused("--method paper has no uncertainty"):
        _ = jcr.load_run(tmp_path).covariance


@pytest.mark.long
@pytest.mark.skipif(not (FIXTURES / "make_synthetic.py").is_file(), reason="../shared/align is absent")
def test_the_alignment_is_as_accurate_as_the_published_one(tmp_path: Path):
    from jcr.paper.alignment import align
    from jcr.pointmaps.pair_predictions import read_pairs

    made, result = tmp_path / "pairs.npz", tmp_path / "aligned.npz"
    subprocess.run([sys.executable, FIXTURES / "make_synthetic.py", "128", "96", "10", made], check=True)
    # Its principal point is that of DUSt3R, half a pixel from the middle of the grid.
    camera = Intrinsics(121.6, 121.6, 64.0, 48.0, 128, 96)
    found = align(replace(read_pairs(made), intrinsics=camera))
    np.savez(result, poses=found.recon_from_camera, focals=np.full(10, found.focal_px[0]), depth=found.depth)
    done = subprocess.run(
        [sys.executable, FIXTURES / "eval_ga.py", made, result], check=True, capture_output=True, text=True
    )
    words = done.stdout.split()
    mean_mm, deg = float(words[words.index("mean") + 1]), float(words[words.index("deg") + 2])
    # The published aligner: 0.84 mm and 0.091°.
    assert mean_mm < 1.1 and deg < 0.12, done.stdout


@pytest.fixture(scope="module")
def predicted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A simulated capture and predictions of its pairs."""
    folder = tmp_path_factory.mktemp("published")
    made = simulate(folder / "capture", SimulateOptions(images=3))
    write_pairs(folder / "pairs.npz", pairs_of_capture(made, errors=PairErrors(warp=0.003), seed=0)[0])
    return made, folder / "pairs.npz"


@pytest.mark.gl
def test_one_switch_runs_the_published_method_from_images_to_the_map(predicted: tuple[Path, Path], tmp_path):
    made, pairs = predicted
    options = {
        "method": "paper", "reconstruct": {"predictions": str(pairs)}, "map": {"steps": 10, "cell": 0.04},
    }  # fmt: skip
    result = jcr.run(made, tmp_path / "out", options)
    reference = json.loads((made / "reference.json").read_text())["gripper_from_camera"]
    step = step_between(result.gripper_from_camera, np.array(reference))
    assert np.linalg.norm(step[:3]) < 0.03 and np.degrees(np.linalg.norm(step[3:])) < 2
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert content["method"] == "paper" and content["uncertainty"] is None
    assert content["residuals"]["translation"] > 0
    assert "checks nothing" in (tmp_path / "out" / "report.html").read_text()
    scene = jcr.load_map(tmp_path / "out")
    assert scene.is_published and scene.history["steps"] == "10"
    with refused("no uncertainty"):
        scene.check_spheres(np.zeros((1, 3)), 0.1, confidence=0.95)
    assert jcr.run(made, tmp_path / "out", options).is_unchanged


@pytest.mark.gl
def test_options_and_back_ends_that_the_method_lacks_are_refused(predicted: tuple[Path, Path], tmp_path):
    made, _ = predicted
    with refused("does not use require"):
        jcr.calibrate(made, tmp_path, {"method": "paper", "calibrate": {"require": (1.0, 0.1)}})
    with refused("has no back end direct"):
        jcr.calibrate(made, tmp_path, {"method": "paper", "reconstruct": {"backend": "direct"}})
