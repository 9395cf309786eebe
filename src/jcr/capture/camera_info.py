"""Intrinsics and their standard deviations in capture.json, camera_info YAML and CameraInfo messages."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field

from jcr.capture.images import other_size
from jcr.capture.plain_files import read_yaml, shown, validated
from jcr.errors import InputError
from jcr.geometry import HUGE
from jcr.records import COEFFICIENTS, DistortionModel, Intrinsics, coefficients_of

FILE = "camera_info.yaml"
NAMES = ("fx", "fy", "cx", "cy")
_ROS_MODELS: dict[str, DistortionModel] = {
    "": "pinhole",
    "plumb_bob": "pinhole",
    "rational_polynomial": "rational",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
}
"""Distortion models by their names in ROS (sensor_msgs/distortion_models.hpp; depthai and others write fisheye)."""
Positive = Annotated[float, Field(gt=0, lt=HUGE)]
Std = Annotated[float, Field(ge=0, lt=HUGE)]


class IntrinsicsEntry(BaseModel):
    """Intrinsics in a capture.json, px; the size of the images is that of the capture."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: list[float] | None = None
    """Coefficients in OpenCV's order; none given: 0."""
    model: DistortionModel = "pinhole"
    width: int | None = None
    """Width of the images, px; of the capture's images where it is not stated."""
    height: int | None = None
    """Height of the images, px; of the capture's images where it is not stated."""

    @staticmethod
    def of(intrinsics: Intrinsics) -> "IntrinsicsEntry":
        """Return the entry of intrinsics."""
        model = {} if intrinsics.model == "pinhole" else {"model": intrinsics.model}
        numbers = {key: getattr(intrinsics, key) for key in NAMES}
        return IntrinsicsEntry(**model, **numbers, distortion=list(intrinsics.distortion))

    def record(self, size: tuple[int, int], where: str) -> Intrinsics:
        """Return the intrinsics of images of `size`; raise InputError, begun with `where`, where they cannot be."""
        names = COEFFICIENTS[self.model]
        distortion = self.distortion or [0.0] * len(names)
        if len(distortion) != len(names):
            raise InputError(
                f"{where}: distortion has {len(distortion)} numbers, not the {len(names)} of a {self.model} model, "
                f'{",".join(names)}; "model" may be {", ".join(COEFFICIENTS)}'
            )
        stated = (self.width or size[0], self.height or size[1])
        if stated != size:
            raise other_size(where, stated, size, remedy="give those of these images, or null")
        if not (0 < self.cx < size[0] and 0 < self.cy < size[1]):
            raise InputError(
                f"{where}: the principal point ({self.cx:.4g}, {self.cy:.4g}) lies outside the {size[0]}x{size[1]} "
                "images; give the intrinsics of this resolution, or null to estimate them"
            )
        coefficients = coefficients_of(distortion)
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, *size, coefficients, self.model)


class StdEntry(BaseModel):
    """Standard deviations of intrinsics in a capture.json, px and units of distortion; 0 is exact, null not stated."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False, extra="forbid")
    fx: Std | None = None
    fy: Std | None = None
    cx: Std | None = None
    cy: Std | None = None
    distortion: list[Std | None] = []

    @staticmethod
    def of(std: Float[ndarray, " p"]) -> "StdEntry":
        """Return the entry of standard deviations, NaN where one is not stated."""
        values = [None if np.isnan(value) else value for value in std.tolist()]
        return StdEntry(**dict(zip(NAMES, values, strict=False)), distortion=values[4:])

    def array(self, intrinsics: Intrinsics | None, where: str) -> Float[ndarray, " p"]:
        """Return the standard deviations in the order of `intrinsics`, NaN where one is not stated."""
        if intrinsics is None:
            raise InputError(f"{where}: there are no intrinsics whose errors these are; give both or none")
        count = len(intrinsics.distortion)
        if len(self.distortion) > count:
            raise InputError(f"{where}: distortion must be a list of at most {count} numbers")
        values = [*(getattr(self, name) for name in NAMES), *self.distortion]
        std = np.full(4 + count, np.nan)
        std[: len(values)] = [np.nan if value is None else value for value in values]
        return std


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
    info: _CameraInfo = validated(_CameraInfo, read_yaml(file), str(file))
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
    count = len(COEFFICIENTS[known])
    entry = dict(zip(("fx", "cx", "fy", "cy"), (matrix[k] for k in (0, 2, 4, 5)), strict=True))
    entry |= {"distortion": [*coefficients[:count], *[0.0] * (count - len(coefficients))], "model": known}
    entry |= {"width": calibrated_size[0], "height": calibrated_size[1]}
    return validated(IntrinsicsEntry, entry, where).record(size, f"{where}: intrinsics")
