"""The capture folder: `capture.json` and the images it names."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jcr.capture.checks import checked_capture, checked_lens, read_rigid
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, read_json
from jcr.errors import InputError
from jcr.files import write_bytes, write_text
from jcr.records import Capture, Intrinsics

FILE = "capture.json"


def read(path: Path, options: ReadOptions | None = None) -> Capture:
    """The capture in a folder, or named by its capture.json; no option touches it."""
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    if not file.is_file():
        raise InputError(f"{folder}: holds no capture.json; name a capture folder")
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file}: has no list "frames"; expected {{"frames": [...], "intrinsics": ...}}')
    frames = content["frames"]
    images = [_image_name(frame, i, file) for i, frame in enumerate(frames)]
    without_pose = [
        name for name, frame in zip(images, frames, strict=True) if "base_from_gripper" not in frame
    ]
    if without_pose:
        raise InputError(
            f"{file}: {len(images)} images but {len(images) - len(without_pose)} gripper poses; "
            f"add base_from_gripper to {', '.join(without_pose)}"
        )
    poses = [
        read_rigid(frame["base_from_gripper"], f"{file}: base_from_gripper of frame {i} ({name})")
        for i, (name, frame) in enumerate(zip(images, frames, strict=True))
    ]
    capture = checked_capture(folder, images, np.reshape(poses, (-1, 4, 4)), str(file))
    return replace(capture, intrinsics=read_lens(content.get("intrinsics"), capture.image_size, file))


def read_lens(lens: Any, size: tuple[int, int], file: Path) -> Intrinsics | None:
    """The lens of images of `size` from the "intrinsics" of a capture.json; InputError if it cannot be."""
    if lens is None:
        return None
    where = f"{file}: intrinsics"
    if not isinstance(lens, dict) or not {"fx", "fy", "cx", "cy"} <= lens.keys():
        raise InputError(f"{where}: need numbers fx, fy, cx, cy and distortion [k1,k2,p1,p2,k3], or null")
    focal_and_centre = [lens[key] for key in ("fx", "fy", "cx", "cy")]
    distortion = lens.get("distortion") or [0.0] * 5
    return checked_lens(focal_and_centre, distortion, size, where)


def write(folder: Path, capture: Capture, **remarks: Any) -> None:
    """Write capture.json for images that lie in `folder` already; `remarks` are keys that readers ignore."""
    frames = [
        {"image": name, "base_from_gripper": pose.tolist()}
        for name, pose in zip(capture.images, capture.base_from_gripper, strict=True)
    ]
    lens = None
    if capture.intrinsics is not None:
        lens = {key: getattr(capture.intrinsics, key) for key in ("fx", "fy", "cx", "cy", "distortion")}
    write_text(folder / FILE, json.dumps({"frames": frames, "intrinsics": lens} | remarks, indent=1) + "\n")


def kept(capture: Capture, folder: Path) -> Capture:
    """The capture copied into a folder of its own with a capture.json, unless it has one where it lies.

    A run whose capture was read from another format can then go on without that format's options.
    """
    if capture.source is None:
        return capture
    for name in capture.images:
        write_bytes(folder / name, (capture.folder / name).read_bytes())
    write(folder, capture, source=str(capture.source))
    return replace(read(folder), cameras=capture.cameras, notes=capture.notes)


def _image_name(frame: Any, index: int, file: Path) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
        raise InputError(f'{file}: frame {index} has no "image"; give the image\'s path as text')
    contained(file.parent, frame["image"], f"{file}: frame {index}")
    return frame["image"]
