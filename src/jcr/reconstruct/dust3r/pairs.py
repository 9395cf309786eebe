"""Pairwise pointmaps as a record and a file: what a network predicts and what global alignment reads."""

import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.files import written_whole
from jcr.reconstruct.dust3r.preprocess import ImageGrid
from jcr.records import Intrinsics

ARRAYS = {"edges": 2, "pts3d": 4, "conf": 3, "pts3d_in_other_view": 4, "conf2": 3}
"""Keys every file has, and their dimensions; the names are those of DUSt3R's own output."""


@dataclass(frozen=True)
class PairPredictions:
    """Pointmaps of ordered image pairs, each pair in its first image's camera frame, at a scale of its own.

    For edge e = (n, m), `pts3d[e]` has a point for each pixel of image n, `pts3d_in_other_view[e]` one for
    each pixel of image m, both in the camera frame of n (paper section III: X_n,e and X_m,e).
    """

    edges: Int[ndarray, "e 2"]
    pts3d: Float[ndarray, "e h w 3"]
    conf: Float[ndarray, "e h w"]
    """Of `pts3d`, at least 0; the network's own is at least 1."""
    pts3d_in_other_view: Float[ndarray, "e h w 3"]
    conf2: Float[ndarray, "e h w"]
    """Of `pts3d_in_other_view`."""
    images: tuple[str, ...] = ()
    """Names by which the capture speaks of the images; empty when the file does not say."""
    colors: UInt8[ndarray, "n h w 3"] | None = None
    """RGB at the pointmaps' pixels."""
    intrinsics: Intrinsics | None = None
    """Of the pointmaps' pixel grid, pixel (0, 0) being a centre; None: unknown, to be estimated."""
    grid: ImageGrid | None = None
    """Where the grid's pixels lie in the original images."""
    is_metric: bool = False

    @property
    def image_count(self) -> int:
        """Images the edges speak of."""
        return len(self.images) or int(self.edges.max()) + 1


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
    with written_whole(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **{name: getattr(predictions, name) for name in ARRAYS}, **extra)  # type: ignore[arg-type]


def read_pairs(path: Path) -> PairPredictions:
    """Read predictions from npz and check them.

    Raises InputError for a file that is missing, damaged, lacks an array, or has shapes that do not agree.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; `jcr predict CAPTURE {path.name}` writes one")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: no readable npz file ({error}); write it again with numpy.savez") from None
    return pairs_from_arrays(arrays, str(path))


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
    edges, pts3d = arrays["edges"], arrays["pts3d"]
    count, height, width = pts3d.shape[:3]
    shapes = {
        "edges": (count, 2),
        "pts3d": (count, height, width, 3),
        "conf": (count, height, width),
        "pts3d_in_other_view": (count, height, width, 3),
        "conf2": (count, height, width),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise InputError(f"{source}: {name} has shape {arrays[name].shape}, pts3d asks for {shape}")
    if count == 0:
        raise InputError(f"{source}: no pair in it; predict at least one")
    if edges.dtype.kind not in "iu":
        raise InputError(f"{source}: edges must be integers, they are {edges.dtype}")
    images = tuple(str(name) for name in arrays.get("images", ()))
    image_count = len(images) or int(edges.max()) + 1
    if edges.min() < 0 or edges.max() >= image_count or (edges[:, 0] == edges[:, 1]).any():
        raise InputError(f"{source}: edges must join two of the {image_count} images, counted from 0")
    for name in ("pts3d", "conf", "pts3d_in_other_view", "conf2"):
        # One edge at a time: a mask of the whole would cost as much memory again as a quarter of the file.
        for edge, values in enumerate(arrays[name]):
            if not np.isfinite(values).all():
                raise InputError(
                    f"{source}: {name}[{edge}] is not finite everywhere; put 0 there, with confidence 0"
                )
            if name in ("conf", "conf2") and values.min() < 0:
                raise InputError(
                    f"{source}: {name}[{edge}] is negative somewhere; a confidence is at least 0"
                )
    intrinsics = grid = None
    if "intrinsics" in arrays:
        if arrays["intrinsics"].shape != (4,) or not (arrays["intrinsics"][:2] > 0).all():
            raise InputError(f"{source}: intrinsics must be fx, fy, cx, cy of the {width}x{height} grid")
        fx, fy, cx, cy = (float(value) for value in arrays["intrinsics"])
        intrinsics = Intrinsics(fx, fy, cx, cy, width, height)
    if "grid" in arrays:
        if arrays["grid"].shape != (4, 2) or tuple(arrays["grid"][3]) != (width, height):
            raise InputError(
                f"{source}: grid must be the rows original size, resized size, crop corner, {width, height}"
            )
        grid = ImageGrid(*((int(x), int(y)) for x, y in arrays["grid"]))
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
