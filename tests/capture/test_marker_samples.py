"""Samples of marker-based tools, and the intrinsics beside a table of poses."""

from pathlib import Path

import numpy as np
import pytest

import capture_writers as writers
import jcr
from jcr.calibration.calibrate import calibrate_pose_pairs
from jcr.calibration.summary import summary
from jcr.capture.read import format_of, read_source
from jcr.geometry import scale_translation
from jcr.records import PosePairs
from refusal import refused
from simulation.problems import HandEyeProblem, hand_eye_problem


@pytest.fixture(scope="module")
def problem() -> HandEyeProblem:
    return hand_eye_problem(np.random.default_rng(3), 12)


@pytest.mark.parametrize("name", ["moveit", "easy_handeye2"])
def test_samples_of_markers_are_solved_without_images(name: str, tmp_path: Path, problem: HandEyeProblem):
    write = writers.write_moveit if name == "moveit" else writers.write_easy_handeye2
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    path = write(tmp_path, problem.base_from_gripper, cameras)
    assert format_of(path) == "samples"
    pairs = read_source(path)
    assert isinstance(pairs, PosePairs) and pairs.is_metric
    solved = jcr.solve_hand_eye(pairs.base_from_gripper, pairs.recon_from_camera)
    assert np.abs(solved.gripper_from_camera - problem.gripper_from_camera).max() < 1e-6
    assert "from the robot and the size of the board" in summary(calibrate_pose_pairs(pairs))
    with refused("no images; use `jcr calibrate`"):
        jcr.read_capture(path)


def test_a_scale_that_is_not_one_tells_of_a_marker_of_another_size(tmp_path: Path, problem: HandEyeProblem):
    from jcr.pipeline.run import calibrate_poses

    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    for size, words in ((1.0, None), (1.1, "the marker is 9.1 ± ")):
        path = writers.write_moveit(tmp_path, problem.base_from_gripper, scale_translation(cameras, size))
        result = calibrate_poses(read_source(path), tmp_path / "out")
        assert result.converged and result.calibration.backend == "poses given"
        assert result.calibration.scale == pytest.approx(1 / size, rel=1e-6)
        assert [words in warning for warning in result.calibration.warnings] == ([True] if words else [])


def test_faults_of_samples_are_named(tmp_path: Path, problem: HandEyeProblem):
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    with refused("eye_on_base, a camera beside the robot"):
        read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, "eye_on_base"))
    empty = read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, ""))
    assert "taken as eye_in_hand" in empty.notes[0]
    mixed = read_source(writers.write_moveit(tmp_path, scale_translation(gripper, 1e3), camera))
    assert np.allclose(mixed.base_from_gripper, gripper), "millimetres are known by their size"
    with refused("2 frames; at least 3"):
        read_source(writers.write_moveit(tmp_path, gripper[:2], camera[:2]))
    for pose in ("[1, 2]", "[]"):
        (tmp_path / "samples.yaml").write_text(
            f"- {{effector_wrt_world: {pose}, object_wrt_sensor: [1]}}\n" * 3
        )
        with refused("effector_wrt_world holds no poses"):
            read_source(tmp_path / "samples.yaml")


def test_intrinsics_beside_a_table_are_read_and_those_of_another_size_named(tmp_path: Path, tabletop: Path):
    bundled = jcr.read_capture(tabletop)
    folder = writers.write_table(tmp_path / "table", bundled).parent
    got = jcr.read_capture(folder)
    assert got.intrinsics == bundled.intrinsics
    np.testing.assert_allclose(got.base_from_gripper, bundled.base_from_gripper, atol=1e-9)
    info = folder / "camera_info.yaml"
    info.write_text(info.read_text().replace("image_width: 640", "image_width: 1280"))
    with refused("1280x480 pixels, images of 640x480"):
        jcr.read_capture(folder)
