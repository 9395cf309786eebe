"""Intrinsics of ROS: camera_info YAML, CameraInfo messages, and other sources whose numbers are those of an entry."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from jcr.capture.plain_files import read_yaml, validated_content
from jcr.errors import InputError, shown
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics
from jcr.records.capture_json import IntrinsicsEntry

FILE = "camera_info.yaml"
_ROS_MODELS: dict[str, DistortionModel] = {
    "": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Distortion models by their names in ROS (sensor_msgs/distortion_models.hpp; depthai and others write fisheye)."""


class _Numbers(BaseModel):
    """Matrix of a camera_info YAML."""

    data: list[float]


class _CameraInfo(BaseModel):
    """Content of a camera_info YAML."""

    model_config = ConfigDict(strict=True)
    image_width: int
    image_height: int
    camera_matrix: _Numbers
    distortion_model: str
    distortion_coefficients: _Numbers


def read_camera_info(file: Path, size: tuple[int, int]) -> Intrinsics | None:
    """Read the intrinsics of a camera_info YAML for images of `size`; None of a camera that is not calibrated."""
    info: _CameraInfo = validated_content(_CameraInfo, read_yaml(file), str(file))
    matrix, coefficients = info.camera_matrix.data, info.distortion_coefficients.data
    calibrated = info.image_width, info.image_height
    return intrinsics_of_ros(matrix, info.distortion_model, coefficients, calibrated, size, str(file))


def intrinsics_of_ros(
    matrix: Sequence[Any],
    model: str,
    coefficients: Sequence[Any],
    calibrated_size: tuple[int, int],
    size: tuple[int, int],
    where: str,
) -> Intrinsics | None:
    """Return intrinsics from K (9 numbers) and D; None for the zeros of a camera that was never calibrated.

    Raises InputError for a distortion that jcr does not know, or intrinsics of another resolution.
    """
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    known = _ROS_MODELS.get(model)
    if known is None and not any(coefficients):
        known = "pinhole"
    if known is None or any(coefficients[len(COEFFICIENTS[known]) :]):
        raise InputError(
            f"{where}: distortion model {shown(model)} with {len(coefficients)} coefficients; jcr knows plumb_bob (5), "
            "rational_polynomial (8) and equidistant (4): use rectified images, or calibrate with one of these"
        )
    if known == "rational" and not any(coefficients[5:]):
        known = "pinhole"
    fx, _, cx, _, fy, cy, *_ = matrix
    count = len(COEFFICIENTS[known])
    padded = [*coefficients[:count], *[0.0] * (count - len(coefficients))]
    return checked_intrinsics((fx, fy, cx, cy), padded, known, calibrated_size, size, (where, "intrinsics"))


def checked_intrinsics(
    parameters: Sequence[Any],
    distortion: Sequence[Any],
    model: DistortionModel,
    calibrated_size: tuple[int, int],
    size: tuple[int, int],
    where: tuple[str, str],
) -> Intrinsics:
    """Return the intrinsics of images of `size`; raise InputError where a number cannot be.

    `parameters` are fx, fy, cx and cy (px) at the size of calibration; `where` is the source and its part.
    """
    entry = dict(zip(("fx", "fy", "cx", "cy"), parameters, strict=True))
    entry |= {"distortion": [*distortion], "model": model}
    entry |= dict(zip(("width", "height"), calibrated_size, strict=True))
    return validated_content(IntrinsicsEntry, entry, where[0]).record(size, ": ".join(where))
