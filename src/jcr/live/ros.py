"""Images, depth and intrinsics from ROS messages for nodes; ROS itself is not imported."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from jcr.capture.camera_info import intrinsics_of_ros
from jcr.capture.ros_image import depth_of, image_of
from jcr.records import Intrinsics


def read_ros_image(message: Any) -> UInt8[ndarray, "h w 3"]:
    """Return the RGB image of a sensor_msgs/Image or CompressedImage; raise InputError for what is no colour image."""
    pixels, _ = image_of(_with_array(message), "image")
    if isinstance(pixels, bytes):
        decoded = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_COLOR_RGB)
        return np.asarray(decoded, np.uint8)
    return pixels


def read_ros_depth(message: Any) -> UInt16[ndarray, "h w"]:
    """Return the depth (mm) of a sensor_msgs/Image or CompressedImage, 0 where there is none."""
    return depth_of(_with_array(message), "depth")


def read_ros_camera_info(message: Any) -> Intrinsics | None:
    """Return the intrinsics of a sensor_msgs/CameraInfo; None of a camera that was never calibrated."""
    size = (message.width, message.height)
    return intrinsics_of_ros(
        list(message.k), message.distortion_model, list(message.d), size, size, "camera_info"
    )


def _with_array(message: Any) -> SimpleNamespace:
    """Return the message with its data as an array of bytes, which rclpy gives as array.array."""
    names = ("format",) if hasattr(message, "format") else ("encoding", "width", "height", "step")
    fields = {name: getattr(message, name) for name in names}
    fields["is_bigendian"] = getattr(message, "is_bigendian", 0)
    return SimpleNamespace(**fields, data=np.frombuffer(bytes(message.data), np.uint8))
