"""Folders of images and numbers as people hold them, and the decision of the images between readings and orders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jcr
from benchmarks.inputs import _outcome
from capture_writers import rows_as, write_easy_handeye2, write_moveit
from in_process import run_jcr
from jcr.capture.discovery import find_images
from jcr.capture.documents import Table
from jcr.capture.notations import numbers_of
from jcr.capture.options import ReadOptions
from jcr.capture.readings import readings_of
from jcr.errors import RejectedError
from jcr.estimation.pose_misfit import Misfit, pose_misfit
from jcr.geometry import inverse, transform
from jcr.pipeline.reading_decision import _from_images_alone, decide, decided_by_images
from jcr.progress import silent
from jcr.records import Capture, Reconstruction
from refusal import refused
from scenes import capture_of, reconstruction_of
from simulation.layouts import LAYOUTS, Layout
from simulation.problems import INTRINSICS, HandEyeProblem, hand_eye_problem
from simulation.recordings import simulated_recordings

COUNT = 6
POSES = hand_eye_problem(np.random.default_rng(3), COUNT).base_from_gripper
NAMES = [f"{k}.png" for k in range(8, 8 + COUNT)]
"""8.png … 13.png, whose order as text is another one."""
HEADER = "x,y,z,qx,qy,qz,qw"
ROWS = [",".join(map(repr, row)) for row in rows_as("quat:xyzw", POSES).tolist()]
NAMED_ROWS = [f"{row},{name}" for row, name in zip(ROWS, NAMES, strict=True)]


def draw(folder: Path, names: list[str] = NAMES, size: tuple[int, int] = (32, 24), seed: int = 0) -> Path:
    """Write images of noise."""
    random = np.random.default_rng(seed)
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(random.integers(0, 255, (*size[::-1], 3), dtype=np.uint8)).save(folder / name)
    return folder


def write(file: Path, lines: list[str]) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")
    return file


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_layouts_of_people_are_read_right_without_options(layout: Layout, tmp_path: Path):
    """What names and numbers leave open is decided by the camera poses of ten images."""
    (one,) = simulated_recordings(tmp_path / "simulated", [10])
    found = _outcome(tmp_path / "layout", layout, one, "", one.base_from_gripper)
    assert found.kind == "right", found.message


def test_a_file_pairs_poses_of_any_name_with_images(tmp_path: Path):
    draw(tmp_path, [f"images/{name}" for name in NAMES])
    lines = []
    for name, row, letter in zip(NAMES, rows_as("quat:xyzw", POSES).tolist(), "dbfaec", strict=True):
        cells = zip(HEADER.split(","), row, strict=True)
        write(tmp_path / f"data/{letter}.yaml", [f"{key}: {value!r}" for key, value in cells])
        lines += [f"- {{image: images/{name}, pose: data/{letter}.yaml}}"]
    write(tmp_path / "index.yaml", lines)
    got = jcr.read_capture(tmp_path)
    assert [Path(name).name for name in got.images] == NAMES
    np.testing.assert_allclose(got.base_from_gripper, POSES, atol=1e-9)
    assert any("paired with the images" in note for note in got.notes)


def test_poses_without_an_image_are_left_out_with_a_note(tmp_path: Path):
    """A third of the poses went without a word."""
    draw(tmp_path, NAMES[2:])
    write(tmp_path / "p.csv", [f"{HEADER},image", *NAMED_ROWS])
    got = jcr.read_capture(tmp_path)
    np.testing.assert_allclose(got.base_from_gripper, POSES[2:], atol=1e-9)
    assert any(
        "2 poses of p.csv without an image" in note and "row 1, 2 of its table" in note for note in got.notes
    )


def test_images_left_out_and_chosen_are_stated(tmp_path: Path):
    draw(tmp_path, [f"rgb/{name}" for name in NAMES])
    draw(tmp_path, [f"other/{name}" for name in (*NAMES, "14.png")], seed=1)
    draw(tmp_path, ["rgb/preview.png"], (16, 12))
    draw(tmp_path, [".hidden.png", "rgb/8_mask.png", "Masks/8.png", "rgb/depth_8.png"])
    images, notes = find_images(tmp_path)
    assert images == tuple(f"rgb/{name}" for name in NAMES)
    assert "images taken from rgb/, not from other" in notes
    assert any("left out: 1 image of another size than 32x24: rgb/preview.png" in note for note in notes)


def test_pictures_in_other_formats_are_named(tmp_path: Path):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"ftypheic")
    with refused("holds no images .*it holds HEIC pictures: convert them to PNG or JPEG"):
        jcr.read_capture(tmp_path)


def test_a_folder_without_poses_says_what_to_add(tmp_path: Path):
    write(draw(tmp_path / "a") / "readme.txt", ["hello"])
    with refused(r"no gripper poses for its 6 images \(8.png … 13.png\) in readme.txt; add"):
        jcr.read_capture(tmp_path / "a")


def test_a_copy_of_the_poses_in_another_file_counts_once(tmp_path: Path):
    write(draw(tmp_path) / "poses.csv", [HEADER, *ROWS])
    (tmp_path / "poses.json").write_text(json.dumps(np.round(POSES, 6).tolist()))
    got = jcr.read_capture(tmp_path)
    assert got.reading is not None and got.reading.file == "poses.csv"


PROBLEM = hand_eye_problem(np.random.default_rng(1), 12, robot_noise=(2e-4, 5e-4), camera_noise=(1e-4, 1e-4))


def undecided(
    poses: np.ndarray, notation: str = "rotvec", images: int | None = None, name: str = "p.csv"
) -> Capture:
    """Return the capture of poses that are written in a notation, in mm and degrees, without names."""
    turned = numbers_of(poses[:, :3, :3], notation) * (
        np.degrees(1.0) if notation[:3] in ("rot", "eul") else 1.0
    )
    rows = tuple(map(tuple, np.hstack([1e3 * poses[:, :3, 3], turned]).tolist()))
    table = Table(file=Path(name), columns=(None,) * len(rows[0]), rows=rows)
    candidates = tuple(readings_of(table, ReadOptions(), name)[1])
    nothing = np.full((images or len(poses), 4, 4), np.nan)
    return capture_of(nothing, source=Path(name), candidates=candidates)


def decided(capture: Capture, problem: HandEyeProblem = PROBLEM, rows: np.ndarray | None = None) -> Capture:
    rows = np.arange(len(capture)) if rows is None else rows
    return decide(capture, problem.recon_from_camera[rows], rows)


def assert_refused(
    capture: Capture, words: str, problem: HandEyeProblem = PROBLEM, rows: np.ndarray | None = None
):
    with refused(words):
        decided(capture, problem, rows)


def test_images_without_a_camera_pose_do_not_change_the_reading():
    rows = np.array([0, 1, 3, 4, 5, 7, 8, 10, 11])
    got = decided(undecided(PROBLEM.base_from_gripper, "euler:ZYZ"), rows=rows)
    assert got.reading is not None and got.reading.notation == "euler:ZYZ" and len(got) == 12


def test_a_camera_beside_the_robot_is_read_from_a_plain_folder(tmp_path: Path):
    """Seen from what the gripper carries, it moves by the inverse poses; before, every reading was refused."""
    poses = inverse(PROBLEM.base_from_gripper)
    fixed = replace(undecided(poses, "euler:ZYX"), mount="base")
    got = decided(fixed)
    assert got.reading is not None and got.reading.notation == "euler:ZYX" and not got.reading.inverted
    assert got.mount == "base" and not got.candidates
    np.testing.assert_allclose(got.base_from_gripper, poses, atol=1e-9)
    inverted = replace(undecided(PROBLEM.base_from_gripper, "quat:xyzw"), mount="base")
    assert decided(inverted).base_from_gripper == pytest.approx(poses, abs=1e-9)
    without = decided(undecided(poses, "euler:ZYX"))  # the same equations as of a camera on the gripper
    assert without.reading is not None and without.reading.inverted and "--mount base" in without.notes[-1]
    write(draw(tmp_path) / "p.csv", [f"{HEADER},image", *NAMED_ROWS])
    assert jcr.read_capture(tmp_path, ReadOptions(mount="base")).mount == "base"


def test_what_decides_the_reading_is_not_lost_for_the_run(monkeypatch: pytest.MonkeyPatch):
    """A board was dropped in silence where the images decided the reading, and wrong intrinsics were not tested."""
    made = reconstruction_of(PROBLEM.recon_from_camera)
    capture, tried = undecided(PROBLEM.base_from_gripper, "euler:ZYX"), list[str]()

    def alone(one: Capture, *_: object) -> Reconstruction:
        tried.append("free" if one.intrinsics is None else "given")
        if one.intrinsics is not None:
            raise RejectedError("registered 0 of 12 images")
        return made

    monkeypatch.setattr("jcr.sfm.colmap.reconstruct_alone", alone)
    monkeypatch.setattr("jcr.boards.marker.reconstruct_marker", lambda *_: tried.append("board") or made)
    found, kept = decided_by_images(capture)
    assert kept is made and tried == ["free"] and found.reading is not None
    tried.clear()
    given = replace(capture, intrinsics=made.intrinsics)
    found, kept = decided_by_images(given)
    assert tried == ["given", "free"] and found.intrinsics == made.intrinsics
    # Estimated intrinsics are not tried again in the run; a warning names the given ones.
    assert (
        kept is not None and "with them 0 of 12 images register, with estimated ones 12" in kept.warnings[-1]
    )
    tried.clear()
    assert decided_by_images(capture, "chessboard:9x6:0.025")[1] is None and tried == ["board"]


def test_some_images_of_an_undecided_capture_keep_their_own_poses():
    rows = np.arange(0, 12, 2)
    some = undecided(PROBLEM.base_from_gripper, "euler:ZYX").of_rows(rows)
    got = decide(some, PROBLEM.recon_from_camera[rows], np.arange(len(rows)))
    np.testing.assert_allclose(got.base_from_gripper, PROBLEM.base_from_gripper[rows], atol=1e-9)


def test_two_wrong_poses_of_twelve_do_not_change_the_reading():
    poses = PROBLEM.base_from_gripper.copy()
    poses[[2, 7]] = poses[[7, 2]]
    got = decided(undecided(poses, "euler:ZYX"))
    assert got.reading is not None and got.reading.notation == "euler:ZYX"


def test_readings_that_both_fit_are_refused_with_the_option_for_each():
    """The flange and the tool's tip move together, and the images do not show which is meant."""
    tip = PROBLEM.base_from_gripper @ transform(np.eye(3), np.array([0.0, 0.0, 0.15]))
    flange, tool = (
        tuple((replace(one, columns=name), poses) for one, poses in undecided(given).candidates[:1])
        for name, given in (("flange", PROBLEM.base_from_gripper), ("tcp", tip))
    )
    words = "--pose-columns flange --pose-convention rotvec .*--pose-columns tcp --pose-convention rotvec .*: say which"
    assert_refused(replace(undecided(tip), candidates=(*flange, *tool)), f"p.csv: .*{words}")


@pytest.mark.slow
@pytest.mark.parametrize(("order", "words"), [
    (np.arange(12)[::-1], "listed in reverse order of the images"),
    (np.r_[0, np.arange(11)], r"one ahead of the images \(image k has pose k \+ 1\)"),
    (np.r_[np.arange(1, 12), 11], r"one behind the images \(image k has pose k − 1\)"),
    (np.argsort([str(k) for k in range(12)]), "as text"),
])  # fmt: skip
def test_another_order_is_named_and_never_taken(order: np.ndarray, words: str):
    """Row k holds the pose of image order[k]."""
    capture = undecided(PROBLEM.base_from_gripper[order], "euler:xyz")
    assert_refused(capture, f"p.csv: the poses fit the images .*when they are .*{words}")


def test_poses_of_another_capture_and_permuted_ones_fit_no_reading(monkeypatch: pytest.MonkeyPatch):
    """Few of the 700 readings and orders are fitted, each of which takes 60 ms with twenty images."""
    fitted = list[int]()

    def counted(*given: np.ndarray) -> Misfit:
        fitted.append(len(given[0]))
        return pose_misfit(given[0], given[1])

    monkeypatch.setattr("jcr.pipeline.reading_decision.pose_misfit", counted)
    other = hand_eye_problem(np.random.default_rng(8), 12).base_from_gripper
    for poses in (other, PROBLEM.base_from_gripper[np.random.default_rng(2).permutation(12)]):
        for notation in ("rotvec", "quat:wxyz"):
            assert_refused(undecided(poses, notation), "p.csv: the poses fit the images in no reading")
    assert 4 <= len(fitted) < 4 * 60


@pytest.mark.slow
def test_rows_too_many_and_too_few_are_named():
    poses = PROBLEM.base_from_gripper
    extra = np.insert(poses, 4, transform(np.eye(3), np.array([0.4, 0.1, 0.6])), axis=0)
    assert_refused(
        undecided(extra, "euler:xyz", images=12), "13 poses for 12 images .*row 5 .*remove it from the file"
    )
    assert_refused(
        undecided(extra, "matrix", images=12, name="p.npy"), r"row 5 .*numpy\.delete\(.*, \[4\], 0\)"
    )
    assert_refused(
        undecided(np.delete(poses, 7, 0), "quat:xyzw", images=12),
        "11 poses for 12 images .*7.png have no pose: remove",
    )
    other = hand_eye_problem(np.random.default_rng(8), 13).base_from_gripper
    assert_refused(
        undecided(other, "quat:xyzw", images=12),
        "13 poses for 12 images .*in no choice of them the poses fit",
    )


@pytest.mark.parametrize("inverted", [False, True])
def test_poses_of_the_camera_such_as_a_boards_are_never_taken(inverted: bool):
    cameras = PROBLEM.base_from_camera
    assert_refused(
        undecided(cameras if inverted else inverse(cameras), "rotvec"),
        "the poses are those of the camera itself",
    )


def test_a_board_beside_the_robot_is_not_taken():
    robot, board = (
        undecided(PROBLEM.base_from_gripper),
        undecided(inverse(PROBLEM.base_from_camera), name="b.csv"),
    )
    got = decided(replace(robot, candidates=(*board.candidates, *robot.candidates)))
    assert got.reading is not None and got.reading.file == "p.csv"


def test_four_images_decide_nothing():
    problem = hand_eye_problem(np.random.default_rng(1), 4)
    assert_refused(undecided(problem.base_from_gripper, "euler:ZYX"), "say which", problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inverted", "write", "way"),
    [("marker", write_moveit, ()), ("gripper", write_easy_handeye2, ("--pose-inverted",))],
)
def test_pairs_with_an_inverse_are_never_accepted(inverted, write, way, tmp_path):
    gripper, marker = PROBLEM.base_from_gripper[:7], PROBLEM.recon_from_camera[:7]
    pairs = (inverse(gripper), marker) if inverted == "gripper" else (gripper, inverse(marker))
    done = run_jcr("calibrate", write(tmp_path / "in", *pairs), tmp_path / "out", *way)
    assert done.returncode == 3 and "either the gripper poses or the marker poses are inverted" in done.stdout


@pytest.mark.slow
def test_the_images_decide_once_and_the_run_keeps_the_reading(half_capture: Path, tmp_path: Path):
    """Seven bundled images, and a listing in the notation of Doosan without any name."""
    capture = jcr.read_capture(half_capture)
    (tmp_path / "a").mkdir()
    for name in capture.images[:7]:
        shutil.copy(capture.folder / name, tmp_path / "a")
    poses = capture.base_from_gripper[:7]
    angles = np.degrees(numbers_of(poses[:, :3, :3], "euler:ZYZ"))
    np.savetxt(tmp_path / "a/list.txt", np.hstack([1e3 * poses[:, :3, 3], angles]), "%.6f")
    done = run_jcr("calibrate", tmp_path / "a", tmp_path / "out")
    assert done.returncode == 0 and "angles ZYZ in degrees" in done.stdout, done.stdout + done.stderr
    assert "decided by the images" in done.stdout
    seconds = json.loads((tmp_path / "out" / "calibration.json").read_text())["timings_s"]
    assert seconds["decide"] > seconds["reconstruct"], (
        "what decided is the reconstruction, and its time was not stated"
    )
    kept = jcr.read_capture(tmp_path / "out/capture")
    assert kept.reading is not None and kept.reading.decided_by == "images" and len(kept) == 7
    np.testing.assert_allclose(kept.base_from_gripper, poses, atol=1e-8)
    assert "unchanged" in run_jcr("calibrate", tmp_path / "a", tmp_path / "out").stderr


@pytest.mark.parametrize(("column", "cell", "said"), [
    (1, "nan", "column y holds nan"), (1, "inf", "column y holds inf"), (1, "", "column y is empty"),
    (6, "half", "column qw holds 'half'"), (slice(3, 7), ["0"] * 4, "0 0 0 0 is no rotation"),
    (slice(3, 7), ["1", "1", "0", "0"], "1 1 0 0 is no rotation"), (2, "812.5", "is 812.5 m from the base"),
])  # fmt: skip
def test_a_row_without_a_pose_is_left_out_with_the_cell_that_is_wrong(tmp_path, column, cell, said):
    cells = [row.split(",") for row in ROWS]
    cells[2][column] = cell
    rows = [f"{','.join(row)},{name}" for row, name in zip(cells, NAMES, strict=True)]
    write(draw(tmp_path) / "poses.csv", [f"{HEADER},image", *rows])
    kept = jcr.read_capture(tmp_path)
    assert len(kept) == COUNT - 1, kept.notes
    assert any(said in note and NAMES[2] in note for note in kept.notes), kept.notes


@pytest.mark.parametrize("option", [None, "poses"])
def test_images_without_a_pose_file_of_their_own_are_named(tmp_path: Path, option: str | None):
    folder = draw(tmp_path / "all", [f"images/{k:02d}.png" for k in range(9)])
    for k, pose in enumerate(POSES[:4]):
        write(folder / f"poses/{k:02d}.txt", [" ".join(map(repr, row)) for row in pose.tolist()])
    with refused("poses/0[*]: 5 of 9 images have no pose there, and at most 2 may lack one: images/04.png"):
        jcr.read_capture(folder, ReadOptions(poses=None if option is None else folder / option))


@pytest.mark.parametrize(("layout", "said"), [
    ("quaternion", "quaternions in its columns qx, qy, qz, qw have the length 1.2 instead of 1; .*normalise"),
    ("rotation", "matrices in its columns r11, r12, .* no rotations: their axes have the length 1.2"),
    ("transform", "matrices in its columns T_00, T_01, .* no rotations: their axes have the length 1.2"),
    ("mirrored", "no rotations: they are mirrored"),
])  # fmt: skip
def test_numbers_that_are_no_rotation_under_the_names_of_one_are_named(
    tmp_path: Path, layout: str, said: str
):
    poses, names = POSES.copy(), [f"T_{i}{j}" for i in range(4) for j in range(4)]
    poses[:, :3, :3] = -poses[:, :3, :3] if layout == "mirrored" else 1.2 * poses[:, :3, :3]
    numbers = poses.reshape(-1, 16)
    if layout == "quaternion":
        numbers, names = rows_as("quat:xyzw", POSES) * ([1.0] * 3 + [1.2] * 4), HEADER.split(",")
    elif layout == "rotation":
        numbers = np.hstack([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)])
        names = ["x", "y", "z", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))]
    rows = [",".join([*map(repr, row), name]) for row, name in zip(numbers.tolist(), NAMES, strict=True)]
    write(draw(tmp_path) / "poses.csv", [",".join([*names, "image"]), *rows])
    with refused(said):
        jcr.read_capture(tmp_path)


@pytest.mark.parametrize(("header", "cell", "said"), [
    ("x,y,z,qx,qy,qz,other", None, "its columns x, y, z, qx, qy, qz, other, image are no position with a rotation"),
    (HEADER, "nan", f"column y has no number in {COUNT} of {COUNT} rows"),
])  # fmt: skip
def test_a_file_without_poses_says_which_columns_it_has(tmp_path, header: str, cell: str | None, said: str):
    cells = [row.split(",") for row in ROWS]
    rows = [
        ",".join([row[0], cell or row[1], *row[2:], name]) for row, name in zip(cells, NAMES, strict=True)
    ]
    write(draw(tmp_path) / "poses.csv", [f"{header},image", *rows])
    with refused(said):
        jcr.read_capture(tmp_path)


def test_misspelt_keys_of_a_capture_are_named(small_capture: Path, tmp_path: Path):
    folder = shutil.copytree(small_capture, tmp_path / "misspelt")
    content = json.loads((folder / "capture.json").read_text())
    content["intrinsic"] = content.pop("intrinsics") | {"distorsion": [0.0] * 5}
    content["weather"] = "fair"  # a remark of the user's own
    content["frames"][0]["base_from_camera"] = 1.0  # one as well, beside base_from_gripper
    (folder / "capture.json").write_text(json.dumps(content))
    (note,) = jcr.read_capture(folder).notes
    assert note.endswith("'intrinsic' is not used; did you mean intrinsics?")
    content["intrinsics"] = content.pop("intrinsic")
    (folder / "capture.json").write_text(json.dumps(content))
    (note,) = jcr.read_capture(folder).notes
    assert note.endswith("'distorsion' is not used; did you mean distortion?")


@pytest.mark.parametrize(
    ("given", "estimated", "registered", "are_named"),
    [
        (6, 12, 6, False),
        (5, 12, 12, True),
        (5, 10, 10, False),
        (0, 6, 6, False),
        (0, 7, 7, True),
        (4, 4, 4, False),
    ],
)
def test_given_intrinsics_are_named_where_few_images_register_with_them(
    given: int, estimated: int, registered: int, are_named: bool, monkeypatch: pytest.MonkeyPatch
):
    """Of twelve images; 0 stands for a failed reconstruction. Half of the images are enough for the given ones."""

    def reconstruct(capture: Capture, *_: object) -> Reconstruction:
        count = estimated if capture.intrinsics is None else given
        if not count:
            raise RejectedError("no images register")
        return replace(reconstruction_of(PROBLEM.recon_from_camera[:count]), image_index=np.arange(count))

    monkeypatch.setattr("jcr.sfm.colmap.reconstruct_alone", reconstruct)
    capture = capture_of(PROBLEM.base_from_gripper[:12], intrinsics=INTRINSICS)
    made, has_failed = _from_images_alone(capture, None, 0, silent)
    assert (len(made.image_index), has_failed) == (registered, are_named)
    assert bool(made.warnings) is are_named
