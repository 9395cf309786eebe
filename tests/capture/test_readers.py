"""One capture in every format is read as the same capture; each fault is named with its place and remedy."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from jcr.capture.controllers import CONVENTIONS, poses_from_numbers
from jcr.capture.formats.table import read_pose_table
from jcr.capture.plain_files import read_yaml
from scipy.spatial.transform import Rotation

import capture_writers as writers
import jcr
from jcr.capture.options import ReadOptions
from jcr.capture.pairing import PoseTable, stamp_ns
from jcr.capture.read import FORMATS, format_of, read_source
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


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_every_controller_is_read_as_it_writes(convention: str, problem: HandEyeProblem):
    poses = problem.base_from_gripper
    numbers = writers.rows_as(convention, poses)
    got = poses_from_numbers(numbers, convention, "auto", "table")
    assert np.allclose(got, poses, rtol=0, atol=1e-9)
    form = CONVENTIONS[convention]
    if form.rotation != "matrix":
        # In other units than the controller's.
        numbers[:, :3] *= form.scales("auto")[0] / form.scales("mm-deg")[0]
        numbers[:, 3:] *= form.scales("auto")[1] / form.scales("mm-deg")[1] if form.has_angles else 1.0
        got = poses_from_numbers(numbers, convention, "mm-deg", "table")
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


def pose_message(
    xyz: np.ndarray, quat_xyzw: np.ndarray, keys: tuple[str, str] = ("position", "orientation")
) -> dict:
    parts = dict(zip("xyz", xyz.tolist(), strict=True)), dict(zip("xyzw", quat_xyzw.tolist(), strict=True))
    return dict(zip(keys, parts, strict=True))


TRANSFORM = ("translation", "rotation")
POSE_FORMS = {
    "geometry_msgs/Pose": lambda pose, t, q, v: pose_message(t, q),
    "geometry_msgs/PoseStamped": lambda pose, t, q, v: {
        "header": {"stamp": {"sec": 1, "nanosec": 5}, "frame_id": "base_link"}, "pose": pose_message(t, q)
    },
    "geometry_msgs/PoseWithCovariance": lambda pose, t, q, v: {"pose": pose_message(t, q), "covariance": [0.0] * 36},
    "geometry_msgs/Transform": lambda pose, t, q, v: pose_message(t, q, TRANSFORM),
    "quaternion list": lambda pose, t, q, v: {"t": t.tolist(), "quaternion": q.tolist()},
    "quaternion list, w first": lambda pose, t, q, v: {"xyz": t.tolist(), "quat_wxyz": q[[3, 0, 1, 2]].tolist()},
    "rotation vector": lambda pose, t, q, v: {"tvec": t.tolist(), "rvec": v.tolist()},
    "rotation matrix": lambda pose, t, q, v: {"R": pose[:3, :3].tolist(), "t": t.tolist()},
    "matrix": lambda pose, t, q, v: {"base_from_gripper": pose.tolist()},
    "matrix of 16": lambda pose, t, q, v: {"pose": pose.ravel().tolist()},
    "bare matrix": lambda pose, t, q, v: pose.tolist(),
    "columns": lambda pose, t, q, v: dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*t, *q], strict=True)),
}  # fmt: skip


def table_of(tmp_path: Path, text: str, suffix: str = ".csv") -> PoseTable:
    (tmp_path / f"poses{suffix}").write_text(text)
    return read_pose_table(tmp_path / f"poses{suffix}", ReadOptions())


def listed(tmp_path: Path, suffix: str, content) -> PoseTable:
    plain = json.dumps(content)
    return table_of(tmp_path, plain if suffix == ".json" else yaml.safe_dump(json.loads(plain)), suffix)


@pytest.mark.parametrize("form", POSE_FORMS)
def test_lists_of_poses_are_recognised_by_their_content(form: str, tmp_path: Path, problem: HandEyeProblem):
    poses = problem.base_from_gripper
    names = tuple(f"{k}.png" for k in range(len(poses)))
    entries = []
    for pose in poses:
        rotation = Rotation.from_matrix(pose[:3, :3])
        entries.append(POSE_FORMS[form](pose, pose[:3, 3], rotation.as_quat(), rotation.as_rotvec()))
    by_name = dict(zip(names, entries, strict=True))
    for suffix, content in ((".yaml", entries), (".json", {"poses": entries}), (".json", by_name)):
        got = listed(tmp_path, suffix, content)
        assert np.allclose(got.base_from_gripper, poses, atol=1e-9) and not got.faults
        assert got.images == (names if content is by_name else None)
    if isinstance(entries[0], dict) and form != "columns":
        with_images = [entry | {"image": name} for name, entry in by_name.items()]
        got = listed(tmp_path, ".json", with_images[::-1])
        assert got.images == names[::-1] and np.allclose(got.base_from_gripper, poses[::-1], atol=1e-9)


def test_messages_as_ros2_topic_echo_prints_them_are_read(tmp_path: Path, problem: HandEyeProblem):
    rows = writers.rows_as("quat-xyzw", problem.base_from_gripper)
    documents = [pose_message(row[:3], row[3:]) for row in rows]
    got = table_of(tmp_path, "".join(f"{yaml.safe_dump(one)}---\n" for one in documents), ".yaml")
    assert np.allclose(got.base_from_gripper, problem.base_from_gripper, atol=1e-9)


def test_a_list_entry_without_a_pose_is_named(tmp_path: Path):
    for entry in ({"orientation": [0, 0, 0, 1]}, {"tool": "none"}, 7, [[1, 2], [3, 4]]):
        with pytest.raises(jcr.InputError, match=r"poses\.json: .*(no pose|contain no pose)"):
            listed(tmp_path, ".json", [entry] * 12)


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


def test_an_image_without_a_near_pose_and_a_damaged_sample_are_left_out(tmp_path: Path, capture: Capture):
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


def edit_line(file: Path, number: int, change) -> None:
    lines = file.read_text().splitlines()
    lines[number] = change(lines[number])
    file.write_text("\n".join(lines) + "\n")


def edit_info(file: Path, was: str, now: str) -> None:
    info = file.parent / "camera_info.yaml"
    info.write_text(info.read_text().replace(was, now))


def scaled(file: Path, convention: str, header: str, position: float = 1, angle: float = 1) -> None:
    rows = file.read_text().splitlines()[1:]
    poses = poses_from_numbers(
        np.array([[float(cell) for cell in row.split(",")[1:]] for row in rows]), "quat-xyzw", "auto", ""
    )
    numbers = writers.rows_as(convention, poses) * ([position] * 3 + [angle] * (len(header.split(",")) - 4))
    cells = [[row.split(",")[0], *map(repr, line.tolist())] for row, line in zip(rows, numbers, strict=True)]
    file.write_text("\n".join([header, *(",".join(line) for line in cells)]))


RPY = "image,x,y,z,roll,pitch,yaw"
Spoil = Callable[[Path], object]
FAULTS: dict[str, tuple[Spoil, str, str]] = {
    "column missing": (
        lambda f: edit_line(f, 0, lambda line: line.replace("qw", "q")), "auto", "contain no pose"
    ),
    "row short": (
        lambda f: edit_line(f, 3, lambda line: line.rsplit(",", 1)[0]), "auto", "row 3 has 7 columns, not 8"
    ),
    "millimetres": (
        lambda f: scaled(f, "rpy", RPY, 1e3), "auto", "look like millimetres: .*add --pose-units mm-rad"
    ),
    "degrees": (
        lambda f: scaled(f, "rpy", RPY, 1, 57.3), "auto", "look like degrees: add --pose-units m-deg"
    ),
    "metres for millimetres": (
        lambda f: scaled(f, "rpy", RPY, 1, 57.3), "xarm", "too near for this convention's millimetres"
    ),
    "columns for rows": (
        lambda f: scaled(f, "franka", "image," + ",".join(CONVENTIONS["matrix"].columns)), "auto", "transposed"
    ),
    "rx ry rz": (
        lambda f: scaled(f, "ur", "image,x,y,z,rx,ry,rz"), "auto", "rotation vector .* or angles"
    ),
    "a line that is no UR pose": (
        lambda f: f.write_text("0.png p[0.4,0,0.5,0,3,0]\n1.png 0.4 0 0.5\n"), "auto", "line 2 holds no p"
    ),
    "no text": (lambda f: f.write_bytes(b"\x89PNG\xff"), "auto", "not UTF-8"),
    "image outside": (
        lambda f: edit_line(f, 1, lambda line: "../99.jpg" + line[line.index(",") :]), "auto", "leads out of"
    ),
    "images not there": (
        lambda f: [(f.parent / f"images/0{k}.jpg").unlink() for k in range(4)], "auto",
        r"4 of 12 images that are not in .*: images/00.jpg, images/01.jpg",
    ),
    "intrinsics of another size": (
        lambda f: edit_info(f, "image_width: 640", "image_width: 1280"), "auto",
        "intrinsics of 1280x480 pixels, images of 640x480",
    ),
}  # fmt: skip
"""Changes of a table or its folder, and the convention with which it is read."""
ROW_FAULTS: dict[str, tuple[int, Spoil, str]] = {
    "quaternion not of unit length": (
        0, lambda f: edit_line(f, 1, lambda line: ",".join([*line.split(",")[:4], "1", "1", "0", "0"])),
        r"pose 1: its quaternion has length 1\.414",
    ),
    "far": (
        1,
        lambda f: edit_line(f, 2, lambda line: ",".join([*line.split(",")[:3], "812.5", *line.split(",")[4:]])),
        "pose 2 is 812.5 m from the base",
    ),
}  # fmt: skip
"""Faults of one row alone, and the index of that row."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> Path:
    """The folder of a table with its images."""
    return writers.write_table(tmp_path_factory.mktemp("table") / "table", capture).parent


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_tables_are_named(fault: str, tmp_path: Path, written: Path):
    spoil, convention, words = FAULTS[fault]
    folder = shutil.copytree(written, tmp_path / "table")
    spoil(folder / "poses.csv")
    with pytest.raises(jcr.InputError, match=words) as caught:
        jcr.read_capture(folder, {"pose_convention": convention})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fault", ROW_FAULTS)
def test_a_row_without_pose_is_left_out_named(fault: str, tmp_path: Path, written: Path, capture: Capture):
    row, spoil, words = ROW_FAULTS[fault]
    folder = shutil.copytree(written, tmp_path / "table")
    spoil(folder / "poses.csv")
    got = jcr.read_capture(folder)
    assert got.images == capture.images[:row] + capture.images[row + 1 :]
    assert np.allclose(got.base_from_gripper, np.delete(capture.base_from_gripper, row, 0), atol=1e-9)
    assert any(re.search(f"left out: .*{words}", note) for note in got.notes)


UR_ROWS = ["{k}.png, p[{numbers}]", "{k}.png; p [{numbers}]", '{k}.png\t"p[{numbers}]"']


@pytest.mark.parametrize("row", UR_ROWS)
@pytest.mark.parametrize("header", ["", "image,pose\n", "# copied from the log\n"])
def test_ur_poses_are_read_as_in_urscript(tmp_path: Path, problem: HandEyeProblem, row: str, header: str):
    rows = writers.rows_as("ur", problem.base_from_gripper)
    lines = [row.format(k=k, numbers=", ".join(map(repr, line))) for k, line in enumerate(rows.tolist())]
    got = table_of(tmp_path, header + "\n".join(lines))
    assert got.images == tuple(f"{k}.png" for k in range(12))
    assert np.allclose(got.base_from_gripper, problem.base_from_gripper, atol=1e-9)


def test_a_spreadsheet_with_decimal_commas_is_read(tmp_path: Path, problem: HandEyeProblem):
    rows = writers.rows_as("quat-xyzw", problem.base_from_gripper)
    lines = [";".join(f"{value:.9f}".replace(".", ",") for value in row) for row in rows]
    got = table_of(tmp_path, "\n".join(["x;y;z;qx;qy;qz;qw", *lines]))
    assert np.allclose(got.base_from_gripper, problem.base_from_gripper, atol=1e-8)


def test_options_give_units_and_direction(tmp_path: Path, written: Path, problem: HandEyeProblem):
    file = Path(shutil.copy(written / "poses.csv", tmp_path))
    scaled(file, "rpy", RPY, 1e2)
    got = read_pose_table(file, ReadOptions(pose_units="cm-rad"))
    assert np.allclose(got.base_from_gripper, problem.base_from_gripper)
    inverted = jcr.read_capture(written, {"pose_inverted": True})
    assert np.allclose(inverted.base_from_gripper, np.linalg.inv(problem.base_from_gripper))


@pytest.mark.parametrize("name", ["/home/robot/run 7/{}", r"C:\run\{}", "IMAGES/{}"])
def test_images_are_found_by_their_own_names_and_those_without_a_pose_named(
    tmp_path: Path, written: Path, capture: Capture, name: str
):
    folder = shutil.copytree(written, tmp_path / "table")
    lines = (folder / "poses.csv").read_text().splitlines()[:10]
    renamed = [name.format(line.removeprefix("images/").replace(".jpg", ".PNG")) for line in lines[1:]]
    (folder / "poses.csv").write_text("\n".join([lines[0], *renamed]))
    got = jcr.read_capture(folder)
    assert got.images == capture.images[:9]
    assert any(name.format("00.PNG") in note and "images/00.jpg" in note for note in got.notes)
    assert any("3 images have no pose in poses.csv and are left out: images/09.jpg" in n for n in got.notes)
    (folder / "poses.csv").unlink()
    with pytest.raises(
        jcr.InputError, match=r"no poses.csv beside its 12 images \(images/00.jpg … images/11.jpg"
    ):
        jcr.read_capture(folder)


def test_counts_that_differ_are_named(tmp_path: Path, capture: Capture):
    writers.write_npy(tmp_path, capture)
    np.save(tmp_path / "poses.npy", capture.base_from_gripper[:-1])
    with pytest.raises(jcr.InputError, match="11 poses for 12 images"):
        jcr.read_capture(tmp_path)
    for save in (
        lambda file: np.save(file, np.array([{"a": 1}], dtype=object), allow_pickle=True),
        lambda file: np.savez(file, points=np.zeros((2, 3))),  # numpy.load opens it, whatever its name
    ):
        with (tmp_path / "poses.npy").open("wb") as stream:
            save(stream)
        with pytest.raises(jcr.InputError, match="not a NumPy array of numbers"):
            jcr.read_capture(tmp_path)
    np.save(tmp_path / "poses.npy", np.zeros((4, 0, 4)))
    with pytest.raises(jcr.InputError, match="no table of numbers"):
        jcr.read_capture(tmp_path)


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
    for pose, words in (("[1, 2]", "2 columns of numbers without names"), ("[]", "holds no poses")):
        (tmp_path / "samples.yaml").write_text(f"- {{effector_wrt_world: {pose}, object_wrt_sensor: [1]}}\n")
        with pytest.raises(jcr.InputError, match=f"effector_wrt_world: {words}"):
            read_source(tmp_path / "samples.yaml")


def test_what_is_no_capture_is_named_what_would_be_one(tmp_path: Path):
    with pytest.raises(jcr.InputError, match="holds no capture.json, nor anything else"):
        jcr.read_capture(tmp_path)
    (tmp_path / "notes.md").write_text("hello")
    with pytest.raises(jcr.InputError, match="give its format with --format") as caught:
        jcr.read_capture(tmp_path / "notes.md")
    assert all(name in str(caught.value) for name in FORMATS)


@pytest.mark.parametrize("text", ["9700000000000000000", "1e30", "0.58E58800781040842", "nan", "now"])
def test_a_stamp_that_64_bits_do_not_hold_is_refused(text: str):
    """By fuzzing: the first made floats of all the stamps beside it, the third was too large to compare."""
    assert stamp_ns("9200000000000000000", "a table") == 9_200_000_000_000_000_000
    with pytest.raises(jcr.InputError, match="not a time stamp"):
        stamp_ns(text, "a table")


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
