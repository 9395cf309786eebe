"""A simulated recording: a ROS bag in which an arm goes through a capture's views and stops at each."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

from jcr.capture.images import read_image
from jcr.extras import extra
from jcr.geometry import rotation_between_deg, transform
from jcr.records import Capture

FPS, TF_HZ = 30.0, 100.0
START_NS = 1_700_000_000_123_456_789
BLUR_PX_PER_M = 30.0
"""Length of the blur (px) per m/s: 600 px of focal length, half a metre away, 25 ms of exposure."""


def nearest_view(
    poses: Float[ndarray, "n 4 4"], views: Float[ndarray, "m 4 4"]
) -> tuple[Float[ndarray, " n"], Float[ndarray, " n"], ndarray]:
    """Return distance (mm) and angle (deg) of each pose from the nearest view, and the number of that view."""
    distance = np.linalg.norm(poses[:, None, :3, 3] - views[None, :, :3, 3], axis=-1)
    nearest = distance.argmin(1)
    angle = rotation_between_deg(poses[:, :3, :3], views[nearest, :3, :3])
    return 1e3 * distance.min(1), np.asarray(angle), nearest


def write_bag(
    path: Path,
    capture: Capture,
    kind: Literal["ros1", "sqlite3", "mcap"],
    seconds: float,
    fps: float = FPS,
    tf_hz: float = TF_HZ,
    compressed: bool = True,
) -> Path:
    """Write a bag in which the arm stops at every view of a capture and moves smoothly between them.

    Topics: /camera/image_raw or /camera/image_raw/compressed, /camera/camera_info, /tf (base_link to tool0) and
    /tf_static (world to base_link).
    """
    rosbag1, rosbag2 = extra("rosbags.rosbag1", "ros", "a bag"), extra("rosbags.rosbag2", "ros", "a bag")
    typesys = extra("rosbags.typesys", "ros", "a bag")
    store = typesys.get_typestore(
        typesys.Stores.ROS1_NOETIC if kind == "ros1" else typesys.Stores.ROS2_HUMBLE
    )
    plugins = rosbag2.StoragePlugin
    if kind == "ros1":
        definition = "geometry_msgs/TransformStamped[] transforms\n"
        store.register(typesys.get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))
        writer = rosbag1.Writer(path)
    else:
        plugin = plugins.MCAP if kind == "mcap" else plugins.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    with writer:
        connections: dict[str, Any] = {}
        for stamp_ns, topic, message in _messages(
            store.types, capture, seconds, fps, tf_hz, compressed, kind
        ):
            name = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
            writer.write(connections[topic], stamp_ns, serialize(message, name))
    return path


def pose_at(views: Float[ndarray, "m 4 4"], seconds: float, time_s: Float[ndarray, " n"]):
    """Return poses (n,4,4) of an arm that halts at each view for half of its share of the time, and speeds (m/s)."""
    share = seconds / len(views)
    # 10u³ − 15u⁴ + 6u⁵ starts and ends at rest (Flash and Hogan 1985, minimum jerk).
    u = np.clip((time_s % share) / share * 2 - 1, 0, 1)
    rows = np.minimum(time_s // share, len(views) - 1) + u**3 * (10 - 15 * u + 6 * u**2)
    rows = np.minimum(rows, len(views) - 1)
    before = np.minimum(rows.astype(int), len(views) - 2)
    rotation = Slerp(np.arange(len(views)), Rotation.from_matrix(views[:, :3, :3]))(rows).as_matrix()
    step = views[before + 1, :3, 3] - views[before, :3, 3]
    poses = transform(rotation, views[before, :3, 3] + (rows - before)[:, None] * step)
    return poses, np.linalg.norm(step, axis=1) * 30 * u**2 * (1 - u) ** 2 * 2 / share, rows


def _messages(
    types: dict[str, Any],
    capture: Capture,
    seconds: float,
    fps: float,
    tf_hz: float,
    compressed: bool,
    kind: str,
) -> Iterator[tuple[int, str, Any]]:
    """Yield the recorded messages in order of time."""

    def header(at: int, frame: str = "camera") -> Any:
        stamp = types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9)
        sequence = (0,) if kind == "ros1" else ()
        return types["std_msgs/msg/Header"](*sequence, stamp, frame)

    def tf(at: int, parent: str, child: str, pose: Float[ndarray, "4 4"]) -> Any:
        rotation = types["geometry_msgs/msg/Quaternion"](
            *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        )
        translation = types["geometry_msgs/msg/Vector3"](*pose[:3, 3].tolist())
        moved = types["geometry_msgs/msg/Transform"](translation, rotation)
        stamped = types["geometry_msgs/msg/TransformStamped"](header(at, parent), child, moved)
        return types["tf2_msgs/msg/TFMessage"]([stamped])

    def image_message(at: int, form: str, pixels: ndarray) -> Any:
        height, width = pixels.shape[:2]
        data = pixels.view(np.uint8).ravel()
        fields = (height, width, form, 0, len(data) // height, data)
        return types["sensor_msgs/msg/Image"](header(at), *fields)

    camera = capture.intrinsics
    assert camera is not None
    k, d = camera.matrix.ravel(), np.array(camera.distortion)
    p = np.column_stack([camera.matrix, np.zeros(3)]).ravel()
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    optics = (camera.height, camera.width, "plumb_bob", d, k, np.eye(3).ravel(), p, 0, 0, roi)
    yield START_NS, "/tf_static", tf(START_NS, "world", "base_link", np.eye(4))
    yield START_NS, "/camera/camera_info", types["sensor_msgs/msg/CameraInfo"](header(START_NS), *optics)
    images = [read_image(capture.folder / name) for name in capture.images]
    rng = np.random.default_rng(0)
    events = [(k / tf_hz, "tf") for k in range(round(seconds * tf_hz))]
    events += [((k + 0.5) / fps, "image") for k in range(round(seconds * fps))]
    for time_s, what in sorted(events):
        at = START_NS + round(1e9 * time_s)
        poses, speeds, rows = pose_at(capture.base_from_gripper, seconds, np.array([time_s]))
        if what == "tf":
            yield at, "/tf", tf(at, "base_link", "tool0", poses[0])
            continue
        row = round(float(rows[0]))
        # Blurred by the camera's speed, with one grey level of noise in places: no two frames are alike.
        length = 1 + round(BLUR_PX_PER_M * float(speeds[0]))
        image = images[row] ^ (rng.random(images[row].shape[:2]) < 0.02)[..., None].astype(np.uint8)
        image = np.asarray(cv2.blur(image, (length, 1)), np.uint8) if length > 1 else image
        if compressed:
            data = np.asarray(cv2.imencode(".jpg", image[:, :, ::-1])[1]).ravel()
            message = types["sensor_msgs/msg/CompressedImage"](header(at), "jpeg", data)
            yield at, "/camera/image_raw/compressed", message
        else:
            yield at, "/camera/image_raw", image_message(at, "rgb8", image)
