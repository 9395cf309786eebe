"""Intrinsics and their standard deviations as capture.json, camera_info YAML and CameraInfo messages state them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.images import other_size
from jcr.capture.plain_files import read_yaml, shown
from jcr.errors import InputError
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics, coefficients_of

FILE = "camera_info.yaml"
FAR_OFF_CENTRE = 0.3
"""Share of width or height: no camera has its principal point so far from the middle, unless images were cropped."""
NAMES = ("fx", "fy", "cx", "cy")
_ROS_MODELS: dict[Any, DistortionModel] = {
    "": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Distortion models by their names in ROS (sensor_msgs/distortion_models.hpp; depthai and others write fisheye)."""


def checked_intrinsics(
    focal_and_centre: Sequence[Any],
    distortion: Sequence[Any],
    size: tuple[int, int],
    where: str,
    model: DistortionModel = "pinhole",
) -> Intrinsics:
    """Return intrinsics of images of `size` from fx, fy, cx, cy and coefficients; InputError if they cannot be."""
    names = COEFFICIENTS[model]
    try:
        fx, fy, cx, cy = (float(value) for value in focal_and_centre)
        coefficients = [float(k) for k in distortion]
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{where}: need numbers fx, fy, cx, cy and distortion [{','.join(names)}], or null"
        ) from None
    if len(coefficients) != len(names):
        raise InputError(
            f"{where}: distortion has {len(coefficients)} numbers, not the {len(names)} of a {model} intrinsics, "
            f'{",".join(names)}; "model" may be {", ".join(COEFFICIENTS)}'
        )
    if not np.isfinite([fx, fy, cx, cy, *coefficients]).all() or fx <= 0 or fy <= 0:
        raise InputError(
            f"{where}: fx and fy must be positive and all numbers finite; or give null to estimate them"
        )
    width, height = size
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: the principal point ({cx:.4g}, {cy:.4g}) lies outside the {width}x{height} images; "
            "scale the intrinsics to this resolution"
        )
    return Intrinsics(fx, fy, cx, cy, width, height, coefficients_of(coefficients), model)


def read_intrinsics(intrinsics: Any, size: tuple[int, int], where: Path | str) -> Intrinsics | None:
    """Return the intrinsics of images of `size` from the "intrinsics" of a capture.json; None where they are null.

    `where` begins the message of the InputError: the file, or the file and a camera of it.
    """
    if intrinsics is None:
        return None
    where = f"{where}: intrinsics"
    if not isinstance(intrinsics, dict) or not set(NAMES) <= intrinsics.keys():
        raise InputError(f"{where}: need numbers fx, fy, cx, cy and distortion [k1,k2,p1,p2,k3], or null")
    model = intrinsics.get("model", "pinhole")
    if model not in COEFFICIENTS:
        raise InputError(
            f"{where}: distortion model {model!r} is not known; give one of {', '.join(COEFFICIENTS)}"
        )
    distortion = intrinsics.get("distortion") or [0.0] * len(COEFFICIENTS[model])
    if not isinstance(distortion, list):
        raise InputError(f"{where}: distortion must be a list [{','.join(COEFFICIENTS[model])}]")
    return checked_intrinsics([intrinsics[key] for key in NAMES], distortion, size, where, model)


def read_intrinsics_of_size(intrinsics: Any, size: tuple[int, int], where: Path | str) -> Intrinsics | None:
    """Return intrinsics as `read_intrinsics`; InputError where they are of another resolution than the images.

    The resolution is their own "width" and "height" where they have these, else the principal point shows it.
    """
    found = read_intrinsics(intrinsics, size, where)
    if found is None:
        return None
    stated = intrinsics.get("width", size[0]), intrinsics.get("height", size[1])
    remedy = "give those of this resolution, or null to estimate them"
    if stated != size:
        raise other_size(f"{where}: intrinsics of another resolution,", stated, size, remedy=remedy)
    if max(abs(found.cx / size[0] - 0.5), abs(found.cy / size[1] - 0.5)) > FAR_OFF_CENTRE:
        raise InputError(
            f"{where}: intrinsics of another resolution, with centre ({found.cx:.4g}, {found.cy:.4g}) in images of "
            f"{size[0]}x{size[1]} pixels; {remedy}"
        )
    return found


def read_std(given: Any, intrinsics: Intrinsics | None, where: Path | str) -> Float[ndarray, " p"] | None:
    """Return standard deviations in the units of "intrinsics", NaN where one is not stated; 0 is exact."""
    if given is None:
        return None
    where = f"{where}: intrinsics_std"
    if intrinsics is None:
        raise InputError(f"{where}: there are no intrinsics whose errors these could be; give both or none")
    if not isinstance(given, dict) or not given.keys() <= {*NAMES, "distortion"}:
        raise InputError(f"{where}: need some of fx, fy, cx, cy (px) and distortion [k1,k2,p1,p2,k3]")
    distortion = given.get("distortion") or []
    if not isinstance(distortion, list) or len(distortion) > len(intrinsics.distortion):
        raise InputError(
            f"{where}: distortion must be a list of at most {len(intrinsics.distortion)} numbers"
        )
    values = [given.get(name) for name in NAMES] + distortion
    if not all(
        value is None or (type(value) in (int, float) and 0 <= value < intrinsics.width) for value in values
    ):
        raise InputError(f"{where}: standard deviations are numbers of 0 or more, or null")
    std = np.full(4 + len(intrinsics.distortion), np.nan)
    std[: len(values)] = [np.nan if value is None else value for value in values]
    return std


def intrinsics_as_json(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return the "intrinsics" of a capture.json."""
    model = {} if intrinsics.model == "pinhole" else {"model": intrinsics.model}
    return (
        model | {key: getattr(intrinsics, key) for key in NAMES} | {"distortion": list(intrinsics.distortion)}
    )


def std_as_json(std: Float[ndarray, " p"]) -> dict[str, Any]:
    """Return the "intrinsics_std" of a capture.json."""
    values = [None if np.isnan(value) else value for value in std.tolist()]
    return dict(zip(NAMES, values, strict=False)) | {"distortion": values[4:]}


def read_camera_info(file: Path, size: tuple[int, int]) -> Intrinsics | None:
    """Read the intrinsics of a camera_info YAML for images of `size`; None of a camera that is not calibrated."""
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
    """Return intrinsics from K (9 numbers) and D; None for the zeros of a camera that was never calibrated.

    Raises InputError for a distortion that jcr does not know, or intrinsics of another resolution.
    """
    if not isinstance(model, str):
        raise InputError(f"{where}: the distortion model must be a name, as plumb_bob")
    if len(matrix) != 9:
        raise InputError(f"{where}: the camera matrix has {len(matrix)} numbers, not nine")
    if not any(matrix):
        return None
    if tuple(calibrated_size) != size:
        raise other_size(
            f"{where}: intrinsics", tuple(calibrated_size), size, remedy="give those of these images"
        )
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
    count = len(COEFFICIENTS[known])
    padded = [*coefficients[:count], *[0.0] * (count - len(coefficients))]
    return checked_intrinsics([matrix[0], matrix[4], matrix[2], matrix[5]], padded, size, where, known)
