"""Pairwise pointmaps as a record and an npz file, the input of global alignment; lists of image pairs."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.memory import require_memory
from jcr.pointmaps.image_grid import ImageGrid
from jcr.records import Intrinsics

SHAPES = {
    "edges": "E 2",
    "pts3d": "E H W 3",
    "conf": "E H W",
    "pts3d_in_other_view": "E H W 3",
    "conf2": "E H W",
}
"""Required arrays of a file and their shapes, named as in DUSt3R's output; E pairs, images of H x W pixels."""


@dataclass(frozen=True, kw_only=True)
class PairPredictions:
    """Pointmaps of ordered image pairs, each pair in its first image's camera frame and in a unit of its own.

    For pair e = (n, m) of `edges`, `pts3d[e]` has a point for each pixel of image n, `pts3d_in_other_view[e]` one for
    each pixel of image m. Both are in the camera frame of n.
    """

    edges: Int[ndarray, "e 2"]
    pts3d: Float[ndarray, "e h w 3"]
    conf: Float[ndarray, "e h w"]
    """Confidence of `pts3d`, at least 0; DUSt3R's own is at least 1."""
    pts3d_in_other_view: Float[ndarray, "e h w 3"]
    conf2: Float[ndarray, "e h w"]
    """Confidence of `pts3d_in_other_view`."""
    images: tuple[str, ...] = ()
    """Names of the images in the capture; empty when the file has none."""
    colors: UInt8[ndarray, "n h w 3"] | None = None
    """RGB at the pointmaps' pixels."""
    intrinsics: Intrinsics | None = None
    """Intrinsics of the pointmaps' pixel grid; None: unknown, to be estimated."""
    grid: ImageGrid | None = None
    """Position of the grid's pixels in the original images; None: unknown."""
    is_metric: bool = False

    @property
    def image_count(self) -> int:
        """Number of images: that of the names, or without names the largest index in `edges` plus 1."""
        return len(self.images) or int(self.edges.max()) + 1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images for messages, or their numbers (#0, #1, …) without names."""
        return self.images or tuple(f"#{k}" for k in range(self.image_count))


def read_pairs(path: Path) -> PairPredictions:
    """Read pairwise predictions from an npz file; raise InputError if it is damaged, incomplete or inconsistent."""
    return pairs_from_arrays(read_arrays(path), str(path))


def read_arrays(path: Path) -> dict[str, ndarray]:
    """Read all arrays of an npz file; raise InputError if it is missing or damaged, or does not fit into memory."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give predictions as npz (jcr docs predictions)")
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            if file.zip is not None:
                members = file.zip.infolist()
                require_memory(sum(member.file_size for member in members), str(path))
                # Of other methods than NumPy's, a few bytes unpack to gigabytes, whatever size is stated.
                if any(
                    one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for one in members
                ):
                    raise ValueError("a compression that NumPy does not write")
            arrays = dict(file)
        # NumPy returns raw bytes for members that are no arrays.
        if strangers := [name for name, array in arrays.items() if not isinstance(array, ndarray)]:
            raise ValueError(f"{strangers[0]} in it is not an array")
        return arrays
    except InputError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        raise InputError(f"{path}: no readable npz file ({error}); write it again with numpy.savez") from None


def pairs_from_arrays(arrays: dict[str, ndarray], source: str) -> PairPredictions:
    """Return checked pairwise predictions from the arrays of a file (by name, see SHAPES), named `source` in messages.

    Raises InputError for arrays that are missing or inconsistent.
    """
    check_arrays(arrays, SHAPES, source)
    edges = arrays["edges"]
    count, height, width = arrays["pts3d"].shape[:3]
    images = tuple(str(name) for name in arrays.get("images", ()))
    if len(edges) == 0:
        raise InputError(f"{source}: no pair in it; predict at least one")
    if edges.dtype.kind not in "iu":
        raise InputError(f"{source}: edges must be integers, they are {edges.dtype}")
    image_count = len(images) or int(edges.max()) + 1
    if edges.min() < 0 or edges.max() >= image_count or (edges[:, 0] == edges[:, 1]).any():
        raise InputError(f"{source}: edges must join two of the {image_count} images, counted from 0")
    intrinsics, grid = camera_of_arrays(arrays, (width, height), source)
    colors = arrays.get("colors")
    if colors is not None and (colors.shape != (image_count, height, width, 3) or colors.dtype != np.uint8):
        raise InputError(f"{source}: colors must be uint8 of shape {(image_count, height, width, 3)}")
    return PairPredictions(
        edges=edges.astype(np.int64),
        **{name: arrays[name].astype(np.float32, copy=False) for name in SHAPES if name != "edges"},
        images=images,
        colors=colors,
        intrinsics=intrinsics,
        grid=grid,
        is_metric=bool(arrays.get("is_metric", False)),
    )


def check_arrays(arrays: dict[str, ndarray], shapes: Mapping[str, str], source: str) -> None:
    """Check that arrays exist, are finite and have the `shapes`, such as "N H W 3" with equal sizes for equal letters.

    Raises InputError for the first wrong array, and for a confidence below 0 (arrays named conf…).
    """
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            raise InputError(f"{source}: no array {name!r}; needed are {', '.join(shapes)}")
        array, axes = arrays[name], shape.split()
        asked = [int(axis) if axis.isdecimal() else sizes.get(axis) for axis in axes]
        fits = array.ndim == len(axes) and array.dtype.kind in "fiu"
        if not fits or any(size not in (None, own) for size, own in zip(asked, array.shape, strict=True)):
            raise InputError(
                f"{source}: {name} is {array.dtype} of shape {array.shape}; give numbers {shape}"
            )
        sizes |= dict(zip(axes, array.shape, strict=True))
        # One row at a time: a mask of all pairs would take a quarter of the pairs' memory.
        for row, values in enumerate(array):
            if not np.isfinite(values).all():
                raise InputError(f"{source}: {name}[{row}] is not finite; put 0 there, with confidence 0")
            if name.startswith("conf") and values.size and values.min() < 0:
                raise InputError(f"{source}: {name}[{row}] is negative somewhere; a confidence is at least 0")


def camera_of_arrays(
    arrays: dict[str, ndarray], size: tuple[int, int], source: str
) -> tuple[Intrinsics | None, ImageGrid | None]:
    """Return the intrinsics and the crop from the arrays `intrinsics` and `grid` of a file; each is None if absent.

    `size` is width and height of the pointmaps. `intrinsics` has fx, fy, cx, cy of their pixels. The rows of `grid` are
    original size, resized size, crop corner and `size`, each x, y. Raises InputError for wrong ones.
    """
    intrinsics = grid = None
    if "intrinsics" in arrays:
        if arrays["intrinsics"].shape != (4,) or not (arrays["intrinsics"][:2] > 0).all():
            raise InputError(f"{source}: intrinsics must be fx, fy, cx, cy of the {size[0]}x{size[1]} grid")
        fx, fy, cx, cy = (float(value) for value in arrays["intrinsics"])
        intrinsics = Intrinsics(fx, fy, cx, cy, *size)
    if "grid" in arrays:
        if arrays["grid"].shape != (4, 2) or tuple(arrays["grid"][3]) != size:
            raise InputError(
                f"{source}: grid must be original size, resized size, crop corner and {size[0]}, {size[1]}"
            )
        grid = ImageGrid(*((int(x), int(y)) for x, y in arrays["grid"]))
    return intrinsics, grid


def complete_pairs(count: int) -> Int[ndarray, "e 2"]:
    """Return all ordered pairs of `count` images as in DUSt3R: first (i, j) with i > j, then each reversed."""
    return window_pairs(count, count)


def window_pairs(count: int, size: int) -> Int[ndarray, "e 2"]:
    """Return the pairs of images whose rows differ by at most `size`: first (i, j) with i > j, then each reversed."""
    edges = np.argwhere(np.tri(count, k=-1, dtype=bool) & ~np.tri(count, k=-size - 1, dtype=bool))
    return np.concatenate([edges, edges[:, ::-1]])
