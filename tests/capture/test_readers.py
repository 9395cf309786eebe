"""One capture in every format is read as the same capture; each fault is named with its place and remedy."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import capture_writers as writers
import jcr
from in_process import run_jcr
from jcr.capture.conventions import CONVENTIONS, poses_from_numbers
from jcr.capture.formats import capture_json, colmap
from jcr.capture.options import ReadOptions
from jcr.capture.pairing import stamp_ns
from jcr.capture.plain_files import read_npy, read_yaml
from jcr.capture.read import FORMATS, format_of, read_source
from jcr.cli.query import read_points
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
    assert intrinsics is not None and (intrinsics.width, intrinsics.height) == (
        expected.width,
        expected.height,
    )
    assert np.allclose([intrinsics.matrix.ravel()], [expected.matrix.ravel()], rtol=0, atol=1e-9)
    assert np.allclose(intrinsics.distortion, expected.distortion, rtol=0, atol=1e-12)


def assert_same_calibration(gripper: np.ndarray, camera: np.ndarray, problem: HandEyeProblem) -> None:
    solved = jcr.solve_hand_eye(gripper, camera)
    assert np.abs(solved.gripper_from_camera - problem.gripper_from_camera).max() < 1e-6


@pytest.mark.parametrize("name", [*writers.CORPUS, "ethz-asl"])
def test_images_and_poses_read_back_as_the_same_capture(
    name: str, tmp_path: Path, capture: Capture, problem: HandEyeProblem
):
    if name == "ethz-asl":
        writers.write_tum(tmp_path, capture, "# t, x, y, z, q_x, q_y, q_z, q_w")
    else:
        writers.CORPUS[name](tmp_path, capture)
    got = jcr.read_capture(tmp_path)
    assert_same(got, capture)
    assert_same_calibration(got.base_from_gripper, problem.recon_from_camera, problem)


def test_cameras_that_were_given_read_back_with_their_capture(
    tmp_path: Path, capture: Capture, problem: HandEyeProblem
):
    path = writers.write_colmap(tmp_path, capture, problem.recon_from_camera)
    assert format_of(path) == "colmap"
    got = jcr.read_capture(path)
    assert_same(got, capture)
    _, cameras = colmap.read_cameras(got.cameras)
    assert np.allclose(cameras, problem.recon_from_camera, atol=1e-9)
    assert_same_calibration(got.base_from_gripper, cameras, problem)


@pytest.mark.parametrize("name", [b"x" * 300, b"../../secret.png"])
def test_a_model_that_names_no_file_is_refused(
    name: bytes, tmp_path: Path, capture: Capture, problem: HandEyeProblem
):
    """The long name was found by fuzzing."""
    path = writers.write_colmap(tmp_path, capture, problem.recon_from_camera)
    file = path / "sparse" / "0" / "images.bin"
    known = Path(capture.images[2]).name.encode() + b"\0"
    data = file.read_bytes()
    assert data.count(known) == 1
    file.write_bytes(data.replace(known, name + b"\0"))
    with pytest.raises(jcr.InputError, match="no path inside|leads out"):
        jcr.read_capture(path)


@pytest.mark.parametrize("name", ["moveit", "easy_handeye2"])
def test_samples_of_markers_are_solved_without_images(name: str, tmp_path: Path, problem: HandEyeProblem):
    write = writers.write_moveit if name == "moveit" else writers.write_easy_handeye2
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    path = write(tmp_path, problem.base_from_gripper, cameras)
    assert format_of(path) == "samples"
    pairs = read_source(path)
    assert isinstance(pairs, PosePairs) and pairs.is_metric
    assert_same_calibration(pairs.base_from_gripper, pairs.recon_from_camera, problem)
    with pytest.raises(jcr.InputError, match="no images; use `jcr calibrate`"):
        jcr.read_capture(path)


def test_a_scale_that_is_not_one_tells_of_a_marker_of_another_size(tmp_path: Path, problem: HandEyeProblem):
    from jcr.pipeline.run import calibrate_poses

    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    for size, words in ((1.0, None), (1.1, "10.0 % too large")):
        path = writers.write_moveit(tmp_path, problem.base_from_gripper, scale_translation(cameras, size))
        result = calibrate_poses(read_source(path), tmp_path / "out")
        assert result.converged and result.calibration.backend == "poses given"
        assert result.calibration.scale == pytest.approx(1 / size, rel=1e-6)
        assert [words in warning for warning in result.calibration.warnings] == ([True] if words else [])


def test_an_orbit_hides_the_scale_and_a_marker_gives_it_back(tmp_path: Path):
    from jcr.pipeline.run import calibrate_poses

    orbit = hand_eye_problem(np.random.default_rng(5), 12, "orbit")
    cameras = scale_translation(orbit.recon_from_camera, orbit.scale)
    assert not jcr.solve_hand_eye(orbit.base_from_gripper, cameras).converged
    result = calibrate_poses(
        read_source(writers.write_moveit(tmp_path, orbit.base_from_gripper, cameras)), tmp_path
    )
    assert result.converged and "taken as 1" in " ".join(result.calibration.warnings)
    off = result.hand_eye.gripper_from_camera - orbit.gripper_from_camera
    assert np.abs(off).max() < 1e-4


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_controller_is_read_as_it_writes(convention: str, problem: HandEyeProblem):
    poses = problem.base_from_gripper
    got = poses_from_numbers(writers.rows_as(convention, poses), convention, "auto", "table")
    assert np.allclose(got, poses, rtol=0, atol=1e-9)


def test_known_poses_of_controllers():
    """Values from the controllers' manuals, not from our own writer."""
    # UR: p[0.1, 0.2, 0.3, 0, 3.1416, 0] rotates by 180° about y.
    ur = poses_from_numbers(np.array([[0.1, 0.2, 0.3, 0, np.pi, 0]]), "ur", "auto", "")
    assert np.allclose(ur[0, :3, :3], np.diag([-1, 1, -1]), atol=1e-9)
    # KUKA: A=90 about z, then B=90 about the new y: the tool's x axis ends up pointing down.
    kuka = poses_from_numbers(np.array([[500, 0, 300, 90, 90, 0.0]]), "kuka", "auto", "")
    assert np.allclose(kuka[0, :3, 0], [0, 0, -1], atol=1e-9)
    assert np.allclose(kuka[0, :3, 3], [0.5, 0, 0.3])
    # ABB: [[600,0,400],[0,1,0,0]] is w, x, y, z: 180° about x.
    abb = poses_from_numbers(np.array([[600, 0, 400, 0, 1, 0, 0.0]]), "abb", "auto", "")
    assert np.allclose(abb[0, :3, :3], np.diag([1, -1, -1]), atol=1e-9)
    # Franka: the translation is the last four of sixteen.
    franka = poses_from_numbers(
        np.array([[1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, 0.3, 0, 0.5, 1.0]]), "franka", "auto", ""
    )
    assert np.allclose(franka[0, :3, 3], [0.3, 0, 0.5])


def named(keys: str, values: np.ndarray) -> dict[str, float]:
    return dict(zip(keys, values.tolist(), strict=True))


POSE_FORMS = {
    "geometry_msgs/Pose": lambda pose, q, v: {
        "position": named("xyz", pose[:3, 3]), "orientation": named("xyzw", q)
    },
    "geometry_msgs/PoseStamped": lambda pose, q, v: {
        "header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "base_link"},
        "pose": {"position": named("xyz", pose[:3, 3]), "orientation": named("xyzw", q)},
    },
    "geometry_msgs/PoseWithCovariance": lambda pose, q, v: {
        "pose": {"position": named("xyz", pose[:3, 3]), "orientation": named("xyzw", q)}, "covariance": [0.0] * 36
    },
    "geometry_msgs/Transform": lambda pose, q, v: {
        "translation": named("xyz", pose[:3, 3]), "rotation": named("xyzw", q)
    },
    "quaternion list": lambda pose, q, v: {"t": pose[:3, 3].tolist(), "quaternion": q.tolist()},
    "quaternion list, w first": lambda pose, q, v: {"xyz": pose[:3, 3].tolist(), "quat_wxyz": q[[3, 0, 1, 2]].tolist()},
    "rotation vector": lambda pose, q, v: {"tvec": pose[:3, 3].tolist(), "rvec": v.tolist()},
    "rotation matrix": lambda pose, q, v: {"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()},
    "matrix": lambda pose, q, v: {"base_from_gripper": pose.tolist()},
    "matrix of 16": lambda pose, q, v: {"pose": pose.ravel().tolist()},
    "bare matrix": lambda pose, q, v: pose.tolist(),
    "columns": lambda pose, q, v: named(["x", "y", "z", "qx", "qy", "qz", "qw"], np.append(pose[:3, 3], q)),
    "easy_handeye2": lambda pose, q, v: {
        "robot": {"translation": named("xyz", pose[:3, 3]), "rotation": named("xyzw", q)},
        "tracking": {"translation": named("xyz", np.ones(3)), "rotation": named("xyzw", np.eye(4)[3])},
    },
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
@pytest.mark.parametrize("form", POSE_FORMS)
def test_lists_of_poses_are_recognised_by_their_content(
    form: str, suffix: str, tmp_path: Path, capture: Capture
):
    writers.copy_images(capture, tmp_path)
    writers.write_camera_info(capture, tmp_path)
    entries = []
    for pose in capture.base_from_gripper:
        rotation = Rotation.from_matrix(pose[:3, :3])
        entries.append(POSE_FORMS[form](pose, rotation.as_quat(), rotation.as_rotvec()))
    file = tmp_path / f"poses{suffix}"
    write = json.dumps if suffix == ".json" else yaml.safe_dump
    for content in (entries, {"poses": entries}, dict(zip(capture.images, entries, strict=True))):
        file.write_text(write(content))
        assert_same(jcr.read_capture(tmp_path), capture)
    if isinstance(entries[0], dict) and form != "columns":
        content = [entry | {"image": name} for name, entry in zip(capture.images, entries, strict=True)]
        file.write_text(write(content[::-1]))
        got = jcr.read_capture(tmp_path)
        assert got.images == capture.images[::-1]
        assert np.allclose(got.base_from_gripper, capture.base_from_gripper[::-1], atol=1e-9)


def test_messages_as_ros2_topic_echo_prints_them_are_read(tmp_path: Path, capture: Capture):
    writers.copy_images(capture, tmp_path)
    writers.write_camera_info(capture, tmp_path)
    rows = writers.rows_as("quat-xyzw", capture.base_from_gripper)
    documents = [
        POSE_FORMS["geometry_msgs/Pose"](np.block([[np.eye(3), row[:3, None]]]), row[3:], None)
        for row in rows
    ]
    (tmp_path / "poses.yaml").write_text("".join(f"{yaml.safe_dump(one)}---\n" for one in documents))
    assert_same(jcr.read_capture(tmp_path), capture)


def test_a_list_entry_without_a_pose_is_named(tmp_path: Path, capture: Capture):
    writers.copy_images(capture, tmp_path)
    for entry in ({"orientation": [0, 0, 0, 1]}, {"tool": "none"}, 7, [[1, 2], [3, 4]]):
        (tmp_path / "poses.json").write_text(json.dumps([entry] * 12))
        with pytest.raises(jcr.InputError, match=r"poses\.json: .*(no pose|contain no pose)"):
            jcr.read_capture(tmp_path)


def test_units_in_the_names_of_columns_are_believed(tmp_path: Path, capture: Capture):
    writers.write_table(tmp_path, capture, "xarm", "image,x [mm],y [mm],z [mm],roll_deg,pitch_deg,yaw_deg")
    assert_same(jcr.read_capture(tmp_path), capture)


def test_images_are_paired_as_people_count(tmp_path: Path, capture: Capture):
    """img2 comes before img10."""
    names = [f"img{k}.jpg" for k in range(1, 13)]
    for name, image in zip(names, capture.images, strict=True):
        shutil.copy(capture.folder / image, tmp_path / name)
    np.save(tmp_path / "poses.npy", capture.base_from_gripper)
    got = jcr.read_capture(tmp_path)
    assert got.images == tuple(names)
    assert "paired" in got.notes[0]


def test_poses_are_interpolated_at_nanosecond_stamps(tmp_path: Path, capture: Capture):
    """Half-way between two poses, at a stamp whose last digits a float would lose."""
    moved = capture.base_from_gripper[:3].copy()
    moved[:, :3, 3] += [0.1, 0, 0]
    start = 1_700_000_000_000_000_001
    (tmp_path / "images").mkdir()
    lines = []
    for k in range(3):
        shutil.copy(capture.folder / capture.images[k], tmp_path / "images" / f"{start + k * 10**9}.jpg")
        for shift, pose in ((-3, capture.base_from_gripper[k]), (1, moved[k])):
            row = writers.rows_as("quat-xyzw", pose[None])[0]
            lines.append(" ".join([str(start + k * 10**9 + shift), *map(repr, row.tolist())]))
    (tmp_path / "poses.txt").write_text("\n".join(lines))
    got = jcr.read_capture(tmp_path)
    assert np.allclose(got.base_from_gripper[:, 0, 3] - capture.base_from_gripper[:3, 0, 3], 0.075, atol=1e-9)


def test_an_image_without_a_pose_near_its_time_and_a_damaged_sample_are_left_out(
    tmp_path: Path, capture: Capture
):
    writers.write_tum(tmp_path, capture)
    file = tmp_path / "poses.txt"
    lines = file.read_text().splitlines()
    lines[9] = lines[9].rsplit(" ", 1)[0] + " nan"  # the second sample of the fifth image
    del lines[4:6]  # both samples of the third image
    file.write_text("\n".join(lines))
    got = jcr.read_capture(tmp_path, ReadOptions(max_gap_ms=500.0))
    kept = [k for k in range(12) if k not in (2, 4)]
    assert sum("no pose within 500 ms" in note for note in got.notes) == 2
    assert np.allclose(got.base_from_gripper, capture.base_from_gripper[kept], atol=1e-6)


def test_a_run_keeps_what_it_read_so_that_it_can_go_on(tmp_path: Path, capture: Capture):
    source = tmp_path / "source"
    got = jcr.read_capture(writers.write_table(source, capture))
    there = capture_json.kept(got, tmp_path / "kept")
    shutil.rmtree(source)
    again = jcr.read_capture(tmp_path / "kept")
    assert_same(again, capture)
    # To the last bit: a reconstruction is taken up again only where nothing changed.
    assert (again.base_from_gripper == there.base_from_gripper).all() and again.images == there.images


def edit_line(file: Path, number: int, change) -> None:
    lines = file.read_text().splitlines()
    lines[number] = change(lines[number])
    file.write_text("\n".join(lines) + "\n")


def scaled(folder: Path, convention: str, header: str, position: float = 1, angle: float = 1) -> None:
    rows = (folder / "poses.csv").read_text().splitlines()[1:]
    poses = poses_from_numbers(
        np.array([[float(cell) for cell in row.split(",")[1:]] for row in rows]), "quat-xyzw", "auto", ""
    )
    numbers = writers.rows_as(convention, poses) * ([position] * 3 + [angle] * (len(header.split(",")) - 4))
    cells = [[row.split(",")[0], *map(repr, line.tolist())] for row, line in zip(rows, numbers, strict=True)]
    (folder / "poses.csv").write_text("\n".join([header, *(",".join(line) for line in cells)]))


RPY = "image,x,y,z,roll,pitch,yaw"
FAULTS = {
    "column missing": (
        lambda f: edit_line(f, 0, lambda line: line.replace("qw", "q")),
        {},
        "contain no pose",
    ),
    "column of the convention missing": (
        lambda f: None,
        {"pose_convention": "kuka"},
        "no column a, b, c, which --pose-convention kuka needs",
    ),
    "row short": (
        lambda f: edit_line(f, 3, lambda line: line.rsplit(",", 1)[0]),
        {},
        "row 3 has 7 columns, not 8",
    ),
    "image outside": (
        lambda f: edit_line(f, 1, lambda line: "../99.jpg" + line[line.index(",") :]),
        {},
        "leads out of",
    ),
    "millimetres": (
        lambda f: scaled(f.parent, "rpy", RPY, 1e3),
        {},
        "look like millimetres: add --pose-units mm-rad",
    ),
    "degrees": (
        lambda f: scaled(f.parent, "rpy", RPY, 1, 57.3),
        {},
        "look like degrees: add --pose-units m-deg",
    ),
    "metres for millimetres": (
        lambda f: scaled(f.parent, "rpy", RPY, 1, 57.3),
        {"pose_convention": "xarm"},
        "too near for this convention's millimetres",
    ),
    "radians for degrees": (
        lambda f: scaled(f.parent, "rpy", RPY, 1e3),
        {"pose_convention": "xarm"},
        "too small for this convention's degrees",
    ),
    "rx ry rz": (
        lambda f: scaled(f.parent, "ur", "image,x,y,z,rx,ry,rz"),
        {},
        "rotation vector .* or angles",
    ),
    "gzip": (lambda f: f.write_bytes(b"\x1f\x8b\x08\x00rest"), {}, "compressed by gzip"),
    "an image": (lambda f: f.write_bytes((f.parent / "images/00.jpg").read_bytes()), {}, "not UTF-8"),
    "empty": (lambda f: f.write_text(""), {}, "holds no poses"),
    "two frames": (
        lambda f: f.write_text("\n".join(f.read_text().splitlines()[:3])),
        {},
        "2 frames; at least 3",
    ),
    "intrinsics of another size": (
        lambda f: (f.parent / "camera_info.yaml").write_text(
            (f.parent / "camera_info.yaml").read_text().replace("image_width: 640", "image_width: 1280")
        ),
        {},
        "intrinsics of 1280x480 pixels, images of 640x480",
    ),
    "fisheye intrinsics": (
        lambda f: (f.parent / "camera_info.yaml").write_text(
            (f.parent / "camera_info.yaml").read_text().replace("plumb_bob", "equidistant")
        ),
        {},
        "distortion model 'equidistant'",
    ),
    "YAML that makes objects": (
        lambda f: (f.parent / "camera_info.yaml").write_text("!!python/object/apply:os.system [echo]"),
        {},
        "not YAML",
    ),
}
ROW_FAULTS = {
    "word for a number": (
        lambda f: edit_line(f, 2, lambda line: line.rsplit(",", 1)[0] + ",here"),
        {},
        "row 2, column qw: 'here' is not a number",
    ),
    "NaN": (
        lambda f: edit_line(f, 2, lambda line: line.rsplit(",", 1)[0] + ",nan"),
        {},
        "pose 2 holds NaN",
    ),
    "quaternion not of unit length": (
        lambda f: edit_line(f, 1, lambda line: ",".join([*line.split(",")[:4], "1", "1", "0", "0"])),
        {},
        r"pose 1: its quaternion has length 1\.414",
    ),
}
ROW_FAULTS |= {
    "far": (
        lambda f: edit_line(
            f, 2, lambda line: ",".join([*line.split(",")[:3], "812.5", *line.split(",")[4:]])
        ),
        {},
        "pose 2 is 812.5 m from the base",
    ),
    "image not there": (
        lambda f: edit_line(f, 1, lambda line: "images/99.jpg" + line[line.index(",") :]),
        {},
        "99.jpg: no such image",
    ),
    "image": (lambda f: (f.parent / "images/01.jpg").unlink(), {}, "no such image"),
}
"""Faults of one row alone."""


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_tables_are_named(fault: str, tmp_path: Path, capture: Capture):
    spoil, options, words = FAULTS[fault]
    file = writers.write_table(tmp_path, capture)
    spoil(file)
    with pytest.raises(jcr.InputError, match=words) as caught:
        jcr.read_capture(tmp_path, ReadOptions(**options))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ROW_FAULTS)
def test_a_row_that_holds_no_pose_is_left_out_with_its_reason(fault: str, tmp_path: Path, capture: Capture):
    spoil, _, words = ROW_FAULTS[fault]
    spoil(writers.write_table(tmp_path, capture))
    got = jcr.read_capture(tmp_path)
    row = 0 if "quaternion" in fault or "there" in fault else 1
    assert got.images == capture.images[:row] + capture.images[row + 1 :]
    assert np.allclose(got.base_from_gripper, np.delete(capture.base_from_gripper, row, 0), atol=1e-9)
    assert any(re.search(f"left out: .*{words}", note) for note in got.notes)


def test_counts_that_differ_are_named(tmp_path: Path, capture: Capture):
    writers.write_npy(tmp_path, capture)
    np.save(tmp_path / "poses.npy", capture.base_from_gripper[:-1])
    with pytest.raises(jcr.InputError, match="11 poses for 12 images"):
        jcr.read_capture(tmp_path)
    np.save(tmp_path / "poses.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(jcr.InputError, match="not a NumPy array of numbers"):
        jcr.read_capture(tmp_path)


def test_numbers_without_names_ask_for_their_convention(tmp_path: Path, capture: Capture):
    writers.write_table(tmp_path, capture, "ur", header=None)
    with pytest.raises(jcr.InputError, match="6 columns of numbers without names; .*--pose-convention"):
        jcr.read_capture(tmp_path)
    assert_same(jcr.read_capture(tmp_path, ReadOptions(pose_convention="ur")), capture)


def test_faults_of_samples_are_named(tmp_path: Path, problem: HandEyeProblem):
    gripper, camera = problem.base_from_gripper, problem.recon_from_camera
    with pytest.raises(jcr.InputError, match="eye_on_base, a camera beside the robot"):
        read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, "eye_on_base"))
    empty = read_source(writers.write_easy_handeye2(tmp_path, gripper, camera, ""))
    assert "taken as eye_in_hand" in empty.notes[0]
    with pytest.raises(jcr.InputError, match="look like millimetres"):
        read_source(writers.write_moveit(tmp_path, scale_translation(gripper, 1e3), camera))
    with pytest.raises(jcr.InputError, match="2 frames; at least 3"):
        read_source(writers.write_moveit(tmp_path, gripper[:2], camera[:2]))
    (tmp_path / "samples.yaml").write_text("- {effector_wrt_world: [1, 2], object_wrt_sensor: [1]}\n")
    with pytest.raises(jcr.InputError, match="effector_wrt_world: 2 columns of numbers without names"):
        read_source(tmp_path / "samples.yaml")


def test_faults_of_given_cameras_are_named(tmp_path: Path, capture: Capture, problem: HandEyeProblem):
    folder = writers.write_colmap(tmp_path / "capture", capture, problem.recon_from_camera)
    (folder / "poses.csv").unlink()
    with pytest.raises(jcr.InputError, match="holds no table of poses .*; name it with --poses"):
        jcr.read_capture(folder)
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cameras.bin").write_bytes(b"nonsense")
    with pytest.raises(jcr.InputError, match="not a readable COLMAP model"):
        jcr.read_capture(tmp_path / "model")


def test_what_is_no_capture_is_named_what_would_be_one(tmp_path: Path):
    with pytest.raises(jcr.InputError, match="holds no capture.json, nor anything else"):
        jcr.read_capture(tmp_path)
    (tmp_path / "notes.md").write_text("hello")
    with pytest.raises(jcr.InputError, match="give its format with --format") as caught:
        jcr.read_capture(tmp_path / "notes.md")
    assert all(name in str(caught.value) for name in FORMATS)


@pytest.mark.slow
def test_the_command_line_calibrates_samples(tmp_path: Path, problem: HandEyeProblem):
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    path = writers.write_easy_handeye2(tmp_path, problem.base_from_gripper, cameras)
    done = run_jcr("calibrate", path, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "the scale is 1, as the marker's size says" in done.stdout
    content = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert np.abs(content["gripper_from_camera"] - problem.gripper_from_camera).max() < 1e-6
    checked = run_jcr("check", path, "--json")
    assert checked.returncode == 0 and json.loads(checked.stdout)["observability"]["observable"]
    refused = run_jcr("run", path, tmp_path / "map")
    assert (
        refused.returncode == 2 and refused.stderr.startswith("error: ") and "jcr calibrate" in refused.stderr
    )


@pytest.mark.slow
def test_swapped_poses_of_samples_are_named(tmp_path: Path, problem: HandEyeProblem):
    """Gripper poses given as base in gripper, the commonest mistake of all."""
    cameras = scale_translation(problem.recon_from_camera, problem.scale)
    path = writers.write_moveit(tmp_path, np.linalg.inv(problem.base_from_gripper), cameras)
    from jcr.pipeline.run import calibrate_poses

    result = calibrate_poses(read_source(path), tmp_path / "out")
    assert not result.converged and "inverses" in result.calibration.warnings[0]


@pytest.mark.parametrize("text", ["9700000000000000000", "1e30", "0.58E58800781040842", "nan", "now"])
def test_a_stamp_that_64_bits_do_not_hold_is_refused(text: str):
    """By fuzzing: the first made floats of all the stamps beside it, the third was too large to compare."""
    assert stamp_ns("9200000000000000000", "a table") == 9_200_000_000_000_000_000
    with pytest.raises(jcr.InputError, match="not a time stamp"):
        stamp_ns(text, "a table")


def test_an_archive_named_as_an_array_is_refused(tmp_path: Path):
    """Found by fuzzing: numpy.load opens what begins with PK as an archive, whatever its name."""
    np.savez(tmp_path / "points.npz", points=np.zeros((2, 3)))
    (tmp_path / "points.npz").rename(tmp_path / "points.npy")
    for read in (read_npy, read_points):
        with pytest.raises(jcr.InputError, match=r"points\.npy: not a NumPy array"):
            read(tmp_path / "points.npy")


@pytest.mark.parametrize(
    "text",
    ['"\\U99999999"', "2001-99-99", "1" * 5000, "[" * 3000, "{a: b", "&a [*a", "!!python/name:os.system"],
)
def test_yaml_that_cannot_be_is_refused(text: str, tmp_path: Path):
    """The character beyond Unicode was found by fuzzing."""
    file = tmp_path / "poses.yaml"
    file.write_text(text)
    with pytest.raises(jcr.InputError, match=r"poses\.yaml: "):
        read_yaml(file)
