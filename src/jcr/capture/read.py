"""Reading a capture folder: `capture.json` and the images it names, checked before anything heavy starts."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.errors import InputError
from jcr.geometry import require_rigid
from jcr.records import Capture, Intrinsics

FILE = "capture.json"
MIN_FRAMES = 3
MAX_REACH = 10.0
"""Metres; no arm reaches farther from its base, so larger numbers are millimetres."""


def read_capture(path: str | Path) -> Capture:
    """The capture in a folder (or named by its capture.json).

    Raises InputError naming the file, the fault and its cure: anything missing, unreadable, of another size,
    not rigid, in millimetres, or fewer than three frames.
    """
    path = Path(path)
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    if not path.exists():
        raise InputError(f"{path}: no such capture; name a folder that holds a capture.json")
    if not file.is_file():
        raise InputError(f"{folder}: holds no capture.json; name a capture folder")
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file}: has no list "frames"; expected {{"frames": [...], "intrinsics": ...}}')
    frames = content["frames"]
    if len(frames) < MIN_FRAMES:
        raise InputError(f"{file}: {len(frames)} frames; at least {MIN_FRAMES} are needed, 8 to 12 are good")
    images = tuple(_image_name(frame, i, file) for i, frame in enumerate(frames))
    without_pose = [
        name for name, frame in zip(images, frames, strict=True) if "base_from_gripper" not in frame
    ]
    if without_pose:
        raise InputError(
            f"{file}: {len(images)} images but {len(images) - len(without_pose)} gripper poses; "
            f"add base_from_gripper to {', '.join(without_pose)}"
        )
    twice = {name for name in images if images.count(name) > 1}
    if twice:
        raise InputError(f"{file}: names {', '.join(sorted(twice))} more than once; keep one frame per image")
    poses = np.stack(
        [
            read_rigid(frame["base_from_gripper"], f"{file}: base_from_gripper of frame {i} ({name})")
            for i, (name, frame) in enumerate(zip(images, frames, strict=True))
        ]
    )
    check_metres(poses, str(file))
    size = _common_size(folder, images)
    return Capture(folder, images, poses, size, read_lens(content.get("intrinsics"), size, file))


def read_json(file: Path) -> Any:
    """The content of a JSON file; InputError on bytes that are not UTF-8 JSON or keys that appear twice."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        for key in keys:
            if keys.count(key) > 1:
                raise InputError(f"{file}: the key {key!r} appears twice in one object; keep one")
        return dict(pairs)

    try:
        return json.loads(file.read_bytes().decode("utf-8"), object_pairs_hook=unique)
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not UTF-8 text (byte {error.start}); save it as UTF-8 JSON") from None
    except json.JSONDecodeError as error:
        raise InputError(
            f"{file}: not JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except RecursionError:
        raise InputError(f"{file}: nested too deeply to be a capture; write it as the README shows") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); check its permissions") from None


def read_rigid(value: Any, where: str) -> Float[ndarray, "4 4"]:
    """A rigid 4x4 from nested lists; InputError saying how far from rigid it is and what it looks like."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{where}: not a 4x4 matrix of numbers; write four rows of four") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}, not 4x4; write four rows of four numbers")
    return require_rigid(matrix, where)


def check_metres(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """InputError when positions are too far from the base to be metres."""
    farthest = float(np.abs(base_from_gripper[:, :3, 3]).max())
    if farthest > MAX_REACH:
        raise InputError(
            f"{where}: the gripper is up to {farthest:.4g} from the base; these look like millimetres: "
            "divide the translations by 1000"
        )


def contained(folder: Path, name: str, where: str) -> Path:
    """`folder/name`, or InputError when the name is absolute, has a NUL, or leads out of the folder."""
    if "\0" in name or not name or Path(name).is_absolute():
        raise InputError(f"{where}: {name!r} is no path inside the capture; use one relative to {folder}")
    target = folder / name
    if not target.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{where}: {name!r} leads out of {folder}; copy the image into the capture")
    return target


def _image_name(frame: Any, index: int, file: Path) -> str:
    if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
        raise InputError(f'{file}: frame {index} has no "image"; give the image\'s path as text')
    contained(file.parent, frame["image"], f"{file}: frame {index}")
    return frame["image"]


def _common_size(folder: Path, images: tuple[str, ...]) -> tuple[int, int]:
    """Decode every image once: a truncated one is found now, not after minutes of matching."""
    sizes, digests = {}, {}
    for name in images:
        pixels = read_image(folder / name)
        sizes[name] = (pixels.shape[1], pixels.shape[0])
        same = digests.setdefault(hashlib.sha256(pixels.tobytes()).digest(), name)
        if same != name:
            raise InputError(
                f"{folder / name}: the same picture as {same}; drop one of the frames or take it again"
            )
    first = sizes[images[0]]
    for name, size in sizes.items():
        if size != first:
            raise InputError(
                f"{folder / name}: {size[0]}x{size[1]} pixels, but {images[0]} has {first[0]}x{first[1]}; "
                "all images must come from one camera at one resolution"
            )
    return first


def read_lens(value: Any, size: tuple[int, int], file: Path) -> Intrinsics | None:
    """The lens of images of `size` from the "intrinsics" of a capture.json; InputError if it cannot be."""
    if value is None:
        return None
    where = f"{file}: intrinsics"
    try:
        fx, fy, cx, cy = (float(value[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = [float(k) for k in value.get("distortion") or [0.0] * 5]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise InputError(
            f"{where}: need numbers fx, fy, cx, cy and distortion [k1,k2,p1,p2,k3], or null"
        ) from None
    if len(distortion) != 5:
        raise InputError(f"{where}: distortion has {len(distortion)} numbers, not the five k1,k2,p1,p2,k3")
    if not np.isfinite([fx, fy, cx, cy, *distortion]).all() or fx <= 0 or fy <= 0:
        raise InputError(
            f"{where}: fx and fy must be positive and all numbers finite; or give null to estimate them"
        )
    width, height = size
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: the principal point ({cx:.4g}, {cy:.4g}) lies outside the {width}x{height} images; "
            "scale the intrinsics to this resolution"
        )
    k1, k2, p1, p2, k3 = distortion
    return Intrinsics(fx, fy, cx, cy, width, height, (k1, k2, p1, p2, k3))
