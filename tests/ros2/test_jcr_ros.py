"""The ROS 2 package: its core with a simulated arm and camera, its node with stand-ins for rclpy."""

import json
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml
from jcr_ros.core import Calibrator, FrameStream, Settings
from numpy import ndarray
from scipy.spatial.transform import Rotation

import jcr
from jcr.capture.images import read_depth_images, read_image
from places import ROOT
from refusal import refused
from scenes import reference_of
from waiting import until

PACKAGE = ROOT / "ros2" / "jcr_ros"


class Played:
    """An arm that stands at one pose, and a camera that sees its image, until it is moved on."""

    def __init__(self, folder: Path) -> None:
        capture = jcr.read_capture(folder)
        self.poses = list(capture.base_from_gripper)
        self.images = [read_image(folder / name) for name in capture.images]
        self.at = 0
        self.start = time.monotonic()

    @property
    def time_s(self) -> float:
        return 20 * (time.monotonic() - self.start)  # the arm lives twenty times as fast

    def gripper(self) -> jcr.RobotState:
        return jcr.RobotState(self.time_s, self.poses[self.at])

    def message(self) -> SimpleNamespace:
        image = self.images[self.at]
        height, width = image.shape[:2]
        stamp = SimpleNamespace(sec=int(self.time_s), nanosec=int(1e9 * (self.time_s % 1)))
        return SimpleNamespace(
            header=SimpleNamespace(stamp=stamp), height=height, width=width, encoding="rgb8", step=3 * width,
            data=array("B", image.tobytes()),
        )  # fmt: skip

    def film(self, push: Callable[[Any, float], None], over: threading.Event) -> None:
        while not over.wait(0.04):
            push(self.message(), self.time_s)


def camera_info(**more: Any) -> SimpleNamespace:
    k = [300.0, 0.0, 159.75, 0.0, 300.0, 119.75, 0.0, 0.0, 1.0]
    return SimpleNamespace(width=320, height=240, k=k, d=[0.0] * 5, distortion_model="plumb_bob", **more)


@pytest.fixture
def filmed() -> Iterator[Callable[[Calibrator, Played], None]]:
    over, threads = threading.Event(), []

    def film(calibrator: Calibrator, played: Played) -> None:
        def push(message: Any, time_s: float) -> None:
            calibrator.frames.push_image(jcr.read_ros_image(message), time_s)

        threads.append(threading.Thread(target=played.film, args=(push, over)))
        threads[-1].start()

    yield film
    over.set()
    for thread in threads:
        thread.join()


@pytest.mark.slow
def test_images_are_taken_by_service_and_a_change_is_undone(tmp_path, half_capture, filmed):
    played, events, states = Played(half_capture), [], []

    def session() -> Calibrator:
        given = Settings(folder=tmp_path / "c", options=jcr.SessionOptions(images=6), at_rest=False)
        return Calibrator(given, played.gripper, events.append, states.append, lambda transform: None)

    first = session()
    first.intrinsics = jcr.read_ros_camera_info(camera_info())
    filmed(first, played)
    assert first.start().startswith("http://127.0.0.1:")
    with refused("already started"):
        first.start()
    with refused("another jcr is writing"):
        session().start()
    for played.at in range(4):
        assert first.take() == (True, f"kept images/{played.at + 1:03d}.png")
    until(lambda: states and states[-1]["translation_95_mm"] is not None)
    assert {"translation_95_mm", "rotation_95_deg", "findings", "verdict", "event"} <= states[-1].keys()
    assert states[-1]["translation_95_mm"] > 0 and states[0]["translation_95_mm"] is None
    assert first.take() == (False, "the gripper is where images/004.png was taken; move to another pose")
    assert first.undo()[0] is True
    until(lambda: len(states[-1]["images"]) == 3)
    first.stop()
    assert first.undo() == (False, "nothing to undo")

    resumed = session()
    filmed(resumed, played)
    resumed.start()
    assert resumed.take() == (True, "kept images/004.png")
    resumed.stop()
    capture = jcr.read_capture(tmp_path / "c")
    assert len(capture) == 4 and capture.intrinsics is not None and capture.intrinsics.fx == 300
    assert np.allclose(capture.base_from_gripper, played.poses[:4])


def test_intrinsics_that_are_not_known_and_a_gripper_that_is_not_in_tf_are_named(tmp_path: Path):
    nothing: Any = lambda *_: None  # noqa: E731
    calibrator = Calibrator(Settings(folder=tmp_path / "c"), lambda: None, nothing, nothing, nothing)
    with refused("camera_info"):
        info = camera_info()
        info.distortion_model, info.d = "double_sphere", [0.1] * 2
        jcr.read_ros_camera_info(info)
    assert "gripper_frame" in calibrator.take()[1]


def test_a_rejected_transform_is_not_broadcast(tmp_path: Path):
    broadcast: list[ndarray] = []
    nothing: Any = lambda *_: None  # noqa: E731
    calibrator = Calibrator(Settings(folder=tmp_path / "c"), lambda: None, nothing, nothing, broadcast.append)
    said = SimpleNamespace(warnings=["the camera moved"])
    found = {"gripper_from_camera": np.eye(4), "covariance": np.eye(7), "calibration": said}
    for converged, verdict in ((False, "rejected"), (True, "accepted")):
        result = SimpleNamespace(**found, converged=converged, verdict=verdict)
        calibrator._conclude(SimpleNamespace(finish=lambda result=result: result))  # type: ignore[arg-type]
        assert len(broadcast) == converged and calibrator.outcome[0] is converged
        assert converged or calibrator.outcome[1].endswith("rejected: the camera moved")


def test_an_image_gets_the_depth_of_its_own_stamp():
    """A depth camera's images come later or earlier than the colour images of the same moment."""
    stream, image = FrameStream(has_depth=True), np.zeros((4, 6, 3), np.uint8)
    for k in range(3):
        stream.push_image(image, 0.1 * k)
    assert stream.latest() is None
    stream.push_depth(np.full((4, 6), 101, np.uint16), 0.105)
    frame = stream.latest()
    assert (frame.time_s, frame.depth_mm[0, 0]) == (0.1, 101)
    # The depth of an image that was dropped is not used for another one.
    stream.push_depth(np.full((4, 6), 100, np.uint16), 0.0)
    assert stream.latest() is frame
    stream.push_depth(np.full((4, 6), 103, np.uint16), 0.3)
    stream.push_image(image, 0.31)
    frame = stream.latest()
    assert frame is not None and frame.depth_mm is not None and frame.depth_mm[0, 0] == 103
    # A camera whose depth has ended does not end the images.
    for k in range(20):
        stream.push_image(image, 1.0 + 0.1 * k)
    frame = stream.latest()
    assert frame is not None and frame.time_s >= 1.0 and frame.depth_mm is None


class Message(SimpleNamespace):
    """Any message: parts are made when they are asked for."""

    def __init__(self, *_: Any, **fields: Any) -> None:
        super().__init__(**fields)

    def __getattr__(self, name: str) -> "Message":
        if name.startswith("__"):
            raise AttributeError(name)
        part = Message()
        setattr(self, name, part)
        return part


class Module(ModuleType):
    """Any module of ROS, in which every name is that of a message."""

    def __getattr__(self, name: str) -> type[Message]:
        if name.startswith("__"):
            raise AttributeError(name)
        return Message


class FakeNode:
    """rclpy.node.Node, as far as the node uses it."""

    parameters: dict[str, Any] = {}

    def __init__(self, name: str) -> None:
        self.subscriptions_made: dict[str, Callable[[Any], None]] = {}
        self.services: dict[str, Callable[[Any, Any], Any]] = {}
        self.get_logger = self.get_clock = MagicMock()

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind: Any, topic: str, heard: Any, qos: Any, **_: Any) -> str:
        self.subscriptions_made[topic] = heard
        return topic

    def destroy_subscription(self, subscription: str) -> None:
        del self.subscriptions_made[subscription]

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        messages: list[Any] = []
        return SimpleNamespace(publish=messages.append, messages=messages)

    def create_service(self, kind: Any, name: str, answer: Callable[[Any, Any], Any], **_: Any) -> None:
        self.services[name] = answer


MODULES = [
    *(
        "rclpy",
        "rclpy.callback_groups",
        "rclpy.executors",
        "rclpy.node",
        "rclpy.qos",
        "rclpy.time",
        "tf2_ros",
    ),
    *("geometry_msgs.msg", "sensor_msgs.msg", "std_msgs.msg", "std_srvs.srv"),
]
"""Modules of ROS that the node imports."""


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for name in {*MODULES, *(name.partition(".")[0] for name in MODULES)}:
        monkeypatch.setitem(sys.modules, name, Module(name))
    monkeypatch.delitem(sys.modules, "jcr_ros.node", raising=False)
    sent: list[Any] = []
    sys.modules["rclpy.node"].Node = FakeNode  # type: ignore[attr-defined]
    vars(sys.modules["tf2_ros"]).update(
        Buffer=lambda: SimpleNamespace(lookup_transform=None),
        StaticTransformBroadcaster=lambda node: SimpleNamespace(sendTransform=sent.append, sent=sent),
        TransformException=KeyError,
    )
    return import_module("jcr_ros.node")


def stamped(pose: ndarray, time_s: float) -> Any:
    message = Message()
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = pose[:3, 3]
    rotation.x, rotation.y, rotation.z, rotation.w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    message.header.stamp.sec, message.header.stamp.nanosec = int(time_s), int(1e9 * (time_s % 1))
    return message


@pytest.mark.slow
def test_the_node_broadcasts_the_accepted_transform(
    tmp_path: Path,
    tabletop: Path,
    half_capture: Path,
    node_module: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
):
    played = Played(half_capture)
    parameters = {"folder": str(tmp_path / "c"), "images": 5, "depth_topic": "/depth"}
    parameters |= {"require_mm": 5.0, "require_deg": 1.0}
    monkeypatch.setattr(FakeNode, "parameters", parameters)
    node = node_module.CalibratorNode()
    node.buffer.lookup_transform = lambda base, gripper, at: stamped(played.poses[played.at], played.time_s)
    node.subscriptions_made["/camera/color/camera_info"](camera_info())
    depth = array("B", np.full((240, 320), 0.5, np.float32).tobytes())
    over = threading.Event()

    def push(message: Any, time_s: float) -> None:
        """Publish an image, and its depth after it."""
        node.subscriptions_made["/camera/color/image_raw"](message)
        shape = {"height": 240, "width": 320, "step": 4 * 320, "is_bigendian": 0}
        measured = SimpleNamespace(header=message.header, encoding="32FC1", data=depth, **shape)
        node.subscriptions_made["/depth"](measured)

    film = threading.Thread(target=played.film, args=(push, over))
    film.start()
    try:
        assert node.services["~/start"](None, Message()).success
        for k in range(5):
            played.at = k
            until(lambda k=k: (tmp_path / f"c/images/{k + 1:03d}.png").exists())
    finally:
        over.set()
        film.join()
    answer = node.services["~/finish"](None, Message())
    states = [json.loads(one.data) for one in node.status.messages]
    assert states[-1]["done"] and len(states[-1]["images"]) == 5
    capture = jcr.read_capture(tmp_path / "c")
    depth_m = read_depth_images(capture.folder / str(capture.depths[0]), capture.image_size)
    assert np.median(depth_m) == 0.5
    assert answer.success, answer.message
    (sent,) = node.broadcaster.sent
    assert (sent.header.frame_id, sent.child_frame_id) == ("tool0", "camera_color_optical_frame")
    truth = reference_of(tabletop)
    place = sent.transform.translation
    assert np.linalg.norm(np.array([place.x, place.y, place.z]) - truth[:3, 3]) < 5e-3


def test_the_package_names_what_it_installs():
    setup = (PACKAGE / "setup.py").read_text()
    for file in ("launch/calibrate.launch.py", "rviz/calibrate.rviz", "package.xml", "resource/jcr_ros"):
        assert (PACKAGE / file).is_file() and file.rpartition("/")[2] in setup
    assert yaml.safe_load((PACKAGE / "rviz/calibrate.rviz").read_text())["Visualization Manager"]["Displays"]
    compile((PACKAGE / "launch/calibrate.launch.py").read_text(), "launch", "exec")
