"""Input of a calibration: intrinsics, images with gripper poses, or poses alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pydantic import ConfigDict, Field, model_validator

from jcr.records.json_fields import Positive, Spread

DistortionModel = Literal["pinhole", "rational", "thin_prism", "fisheye"]
COEFFICIENTS: dict[DistortionModel, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "thin_prism": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Coefficients of each distortion in OpenCV's order; ROS calls them plumb_bob, rational_polynomial (with 8 or 12) and
equidistant."""
LARGEST_PX = 100_000
"""Width of the largest image; no camera's image is wider."""
Pixels = Annotated[int, Field(ge=1, le=LARGEST_PX)]


@dataclass(frozen=True)
class Intrinsics:
    """A camera with one of OpenCV's distortions, in pixels of a `width` x `height` image."""

    __pydantic_config__ = ConfigDict(allow_inf_nan=False)
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: Pixels
    height: Pixels
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Coefficients, as many as COEFFICIENTS has names for the model."""
    model: DistortionModel = "pinhole"

    @property
    def matrix(self) -> Float[ndarray, "3 3"]:
        """K (3,3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def with_std(self, std: Float[ndarray, " q"] | None) -> "IntrinsicsAndStd":
        """Return the intrinsics with standard deviations in the order of camera.parameters; None: not estimated."""
        values: dict[str, Any] = vars(self) | {"std": None if std is None else tuple(std.tolist())}
        return IntrinsicsAndStd(**values)

    @model_validator(mode="after")
    def _has_coefficients_of_model(self) -> "Intrinsics":
        names = COEFFICIENTS[self.model]
        if len(self.distortion) != len(names):
            raise ValueError(f"{len(self.distortion)} coefficients, but a {self.model} model has {names}")
        return self


@dataclass(frozen=True)
class IntrinsicsAndStd(Intrinsics):
    """Intrinsics with their standard deviations."""

    std: tuple[Spread, ...] | None = None
    """Standard deviations of fx, fy, cx, cy (px) and the distortion; None where the intrinsics were not estimated."""

    @model_validator(mode="after")
    def _has_std_of_each(self) -> "IntrinsicsAndStd":
        if self.std is not None and len(self.std) != 4 + len(self.distortion):
            raise ValueError(
                f"{len(self.std)} standard deviations, but a {self.model} model has "
                f"{4 + len(self.distortion)} parameters"
            )
        return self


Mount = Literal["gripper", "base"]
"""Body that a camera is mounted on: the gripper of an arm, or the ground that the arm's base stands on."""


@dataclass(frozen=True, kw_only=True)
class CellCamera:
    """A further camera of the robot's cell, and its images."""

    name: str
    mount: Mount
    images: tuple[str, ...]
    """Paths relative to the folder."""
    image_size: tuple[int, int]
    intrinsics: Intrinsics | None = None
    intrinsics_std: Float[ndarray, " q"] | None = None
    folder: Path | None = None
    """None: the capture's."""
    frame: Int[ndarray, " k"] | None = None
    """Rows of the capture at whose gripper poses the images of a camera on the same gripper were taken; else None."""
    arm: str | None = None
    """The other arm that carries it; None: the capture's own, or none."""
    base_from_gripper: Float[ndarray, "k 4 4"] | None = None
    """Gripper poses of the other arm in its own base, one for each image."""


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Images of one scene and the gripper pose at each, checked on reading."""

    folder: Path
    images: tuple[str, ...]
    """Paths relative to `folder`; the names by which everything later speaks of an image."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    image_size: tuple[int, int]
    """Width, height in pixels after EXIF rotation; the same for all images."""
    intrinsics: Intrinsics | None = None
    """None: unknown, to be estimated."""
    intrinsics_std: Float[ndarray, " q"] | None = None
    """Standard deviations of the given ones, in the order of camera.parameters, not a number where one is not stated."""
    source: Path | None = None
    """Source that it was read from, where that is not a capture.json in `folder`."""
    cameras: Path | None = None
    """A COLMAP model that holds the cameras' poses already."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader: pairing of files, frames left out."""
    joints: Float[ndarray, "n dof"] | None = None
    """Joint angles (rad) at each image, from the base on; None: not recorded."""
    robot: str | None = None
    """Name of the arm, one of jcr.estimation.arms.ROBOT_NAMES."""
    urdf: Path | None = None
    """The arm's URDF file, not relative to `folder`; None where none was given."""
    orientation: int = 1
    """EXIF's, of all images: 1 as the sensor has them; others were rotated upright, and the camera frame is theirs."""
    pose_convention: str | None = None
    """Pose convention, a name of capture.controllers.CONVENTIONS; None where the file does not state one."""
    depths: tuple[str | None, ...] | None = None
    """Images of a depth camera, one for each image or None: aligned 16-bit PNG in mm, relative to `folder`."""
    camera_name: str = "wrist"
    mount: Mount = "gripper"
    """base: a fixed camera, and the images show what the gripper carries."""
    others: tuple[CellCamera, ...] = ()

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    def of_rows(self, rows: Sequence[int] | Int[ndarray, " k"]) -> "Capture":
        """Return the capture with some of its images, in this order, without further cameras."""
        chosen = np.asarray(rows, dtype=int).tolist()
        return replace(
            self,
            images=tuple(self.images[row] for row in chosen),
            base_from_gripper=self.base_from_gripper[chosen],
            joints=None if self.joints is None else self.joints[chosen],
            depths=None if self.depths is None else tuple(self.depths[row] for row in chosen),
            others=(),
        )


@dataclass(frozen=True, kw_only=True)
class PosePairs:
    """Gripper and camera poses of the same instants, the cameras found by somebody else: no image is needed."""

    source: Path
    images: tuple[str, ...]
    """Names of the samples."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    recon_from_camera: Float[ndarray, "n 4 4"]
    is_metric: bool
    """The cameras' unit is the metre, as with a marker of known size."""
    notes: tuple[str, ...] = ()
    backend: str = "poses given"

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    @property
    def image_index(self) -> Int[ndarray, " n"]:
        """Rows of the samples with a camera pose: all, as in a Reconstruction that registered every image."""
        return np.arange(len(self))
