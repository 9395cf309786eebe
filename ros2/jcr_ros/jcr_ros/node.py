"""The ROS 2 node: tf, images and camera_info in; the state of the calibration, next pose and static transform out."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy import ndarray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_ros import Buffer, StaticTransformBroadcaster, TransformException, TransformListener

from jcr.errors import InputError
from jcr.export.ros import CameraMount
from jcr.geometry import transform
from jcr.live.collect import CollectOptions
from jcr.live.rest import State
from jcr_ros.core import Session, Settings


class Calibrator(Node):
    """Takes images and calibrates; see README.md for topics, services and parameters."""

    def __init__(self) -> None:
        super().__init__("jcr")
        self.base = self._parameter("base_frame", "base_link")
        self.gripper = self._parameter("gripper_frame", "tool0")
        settings = Settings(
            folder=Path(self._parameter("folder", "jcr_capture")).expanduser(),
            collect=self._collect_options(),
            at_rest=self._parameter("at_rest", True),
            robot=self._parameter("robot", ""),
            parent=self.gripper,
            child=self._parameter("camera_frame", "camera_color_optical_frame"),
            base=self.base,
        )
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = StaticTransformBroadcaster(self)
        self.session = Session(settings, self._gripper_now, self._show, self._publish, self._broadcast)
        group = ReentrantCallbackGroup()
        image = self._parameter("image_topic", "/camera/color/image_raw")
        kind = CompressedImage if image.endswith("compressed") else Image
        self.create_subscription(kind, image, self._image, qos_profile_sensor_data, callback_group=group)
        info = self._parameter("camera_info_topic", "/camera/color/camera_info")
        self.info = self.create_subscription(CameraInfo, info, self._camera_info, 10, callback_group=group)
        depth = self._parameter("depth_topic", "")
        if depth:
            self.create_subscription(Image, depth, self._depth, qos_profile_sensor_data, callback_group=group)
        self.depth_mm: ndarray | None = None
        self.status = self.create_publisher(String, "~/status", 10)
        self.next_pose = self.create_publisher(PoseStamped, "~/next_pose", 1)
        services = {
            "start": self._start,
            "take": self.session.take,
            "undo": self.session.undo,
            "finish": self.session.finish,
        }
        for name, action in services.items():
            self.create_service(Trigger, f"~/{name}", partial(_answered, action), callback_group=group)
        self._show("call ~/start when image and camera_info arrive")

    def _parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    def _collect_options(self) -> CollectOptions:
        """Of numbers, 0 stands for the default."""
        require = self._parameter("require_mm", 0.0), self._parameter("require_deg", 0.0)
        return CollectOptions(
            images=self._parameter("images", 0) or None,
            require=require if all(require) else None,
            until_accurate=self._parameter("until_accurate", False),
        )

    def _show(self, text: str) -> None:
        self.get_logger().info(text)

    def _publish(self, answer: dict[str, Any]) -> None:
        """The state as JSON, and the next pose."""
        self.status.publish(String(data=json.dumps(answer)))
        if answer.get("next_base_from_gripper") is not None:
            self._propose(np.array(answer["next_base_from_gripper"]))

    def _image(self, message: Any) -> None:
        stamp = message.header.stamp
        try:
            self.session.image(message, stamp.sec + 1e-9 * stamp.nanosec, self.depth_mm)
        except InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _depth(self, message: Any) -> None:
        """16UC1 in mm or 32FC1 in m, aligned with the images (aligned_depth_to_color)."""
        kind = {"16UC1": np.uint16, "32FC1": np.float32}[message.encoding]
        values = np.frombuffer(bytes(message.data), kind).reshape(message.height, -1)[:, : message.width]
        self.depth_mm = (
            values if kind is np.uint16 else np.nan_to_num(1e3 * values).clip(0, 65535).astype(np.uint16)
        )

    def _camera_info(self, message: Any) -> None:
        try:
            self.session.camera_info(message)
        except InputError as error:
            self._show(f"error: {error}")
        self.destroy_subscription(self.info)

    def _gripper_now(self) -> State | None:
        try:
            found = self.buffer.lookup_transform(self.base, self.gripper, Time())
        except TransformException:
            return None
        t, q, stamp = found.transform.translation, found.transform.rotation, found.header.stamp
        rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        return State(stamp.sec + 1e-9 * stamp.nanosec, transform(rotation, np.array([t.x, t.y, t.z])))

    def _propose(self, base_from_gripper: ndarray) -> None:
        message = PoseStamped()
        message.header.frame_id = self.base
        message.header.stamp = self.get_clock().now().to_msg()
        _fill(message.pose.position, message.pose.orientation, base_from_gripper)
        self.next_pose.publish(message)

    def _broadcast(self, mount: CameraMount) -> None:
        """The accepted transform, on /tf_static."""
        message = TransformStamped()
        message.header.frame_id, message.child_frame_id = mount.parent, mount.child
        message.header.stamp = self.get_clock().now().to_msg()
        _fill(message.transform.translation, message.transform.rotation, mount.parent_from_child)
        self.broadcaster.sendTransform(message)

    def _start(self) -> tuple[bool, str]:
        try:
            return True, f"move the arm; {self.session.start()} shows the capture"
        except InputError as error:
            return False, str(error)


def _answered(action: Callable[[], tuple[bool, str]], request: Any, response: Any) -> Any:
    response.success, response.message = action()
    return response


def _fill(translation: Any, rotation: Any, a_from_b: ndarray) -> None:
    """Write a transform (4,4) into the two parts of a message."""
    translation.x, translation.y, translation.z = a_from_b[:3, 3].tolist()
    quat_xyzw = Rotation.from_matrix(a_from_b[:3, :3]).as_quat().tolist()
    rotation.x, rotation.y, rotation.z, rotation.w = quat_xyzw


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    node = Calibrator()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.session.stop()
        node.destroy_node()
        rclpy.try_shutdown()
