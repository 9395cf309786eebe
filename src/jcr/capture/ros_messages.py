"""Intrinsics, images and depth from messages of ROS bags (rosbags) and nodes (rclpy)."""

from collections.abc import Iterator
from contextlib import contextmanager
from operator import index
from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray
from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field

from jcr.capture.images import read_image, read_one_channel, require_pixels
from jcr.capture.intrinsics import entry_of_matrix, intrinsics_entry
from jcr.errors import LONGEST_SHOWN, InputError, shown
from jcr.records import Intrinsics
from jcr.records.json_file import validated_content

_Numbers = Annotated[list[float], BeforeValidator(lambda it: list(it) if hasattr(it, "__iter__") else it)]
"""List of floats, converted from the array of a message."""


class CameraInfo(BaseModel):
    """Content of a CameraInfo message; ROS 1 names the matrices K, D and P."""

    model_config = ConfigDict(strict=True, from_attributes=True)
    width: int
    height: int
    k: _Numbers = Field(validation_alias=AliasChoices("k", "K"))
    distortion_model: str
    d: _Numbers = Field(validation_alias=AliasChoices("d", "D"))
    p: _Numbers = Field(default=[], validation_alias=AliasChoices("p", "P"))


def intrinsics_of_ros(
    content: Any, size: tuple[int, int], where: str, is_rectified: bool = False
) -> Intrinsics | None:
    """Return the intrinsics of images of `size` (width, height); None if the camera was never calibrated.

    `content` is a CameraInfo message; an uncalibrated camera has a matrix of zeros. Rectified images (`is_rectified`)
    have the intrinsics of the projection matrix P and no distortion. Raises InputError for an unknown distortion model,
    or intrinsics of another resolution.
    """
    info: CameraInfo = validated_content(CameraInfo, content, where)
    matrix, model, coefficients = info.k, info.distortion_model, info.d
    if is_rectified:
        matrix, model, coefficients = [*info.p[:3], *info.p[4:7], *info.p[8:11]], "", []
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    entry = {"width": info.width, "height": info.height, "model": model, "distortion": coefficients}
    return intrinsics_entry(entry_of_matrix(matrix) | entry, where).record(size, where)


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
_PAIRED = (cv2.COLOR_YUV2RGB_UYVY, cv2.COLOR_YUV2RGB_YUY2)
"""Conversions of images in which two pixels share their colour."""


def read_ros_image(message: Any) -> UInt8[ndarray, "h w 3"]:
    """Return the RGB image of a sensor_msgs/Image or CompressedImage; raise InputError if it is not a colour image."""
    pixels, _ = image_of(message, "image")
    return read_image(pixels, "image") if isinstance(pixels, bytes) else pixels


def read_ros_camera_info(message: Any) -> Intrinsics | None:
    """Return the intrinsics of a sensor_msgs/CameraInfo; None if the camera was never calibrated."""
    info: CameraInfo = validated_content(CameraInfo, message, "camera_info")
    return intrinsics_of_ros(message, (info.width, info.height), "camera_info")


@contextmanager
def _as_message(where: str) -> Iterator[None]:
    """Raise InputError where a message has other fields than the message of ROS.

    A bag holds the definitions of its messages, so that a field may be missing, or be of any type.
    """
    try:
        yield
    except (AttributeError, TypeError, ValueError, OverflowError, MemoryError, cv2.error) as error:
        if isinstance(error, InputError):
            raise
        reason = " ".join(str(error).split())[:LONGEST_SHOWN]
        raise InputError(f"{where}: no ROS image message ({reason}); record the standard message") from None


def image_of(message: Any, where: str) -> tuple[bytes | UInt8[ndarray, "h w 3"], str]:
    """Return the image in a message, as the bytes of a JPEG or PNG file or as RGB pixels, and the file ending for it.

    `message` is a sensor_msgs/Image or CompressedImage. Raises InputError for depth, for encodings that jcr does not
    read, and for damaged messages. The bytes of a file are not decoded.
    """
    with _as_message(where):
        if hasattr(message, "format"):
            data = bytes(message.data)
            for magic, ending in ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n", ".png")):
                if data.startswith(magic):
                    return data, ending
            raise InputError(f"{where}: compressed as {shown(message.format)}; give JPEG or PNG of colours")
        if message.encoding not in _ENCODINGS:
            raise InputError(
                f"{where}: encoding {shown(message.encoding)} is no colour image; choose another topic"
            )
        channels, code = _ENCODINGS[message.encoding]
        if code in _PAIRED and message.width % 2:  # two pixels share their colour
            raise InputError(f"{where}: {message.encoding} of an odd width, {message.width}; record again")
        pixels = _rows(message, channels, np.dtype(np.uint8), f"{message.encoding} image", where)
        pixels = pixels.reshape(len(pixels), -1, channels)
        return pixels if code is None else np.asarray(cv2.cvtColor(pixels, code), np.uint8), ".png"


def read_ros_depth(message: Any, where: str = "depth") -> UInt16[ndarray, "h w"]:
    """Return the depth (mm) of a sensor_msgs/Image or CompressedImage; 0 where none was measured.

    Depths in metres are rounded to mm. Raises InputError if the message is not a depth image.
    """
    with _as_message(where):
        if hasattr(message, "format"):
            # compressed_depth_image_transport writes its quantisation before the PNG.
            data = bytes(message.data)
            begin = data.find(b"\x89PNG\r\n")
            depth = read_one_channel(data[begin:], where) if begin >= 0 else None
            if depth is None or depth.dtype != np.uint16 or "32FC1" in message.format:
                raise InputError(
                    f"{where}: depth as {shown(message.format)}; record 16UC1, raw or compressedDepth"
                )
            return depth
        kinds = {"16UC1": (np.uint16, 1.0), "mono16": (np.uint16, 1.0), "32FC1": (np.float32, 1e3)}
        if message.encoding not in kinds:
            raise InputError(
                f"{where}: encoding {shown(message.encoding)} is no depth; give 16UC1 (mm) or 32FC1 (m)"
            )
        kind, to_mm = kinds[message.encoding]
        order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
        values = to_mm * _rows(message, 1, order, "depth image", where).astype(float)
        return np.nan_to_num(values, posinf=0.0, neginf=0.0).clip(0, 65535).round().astype(np.uint16)


def _rows(message: Any, channels: int, kind: np.dtype, what: str, where: str) -> ndarray:
    """Return the values of an image message without the padding of its rows, shape (h, w·channels) and type `kind`."""
    width, height, step = (int(index(number)) for number in (message.width, message.height, message.step))
    require_pixels((width, height), where)
    data, used = np.frombuffer(message.data, np.uint8), width * channels * kind.itemsize
    if step < used or data.size < height * step:
        raise InputError(f"{where}: a {what} of {width}x{height} is cut short; record again")
    rows = data[: height * step].reshape(height, step)
    return np.ascontiguousarray(rows[:, :used]).view(kind)
