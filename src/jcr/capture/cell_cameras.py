"""Further cameras of a capture: "cameras" of a capture.json, by name.

A camera bolted to the gripper has one image for each frame, or null; a fixed one that sees the scene has any number;
one on another arm has frames of its own. The entry without images names the camera of the capture's
own frames and what it is bolted to.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.camera_info import intrinsics_as_json, read_intrinsics_of_size, read_std, std_as_json
from jcr.capture.checks import image_sizes, read_rigid, require_frames
from jcr.capture.images import other_size
from jcr.capture.plain_files import contained, first_few, shown
from jcr.errors import InputError
from jcr.records import Capture, CellCamera, Mount

KEYS = {"mount", "watches", "arm", "frames", "images", "intrinsics", "intrinsics_std"}
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
MOUNTS: tuple[Mount, ...] = ("gripper", "base")


def with_cameras(capture: Capture, cameras: Any, file: Path, used: Sequence[bool] | None = None) -> Capture:
    """Return the capture with the cameras of "cameras"; InputError where they cannot be.

    `used` tells for each frame of the file whether the capture has it, all by default.
    """
    if cameras is None:
        return capture
    if not isinstance(cameras, dict) or not all(isinstance(camera, dict) for camera in cameras.values()):
        raise InputError(
            f'{file}: cameras must be {{"NAME": {{"mount": "base" or "gripper", "images": [...]}}}}'
        )
    own = [name for name, camera in cameras.items() if "images" not in camera and "frames" not in camera]
    if len(own) > 1:
        raise InputError(
            f"{file}: cameras {first_few(own)} have no images; only one can be the camera of the frames: list the "
            "images of the others"
        )
    others = []
    for name, camera in cameras.items():
        where = f"{file}: camera {name[:64]}"
        _check(name, camera, where)
        if name in own:
            watches = camera.get("watches", "gripper" if camera["mount"] == "base" else "scene")
            if (camera["mount"] == "base") is not (watches == "gripper"):
                raise InputError(
                    f"{where}: the frames have gripper poses, so a fixed camera's images in them must show what the "
                    "gripper carries; list images of the scene as its images"
                )
            capture = replace(capture, camera_name=name, mount=camera["mount"])
        else:
            others.append(_camera(name, camera, capture, where, used))
    if twice := {name for name in (camera.name for camera in others) if name == capture.camera_name}:
        raise InputError(
            f"{file}: camera {first_few(sorted(twice))} is the frames' own; give the other another name"
        )
    return replace(capture, others=tuple(others))


def _check(name: str, camera: dict[str, Any], where: str) -> None:
    """Raise InputError where the keys of a camera cannot be."""
    if not NAME.fullmatch(name):
        raise InputError(f"{where}: a name has letters, digits and _, and begins with a letter")
    if unknown := sorted(camera.keys() - KEYS):
        raise InputError(f"{where}: {first_few(unknown)} is not known; there are {', '.join(sorted(KEYS))}")
    if camera.get("mount") not in MOUNTS:
        raise InputError(f"{where}: mount is {shown(camera.get('mount'))}; write {' or '.join(MOUNTS)}")
    if camera.get("watches", "scene") not in ("scene", "gripper"):
        raise InputError(f"{where}: watches {shown(camera['watches'])}; write scene or gripper")
    if "images" in camera and camera.get("watches") == "gripper":
        raise InputError(
            f"{where}: watches the gripper; give its images a capture of their own, whose camera has mount base"
        )
    if (camera.get("arm") is None) is not ("frames" not in camera) or (
        camera.get("arm") and camera["mount"] == "base"
    ):
        raise InputError(
            f"{where}: a camera on another arm has mount gripper, that arm's name as arm, and frames of its own"
        )


def _camera(
    name: str, camera: dict[str, Any], capture: Capture, where: str, used: Sequence[bool] | None
) -> CellCamera:
    """Return a further camera with its images, all of one size."""
    arm, poses, frame = camera.get("arm"), None, None
    if arm is not None:
        images, poses = _frames(camera["frames"], str(arm), where)
    else:
        listed = camera["images"]
        if not isinstance(listed, list) or not all(
            image is None or isinstance(image, str) for image in listed
        ):
            raise InputError(f"{where}: images must be a list of paths")
        images = [image for image in listed if image is not None]
        if camera["mount"] == "gripper":
            used = [True] * len(capture) if used is None else used
            if len(listed) != len(used):
                raise InputError(
                    f"{where}: {len(listed)} images for {len(used)} frames; give one for each, or null"
                )
            of_frames = [image for image, is_used in zip(listed, used, strict=True) if is_used]
            images = [image for image in of_frames if image is not None]
            frame = np.flatnonzero([image is not None for image in of_frames])
    if not images:
        raise InputError(f"{where}: no images; list some, or remove the camera")
    require_frames(len(images), where, 0)
    for image in images:
        contained(capture.folder, image, where)
    if len(set(images)) < len(images) or set(images) & set(capture.images):
        raise InputError(f"{where}: an image is named twice, or is one of the frames' own")
    sizes = image_sizes(capture.folder, images)
    if other := [k for k, size in enumerate(sizes) if size != sizes[0]]:
        raise other_size(f"{where}: {images[other[0]]}", sizes[other[0]], sizes[0], images[0])
    intrinsics = read_intrinsics_of_size(camera.get("intrinsics"), sizes[0], where)
    std = read_std(camera.get("intrinsics_std"), intrinsics, where)
    return CellCamera(
        name=name,
        mount=camera["mount"],
        images=tuple(images),
        image_size=sizes[0],
        intrinsics=intrinsics,
        intrinsics_std=std,
        frame=frame,
        arm=None if arm is None else str(arm),
        base_from_gripper=poses,
    )


def _frames(frames: Any, arm: str, where: str) -> tuple[list[str], Float[ndarray, "k 4 4"]]:
    """Return the images of a camera on another arm, and the gripper poses of that arm."""
    if not NAME.fullmatch(arm):
        raise InputError(
            f"{where}: arm {shown(arm)}: a name has letters, digits and _, and begins with a letter"
        )
    if not isinstance(frames, list) or not all(
        isinstance(frame, dict) and isinstance(frame.get("image"), str) and "base_from_gripper" in frame
        for frame in frames
    ):
        raise InputError(
            f"{where}: frames must be a list of image and base_from_gripper (in the arm's own base)"
        )
    poses = [
        read_rigid(frame["base_from_gripper"], f"{where}: base_from_gripper of {frame['image']}")
        for frame in frames
    ]
    return [frame["image"] for frame in frames], np.array(poses).reshape(-1, 4, 4)


def cameras_as_json(capture: Capture) -> dict[str, Any]:
    """Return the "cameras" of a capture.json; nothing where there is only the wrist camera."""
    if not capture.others and capture.mount == "gripper":
        return {}
    out: dict[str, Any] = {capture.camera_name: {"mount": capture.mount}}
    for camera in capture.others:
        entry: dict[str, Any] = {"mount": camera.mount}
        if camera.base_from_gripper is not None:
            entry["arm"] = camera.arm
            entry["frames"] = [
                {"image": image, "base_from_gripper": pose.tolist()}
                for image, pose in zip(camera.images, camera.base_from_gripper, strict=True)
            ]
        else:
            entry["images"] = _listed(camera, len(capture))
        entry["intrinsics"] = None if camera.intrinsics is None else intrinsics_as_json(camera.intrinsics)
        if camera.intrinsics_std is not None:
            entry["intrinsics_std"] = std_as_json(camera.intrinsics_std)
        out[camera.name] = entry
    return {"cameras": out}


def _listed(camera: CellCamera, count: int) -> Sequence[str | None]:
    """Return the images of a camera, with None at the frames of the capture that have none."""
    if camera.frame is None:
        return camera.images
    listed: list[str | None] = [None] * count
    for row, image in zip(camera.frame, camera.images, strict=True):
        listed[row] = image
    return listed
