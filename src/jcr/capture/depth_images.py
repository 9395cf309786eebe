"""Depth of a camera that measures it: 16-bit PNG in mm, aligned with the colour images, 0 where there is none."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from PIL import Image

from jcr.capture.images import other_size
from jcr.capture.plain_files import contained, shown
from jcr.errors import InputError

FOLDER = "depth"
"""Folder of the depth images beside the images of a table."""
Names = tuple[str | None, ...]


def read_depth(path: Path, size: tuple[int, int]) -> Float32[ndarray, "h w"]:
    """Read the depth along the optical axis (m) at the pixels of images of `size`; 0 where none was measured.

    Raises InputError where the file is no 16-bit grey image of that size.
    """
    try:
        with Image.open(path) as opened:
            mode, found = opened.mode, opened.size
    except FileNotFoundError:
        raise InputError(f"{path}: no such depth image; correct its name in the capture or add it") from None
    except Exception as error:  # decoders raise whatever a damaged file makes them
        raise InputError(f"{path}: not a readable image ({error}); save it again as 16-bit PNG") from None
    if not mode.startswith("I"):
        raise InputError(f"{path}: a depth image has 16 bits and one channel (mm), this is {mode}")
    if found != size:
        remedy = "align depth with colour (ROS: align_depth.enable, librealsense: rs.align)"
        raise other_size(f"{path}: depth", found, size, remedy=remedy)
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise InputError(f"{path}: not a readable 16-bit image; save it again as 16-bit PNG")
    return depth.astype(np.float32) / 1000


def depth_of_frames(frames: Sequence[dict[str, object]], folder: Path, where: str) -> Names | None:
    """Return the depth images of the frames of a capture.json; None where no frame names one."""
    names = [frame.get("depth") for frame in frames]
    if all(name is None for name in names):
        return None
    for i, name in enumerate(names):
        if name is None:
            continue
        if not isinstance(name, str):
            raise InputError(f"{where}: depth of frame {i} is {shown(name)}; give the image's path as text")
        if not contained(folder, name, f"{where}: depth of frame {i}").is_file():
            raise InputError(f"{where}: depth image {name} is not there; add it, or remove the key")
    return tuple(None if name is None else str(name) for name in names)


def depth_beside(folder: Path, images: Sequence[str]) -> Names | None:
    """Return the depth images in depth/ that are named as the images; None where there are none."""
    names = [f"{FOLDER}/{Path(name).stem}.png" for name in images]
    there = [(folder / name).is_file() for name in names]
    if not any(there):
        return None
    return tuple(name if is_there else None for name, is_there in zip(names, there, strict=True))
