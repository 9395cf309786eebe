"""Captures in every kind of file of poses, faults of single rows, and samples of marker-based tools."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import capture_writers as writers
import jcr
from jcr.calibration.stage import calibrate_pose_pairs
from jcr.calibration.summary import summary
from jcr.capture.read import format_of, read_source
from jcr.geometry import scale_translation
from jcr.records import Capture, PosePairs
from simulation.problems import HandEyeProblem, hand_eye_problem


@pytest.fixture(scope="module")
def problem() -> HandEyeProblem:
    return hand_eye_problem(np.random.default_rng(3), 12)


@pytest.fixture(scope="module")
def capture(tabletop: Path, problem: HandEyeProblem) -> Capture:
    """The bundled images, with poses whose cameras are known exactly and a intrinsics with distortion."""
    bundled = jcr.read_capture(tabletop)
    intrinsics = replace(bundled.intrinsics, distortion=(0.01, -0.02, 1e-3, -2e-3, 0.003))
    return replace(bundled, base_from_gripper=problem.base_from_gripper, intrinsics=intrinsics)


def assert_same(got: Capture, capture: Capture) -> None:
    """The same images, poses to 1e-9, and intrinsics."""
    assert len(got) == len(capture)
    for name, expected in zip(got.images, capture.images, strict=True):
        assert (got.folder / name).read_bytes() == (capture.folder / expected).read_bytes()
    assert np.allclose(got.base_from_gripper, capture.base_from_gripper, rtol=0, atol=1e-9)
    intrinsics, expected = got.intrinsics, capture.intrinsics
    assert intrinsics is not None and expected is not None
    assert (intrinsics.width, intrinsics.height) == (expected.width, expected.height)
    for one, other in ((intrinsics.matrix, expected.matrix), (intrinsics.distortion, expected.distortion)):
        assert np.allclose(one, other, rtol=0, atol=1e-9)


def assert_same_calibration(gripper: np.ndarray, camera: np.ndarray, problem: HandEyeProblem) -> None:
    solved = jcr.solve_hand_eye(gripper, camera)
    assert np.abs(solved.gripper_from_camera - problem.gripper_from_camera).max() < 1e-6


WRITERS = writers.CORPUS | {
    "ethz-asl": lambda folder, capture: writers.write_tum(
        folder, capture, "# t, x, y, z, q_x, q_y, q_z, q_w"
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_formats_read_back_one_capture(name: str, tmp_path: Path, capture: Capture, problem: HandEyeProblem):
    WRITERS[name](tmp_path, capture)
    got = jcr.read_capture(tmp_path)
    if got.candidates:  # neither names nor numbers tell the direction or the notation, and the images decide
        ((reading, poses),) = [
            one for one in got.candidates if np.allclose(one[1], capture.base_from_gripper, atol=1e-9)
        ]
        got = replace(got, base_from_gripper=poses, reading=reading, candidates=())
    assert_same(got, capture)
    assert_same_calibration(got.base_from_gripper, problem.recon_from_camera, problem)


@pytest.mark.parametrize("name", ["moveit", "easy_handeye2"])
def test_samples_of_markers_are_solved_without_images(name: str, tmp_path: Path, problem: HandEyeProblem):
    write = writers.write_moveit if name == "moveit" else writers.write_easy_handeye2
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    path = write(tmp_path, problem.base_from_gripper, cameras)
    assert format_of(path) == "samples"
    pairs = read_source(path)
    assert isinstance(pairs, PosePairs) and pairs.is_metric
    assert_same_calibration(pairs.base_from_gripper, pairs.recon_from_camera, problem)
    assert "from the robot and the size of the board" in summary(calibrate_pose_pairs(pairs))
    with pytest.raises(jcr.InputError, match="no images; use `jcr calibrate`"):
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


def edit_line(file: Path, number: int, change) -> None:
    lines = file.read_text().splitlines()
    lines[number] = change(lines[number])
    file.write_text("\n".join(lines) + "\n")


Spoil = Callable[[Path], object]
ROW_FAULTS: dict[str, tuple[int, Spoil, str]] = {
    "quaternion not of unit length": (
        0, lambda f: edit_line(f, 1, lambda line: ",".join([*line.split(",")[:4], "1", "1", "0", "0"])),
        "the row of images/00.jpg holds no pose",
    ),
    "far": (
        1,
        lambda f: edit_line(f, 2, lambda line: ",".join([*line.split(",")[:3], "812.5", *line.split(",")[4:]])),
        "the pose of images/01.jpg is 812.5 m from the base",
    ),
}  # fmt: skip
"""Faults of one row alone, and the index of that row."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> Path:
    """The folder of a table with its images."""
    return writers.write_table(tmp_path_factory.mktemp("table") / "table", capture).parent


@pytest.mark.parametrize("fault", ROW_FAULTS)
def test_a_row_without_pose_is_left_out_named(fault: str, tmp_path: Path, written: Path, capture: Capture):
    row, spoil, words = ROW_FAULTS[fault]
    folder = shutil.copytree(written, tmp_path / "table")
    spoil(folder / "poses.csv")
    got = jcr.read_capture(folder)
    assert got.images == capture.images[:row] + capture.images[row + 1 :]
    assert np.allclose(got.base_from_gripper, np.delete(capture.base_from_gripper, row, 0), atol=1e-9)
    assert any(re.search(f"left out: .*{words}", note) for note in got.notes)


def test_faults_of_samples_are_named(tmp_path: Path, problem: HandEyeProblem):
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    with pytest.raises(jcr.InputError, match="eye_on_base, a camera beside the robot"):
        read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, "eye_on_base"))
    empty = read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, ""))
    assert "taken as eye_in_hand" in empty.notes[0]
    mixed = read_source(writers.write_moveit(tmp_path, scale_translation(gripper, 1e3), camera))
    assert np.allclose(mixed.base_from_gripper, gripper), "millimetres are known by their size"
    with pytest.raises(jcr.InputError, match="2 frames; at least 3"):
        read_source(writers.write_moveit(tmp_path, gripper[:2], camera[:2]))
    for pose in ("[1, 2]", "[]"):
        (tmp_path / "samples.yaml").write_text(
            f"- {{effector_wrt_world: {pose}, object_wrt_sensor: [1]}}\n" * 3
        )
        with pytest.raises(jcr.InputError, match="effector_wrt_world: holds no poses"):
            read_source(tmp_path / "samples.yaml")


@pytest.mark.parametrize("key", ["mount", "arm"])
def test_a_camera_s_key_beside_the_frames_is_refused(key: str, tmp_path: Path):
    """The camera would be taken for one on the gripper without a word."""
    frames = [{"image": f"{k}.png", "base_from_gripper": np.eye(4).tolist()} for k in range(3)]
    (tmp_path / "capture.json").write_text(json.dumps({"frames": frames, key: "base"}))
    with pytest.raises(jcr.InputError, match=f'"{key}" belongs to a camera'):
        jcr.read_capture(tmp_path)


def test_intrinsics_of_another_size_and_rows_with_missing_numbers_are_named(tmp_path: Path, written: Path):
    folder = shutil.copytree(written, tmp_path / "table")
    info = folder / "camera_info.yaml"
    info.write_text(info.read_text().replace("image_width: 640", "image_width: 1280"))
    with pytest.raises(jcr.InputError, match="1280x480 pixels, images of 640x480"):
        jcr.read_capture(folder)
    info.unlink()
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text(
        "\n".join([*lines[:2], *(line.rsplit(",", 2)[0] for line in lines[2:])])
    )
    with pytest.raises(jcr.InputError):
        jcr.read_capture(folder)
