"""Models of the content of a capture.json: frames, intrinsics and further cameras."""

import json
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    StringConstraints,
    TypeAdapter,
    model_validator,
)

from jcr.errors import InputError, other_size
from jcr.geometry import require_rigid
from jcr.number_format import HUGE
from jcr.records.capture import COEFFICIENTS, DistortionModel, FrameNames, Intrinsics, Mount, Reading
from jcr.records.json_fields import Positive

NAME = r"[A-Za-z][A-Za-z0-9_]{0,63}"
"""Regular expression of valid names of cameras and arms."""
Name = Annotated[str, StringConstraints(pattern=f"^{NAME}$")]
MOST_ROTATION = 6 * np.pi + 0.01
"""Largest absolute joint angle (rad); a larger one is probably in degrees."""
Std = Annotated[float, Field(ge=0, lt=HUGE)] | None


def read_rigid(value: Any, where: str = "matrix") -> Float[ndarray, "4 4"]:
    """Return a rigid 4x4 matrix from nested lists; raise InputError, which names `where`, if it is not rigid."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: not a 4x4 matrix of numbers; write four rows of four") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}, not 4x4; write four rows of four numbers")
    return require_rigid(matrix, where)


RigidMatrix = Annotated[
    Any,
    BeforeValidator(lambda value: value if isinstance(value, ndarray) else read_rigid(value)),
    PlainSerializer(lambda pose: pose.tolist()),
]
"""Rigid transform (4,4), in files as nested lists; an array is accepted unchanged and unchecked."""


def _plausible(angles: list[float]) -> list[float]:
    """Return the joint angles (rad) unchanged; raise ValueError if one is over 6π, and thus probably in degrees."""
    if (largest := max(map(abs, angles))) > MOST_ROTATION:
        raise ValueError(f"up to {largest:.4g} rad; these look like degrees: convert them")
    return angles


class Entry(BaseModel):
    """Base class of the objects in a capture.json; unknown keys are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


class IntrinsicsEntry(Entry, extra="allow"):
    """Intrinsics in a capture.json (px), which apply to images of the capture's size."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float
    distortion: list[float] | None = None
    """Coefficients in OpenCV's order; None or empty: no distortion."""
    model: DistortionModel = "pinhole"
    width: int | None = None
    """Width (px) of the images that the intrinsics apply to; None: that of the capture's images."""
    height: int | None = None
    """Height (px) of the images that the intrinsics apply to; None: that of the capture's images."""

    @staticmethod
    def of(intrinsics: Intrinsics) -> "IntrinsicsEntry":
        """Return the entry that states these intrinsics, without the size of the images."""
        model = {} if intrinsics.model == "pinhole" else {"model": intrinsics.model}
        numbers = {key: getattr(intrinsics, key) for key in ("fx", "fy", "cx", "cy")}
        return IntrinsicsEntry(**model, **numbers, distortion=list(intrinsics.distortion))

    def record(self, size: tuple[int, int], where: str) -> Intrinsics:
        """Return the intrinsics for images of `size` (width, height).

        Raises InputError if they do not fit the images or the distortion model.
        """
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
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, *size, tuple(distortion), self.model)


class StdEntry(Entry, extra="forbid"):
    """Standard deviations of the intrinsics in a capture.json (px; distortion: no unit). 0: exact; null: not stated."""

    fx: Std = None
    fy: Std = None
    cx: Std = None
    cy: Std = None
    distortion: list[Std] = []


class FrameEntry(Entry):
    """Frame of a capture.json: an image, its gripper pose, and other data recorded with it."""

    image: str
    """Path of the image, relative to the folder of the capture."""
    base_from_gripper: RigidMatrix
    joints: Annotated[list[float], Field(min_length=1), AfterValidator(_plausible)] | None = None
    """Joint angles (rad), from the base to the gripper."""
    depth: str | None = None
    """Path of the depth image, relative to the folder of the capture."""
    time_s: float | None = None
    """Time of the image on the camera's clock (s)."""


class CameraEntry(Entry, extra="forbid"):
    """Camera in the object "cameras" of a capture.json, whose keys are the names of the cameras."""

    mount: Mount
    watches: Literal["scene", "gripper"] | None = None
    """Subject of the images; unset: the gripper for a fixed camera without images and for those beside it, else the
    scene."""
    arm: Name | None = None
    """Name of another arm that carries the camera."""
    frames: list[FrameEntry] | None = None
    """Images of a camera on another arm, each with that arm's gripper pose in its own base frame."""
    images: list[str | None] | None = None
    """Paths of the images of a further camera; null for a frame of the capture without one."""
    intrinsics: IntrinsicsEntry | None = None
    intrinsics_std: StdEntry | None = None

    @property
    def is_own(self) -> bool:
        """Whether the entry describes the camera that took the images in the frames of the capture."""
        return self.images is None and self.frames is None

    @model_validator(mode="after")
    def _agrees(self) -> "CameraEntry":
        """Return the entry; raise ValueError if its mount, arm, frames and images contradict each other."""
        is_fixed, own, shows_gripper = self.mount == "base", self.is_own, self.watches == "gripper"
        if own and self.watches is not None and is_fixed is not shows_gripper:
            raise ValueError(
                "the frames have gripper poses, so a fixed camera's images in them must show what the gripper "
                "carries; list images of the scene as its images"
            )
        if not own and shows_gripper and not is_fixed:
            raise ValueError("watches the gripper, so that it stands still; write mount base")
        if (self.arm is None) is not (self.frames is None) or (self.arm is not None and is_fixed):
            raise ValueError(
                "a camera on another arm has mount gripper, that arm's name as arm, and frames of its own"
            )
        if not own and not any(self.images or self.frames or ()):
            raise ValueError("no images; list some, or remove the camera")
        return self


def _one_own(cameras: dict[str, CameraEntry]) -> dict[str, CameraEntry]:
    """Return the cameras; raise ValueError if more than one has no images of its own."""
    if len(own := [name for name, camera in cameras.items() if camera.is_own]) > 1:
        raise ValueError(f"{', '.join(own)} have no images; only one can be the camera of the frames")
    return cameras


CameraEntries = Annotated[dict[Name, CameraEntry], AfterValidator(_one_own)]


class CaptureFile(Entry, extra="allow"):
    """Content of a capture.json; unknown keys are kept."""

    frames: list[Any]
    """Frames as JSON objects; each is validated as a FrameEntry later, because a few of them may be invalid."""
    intrinsics: IntrinsicsEntry | None = None
    intrinsics_std: StdEntry | None = None
    robot: Any = None
    urdf: str | None = None
    cameras: CameraEntries | None = None
    reading: Annotated[Reading, BeforeValidator(TypeAdapter(Reading).validate_python)] | None = None
    """Reading of the poses from a file; absent where they were written as base_from_gripper."""
    frame_names: Annotated[FrameNames, BeforeValidator(TypeAdapter(FrameNames).validate_python)] = (
        FrameNames()
    )
    """Names of the frames of base, gripper and camera in the robot's software."""

    def as_text(self) -> str:
        """Return the text of the capture.json."""
        return json.dumps(self.model_dump(mode="json", exclude_unset=True), indent=1) + "\n"
