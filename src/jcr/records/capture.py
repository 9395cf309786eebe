"""Records of a calibration's input: intrinsics, images with gripper poses, further cameras, or pairs of poses."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pydantic import ConfigDict, Field, StringConstraints

from jcr.errors import InputError, count_of
from jcr.records.field_checks import Checked, require_counts, require_finite, require_rows
from jcr.records.json_fields import Positive, Spread

DistortionModel = Literal["pinhole", "rational", "thin_prism", "fisheye"]
COEFFICIENTS: dict[DistortionModel, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "thin_prism": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Names of each model's distortion coefficients in OpenCV's order. The names of the models in ROS are plumb_bob,
rational_polynomial (8 or 12 coefficients) and equidistant."""
LARGEST_PX = 100_000
"""Largest width and height of an image (px)."""
_Words = Annotated[str, StringConstraints(max_length=1000)]
"""Text of a reading; those of jcr have a few hundred characters."""
_Notation = Annotated[
    str,
    StringConstraints(
        pattern=r"^(matrix(:columns)?|quat:(xyzw|wxyz)|rotvec|euler:([xyz]{3}|[XYZ]{3}))$", max_length=20
    ),
]
_Units = Annotated[str, StringConstraints(pattern=r"^(m|cm|mm)-(rad|deg)$")]
Pixels = Annotated[int, Field(ge=1, le=LARGEST_PX)]
FRAME_NAME = re.compile(r"[A-Za-z0-9_](-?[A-Za-z0-9_/.])*")
"""Names of frames that tf2 and XML accept; two hyphens would end a comment of XML."""
FrameName = Annotated[str, StringConstraints(pattern=f"^{FRAME_NAME.pattern}$", max_length=200)]


@dataclass(frozen=True)
class Intrinsics(Checked):
    """Intrinsics of a camera (px) for images of `width` x `height` pixels, with one of OpenCV's distortion models."""

    __pydantic_config__ = ConfigDict(allow_inf_nan=False)
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    width: Pixels
    height: Pixels
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Distortion coefficients of the model, in the order of COEFFICIENTS."""
    model: DistortionModel = "pinhole"

    @property
    def matrix(self) -> Float[ndarray, "3 3"]:
        """Camera matrix K (3,3) in px: rows (fx, 0, cx), (0, fy, cy), (0, 0, 1)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def with_std(self, std: Float[ndarray, " q"] | None) -> "IntrinsicsAndStd":
        """Return the intrinsics with the standard deviations `std` of their parameters; None: not estimated.

        The order is fx, fy, cx, cy (px), then the distortion coefficients.
        """
        values: dict[str, Any] = vars(self) | {"std": None if std is None else tuple(std.tolist())}
        return IntrinsicsAndStd(**values)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = COEFFICIENTS[self.model]
        if len(self.distortion) != len(names):
            raise InputError(f"{len(self.distortion)} coefficients, but a {self.model} model has {names}")


@dataclass(frozen=True)
class IntrinsicsAndStd(Intrinsics):
    """Intrinsics and the standard deviations of their parameters."""

    std: tuple[Spread, ...] | None = None
    """Standard deviations of fx, fy, cx, cy (px) and the distortion; None where the intrinsics were not estimated."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.std is not None and len(self.std) != 4 + len(self.distortion):
            raise InputError(
                f"{len(self.std)} standard deviations, but a {self.model} model has "
                f"{4 + len(self.distortion)} parameters"
            )


Mount = Literal["gripper", "base"]
"""Body that a camera is mounted on: the gripper of an arm, or the ground that the arm's base stands on."""


@dataclass(frozen=True, kw_only=True)
class CellCamera(Checked):
    """Camera of the robot's cell in addition to the one whose calibration is wanted, with its images."""

    name: str
    mount: Mount
    images: tuple[str, ...]
    """Paths relative to `folder`."""
    image_size: tuple[Pixels, Pixels]
    """Width and height (px)."""
    intrinsics: Intrinsics | None = None
    """Given intrinsics; None: unknown, to be estimated."""
    intrinsics_std: Float[ndarray, " q"] | None = None
    """Standard deviations of the given intrinsics, in the order of camera.parameters; NaN where none is stated."""
    folder: Path | None = None
    """Folder of the images; None: the folder of the capture."""
    frame: Int[ndarray, " k"] | None = None
    """Row of the capture, for each image, with the gripper pose of that image, for a camera on the gripper or one that
    watches it; None for others."""
    arm: str | None = None
    """Name of another arm that carries the camera; None: the arm of the capture, or a fixed camera."""
    base_from_gripper: Float[ndarray, "k 4 4"] | None = None
    """Gripper poses of the other arm in its own base frame, one for each image; None without another arm."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_counts(
            "CellCamera", len(self.images), frame=self.frame, base_from_gripper=self.base_from_gripper
        )
        require_finite("CellCamera", base_from_gripper=self.base_from_gripper)


@dataclass(frozen=True, kw_only=True)
class Reading(Checked):
    """Meaning of the numbers of a pose file: columns, notation of the rotation, units, direction, and who decided it."""

    file: _Words
    """Name of the file, or of the folder with one file for each image."""
    columns: _Words = ""
    """First part of the names of the columns that hold the pose, such as `robot_coords`; empty without names."""
    notation: _Notation = "matrix"
    """Notation of the rotation, as in the option `--pose-convention`: matrix, quat:xyzw, rotvec, euler:ZYX, …"""
    units: _Units = "m-rad"
    """Units of length and angle, as in the option `--pose-units`."""
    inverted: bool = False
    """Whether the numbers are gripper_from_base."""
    decided_by: Literal["names", "numbers", "option", "images"] = "names"
    """Evidence that left this reading alone: names of columns or files, the numbers, an option, or the images."""
    misfit_mm: float | None = None
    """Misfit (mm) of this reading to the camera poses, 1° counted as 5 mm; None if the images were not asked."""
    next_best: _Words | None = None
    """Words for the reading with the next smallest misfit; None without one."""
    next_misfit_mm: float | None = None
    """Misfit (mm) of `next_best`."""


@dataclass(frozen=True, kw_only=True)
class FrameNames(Checked):
    """Names of the frames in the user's robot software, as tf names or URDF links; None where unknown."""

    base: FrameName | None = None
    """Frame of the robot's base, in which the gripper poses are."""
    gripper: FrameName | None = None
    """Frame whose poses in the base the capture has, such as a flange or tool centre point."""
    camera: FrameName | None = None
    """Optical frame of the images: x right, y down, z forward."""

    def replaced(self, **names: Any) -> "FrameNames":
        """Return the record with those of `names` replaced that are valid; others, and None, change nothing."""
        valid = (name for name, text in names.items() if isinstance(text, str) and FRAME_NAME.fullmatch(text))
        return replace(self, **{name: names[name] for name in valid})


@dataclass(frozen=True, kw_only=True)
class Capture(Checked):
    """Images of one scene with the gripper pose at each, after the checks of the reader."""

    folder: Path
    images: tuple[str, ...]
    """Paths relative to `folder`, which are also the names of the images in all later records."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    image_size: tuple[Pixels, Pixels]
    """Width and height of all images (px)."""
    intrinsics: Intrinsics | None = None
    """Given intrinsics; None: unknown, to be estimated."""
    intrinsics_std: Float[ndarray, " q"] | None = None
    """Standard deviations of the given intrinsics, in the order of camera.parameters; NaN where none is stated."""
    source: Path | None = None
    """File or folder that the capture was read from; None: the capture.json in `folder`."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader, for example on the pairing of files and on skipped frames."""
    joints: Float[ndarray, "n dof"] | None = None
    """Joint angles (rad) at each image, from the base to the gripper; None: not recorded."""
    robot: str | None = None
    """Name of the arm, one of jcr.estimation.arms.ROBOT_NAMES; None: unknown."""
    urdf: Path | None = None
    """Path of the arm's URDF file, not relative to `folder`; None: none was given."""
    depths: tuple[str | None, ...] | None = None
    """Depth image of each image, or None for an image without one: aligned 16-bit PNG in mm, relative to `folder`."""
    camera_name: str = "wrist"
    """Name of the camera."""
    frame_names: FrameNames = FrameNames()
    """Names of the frames of base, gripper and camera."""
    mount: Mount = "gripper"
    """Body that the camera is mounted on; base: a fixed camera, whose images show an object in the gripper."""
    others: tuple[CellCamera, ...] = ()
    """Further cameras of the cell."""
    reading: Reading | None = None
    """Reading by which the gripper poses were taken from a file; None: unknown, or not yet decided."""
    candidates: tuple[tuple[Reading, Float[ndarray, "r 4 4"]], ...] = ()
    """Readings that names and numbers leave possible, with the gripper poses that each gives; empty once decided.

    A pose is NaN where a row holds none. r is the number of images, or of rows where rows and images differ in number.
    Until a reading is decided, `base_from_gripper` is NaN."""
    untaken: tuple[tuple[Reading, Float[ndarray, "n 4 4"]], ...] = ()
    """Readings of the same numbers that a name or an option ruled out, for the diagnosis of a rejected calibration."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_counts(
            "Capture", len(self.images), base_from_gripper=self.base_from_gripper, depths=self.depths
        )
        # Poses whose reading is not decided yet are NaN.
        poses = {} if self.candidates else {"base_from_gripper": self.base_from_gripper}
        require_finite("Capture", **poses, joints=self.joints)
        for camera in self.others:
            if camera.frame is not None:
                require_rows("Capture", f"frame of camera {camera.name}", camera.frame, len(self.images))

    def __len__(self) -> int:
        return len(self.images)

    def __repr__(self) -> str:
        size, given = "x".join(map(str, self.image_size)), "unknown" if self.intrinsics is None else "given"
        return f"<Capture {self.source or self.folder}: {count_of(len(self), 'image')} of {size}, intrinsics {given}>"

    def of_rows(self, rows: Sequence[int] | Int[ndarray, " k"]) -> "Capture":
        """Return the capture with the images at the indices `rows` only, in their order, without further cameras."""
        chosen = np.asarray(rows, dtype=int).tolist()
        return replace(
            self,
            images=tuple(self.images[row] for row in chosen),
            base_from_gripper=self.base_from_gripper[chosen],
            joints=None if self.joints is None else self.joints[chosen],
            depths=None if self.depths is None else tuple(self.depths[row] for row in chosen),
            untaken=tuple((reading, poses[chosen]) for reading, poses in self.untaken),
            candidates=tuple(
                # Where rows and images differ in number, nothing says which rows are those of the images.
                (reading, poses[chosen] if len(poses) == len(self) else poses)
                for reading, poses in self.candidates
            ),
            others=(),
        )


@dataclass(frozen=True, kw_only=True)
class PosePairs(Checked):
    """Pairs of gripper and camera poses at the same instants, for a calibration without images."""

    source: Path
    """File that the poses were read from."""
    images: tuple[str, ...]
    """Names of the samples, one for each pair of poses."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    recon_from_camera: Float[ndarray, "n 4 4"]
    is_metric: bool
    """Whether the unit of the camera poses is the metre, as with a marker of known size."""
    notes: tuple[str, ...] = ()
    backend: str = "poses given"
    frame_names: FrameNames = FrameNames()
    """Names of the frames of base, gripper and camera."""
    is_inverted: bool = False
    """Whether the gripper poses were inverted on reading, as `--pose-inverted` asks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_counts("PosePairs", len(self.images), base_from_gripper=self.base_from_gripper)
        poses = {"base_from_gripper": self.base_from_gripper, "recon_from_camera": self.recon_from_camera}
        require_finite("PosePairs", **poses)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def image_index(self) -> Int[ndarray, " n"]:
        """Indices 0 … n-1 of the camera poses, as of a Reconstruction in which every image is registered."""
        return np.arange(len(self))
