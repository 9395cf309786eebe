"""LeRobot data sets, v2.1 and v3.0: the right images with the right poses, out of AV1 videos."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

import capture_writers as writers
import jcr
from jcr.capture.formats.lerobot import Feature, _poses
from jcr.capture.images import read_image
from jcr.capture.options import ReadOptions
from jcr.records import Capture
from refusal import refused
from simulation.problems import HandEyeProblem, hand_eye_problem

pytestmark = [
    pytest.mark.skipif(find_spec(name) is None, reason=f"{name} is not installed (extra lerobot)")
    for name in ("av", "pyarrow")
]

HOLD, MOVE = 5, 5
"""Frames at rest, and on the way to the next view."""
DROID = "observation.state.cartesian_position"
XYZRPY = ["x", "y", "z", "roll", "pitch", "yaw"]


@pytest.fixture(scope="module")
def problem() -> HandEyeProblem:
    return hand_eye_problem(np.random.default_rng(7), 12)


def walked(states: np.ndarray) -> np.ndarray:
    """Each state held for HOLD frames, then MOVE frames of its way to the next."""
    after = np.roll(states, -1, axis=0)
    share = np.concatenate([np.zeros(HOLD), np.arange(1, MOVE + 1) / (MOVE + 1)])
    return (states[:, None] + share[:, None] * (after - states)[:, None]).reshape(-1, states.shape[1])


def pictured(tabletop: Path, count: int, first: int = 0) -> list[np.ndarray]:
    """The bundled images, small, each as often as its view lasts; row and view are encoded in grey bars."""
    capture = jcr.read_capture(tabletop)
    images = []
    for k in range(count):
        small = cv2.resize(
            read_image(capture.folder / capture.images[k]), (160, 120), interpolation=cv2.INTER_AREA
        )
        for step in range(HOLD + MOVE):
            shown = small if step < HOLD else cv2.blur(small, (25, 1))
            shown = shown.copy()
            shown[:16, :80] = 15 * (k + first)  # which view
            images.append(shown)
    return images


def view_of(capture: Capture) -> np.ndarray:
    """Which view each image shows, read from its bar."""
    bars = [read_image(capture.folder / name)[4:12, 8:72].mean() for name in capture.images]
    return np.round(np.array(bars) / 15).astype(int)


def assert_paired(capture: Capture, poses: np.ndarray) -> None:
    """Every image has the pose of the view that it shows."""
    assert len(capture) == len(poses)
    assert sorted(view_of(capture)) == list(range(len(poses)))
    assert np.allclose(capture.base_from_gripper, poses[view_of(capture)], atol=1e-6)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_cartesian_states_give_still_frames_with_their_poses(version, tmp_path, tabletop, problem):
    states = writers.rows_as("rpy", problem.base_from_gripper)
    other = pictured(tabletop, 3, first=12), walked(states[:3])
    episode = pictured(tabletop, 12), walked(states)
    path = writers.write_lerobot(tmp_path / "set", [other, episode], version, DROID, XYZRPY)
    got = jcr.read_capture(path, ReadOptions(episode=(1,), frames=12), into=tmp_path / "frames")
    assert_paired(got, problem.base_from_gripper)
    view = view_of(got)
    solved = jcr.solve_hand_eye(got.base_from_gripper, problem.recon_from_camera[view])
    assert np.abs(solved.gripper_from_camera - problem.gripper_from_camera).max() < 1e-6
    assert not solved.warnings


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_images_may_be_in_the_table(version: str, tmp_path: Path, tabletop: Path, problem: HandEyeProblem):
    import pyarrow as pa
    import pyarrow.parquet as pq

    states = writers.rows_as("rpy", problem.base_from_gripper[:6])
    other = pictured(tabletop, 2, first=9), walked(states[:2])
    episode = pictured(tabletop, 6), walked(states)
    path = writers.write_lerobot(tmp_path / "set", [other, episode], version, DROID, XYZRPY, codec=None)
    content = json.loads((path / "meta/info.json").read_text())
    content.pop("video_path")
    # A set of images has no path of videos.
    (path / "meta/info.json").write_text(
        json.dumps(content | ({"video_path": None} if version == "v3.0" else {}))
    )
    got = jcr.read_capture(path, ReadOptions(episode=(1,), frames=6), into=tmp_path / "frames")
    assert_paired(got, problem.base_from_gripper[:6])
    for file in path.rglob("data/**/*.parquet"):
        table = pq.read_table(file)
        emptied = [{"bytes": None, "path": "x.png"}] * len(table)
        at = table.column_names.index("observation.images.wrist")
        images = pa.array(emptied, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
        pq.write_table(table.set_column(at, "observation.images.wrist", images), file)
    with refused("holds no observation.images.wrist of frame .*embedded"):
        jcr.read_capture(path, ReadOptions(episode=(1,), frames=6), into=tmp_path / "again")


def test_joint_states_in_degrees_go_through_the_urdf(tmp_path: Path, tabletop: Path):
    """As SO-101 records them: names that end in .pos, degrees, the gripper's opening among them."""
    rng = np.random.default_rng(1)
    angles = rng.uniform(-1, 1, (8, 3))
    states = np.column_stack([np.degrees(angles), np.full(8, 30.0)])
    (tmp_path / "arm.urdf").write_text(writers.URDF)
    names = ["pan.pos", "lift.pos", "roll.pos", "grip.pos"]
    episode = pictured(tabletop, 8), walked(states)
    path = writers.write_lerobot(
        tmp_path / "set", [episode], "v3.0", "observation.state", names, codec="libx264"
    )
    options = ReadOptions(urdf=tmp_path / "arm.urdf", gripper_frame="tool0", pose_units="m-deg", frames=8)
    got = jcr.read_capture(path, options, into=tmp_path / "frames")
    assert_paired(got, writers.arm_poses(angles))
    writers.assert_joints(got, angles)
    with refused("for degrees add --pose-units m-deg"):
        options = ReadOptions(urdf=tmp_path / "arm.urdf", gripper_frame="tool0")
        jcr.read_capture(path, options, into=tmp_path / "more")
    with refused("pan, lift, roll, grip are no pose; give --urdf"):
        jcr.read_capture(path, into=tmp_path / "more")


JOINTS = [f"joint_{k}" for k in range(7)]


@pytest.mark.parametrize(("names", "notation"), [
    (["gripper", *XYZRPY], "rpy"),
    ([*JOINTS, "gripper", "x", "y", "z", "qx", "qy", "qz", "qw"], "quat:xyzw"),
    ([f"ee.{name}" for name in ("x", "y", "z", "wx", "wy", "wz")], "rotvec"),
])  # fmt: skip
@pytest.mark.parametrize("option", ["auto", "asked"])
def test_a_pose_is_found_by_its_names_whatever_option_is_given(problem, names, notation, option):
    numbers = writers.rows_as(notation, problem.base_from_gripper)
    others = np.random.default_rng(0).uniform(-1, 1, (12, len(names)))
    others[:, len(names) - numbers.shape[1] :] = numbers
    options = ReadOptions(pose_convention="auto" if option == "auto" else notation)
    got, joints = _poses(others, "observation.state", Feature(names=names), options, Path("set"), None)
    assert joints is None and np.allclose(got, problem.base_from_gripper, atol=1e-9)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory, tabletop: Path, problem: HandEyeProblem) -> Path:
    states = writers.rows_as("rpy", problem.base_from_gripper)[:4]
    folder = tmp_path_factory.mktemp("lerobot") / "set"
    episode = pictured(tabletop, 4), walked(states)
    return writers.write_lerobot(folder, [episode], "v2.1", DROID, XYZRPY, codec="libx264")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"episode": (3,)}, "there is no episode 3; they are counted from 0"),
        ({"episode": (0, 1)}, "2 episodes; read one, or all by jcr batch"),
        (
            {"camera_topic": "front"},
            "the wrist camera: front is not there; choose one with --camera-topic: observation.images.wrist",
        ),
        (
            {"joint_topic": "state"},
            "the robot's state: state is not there; choose one with --joint-topic: .*cartesian_position",
        ),
        ({"urdf": Path("nowhere.urdf")}, "the robot's state: choose one with --joint-topic"),
        (
            {"pose_convention": "matrix"},
            "no columns hold the 9 numbers of --pose-convention matrix; .*euler:xyz",
        ),
    ],
)
def test_what_is_not_in_the_set_is_listed(tmp_path: Path, small: Path, options: dict, words: str):
    with refused(words):
        jcr.read_capture(small, ReadOptions(**options), into=tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_damaged_sets_are_one_line(tmp_path: Path, small: Path):
    video, data = (
        "videos/chunk-000/observation.images.wrist/episode_000000.mp4",
        "data/chunk-000/episode_000000.parquet",
    )
    for name, content, words in (
        (video, b"nonsense", "not a readable video"),
        (video, (small / video).read_bytes()[:3000], "not a readable video"),
        (data, b"nonsense", "not a readable table"),
        ("meta/info.json", b"{}", "features: is missing"),
    ):
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(small, copy)
        (copy / name).write_bytes(content)
        with refused(words):
            jcr.read_capture(copy, into=tmp_path / "frames")
    shutil.copytree(small, tmp_path / "escaped")
    info = json.loads((small / "meta/info.json").read_text()) | {"video_path": "../{video_key}.mp4"}
    (tmp_path / "escaped" / "meta" / "info.json").write_text(json.dumps(info))
    with refused("leads out of"):
        jcr.read_capture(tmp_path / "escaped", into=tmp_path / "frames")
