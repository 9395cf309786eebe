"""The ROS 2 node: tf, images and camera_info in, samples by service or at rest, the static transform out."""

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

from jcr.errors import InputError, NotTrustedError
from jcr.geometry import transform
from jcr.live.rest import State
from jcr_ros.core import Session, Settings


class Calibrator(Node):
    """Takes samples and solves; see README.md for topics, services and parameters."""

    def __init__(self) -> None:
        super().__init__("jcr")
        self.base = self._parameter("base_frame", "base_link")
        self.gripper = self._parameter("gripper_frame", "tool0")
        settings = Settings(
            folder=Path(self._parameter("folder", "jcr_capture")).expanduser(),
            images=self._parameter("images", 12),
            at_rest=self._parameter("at_rest", True),
            robot=self._parameter("robot", ""),
            parent=self.gripper,
            child=self._parameter("camera_frame", "camera_color_optical_frame"),
            base=self.base,
        )
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.broadcaster = StaticTransformBroadcaster(self)
        self.session = Session(settings, self._gripper_now, self._say, self._propose)
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
        for name, answer in (("start", self._start), ("take_sample", self._take), ("solve", self._solve)):
            self.create_service(Trigger, f"~/{name}", answer, callback_group=group)
        self._say("call ~/start when image and camera_info arrive")

    def _parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    def _say(self, text: str) -> None:
        self.get_logger().info(text)
        self.status.publish(String(data=text))

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
            self._say(f"error: {error}")
        self.destroy_subscription(self.info)

    def _gripper_now(self) -> State | None:
        try:
            found = self.buffer.lookup_transform(self.base, self.gripper, Time())
        except TransformException:
            return None
        t, q, stamp = found.transform.translation, found.transform.rotation, found.header.stamp
        rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        return State(stamp.sec + 1e-9 * stamp.nanosec, transform(rotation, np.array([t.x, t.y, t.z])))

    def _propose(self, base_from_gripper: ndarray | None, answer: dict[str, Any]) -> None:
        if base_from_gripper is None:
            return
        message = PoseStamped()
        message.header.frame_id = self.base
        message.header.stamp = self.get_clock().now().to_msg()
        position, rotation = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = base_from_gripper[:3, 3].tolist()
        rotation.x, rotation.y, rotation.z, rotation.w = (
            Rotation.from_matrix(base_from_gripper[:3, :3]).as_quat().tolist()
        )
        self.next_pose.publish(message)

    def _start(self, request: Any, response: Any) -> Any:
        try:
            self.session.start()
        except InputError as error:
            response.success, response.message = False, str(error)
            return response
        response.success = True
        response.message = f"move the arm; {self.session.settings.folder}/live.html shows how it goes"
        return response

    def _take(self, request: Any, response: Any) -> Any:
        response.success, response.message = self.session.take()
        return response

    def _solve(self, request: Any, response: Any) -> Any:
        self.session.stop()
        try:
            mount, response.success, response.message = self.session.solve()
        except (InputError, NotTrustedError) as error:
            response.success, response.message = False, str(error)
            return response
        message = TransformStamped()
        message.header.frame_id, message.child_frame_id = mount.parent, mount.child
        message.header.stamp = self.get_clock().now().to_msg()
        place, turn = message.transform.translation, message.transform.rotation
        place.x, place.y, place.z = mount.parent_from_child[:3, 3].tolist()
        turn.x, turn.y, turn.z, turn.w = (
            Rotation.from_matrix(mount.parent_from_child[:3, :3]).as_quat().tolist()
        )
        self.broadcaster.sendTransform(message)
        self._say(response.message)
        return response


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
