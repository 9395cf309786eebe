"""Intrinsics as ROS writes them: camera_info YAML and CameraInfo messages."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jcr.capture.checks import checked_lens
from jcr.capture.plain_files import read_yaml
from jcr.errors import InputError
from jcr.records import Intrinsics

FILE = "camera_info.yaml"


def read_camera_info(file: Path, size: tuple[int, int]) -> Intrinsics | None:
    """The intrinsics in a camera_info YAML, for images of `size`; None where it says "not calibrated"."""
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
    return lens_of_ros(matrix, model, coefficients, calibrated, size, str(file))


def lens_of_ros(
    matrix: Sequence[Any],
    model: Any,
    coefficients: Sequence[Any],
    calibrated_size: Sequence[Any],
    size: tuple[int, int],
    where: str,
) -> Intrinsics | None:
    """Intrinsics from K (9 numbers) and D; None for the zeros of a camera that was never calibrated.

    Raises InputError for a lens that OpenCV's five coefficients cannot say, or of another resolution.
    """
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    if tuple(calibrated_size) != size:
        raise InputError(
            f"{where}: calibrated at {'x'.join(map(str, calibrated_size))}, the images are "
            f"{'x'.join(map(str, size))}; give the intrinsics of these images"
        )
    beyond = any(coefficients[5:])
    if any(coefficients) and (model not in ("plumb_bob", "rational_polynomial", "") or beyond):
        raise InputError(
            f"{where}: distortion model {model} with {len(coefficients)} coefficients; jcr knows plumb_bob "
            "(k1, k2, p1, p2, k3): use rectified images, or calibrate with plumb_bob"
        )
    five = [*coefficients[:5], *[0.0] * (5 - len(coefficients))]
    return checked_lens([matrix[0], matrix[4], matrix[2], matrix[5]], five, size, where)
