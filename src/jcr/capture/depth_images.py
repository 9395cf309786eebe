"""Depth of a camera that measures it: 16-bit PNG in mm, aligned with the colour images, 0 where there is none."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from jcr.capture.images import other_size
from jcr.errors import InputError
from jcr.files import require_file

FOLDER = "depth"
"""Folder of the depth images beside the images of a table."""
Names = tuple[str | None, ...]


def read_depth(path: Path, size: tuple[int, int]) -> Float32[ndarray, "h w"]:
    """Read the depth along the optical axis (m) at the pixels of images of `size`; 0 where none was measured.

    Raises InputError where the file is no 16-bit grey image of that size.
    """
    require_file(path)
    if not path.is_file():
        raise InputError(f"{path}: no such depth image; correct its name in the capture or add it")
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.dtype != np.uint16 or depth.ndim != 2:
        raise InputError(f"{path}: no depth image of 16 bits and one channel (mm); save it as 16-bit PNG")
    if (found := depth.shape[::-1]) != size:
        remedy = "align depth with colour (ROS: align_depth.enable, librealsense: rs.align)"
        raise other_size(f"{path}: depth", found, size, remedy=remedy)
    return depth.astype(np.float32) / 1000


def depth_beside(folder: Path, images: Sequence[str]) -> Names | None:
    """Return the depth images in depth/ that are named as the images; None where there are none."""
    names = [f"{FOLDER}/{Path(name).stem}.png" for name in images]
    there = [(folder / name).is_file() for name in names]
    if not any(there):
        return None
    return tuple(name if is_there else None for name, is_there in zip(names, there, strict=True))
