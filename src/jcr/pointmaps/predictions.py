"""The back end `predictions`: output of any network, read from one npz file (jcr docs predictions)."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.camera import is_distorted, usable_intrinsics
from jcr.errors import InputError, count_of
from jcr.geometry import apply, inverse, require_rigid
from jcr.pointmaps.image_grid import ImageGrid, PreparedImages, image_grid, read_colors
from jcr.pointmaps.pair_predictions import (
    PairPredictions,
    camera_of_arrays,
    check_arrays,
    pairs_from_arrays,
    read_arrays,
)
from jcr.pointmaps.posed_pointmaps import PosedPointmaps, fit_pinhole
from jcr.pointmaps.reconstruction import align_pairs, reconstruct_pointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction

POINTMAPS = {"confidence": "N H W", "recon_from_camera": "N 4 4", "points_in_recon": "N H W 3"}
"""Required arrays of pointmaps in one frame, and their shapes; N images of H x W pixels."""
LARGEST_MISFIT = 0.02
"""Largest median distance of projections from their pixels, as a share of the width; beyond it poses are wrong."""


def reconstruct_predictions(
    capture: Capture, path: Path, progress: Progress = silent, refining: bool = True
) -> Reconstruction:
    """Return camera poses, pointmaps and tracks from the predictions in an npz file.

    Matches of the images refine the poses, unless `refining` is False. The file has pairwise pointmaps (pairs.ARRAYS),
    or camera poses and pointmaps in one frame (POINTMAPS). Raises
    InputError for a file that is missing, damaged, or does not fit the capture.
    """
    arrays, source = read_arrays(path), str(path)
    if "edges" in arrays:
        predictions, images, rows = predicted_pairs(capture, arrays, source)
        maps = align_pairs(predictions, images, progress)
    elif "recon_from_camera" in arrays:
        check_arrays(arrays, POINTMAPS, source)
        count, height, width = arrays["confidence"].shape
        rows = _rows(tuple(str(name) for name in arrays.get("images", ())), count, capture, source)
        images = _images(capture, rows, arrays, (width, height), source)
        maps = _posed_pointmaps(arrays, np.argsort(rows), images.grid, source)
    else:
        raise InputError(f"{source}: without 'edges' or 'recon_from_camera'; see jcr docs predictions")
    return reconstruct_pointmaps(capture, images, maps, "predictions", progress, np.sort(rows), refining)


def predicted_pairs(
    capture: Capture, arrays: dict[str, ndarray], source: str
) -> tuple[PairPredictions, PreparedImages, Int[ndarray, " m"]]:
    """Return the pairs of a file with `arrays`, the images on their grid, and the row of each in the capture.

    The images are renumbered in the order of the capture.
    """
    predictions = pairs_from_arrays(arrays, source)
    rows = _rows(predictions.images, predictions.image_count, capture, source)
    rank = np.argsort(np.argsort(rows))
    # Rows of a reconstruction ascend; the file's images are renumbered to that order.
    predictions = replace(predictions, edges=rank[predictions.edges], images=())
    height, width = predictions.conf.shape[1:]
    return predictions, _images(capture, rows, arrays, (width, height), source), np.sort(rows)


def _posed_pointmaps(
    arrays: dict[str, ndarray], order: Int[ndarray, " m"], grid: ImageGrid, source: str
) -> PosedPointmaps:
    """Return the pointmaps of a file's `arrays` (POINTMAPS), on the pixel grid `grid`.

    `order` has the file's rows of the images in the order of the result; `source` is the file named in messages. Raises
    InputError where the median distance of the points' projections from their pixels is above LARGEST_MISFIT.
    """
    poses = arrays["recon_from_camera"].astype(np.float64)
    poses = np.stack([require_rigid(poses[k], f"{source}: recon_from_camera[{k}]") for k in order])
    points, confidence = arrays["points_in_recon"][order], arrays["confidence"][order].astype(np.float32)

    def posed(recon_from_camera: ndarray) -> tuple[PosedPointmaps, float]:
        maps = PosedPointmaps(
            grid=grid,
            recon_from_camera=recon_from_camera,
            x_in_camera=np.stack(
                [apply(*each) for each in zip(inverse(recon_from_camera), points, strict=True)]
            ),
            confidence=confidence,
            is_metric=bool(arrays.get("is_metric", False)),
        )
        return maps, fit_pinhole(maps)[1]

    maps, misfit_px = posed(poses)
    largest_px = LARGEST_MISFIT * grid.size[0]
    if misfit_px > largest_px:
        remedy = "give poses and points of one frame"
        if posed(inverse(poses))[1] <= largest_px:
            remedy = "they are camera_from_recon (world to camera); invert them"
        raise InputError(
            f"{source}: by recon_from_camera the points lie {misfit_px:.0f} px from their pixels; {remedy}"
        )
    return maps


def _rows(names: tuple[str, ...], count: int, capture: Capture, source: str) -> Int[ndarray, " m"]:
    """Return the row in the capture of each image of the file; raise InputError for names that do not fit.

    Without `names`, the file must have all images of the capture, in its order; `count` is the number in the file.
    """
    if not names:
        if count != len(capture):
            raise InputError(
                f"{source}: {count_of(count, 'image')}, the capture has {len(capture)}; add the names as array 'images'"
            )
        return np.arange(count)
    if len(names) != count or len(set(names)) != count:
        raise InputError(
            f"{source}: 'images' has {count_of(len(names), 'name')} for {count_of(count, 'image')}; give one each"
        )
    unknown = [name for name in names if name not in capture.images]
    if unknown:
        raise InputError(f"{source}: no image {unknown[0]!r} in the capture; it has {capture.images[0]!r} …")
    return np.array([capture.images.index(name) for name in names])


def _images(
    capture: Capture, rows: Int[ndarray, " m"], arrays: dict[str, ndarray], size: tuple[int, int], source: str
) -> PreparedImages:
    """Return the capture's images on the pixel grid of a file with `arrays`, in ascending order of their `rows`.

    `rows` has the capture's row of each image of the file, and `size` is width and height of the pointmaps. Intrinsics
    in the file are those of undistorted images, as in predictions made by this package. Without them, the pixels are
    taken to be those of the capture's images, and a known distortion cannot be accounted for.
    """
    seen, grid = camera_of_arrays(arrays, size, source)
    intrinsics, warnings = usable_intrinsics(capture.intrinsics)
    original = capture.image_size
    grids = [grid] if grid else [image_grid(original), image_grid(original, 224)]
    if abs(size[0] * original[1] - size[1] * original[0]) <= max(original):
        grids.append(ImageGrid.uncropped(original, size))
    grid = next((one for one in grids if one.size == size), None)
    if grid is None:
        raise InputError(
            f"{source}: pointmaps of {size[0]}x{size[1]} are no plain resize of {original[0]}x{original[1]} images; "
            "give their crop as array 'grid'"
        )
    if seen is not None:
        pinhole = grid.original_intrinsics(seen)
        intrinsics = intrinsics or pinhole
    elif intrinsics is not None and is_distorted(intrinsics):
        intrinsics = pinhole = None
        warnings += (
            f"{source} has no intrinsics, so its pointmaps are taken to be of the distorted images and their "
            "intrinsics are estimated as a pinhole",
        )
    else:
        pinhole = intrinsics
    if grid.original_size != original and (intrinsics is None or not is_distorted(intrinsics)):
        raise InputError(
            f"{source}: made from images of {'x'.join(map(str, grid.original_size))}, the capture's are "
            f"{'x'.join(map(str, original))}; predict from this capture's images"
        )
    ordered = np.sort(rows)
    if "colors" in arrays:
        colors = arrays["colors"]
        if colors.shape != (len(rows), size[1], size[0], 3) or colors.dtype != np.uint8:
            raise InputError(f"{source}: colors must be uint8 of shape {(len(rows), size[1], size[0], 3)}")
        colors = colors[np.argsort(rows)]
    else:
        colors = read_colors(capture.of_rows(ordered), grid, intrinsics, pinhole)
    return PreparedImages(
        colors=colors, grid=grid, intrinsics_of_capture=intrinsics, pinhole=pinhole, warnings=warnings
    )
