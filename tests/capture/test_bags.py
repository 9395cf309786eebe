"""Recordings of robots: ROS 1, sqlite3 and MCAP bags give the frames at which the arm stood still."""

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import capture_writers as writers
import jcr
from jcr.capture.frame_choice import UNREADABLE, best_frames
from jcr.capture.images import encode_png, read_image
from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import TfTree
from jcr.capture.ros_messages import image_of, read_ros_depth
from jcr.records import Capture, FrameNames
from refusal import refused
from simulation.problems import hand_eye_problem
from simulation.ros_bag import nearest_view, write_bag

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed (extra ros)")
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
FRAMES = ReadOptions(base_frame="base_link", gripper_frame="tool0", frames=12)


@pytest.fixture(scope="module")
def capture(half_capture: Path) -> Capture:
    return jcr.read_capture(half_capture)


@pytest.fixture(scope="module")
def mcap(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> Path:
    return write_bag(tmp_path_factory.mktemp("mcap") / "scan", capture, "mcap", 12.0, fps=10.0, tf_hz=50.0)


@pytest.mark.slow
def test_the_stops_of_the_arm_are_found_in_every_storage(tmp_path: Path, capture: Capture, mcap: Path):
    """And the same poses, hence the same calibration, come from all three."""
    rates: dict[str, Any] = {"seconds": 12.0, "fps": 10.0, "tf_hz": 50.0}
    bags = {
        "mcap": mcap,
        "sqlite3": write_bag(tmp_path / "sqlite3", capture, "sqlite3", compressed=False, **rates),
        "ros1": write_bag(tmp_path / "scan.bag", capture, "ros1", **rates),
    }
    for kind, bag in bags.items():
        got = jcr.read_capture(bag, FRAMES, into=tmp_path / f"{kind}-frames")
        off_mm, off_deg, view = nearest_view(got.base_from_gripper, capture.base_from_gripper)
        assert sorted(view) == list(range(12)), kind
        assert off_mm.max() < 1e-6 and off_deg.max() < 1e-6
        assert got.intrinsics == capture.intrinsics
        assert got.frame_names == FrameNames(base="base_link", gripper="tool0", camera="camera")
        # What was read is a capture folder itself.
        again = jcr.read_capture(tmp_path / f"{kind}-frames")
        assert again.frame_names == got.frame_names
        assert (again.base_from_gripper == got.base_from_gripper).all() and again.images == got.images
        for name, k in zip(got.images, view, strict=True):
            files = got.folder / name, capture.folder / capture.images[k]
            image, original = (read_image(file).astype(int) for file in files)
            assert kind != "sqlite3" or np.abs(image - original).max() <= 1  # raw; the bag adds noise


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "images"), [("ros1", 1), ("sqlite3", 2)])
def test_a_camera_that_is_triggered_has_a_view_at_each_stop(tmp_path, capture, kind, images):
    """One image at each stop, and another one on the way."""
    bag = write_bag(
        tmp_path / ("scan.bag" if kind == "ros1" else "scan"), capture, kind, 12.0, fps=images, tf_hz=20.0
    )
    got = jcr.read_capture(bag, FRAMES, into=tmp_path / "frames")
    assert sorted(nearest_view(got.base_from_gripper, capture.base_from_gripper)[2]) == list(range(12))


def test_depth_messages_are_read_in_every_encoding():
    mm = np.array([[0, 700], [1200, 65535]], np.uint16)
    metres = np.array([[np.nan, 0.7], [1.2, np.inf]], np.float32)

    def message(values: np.ndarray, encoding: str, is_bigendian: int = 0) -> SimpleNamespace:
        data = values.view(np.uint8).ravel()
        step = values.shape[1] * values.itemsize
        return SimpleNamespace(
            encoding=encoding, is_bigendian=is_bigendian, height=2, width=2, step=step, data=data
        )

    assert (read_ros_depth(message(mm, "16UC1"), "d") == mm).all()
    assert (read_ros_depth(message(mm.byteswap(), "16UC1", 1), "d") == mm).all()
    assert read_ros_depth(message(metres, "32FC1"), "d").tolist() == [[0, 700], [1200, 0]]
    with refused("no depth"):
        read_ros_depth(message(mm, "rgb8"), "d")
    packed = SimpleNamespace(
        format="16UC1; compressedDepth png", data=np.frombuffer(bytes(12) + encode_png(mm), np.uint8)
    )
    assert (read_ros_depth(packed, "d") == mm).all()


JOINTS, POSES = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
IMAGE = "sensor_msgs/msg/CompressedImage"
Messages = Iterator[tuple[str, str, int, str, tuple[Any, ...]]]
"""Topic, type, time (ns), frame and fields of each message."""


def write_mcap(folder: Path, messages: Messages) -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer

    topics = dict[str, Any]()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, at, frame, fields in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            time = STORE.types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
            message = STORE.types[kind](STORE.types["std_msgs/msg/Header"](time, frame), *fields)
            late = 6_000_000 if kind == IMAGE else 0  # an image is recorded after it was taken
            writer.write(topics[topic], at + late, STORE.serialize_cdr(message, kind))
    return folder


def bytes_of(capture: Capture, k: int) -> np.ndarray:
    return np.frombuffer((capture.folder / capture.images[k]).read_bytes(), np.uint8)


@pytest.mark.slow
def test_joint_states_and_a_urdf_stand_in_for_tf(tmp_path: Path, capture: Capture):
    """Two publishers on one topic, as with an arm and its gripper; the arm halts at eight places."""
    angles = np.random.default_rng(4).uniform(-1, 1, (8, 3))
    (tmp_path / "arm.urdf").write_text(writers.URDF)

    def messages() -> Messages:
        for tick in range(8 * 50):  # 50 Hz, a second a place, the last half of it on the way
            at, none = 10**18 + tick * 20_000_000, (np.zeros(0), np.zeros(0))
            share = max(tick % 50 - 25, 0) / 25
            pan, lift, roll = angles[tick // 50] + share * (angles[(tick // 50 + 1) % 8] - angles[tick // 50])
            yield "/joint_states", JOINTS, at, "", (["roll", "pan"], np.array([roll, pan]), *none)
            grip = ["grip", "lift"], np.array([0.01, lift]), *none
            yield "/joint_states", JOINTS, at + 7_000_000, "", grip
            if tick % 5 == 3:
                yield "/image", IMAGE, at + 3_000_000, "", ("jpeg", bytes_of(capture, tick // 50))

    options = ReadOptions(urdf=tmp_path / "arm.urdf", gripper_frame="tool0", frames=8)
    got = jcr.read_capture(write_mcap(tmp_path / "joints", messages()), options, into=tmp_path / "frames")
    expected = {bytes_of(capture, k).tobytes(): pose for k, pose in enumerate(writers.arm_poses(angles))}
    assert len(got) == 8 and got.intrinsics is None
    assert got.frame_names == FrameNames(base="base_link", gripper="tool0")
    for name, pose in zip(got.images, got.base_from_gripper, strict=True):
        assert np.allclose(pose, expected[(got.folder / name).read_bytes()], atol=1e-6)
    writers.assert_joints(got, angles)


@pytest.mark.slow
def test_a_topic_of_poses_stands_in_for_tf(tmp_path: Path, capture: Capture):
    types = [STORE.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose")]
    point, quaternion, pose_of = types

    def messages() -> Messages:
        for k, pose in enumerate(capture.base_from_gripper):
            turned, at = Rotation.from_matrix(pose[:3, :3]).as_quat(), 10**18 + k * 10**9
            message = pose_of(point(*pose[:3, 3]), quaternion(*turned))
            for step in range(5):
                yield "/ee_pose", POSES, at + step * 10**8, "base_link", (message,)
            yield "/image", IMAGE, at + 2 * 10**8, "lens", ("jpeg", bytes_of(capture, k))

    got = jcr.read_capture(write_mcap(tmp_path / "in", messages()), {"frames": 12}, into=tmp_path / "frames")
    np.testing.assert_allclose(got.base_from_gripper, capture.base_from_gripper, atol=1e-9)
    assert got.frame_names == FrameNames(base="base_link", camera="lens")


def foxglove_stream(capture: Capture) -> Iterator[tuple[str, str, int, dict[str, Any]]]:
    """Topic, schema, time and content of the messages of a recording at the poses of a capture."""
    intrinsics = capture.intrinsics
    start = 10**18
    matrices = {"K": intrinsics.matrix.ravel().tolist(), "D": list(intrinsics.distortion)}
    size = {"width": intrinsics.width, "height": intrinsics.height}
    yield (
        "/lens",
        "CameraCalibration",
        start,
        {"frame_id": "lens", "distortion_model": "plumb_bob", **size, **matrices},
    )
    static = {"translation": [0.0, 0.0, 0.0], "rotation": [0.0, 0.0, 0.0, 1.0]}
    yield "/tf", "FrameTransform", start, {"parent_frame_id": "tool0", "child_frame_id": "lens", **static}
    for k, (name, pose) in enumerate(zip(capture.images, capture.base_from_gripper, strict=True)):
        moved = {"parent_frame_id": "base", "child_frame_id": "tool0", "translation": pose[:3, 3].tolist()}
        moved |= {"rotation": Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()}
        for step in range(5):
            yield "/tf", "FrameTransform", start + k * 10**9 + step * 10**8, moved
        at, data = start + k * 10**9 + 2 * 10**8, (capture.folder / name).read_bytes()
        yield "/wrist", "CompressedImage", at, {"frame_id": "lens", "format": "jpeg", "data": data}


def write_foxglove_json(file: Path, capture: Capture, video: str | None = None) -> None:
    writing: Any = pytest.importorskip("mcap.writer")
    channels = dict[str, int]()
    with file.open("wb") as stream:
        writer = writing.Writer(stream)
        writer.start()
        for topic, schema, at, content in foxglove_stream(capture):
            schema = video if video and schema == "CompressedImage" else schema
            if topic not in channels:
                number = writer.register_schema(f"foxglove.{schema}", "jsonschema", b"{}")
                channels[topic] = writer.register_channel(topic, "json", number)
            axes = {"translation": "xyz", "rotation": "xyzw"}
            message = {name: dict(zip(axes[name], value, strict=True)) if name in axes else value
                       for name, value in content.items()}  # fmt: skip
            if "data" in message:
                message["data"] = base64.b64encode(message["data"]).decode()
            message["timestamp"] = {"sec": at // 10**9, "nsec": at % 10**9}
            writer.add_message(channels[topic], at, json.dumps(message).encode(), at)
        writer.finish()


@pytest.mark.slow
def test_messages_of_foxglove_are_read(tmp_path: Path, capture: Capture):
    write_foxglove_json(tmp_path / "scan.mcap", capture)
    options = {"frames": 12, "base_frame": "base", "gripper_frame": "tool0"}
    got = jcr.read_capture(tmp_path / "scan.mcap", options, into=tmp_path / "frames")
    np.testing.assert_allclose(got.base_from_gripper, capture.base_from_gripper, atol=1e-9)
    assert got.intrinsics == capture.intrinsics
    assert got.frame_names == FrameNames(base="base", gripper="tool0", camera="lens")
    for name, original in zip(got.images, capture.images, strict=True):
        assert (got.folder / name).read_bytes() == (capture.folder / original).read_bytes()
    # A frame that is published once, as the mount of the camera, does not move.
    wrist = jcr.read_capture(
        tmp_path / "scan.mcap", options | {"gripper_frame": "lens"}, into=tmp_path / "lens"
    )
    np.testing.assert_allclose(wrist.base_from_gripper, capture.base_from_gripper, atol=1e-9)


@pytest.mark.slow
def test_a_video_topic_is_named_with_the_command_that_converts_it(tmp_path: Path, capture: Capture):
    write_foxglove_json(tmp_path / "scan.mcap", capture, video="CompressedVideo")
    with refused("/wrist is a video; .*in_transport:=foxglove .*in/foxglove:=/wrist"):
        jcr.read_capture(tmp_path / "scan.mcap", into=tmp_path / "frames")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "a frame of its tf: choose one with --base-frame: base_link, tool0, world"),
        (
            {"base_frame": "base_link", "gripper_frame": "hand"},
            "hand is not there; choose one with --gripper-frame: .* tool0",
        ),
        (
            {"camera_topic": "/nowhere"},
            "the wrist camera's topic: /nowhere is not there; choose one with .*: /camera/image_raw/compressed",
        ),
        ({"urdf": Path("arm.urdf")}, "the joint states: choose one with --joint-topic: there are none"),
        ({"frames": 2}, "--frames 2: at least 3"),
    ],
)
def test_what_is_not_in_the_bag_is_listed(tmp_path: Path, mcap: Path, options: dict, words: str):
    with refused(words):
        jcr.read_capture(mcap, ReadOptions(**options), into=tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


@pytest.mark.slow
def test_stale_poses_are_refused_with_their_gap(tmp_path: Path, capture: Capture):
    """At 5 Hz the poses around an image are 200 ms apart."""
    bag = write_bag(tmp_path / "slow", capture, "mcap", 12.0, fps=10.0, tf_hz=5.0)
    with refused(r"stale .* 200 ms apart"):
        jcr.read_capture(bag, FRAMES, into=tmp_path / "frames")
    patient = ReadOptions(base_frame="base_link", gripper_frame="tool0", frames=12, max_gap_ms=250.0)
    assert len(jcr.read_capture(bag, patient, into=tmp_path / "frames")) == 12


@pytest.mark.parametrize("fault", ["gzip", "cut", "text"])
def test_files_that_are_no_bags_are_one_line(fault: str, tmp_path: Path, mcap: Path):
    file = tmp_path / "scan.mcap"
    data = next(mcap.glob("*.mcap")).read_bytes()
    file.write_bytes({"gzip": b"\x1f\x8b\x08\x00", "cut": data[: len(data) // 2], "text": b"hello"}[fault])
    with refused(r"scan\.mcap: not a readable bag"):
        jcr.read_capture(file, FRAMES, into=tmp_path / "frames")


def test_the_best_frames_are_still_sharp_and_spread():
    """Of 40 stops, 20 of them one view again and again and 5 blurred, twelve are as good as any twelve."""
    rng = np.random.default_rng(0)
    views = hand_eye_problem(rng, 20).base_from_gripper
    stops = np.concatenate([views, np.repeat(views[:1], 20, axis=0)])
    poses = np.repeat(stops, 10, axis=0)
    speed = np.tile([0.2, 0.1, *[0.001] * 6, 0.1, 0.2], 40)
    sharp = np.ones(400)
    sharp[10:60] = 0.2  # five of the views
    sharp[60:70] = UNREADABLE  # another one, which is not called blurred
    asked = []

    def sharpness_of(rows):
        asked.append(rows)
        return sharp[rows]

    rows, notes = best_frames(poses, speed, np.ones(400, bool), sharpness_of, 12)
    assert len(rows) == 12 and (np.diff(rows) > 0).all()
    assert (speed[rows] < 0.005).all() and (sharp[rows] == 1).all()
    assert len({tuple(pose.ravel()) for pose in poses[rows]}) == 12
    assert "5 moments of the recording are blurred" in notes[0]
    assert len(asked) == 1 and (speed[asked[0]] < 0.005).all()
    # Twelve stops suffice where fifteen frames are wanted.
    some = (poses[:120], speed[:120], np.ones(120, bool), lambda rows: np.ones(len(rows)), 15)
    rows, notes = best_frames(*some)
    assert len(rows) == 12 and (speed[rows] < 0.005).all() and not notes
    # Only where the arm never stops are moving frames taken, and said to be.
    rows, notes = best_frames(poses, speed + 0.05, np.ones(400, bool), lambda rows: sharp[rows], 8)
    assert len(rows) == 8 and "stands still at 0 different views where 8" in notes[-1]
    assert (speed[rows] < 0.005).all(), "the slowest frames between stops"


def test_the_latest_of_the_static_transforms_of_a_frame_counts():
    tree, zero = TfTree(), {"y": 0.0, "z": 0.0}
    for sec, x in ((2, 0.2), (3, 0.3), (1, 0.1)):
        header = SimpleNamespace(frame_id="base", stamp=SimpleNamespace(sec=sec, nanosec=0))
        at, turned = SimpleNamespace(x=x, **zero), SimpleNamespace(x=0.0, **zero, w=1.0)
        moved = SimpleNamespace(translation=at, rotation=turned)
        tree.add([SimpleNamespace(header=header, child_frame_id="tool0", transform=moved)], static=True)
    poses, gap = tree.poses_at("base", "tool0", Path("bag"))(np.array([0, 10**10]))
    assert poses[:, 0, 3].tolist() == [0.3, 0.3] and gap.tolist() == [0, 0]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "bayer_rggb8", "bayer_gbrg8", "yuv422_yuy2"])
def test_colours_of_raw_images(encoding: str):
    """An image that is red above and blue below stays so, with rows padded to a multiple of 64 bytes."""
    height, width = 8, 16
    image = np.zeros((height, width, 3), np.uint8)
    image[:4, :, 0] = image[4:, :, 2] = 200
    if encoding == "mono8":
        raw = image.max(2)
    elif encoding.startswith("bayer"):
        pattern = encoding.split("_")[1][:4]
        raw = np.zeros((height, width), np.uint8)
        for k, letter in enumerate(pattern):
            raw[k // 2 :: 2, k % 2 :: 2] = image[k // 2 :: 2, k % 2 :: 2, "rgb".index(letter)]
    elif encoding == "yuv422_yuy2":
        # ITU-R BT.601, studio range.
        weights = np.array([[0.257, 0.504, 0.098], [-0.148, -0.291, 0.439], [0.439, -0.368, -0.071]])
        y, u, v = np.moveaxis(image @ weights.T + [16, 128, 128], -1, 0)
        raw = np.stack([y, np.where(np.arange(width) % 2, v, u)], -1).astype(np.uint8)
    else:
        raw = image if encoding == "rgb8" else image[..., ::-1]
    rows = raw.reshape(height, -1)
    padded = np.zeros((height, 64), np.uint8)
    padded[:, : rows.shape[1]] = rows

    fields = {"height": height, "width": width, "step": 64, "data": padded.ravel()}
    message = SimpleNamespace(encoding=encoding, **fields)
    pixels, ending = image_of(message, "bag")
    assert ending == ".png" and isinstance(pixels, np.ndarray)
    if encoding == "mono8":
        assert (pixels == 200).all()
        return
    assert np.abs(pixels[1, 2:-2].mean(0) - [200, 0, 0]).max() < 20
    assert np.abs(pixels[6, 2:-2].mean(0) - [0, 0, 200]).max() < 20
    message.encoding = "16UC1"
    with refused("encoding '16UC1' is no colour image"):
        image_of(message, "bag")
