"""Intrinsics, images and depth from messages of ROS bags (rosbags) and nodes (rclpy), and from camera_info YAML."""

from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray
from pydantic import AliasChoices, AliasPath, BaseModel, BeforeValidator, ConfigDict, Field

from jcr.capture.intrinsics import intrinsics_of_entry
from jcr.errors import InputError
from jcr.records import Intrinsics
from jcr.records.json_file import validated_content

_Numbers = Annotated[list[float], BeforeValidator(lambda it: list(it) if hasattr(it, "__iter__") else it)]
"""List of floats, converted from the array of a message."""


class CameraInfo(BaseModel):
    """Content of a CameraInfo message or a camera_info YAML; ROS 1 names the matrices K, D and P."""

    model_config = ConfigDict(strict=True, from_attributes=True)
    width: int = Field(validation_alias=AliasChoices("image_width", "width"))
    height: int = Field(validation_alias=AliasChoices("image_height", "height"))
    k: _Numbers = Field(validation_alias=AliasChoices(AliasPath("camera_matrix", "data"), "k", "K"))
    distortion_model: str
    d: _Numbers = Field(validation_alias=AliasChoices(AliasPath("distortion_coefficients", "data"), "d", "D"))
    p: _Numbers = Field(default=[], validation_alias=AliasChoices("p", "P"))


def intrinsics_of_ros(
    content: Any, size: tuple[int, int], where: str, is_rectified: bool = False
) -> Intrinsics | None:
    """Return the intrinsics of images of `size` (width, height); None if the camera was never calibrated.

    `content` is a CameraInfo message or the content of a YAML file; an uncalibrated camera has a matrix of zeros.
    Rectified images (`is_rectified`) have the intrinsics of the projection matrix P and no distortion. Raises
    InputError, begun with `where`, for an unknown distortion model, or intrinsics of another resolution.
    """
    info: CameraInfo = validated_content(CameraInfo, content, where)
    matrix, model, coefficients = info.k, info.distortion_model, info.d
    if is_rectified:
        matrix, model, coefficients = [*info.p[:3], *info.p[4:7], *info.p[8:11]], "", []
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    fx, skew, cx, _, fy, cy, *_ = matrix
    entry = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew, "width": info.width, "height": info.height}
    return intrinsics_of_entry(entry | {"model": model, "distortion": coefficients}, size, where)


_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    **dict.fromkeys(("bgr8", "8UC3"), (3, cv2.COLOR_BGR2RGB)),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    **dict.fromkeys(("mono8", "8UC1"), (1, cv2.COLOR_GRAY2RGB)),
    # OpenCV names a Bayer pattern by its second row, ROS by its first: rggb is OpenCV's BG.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2RGB_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2RGB_YUY2)),
}
"""Channels of each colour encoding of ROS, and OpenCV's code for the conversion to RGB; None if it is RGB already."""


def read_ros_image(message: Any) -> UInt8[ndarray, "h w 3"]:
    """Return the RGB image of a sensor_msgs/Image or CompressedImage; raise InputError if it is not a colour image."""
    pixels, _ = image_of(message, "image")
    if isinstance(pixels, bytes):
        return np.asarray(cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)
    return pixels


def read_ros_camera_info(message: Any) -> Intrinsics | None:
    """Return the intrinsics of a sensor_msgs/CameraInfo; None if the camera was never calibrated."""
    return intrinsics_of_ros(message, (message.width, message.height), "camera_info")


def image_of(message: Any, where: str) -> tuple[bytes | UInt8[ndarray, "h w 3"], str]:
    """Return the image in a message, as the bytes of a JPEG or PNG file or as RGB pixels, and the file ending for it.

    `message` is a sensor_msgs/Image or CompressedImage. Raises InputError, begun with `where`, for depth and for
    encodings that jcr does not read.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        for magic, ending in ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n", ".png")):
            if data.startswith(magic):
                return data, ending
        raise InputError(f"{where}: compressed as {message.format!r}; jcr reads JPEG and PNG of colours")
    encoding, (height, width) = message.encoding, (message.height, message.width)
    if encoding not in _ENCODINGS:
        raise InputError(f"{where}: encoding {encoding!r} is no colour image jcr knows; choose another topic")
    channels, code = _ENCODINGS[encoding]
    rows = _rows(message, width * channels, f"an image of {width}x{height} {encoding}", where)
    pixels = rows.reshape(height, width, channels)
    return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8), ".png"


def read_ros_depth(message: Any, where: str = "depth") -> UInt16[ndarray, "h w"]:
    """Return the depth (mm) of a sensor_msgs/Image or CompressedImage; 0 where none was measured.

    Depths in metres are rounded to mm. Raises InputError, begun with `where`, if the message is not a depth image.
    """
    if hasattr(message, "format"):
        # compressed_depth_image_transport writes its quantisation before the PNG.
        data = bytes(message.data)
        begin = data.find(b"\x89PNG\r\n")
        depth = cv2.imdecode(np.frombuffer(data[max(begin, 0) :], np.uint8), cv2.IMREAD_UNCHANGED)
        if begin < 0 or depth is None or depth.dtype != np.uint16 or "32FC1" in message.format:
            raise InputError(f"{where}: depth as {message.format!r}; record 16UC1, raw or compressedDepth")
        return np.asarray(depth)
    kinds = {"16UC1": (np.uint16, 1.0), "mono16": (np.uint16, 1.0), "32FC1": (np.float32, 1e3)}
    if message.encoding not in kinds:
        raise InputError(f"{where}: encoding {message.encoding!r} is no depth; give 16UC1 (mm) or 32FC1 (m)")
    kind, to_mm = kinds[message.encoding]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    what = f"a depth image of {message.width}x{message.height}"
    values = to_mm * _rows(message, message.width * order.itemsize, what, where).view(order).astype(float)
    return np.nan_to_num(values, posinf=0.0, neginf=0.0).clip(0, 65535).round().astype(np.uint16)


def _rows(message: Any, used: int, what: str, where: str) -> UInt8[ndarray, "h used"]:
    """Return the pixel data of an image message, the first `used` bytes of each of its h rows, without padding.

    Raises InputError, begun with `where` and the name `what` of the data, if bytes are missing.
    """
    data = np.frombuffer(message.data, np.uint8)  # rclpy gives an array.array
    if message.step < used or data.size < message.height * message.step:
        raise InputError(f"{where}: {what} is cut short; record again")
    rows = data[: message.height * message.step].reshape(message.height, message.step)
    return np.ascontiguousarray(rows[:, :used])
