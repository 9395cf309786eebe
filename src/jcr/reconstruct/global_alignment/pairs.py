"""Pointmaps of pairs of images, as a record and a file: what global alignment reads, whoever predicted them."""

import math
import mmap
import struct
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.files import written_whole
from jcr.reconstruct.preprocess import ImageGrid
from jcr.records import Intrinsics

ARRAYS = {"edges": 2, "pts3d": 4, "conf": 3, "pts3d_in_other_view": 4, "conf2": 3}
"""Keys every file has, and their dimensions; the names are those of DUSt3R's own output."""


@dataclass(frozen=True, kw_only=True)
class PairPredictions:
    """Pointmaps of ordered image pairs, each pair in its first image's camera frame, at a scale of its own.

    For edge e = (n, m), `pts3d[e]` has a point for each pixel of image n, `pts3d_in_other_view[e]` one for
    each pixel of image m, both in the camera frame of n (paper section III: X_n,e and X_m,e).
    """

    edges: Int[ndarray, "e 2"]
    pts3d: Float[ndarray, "e h w 3"]
    conf: Float[ndarray, "e h w"]
    """Confidence of `pts3d`, at least 0; the network's own is at least 1."""
    pts3d_in_other_view: Float[ndarray, "e h w 3"]
    conf2: Float[ndarray, "e h w"]
    """Confidence of `pts3d_in_other_view`."""
    images: tuple[str, ...] = ()
    """Names of the images in the capture; empty when the file has none."""
    colors: UInt8[ndarray, "n h w 3"] | None = None
    """RGB at the pointmaps' pixels."""
    intrinsics: Intrinsics | None = None
    """Of the pointmaps' pixel grid, pixel (0, 0) being a centre; None: unknown, to be estimated."""
    grid: ImageGrid | None = None
    """Where the grid's pixels lie in the original images."""
    is_metric: bool = False

    @property
    def image_count(self) -> int:
        """Images that the edges join."""
        return len(self.images) or int(self.edges.max()) + 1

    @property
    def names(self) -> tuple[str, ...]:
        """Of the images, for messages: their numbers where they have none."""
        return self.images or tuple(f"#{k}" for k in range(self.image_count))

    @property
    def pointmaps(self) -> tuple[ndarray, ndarray, ndarray, ndarray]:
        """Points and confidences of the first views, and of the second ones."""
        return self.pts3d, self.conf, self.pts3d_in_other_view, self.conf2

    def release(self) -> None:
        """Take pointmaps that lie in a file out of the resident set; they come back page by page when read."""
        for array in self.pointmaps:
            _release(array)


def _release(array: ndarray) -> None:
    if isinstance(array, np.memmap) and isinstance(array.base, mmap.mmap):
        array.base.madvise(mmap.MADV_DONTNEED)


def write_pairs(path: Path, predictions: PairPredictions) -> None:
    """Write predictions as npz (uncompressed: pointmaps do not compress), whole or not at all."""
    extra: dict[str, object] = {"images": np.array(predictions.images, dtype=str)}
    extra["is_metric"] = predictions.is_metric
    if predictions.colors is not None:
        extra["colors"] = predictions.colors
    if predictions.intrinsics is not None:
        k = predictions.intrinsics
        extra["intrinsics"] = np.array([k.fx, k.fy, k.cx, k.cy])
    if predictions.grid is not None:
        extra["grid"] = np.array(list(asdict(predictions.grid).values()), dtype=np.int64)
    with (
        written_whole(path) as temporary,
        open(temporary, "wb") as stream,
        zipfile.ZipFile(stream, "w") as archive,
    ):
        for name in ARRAYS:
            _write_rows(archive, name, getattr(predictions, name))
        for name, value in extra.items():
            _write_rows(archive, name, np.asanyarray(value))


def _write_rows(archive: zipfile.ZipFile, name: str, array: ndarray) -> None:
    """An array of an npz file as numpy.savez writes it, but row by row: it may be larger than the memory."""
    array = np.asanyarray(array, order="C")
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, np.lib.format.header_data_from_array_1_0(array))
        for row in array.reshape(max(len(array), 1) if array.ndim else 1, -1):
            member.write(row.tobytes())
            _release(array)


def read_pairs(path: Path) -> PairPredictions:
    """Read predictions from npz and check them.

    Raises InputError for a file that is missing, damaged, lacks an array, or has shapes that do not agree.
    """
    return pairs_from_arrays(read_arrays(path), str(path))


def read_arrays(path: Path, in_memory: float = math.inf) -> dict[str, ndarray]:
    """All arrays of an npz file; of one with more than `in_memory` bytes, what is not compressed stays there, mapped.

    Raises InputError where the file is missing or damaged.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; `jcr predict CAPTURE {path.name}` writes one")
    try:
        if path.stat().st_size > in_memory:
            return _map_arrays(path)
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = dict(file)
        # NumPy hands out the bytes of what does not begin as an array does.
        if strangers := [name for name, array in arrays.items() if not isinstance(array, ndarray)]:
            raise ValueError(f"{strangers[0]} in it is not an array")
        return arrays
    except Exception as error:  # zipfile, zlib and NumPy's parser of headers have errors of their own
        raise InputError(f"{path}: no readable npz file ({error}); write it again with numpy.savez") from None


def _map_arrays(path: Path) -> dict[str, ndarray]:
    """Every array of an npz file, read-only, in the file itself where it lies there plainly."""
    arrays = {}
    with open(path, "rb") as stream, zipfile.ZipFile(stream) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                read = np.lib.format.read_array_header_1_0
                shape, by_columns, dtype = (
                    read if version == (1, 0) else np.lib.format.read_array_header_2_0
                )(member)
                start = member.tell()
                while member.read(1 << 20):  # to the end, where its checksum is compared
                    pass
            plain = info.compress_type == zipfile.ZIP_STORED and not by_columns and math.prod(shape)
            if (
                not plain or dtype.hasobject
            ):  # objects in a file are addresses: mapped, they would be followed
                with archive.open(info) as member:
                    arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
                continue
            # What stands before the data: 30 bytes, two of them the length of the name, two that of further fields.
            stream.seek(info.header_offset + 26)
            start += info.header_offset + 30 + sum(struct.unpack("<HH", stream.read(4)))
            arrays[name] = np.memmap(path, dtype, "r", start, shape)
    return arrays


def pairs_from_arrays(arrays: dict[str, ndarray], source: str) -> PairPredictions:
    """Checked predictions from the arrays of a file, `source` being its name in messages.

    Raises InputError for what is missing or does not agree.
    """
    for name, dimensions in ARRAYS.items():
        if name not in arrays:
            raise InputError(f"{source}: no array {name!r}; pair predictions need {', '.join(ARRAYS)}")
        if arrays[name].ndim != dimensions:
            raise InputError(
                f"{source}: {name} has shape {arrays[name].shape}, it needs {dimensions} dimensions"
            )
    edges = arrays["edges"]
    count, height, width = arrays["pts3d"].shape[:3]
    for name, shape in {
        "edges": (count, 2),
        "pts3d": (count, height, width, 3),
        "conf": (count, height, width),
        "pts3d_in_other_view": (count, height, width, 3),
        "conf2": (count, height, width),
    }.items():
        if arrays[name].shape != shape:
            raise InputError(f"{source}: {name} has shape {arrays[name].shape}, pts3d asks for {shape}")
    images = tuple(str(name) for name in arrays.get("images", ()))
    image_count = _check_edges(edges, len(images), source)
    for name in ("pts3d", "conf", "pts3d_in_other_view", "conf2"):
        _check_values(name, arrays[name], source)
    intrinsics, grid = camera_of_arrays(arrays, (width, height), source)
    colors = arrays.get("colors")
    if colors is not None and (colors.shape != (image_count, height, width, 3) or colors.dtype != np.uint8):
        raise InputError(f"{source}: colors must be uint8 of shape {(image_count, height, width, 3)}")
    return PairPredictions(
        edges=edges.astype(np.int64),
        **{name: arrays[name].astype(np.float32, copy=False) for name in ARRAYS if name != "edges"},
        images=images,
        colors=colors,
        intrinsics=intrinsics,
        grid=grid,
        is_metric=bool(arrays.get("is_metric", False)),
    )


def _check_edges(edges: ndarray, names: int, source: str) -> int:
    """The number of images: `names`, or where that is 0 as many as the edges count; InputError for wrong edges."""
    if len(edges) == 0:
        raise InputError(f"{source}: no pair in it; predict at least one")
    if edges.dtype.kind not in "iu":
        raise InputError(f"{source}: edges must be integers, they are {edges.dtype}")
    images = names or int(edges.max()) + 1
    if edges.min() < 0 or edges.max() >= images or (edges[:, 0] == edges[:, 1]).any():
        raise InputError(f"{source}: edges must join two of the {images} images, counted from 0")
    return images


def _check_values(name: str, array: ndarray, source: str) -> None:
    """InputError for points or confidences of a pair that are not finite, or confidences below 0."""
    # One edge at a time: a mask of the whole would cost as much memory again as a quarter of the file.
    for edge, values in enumerate(array):
        _release(array)
        if not np.isfinite(values).all():
            raise InputError(
                f"{source}: {name}[{edge}] is not finite everywhere; put 0 there, with confidence 0"
            )
        if name in ("conf", "conf2") and values.min() < 0:
            raise InputError(f"{source}: {name}[{edge}] is negative somewhere; a confidence is at least 0")


def camera_of_arrays(
    arrays: dict[str, ndarray], size: tuple[int, int], source: str
) -> tuple[Intrinsics | None, ImageGrid | None]:
    """`intrinsics` and `grid` of a file for pointmaps of `size` (width, height); InputError if wrong."""
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
