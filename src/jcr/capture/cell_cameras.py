"""Further cameras of a capture: "cameras" of a capture.json, by name.

A camera bolted to the gripper has one image for each frame, or null; a fixed one that sees the scene has any number;
one on another arm has frames of its own. The entry without images names the camera of the capture's
own frames and its mount.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, StringConstraints, TypeAdapter, model_validator

from jcr.capture.camera_info import IntrinsicsEntry, StdEntry
from jcr.capture.checks import RigidMatrix, require_frames
from jcr.capture.images import read_image, size_of_all
from jcr.capture.plain_files import contained, first_few, validated
from jcr.errors import InputError
from jcr.records import Capture, CellCamera, Mount

NAME = r"[A-Za-z][A-Za-z0-9_]{0,63}"
"""Pattern of the names of cameras and arms."""
Name = Annotated[str, StringConstraints(pattern=f"^{NAME}$")]


class CameraFrame(BaseModel):
    """Image of a camera on another arm, and that arm's gripper pose in its own base."""

    model_config = ConfigDict(strict=True, frozen=True)
    image: str
    base_from_gripper: RigidMatrix


class CameraEntry(BaseModel):
    """Camera in "cameras" of a capture.json."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")
    mount: Mount
    watches: Literal["scene", "gripper"] | None = None
    """Subject of the images; unset: the gripper for a fixed camera without images, else the scene."""
    arm: Name | None = None
    """Other arm that carries the camera."""
    frames: list[CameraFrame] | None = None
    """Images of a camera on another arm."""
    images: list[str | None] | None = None
    intrinsics: IntrinsicsEntry | None = None
    intrinsics_std: StdEntry | None = None

    @property
    def is_own(self) -> bool:
        """Whether the entry is that of the camera of the capture's frames."""
        return self.images is None and self.frames is None

    @model_validator(mode="after")
    def _agrees(self) -> "CameraEntry":
        """Raise ValueError where mount, arm, frames and images contradict each other."""
        is_fixed, own = self.mount == "base", self.is_own
        shows_gripper = (self.watches or "scene") == "gripper"
        text = None
        if own and self.watches is not None and is_fixed is not shows_gripper:
            text = "the frames have gripper poses, so a fixed camera's images in them must show what the gripper "
            text += "carries; list images of the scene as its images"
        elif not own and shows_gripper:
            text = "watches the gripper; give its images a capture of their own, whose camera has mount base"
        elif (self.arm is None) is not (self.frames is None) or (self.arm is not None and is_fixed):
            text = "a camera on another arm has mount gripper, that arm's name as arm, and frames of its own"
        elif not own and not any(self.images or self.frames or ()):
            text = "no images; list some, or remove the camera"
        if text is not None:
            raise ValueError(text)
        return self


def _one_own(cameras: dict[str, CameraEntry]) -> dict[str, CameraEntry]:
    """Return the cameras; raise ValueError where several of them are without images."""
    if len(own := [name for name, camera in cameras.items() if camera.is_own]) > 1:
        raise ValueError(f"{first_few(own)} have no images; only one can be the camera of the frames")
    return cameras


CameraEntries = Annotated[dict[Name, CameraEntry], AfterValidator(_one_own)]
_ADAPTER = TypeAdapter(CameraEntries)


def with_cameras(capture: Capture, cameras: Any, where: str, used: Sequence[bool] | None = None) -> Capture:
    """Return the capture with the cameras of "cameras"; raise InputError, begun with `where`, where they cannot be.

    `used` tells for each frame of the file whether the capture has it, all by default.
    """
    entries: dict[str, CameraEntry] = validated(_ADAPTER, cameras, f"{where}: cameras")
    own = next((name for name, entry in entries.items() if entry.is_own), None)
    if own is not None:
        capture = replace(capture, camera_name=own, mount=entries[own].mount)
    elif capture.camera_name in entries:
        raise InputError(
            f"{where}: camera {capture.camera_name} is the frames' own; give the other another name"
        )
    used = [True] * len(capture) if used is None else used
    others = [
        _camera(name, entry, capture, f"{where}: camera {name}", used)
        for name, entry in entries.items()
        if name != own
    ]
    return replace(capture, others=tuple(others))


def _camera(name: str, entry: CameraEntry, capture: Capture, where: str, used: Sequence[bool]) -> CellCamera:
    """Return a further camera with its images, all of one size."""
    poses, frame = None, None
    if entry.frames is not None:
        listed: Sequence[str | None] = [one.image for one in entry.frames]
        poses = np.array([one.base_from_gripper for one in entry.frames])
    else:
        listed = entry.images or ()
        if entry.mount == "gripper":
            if len(listed) != len(used):
                raise InputError(
                    f"{where}: {len(listed)} images for {len(used)} frames; give one for each, or null"
                )
            listed = [image for image, is_used in zip(listed, used, strict=True) if is_used]
            frame = np.flatnonzero([image is not None for image in listed])
    images = [image for image in listed if image is not None]
    require_frames(len(images), where, 1)
    for image in images:
        contained(capture.folder, image, where)
    if len(set(images)) < len(images) or set(images) & set(capture.images):
        raise InputError(f"{where}: an image is named twice, or is one of the frames' own")
    size = size_of_all({name: read_image(capture.folder / name).shape[1::-1] for name in images}, where)
    intrinsics = None if entry.intrinsics is None else entry.intrinsics.record(size, f"{where}: intrinsics")
    std = entry.intrinsics_std
    return CellCamera(
        name=name,
        mount=entry.mount,
        images=tuple(images),
        image_size=size,
        intrinsics=intrinsics,
        intrinsics_std=None if std is None else std.array(intrinsics, f"{where}: intrinsics_std"),
        frame=frame,
        arm=entry.arm,
        base_from_gripper=poses,
    )


def cameras_as_json(capture: Capture) -> dict[str, Any]:
    """Return the "cameras" of a capture.json; empty where there is only the wrist camera."""
    if not capture.others and capture.mount == "gripper":
        return {}
    entries = {capture.camera_name: CameraEntry(mount=capture.mount)}
    for camera in capture.others:
        entry: dict[str, Any] = {"mount": camera.mount}
        if camera.base_from_gripper is not None:
            pairs = zip(camera.images, camera.base_from_gripper, strict=True)
            frames = [CameraFrame(image=image, base_from_gripper=pose) for image, pose in pairs]
            entry |= {"arm": camera.arm, "frames": frames}
        elif camera.frame is None:
            entry["images"] = [*camera.images]
        else:
            at = dict(zip(camera.frame.tolist(), camera.images, strict=True))
            entry["images"] = [at.get(row) for row in range(len(capture))]
        entry["intrinsics"] = None if camera.intrinsics is None else IntrinsicsEntry.of(camera.intrinsics)
        if camera.intrinsics_std is not None:
            entry["intrinsics_std"] = StdEntry.of(camera.intrinsics_std)
        entries[camera.name] = CameraEntry(**entry)
    return {name: entry.model_dump(mode="json", exclude_unset=True) for name, entry in entries.items()}
