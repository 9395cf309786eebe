"""Which pairs of images to predict, and their pointmaps as a record and a file, read by global alignment."""

import math
import mmap
import struct
import zipfile
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.files import written_whole
from jcr.geometry import apply, fit_similarity, inverse, rotation_angle, transform
from jcr.handeye.closed_form import rotations
from jcr.reconstruct.preprocess import ImageGrid
from jcr.records import Intrinsics

ARRAYS = {"edges": 2, "pts3d": 4, "conf": 3, "pts3d_in_other_view": 4, "conf2": 3}
"""Keys every file has, and their dimensions; the names are those of DUSt3R's own output."""


FEW_IMAGES = 12
"""Up to here "auto" predicts every pair (132); a chain that is wrong costs more than it saves."""


@dataclass(frozen=True)
class PairOptions:
    """Which pairs of images the network sees, and within what memory."""

    pair_graph: Literal["auto", "complete", "window", "robot"] = "auto"
    """complete: all pairs; window: images near each other in the capture's order; robot: all but the pairs
    that by the robot's poses have no view in common; auto: complete up to 12 images, robot beyond."""
    window: int = 3
    """How far apart in the capture's order two images of a pair may be (window only)."""
    image_size: Literal[512, 224] = 512
    """Long edge that the network sees, in pixels; 224 has a quarter of the pixels to compute."""
    memory_gb: float = 8.0
    """Peak resident set of the process, the program itself included; on a GPU, what the network takes there, too.
    Pointmaps that do not fit lie in a file."""
    cache: Path | None = None
    """Folder of predictions already made; unset: jcr/pairs in the user's cache folder."""
    cache_gb: float = 4.0
    """Size at which the oldest predictions in the cache are deleted; 0 turns it off."""


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

    def release(self) -> None:
        """Take pointmaps that lie in a file out of the resident set; they come back page by page when read."""
        for array in (self.pts3d, self.conf, self.pts3d_in_other_view, self.conf2):
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
            return dict(file)
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
            _release(arrays[name])
            if not np.isfinite(values).all():
                raise InputError(
                    f"{source}: {name}[{edge}] is not finite everywhere; put 0 there, with confidence 0"
                )
            if name in ("conf", "conf2") and values.min() < 0:
                raise InputError(
                    f"{source}: {name}[{edge}] is negative somewhere; a confidence is at least 0"
                )
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


def complete_pairs(count: int) -> Int[ndarray, "e 2"]:
    """Every pair in both orders: (i, j) with i > j first, then each reversed, as published."""
    return _both_orders(np.argwhere(np.tri(count, k=-1, dtype=bool)))


def window_pairs(count: int, size: int) -> Int[ndarray, "e 2"]:
    """Pairs of images at most `size` apart in the order of the capture, in both orders."""
    near = np.tri(count, k=-1, dtype=bool) & ~np.tri(count, k=-size - 1, dtype=bool)
    return _both_orders(np.argwhere(near))


def _both_orders(edges: Int[ndarray, "e 2"]) -> Int[ndarray, "e2 2"]:
    return np.concatenate([edges, edges[:, ::-1]])


def overlapping_pairs(
    chain: PairPredictions, base_from_gripper: Float[ndarray, "n 4 4"], least_overlap: float = 0.02
) -> tuple[Int[ndarray, "e 2"], str]:
    """Pairs that can see something in common, in both orders, and in words how that was found.

    `chain` holds the pairs of neighbours, `window_pairs(n, 1)`. From their relative camera poses and the
    robot's come a first hand-eye calibration and the pairs' scales; with them every image's points go into
    the base frame and from there into every other camera. A pair is left out only when less than
    `least_overlap` of the points of either image fall into half again the other's field of view. All pairs
    are kept where the motions do not determine where the camera looks, or the chain contradicts the robot.
    """
    everything = complete_pairs(len(base_from_gripper))
    views = _chain_views(chain, len(base_from_gripper))
    fit = _first_calibration(views, base_from_gripper)
    if isinstance(fit, str):
        return everything, f"all pairs predicted: {fit}"
    gripper_from_camera, metres = fit
    base_from_camera = base_from_gripper @ gripper_from_camera
    camera_from_base = inverse(base_from_camera)
    points = [scale * view.points for scale, view in zip(metres, views, strict=True)]
    points.append(metres[-1] * views[-1].next_points)
    seen = np.zeros((len(points), len(points)))
    for i, x_in_camera in enumerate(points):
        x_in_base = apply(base_from_camera[i], x_in_camera)
        for j, others in enumerate(points):
            seen[i, j] = _share_in_view(apply(camera_from_base[j], x_in_base), others)
    first, second = everything.T
    keep = (np.maximum(seen, seen.T)[first, second] >= least_overlap) | (np.abs(first - second) == 1)
    return everything[keep], f"{keep.sum()} of {len(keep)} pairs predicted: the others share no view"


def _first_calibration(
    views: list["_ChainView"], base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Float[ndarray, "4 4"], Float[ndarray, " k"]] | str:
    """A rough gripper_from_camera and metres per unit of each pair of neighbours, or why there is none."""
    gripper_motion = inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]
    camera_motion = np.stack([view.camera_from_next for view in views])
    rotation_a, rotation_b = gripper_motion[:, :3, :3], camera_motion[:, :3, :3]
    # (1 − cos θ) a aᵀ of each rotation by θ about a, half of its squared logarithm where it is small.
    cosine = (np.trace(rotation_a, axis1=1, axis2=2) - 1) / 2
    scatter = rotation_a.sum(0) - cosine.sum() * np.eye(3)
    _, second, largest = np.linalg.eigvalsh((scatter + scatter.T) / 2)
    if largest < 5e-4 or second < 0.02 * largest:
        return "neighbours turn about less than two axes, so where the camera looks is unknown"
    # Chained along the neighbours, for any frame of the cameras will do.
    camera = np.stack(list(accumulate(rotation_b, np.matmul, initial=np.eye(3))))
    rotation, _ = rotations(base_from_gripper[:, :3, :3], camera, np.ones(len(camera)))
    miss = rotation_angle(np.swapaxes(rotation_a @ rotation, -1, -2) @ rotation @ rotation_b)
    if np.median(miss) > np.radians(10):
        return "the pairs of neighbours do not agree with the robot's rotations"
    # (R_A − I) t − λ_k R t_B = −t_A, linear in the lever arm t, held near 0 a little, and one λ_k per pair.
    motions = np.arange(len(views))
    lever, scales = rotation_a - np.eye(3), np.zeros((len(views), 3, len(views)))
    scales[motions, :, motions] = -camera_motion[:, :3, 3] @ rotation.T
    rows = np.concatenate([lever, scales], axis=2).reshape(-1, 3 + len(views))
    matrix = np.concatenate([rows, 0.1 * np.eye(3, 3 + len(views))])
    right = np.append(-gripper_motion[:, :3, 3].ravel(), np.zeros(3))
    solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
    if (solution[3:] <= 0).any():
        return "the pairs of neighbours do not agree with the robot's translations"
    return transform(rotation, solution[:3]), solution[3:]


@dataclass(frozen=True)
class _ChainView:
    """Two neighbours in one pair's unit."""

    camera_from_next: Float[ndarray, "4 4"]
    points: Float[ndarray, "p 3"]
    """Of the first, in its camera frame."""
    next_points: Float[ndarray, "p 3"]
    """Of the next, in its own camera frame."""


def _chain_views(chain: PairPredictions, count: int, samples: int = 1000) -> list[_ChainView]:
    row = {(int(first), int(second)): e for e, (first, second) in enumerate(chain.edges)}
    views = []
    for k in range(count - 1):
        there, back = row[k, k + 1], row[k + 1, k]
        # The same pixels of the next image, in the camera frame of image k and in their own.
        confidence = np.minimum(chain.conf2[there], chain.conf[back]).ravel()
        best = np.argsort(confidence)[-len(confidence) // 2 :]
        pixels = best[:: max(1, len(best) // samples)]
        in_camera = chain.pts3d_in_other_view[there].reshape(-1, 3)[pixels].astype(np.float64)
        in_next = chain.pts3d[back].reshape(-1, 3)[pixels].astype(np.float64)
        camera_from_next, scale = fit_similarity(in_camera, in_next)
        own = np.argsort(chain.conf[there].ravel())[-len(confidence) // 2 :][:: max(1, len(best) // samples)]
        points = chain.pts3d[there].reshape(-1, 3)[own].astype(np.float64)
        views.append(_ChainView(camera_from_next, points, scale * in_next))
        chain.release()
    return views


def _share_in_view(
    x_in_camera: Float[ndarray, "n 3"], view: Float[ndarray, "p 3"], widen: float = 1.5
) -> float:
    """Fraction of points that fall into the field of view that a camera's own points span, widened."""
    directions = view[:, :2] / np.maximum(view[:, 2:], 1e-6)
    low, high = np.quantile(directions, [0.01, 0.99], axis=0)
    middle, half = (low + high) / 2, widen * (high - low) / 2
    ahead = x_in_camera[:, 2] > 1e-6
    inside = np.abs(x_in_camera[ahead, :2] / x_in_camera[ahead, 2:] - middle) <= half
    return float(inside.all(-1).sum() / len(x_in_camera))
