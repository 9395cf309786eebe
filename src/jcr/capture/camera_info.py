"""Intrinsics as ROS writes them: camera_info YAML and CameraInfo messages."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jcr.capture.checks import checked_intrinsics
from jcr.capture.plain_files import read_yaml, shown
from jcr.errors import InputError
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics

FILE = "camera_info.yaml"
_MODELS: dict[Any, DistortionModel] = {
    "": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""By their names in ROS (sensor_msgs/distortion_models.hpp; depthai and others write fisheye)."""


def read_camera_info(file: Path, size: tuple[int, int]) -> Intrinsics | None:
    """The intrinsics in a camera_info YAML, for images of `size`; None of a camera not calibrated."""
    content = read_yaml(file)
    try:
        matrix, model = content["camera_matrix"]["data"], content["distortion_model"]
        coefficients = content["distortion_coefficients"]["data"]
        calibrated = content["image_width"], content["image_height"]
    except (KeyError, TypeError):
        raise InputError(
            f"{file}: no camera_info; it needs image_width, image_height, camera_matrix, distortion_model and "
            "distortion_coefficients"
        ) from None
    if not isinstance(matrix, list) or not isinstance(coefficients, list):
        raise InputError(f"{file}: the camera matrix and the distortion must be lists of numbers")
    return intrinsics_of_ros(matrix, model, coefficients, calibrated, size, str(file))


def intrinsics_of_ros(
    matrix: Sequence[Any],
    model: Any,
    coefficients: Sequence[Any],
    calibrated_size: Sequence[Any],
    size: tuple[int, int],
    where: str,
) -> Intrinsics | None:
    """Intrinsics from K (9 numbers) and D; None for the zeros of a camera that was never calibrated.

    Raises InputError for a distortion that jcr does not know, or intrinsics of another resolution.
    """
    if not isinstance(model, str):
        raise InputError(f"{where}: the distortion model must be a name, as plumb_bob")
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    if tuple(calibrated_size) != size:
        raise InputError(
            f"{where}: calibrated at {'x'.join(map(str, calibrated_size))}, the images are "
            f"{'x'.join(map(str, size))}; give the intrinsics of these images"
        )
    focal_and_centre = [matrix[0], matrix[4], matrix[2], matrix[5]]
    known = _MODELS.get(model)
    if known is None and not any(coefficients):
        known = "pinhole"
    if known == "rational" and any(coefficients[8:12]):
        known = "thin_prism"
    if known is None or any(coefficients[len(COEFFICIENTS[known]) :]):
        raise InputError(
            f"{where}: distortion model {shown(model)} with {len(coefficients)} coefficients; jcr knows plumb_bob (5), "
            "rational_polynomial (8 or 12) and equidistant (4): use rectified images, or calibrate with one of these"
        )
    if known == "rational" and not any(coefficients[5:]):
        known = "pinhole"
    count = len(COEFFICIENTS[known])
    padded = [*coefficients[:count], *[0.0] * (count - len(coefficients))]
    return checked_intrinsics(focal_and_centre, padded, size, where, known)
