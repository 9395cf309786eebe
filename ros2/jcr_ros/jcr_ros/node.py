"""ROS 2 node: tf, images and camera_info in; state of the calibration and static transform out."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TransformStamped
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

import jcr
from jcr_ros.core import Calibrator, Settings


class CalibratorNode(Node):
    """Node that takes images and calibrates; README.md has its topics, services and parameters."""

    def __init__(self) -> None:
        """Read the parameters, subscribe to the topics, and offer the services."""
        super().__init__("jcr")
        self.base = self._parameter("base_frame", "base_link")
        self.gripper = self._parameter("gripper_frame", "tool0")
        self.camera = self._parameter("camera_frame", "camera_color_optical_frame")
        depth = self._parameter("depth_topic", "")
        settings = Settings(
            folder=Path(self._parameter("folder", "jcr_capture")).expanduser(),
            options=self._options(),
            at_rest=self._parameter("at_rest", True),
            robot=self._parameter("robot", ""),
            frames=jcr.FrameNames(base=self.base, gripper=self.gripper, camera=self.camera),
            has_depth=bool(depth),
        )
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = StaticTransformBroadcaster(self)
        self.calibrator = Calibrator(settings, self._gripper_now, self._show, self._publish, self._broadcast)
        group = ReentrantCallbackGroup()
        image = self._parameter("image_topic", "/camera/color/image_raw")
        self.create_subscription(
            _kind(image), image, self._image, qos_profile_sensor_data, callback_group=group
        )
        info = self._parameter("camera_info_topic", "/camera/color/camera_info")
        self.info = self.create_subscription(CameraInfo, info, self._camera_info, 10, callback_group=group)
        if depth:
            self.create_subscription(
                _kind(depth), depth, self._depth, qos_profile_sensor_data, callback_group=group
            )
        self.status = self.create_publisher(String, "~/status", 10)
        services = {
            "start": self._start,
            "take": self.calibrator.take,
            "undo": self.calibrator.undo,
            "finish": self.calibrator.finish,
        }
        for name, action in services.items():
            self.create_service(Trigger, f"~/{name}", partial(_answered, action), callback_group=group)
        self._show("call ~/start when image and camera_info arrive")

    def _parameter(self, name: str, default: Any) -> Any:
        """Declare a parameter and return its value."""
        return self.declare_parameter(name, default).value

    def _options(self) -> jcr.SessionOptions:
        """Return the options of taking images; 0 images stand for the default."""
        return jcr.SessionOptions(
            images=self._parameter("images", 0) or None,
            require=(self._parameter("require_mm", 5.0), self._parameter("require_deg", 1.0)),
            until_accurate=self._parameter("until_accurate", False),
        )

    def _show(self, text: str) -> None:
        """Log an event."""
        self.get_logger().info(text)

    def _publish(self, answer: dict[str, Any]) -> None:
        """Publish the state as JSON."""
        self.status.publish(String(data=json.dumps(answer)))

    def _image(self, message: Any) -> None:
        """Pass on an image."""
        try:
            self.calibrator.frames.push_image(jcr.read_ros_image(message), _seconds(message.header.stamp))
        except jcr.InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _depth(self, message: Any) -> None:
        """Pass on a depth image, which is aligned with the images (aligned_depth_to_color)."""
        try:
            self.calibrator.frames.push_depth(jcr.read_ros_depth(message), _seconds(message.header.stamp))
        except jcr.InputError as error:
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _camera_info(self, message: Any) -> None:
        """Take the intrinsics of the first message."""
        try:
            self.calibrator.intrinsics = jcr.read_ros_camera_info(message)
        except jcr.InputError as error:
            self._show(f"error: {error}")
        self.destroy_subscription(self.info)

    def _gripper_now(self) -> jcr.RobotState | None:
        """Return the newest pose of the gripper in tf; None while there is none."""
        try:
            found = self.buffer.lookup_transform(self.base, self.gripper, Time())
        except TransformException:
            return None
        t, q = found.transform.translation, found.transform.rotation
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        pose[:3, 3] = t.x, t.y, t.z
        return jcr.RobotState(_seconds(found.header.stamp), pose)

    def _broadcast(self, gripper_from_camera: ndarray) -> None:
        """Send the accepted transform on /tf_static."""
        message = TransformStamped()
        message.header.frame_id, message.child_frame_id = self.gripper, self.camera
        message.header.stamp = self.get_clock().now().to_msg()
        t, q = message.transform.translation, message.transform.rotation
        t.x, t.y, t.z = gripper_from_camera[:3, 3].tolist()
        q.x, q.y, q.z, q.w = Rotation.from_matrix(gripper_from_camera[:3, :3]).as_quat().tolist()
        self.broadcaster.sendTransform(message)

    def _start(self) -> tuple[bool, str]:
        """Start the capture; return whether that worked, and the address of the page or the reason."""
        try:
            return True, f"move the arm; {self.calibrator.start()} shows the capture"
        except jcr.InputError as error:
            return False, str(error)


def _answered(action: Callable[[], tuple[bool, str]], request: Any, response: Any) -> Any:
    """Answer a service with the outcome of an action."""
    response.success, response.message = action()
    return response


def _kind(topic: str) -> type:
    """Return the type of messages of a topic."""
    return CompressedImage if "compressed" in topic else Image


def _seconds(stamp: Any) -> float:
    """Return a stamp in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def main() -> None:
    """Spin until Ctrl-C."""
    rclpy.init()
    node = CalibratorNode()
    executor = MultiThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.calibrator.stop()
        node.destroy_node()
        rclpy.try_shutdown()
