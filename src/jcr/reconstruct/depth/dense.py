"""Dense pointmaps of images whose cameras are known, whichever back end found them."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import pinhole_inside, rays, undistort_image
from jcr.extras import extra
from jcr.memory import ALLOWANCE, GB, MAP, announce, relieve, require, resident
from jcr.progress import Progress
from jcr.reconstruct.depth.views import BYTES_OF_RESULT, BYTES_OF_THREAD, choose_neighbours, sweep_planes
from jcr.records import Intrinsics, Reconstruction, Tracks

BYTES_OF_FEATURES_FOUND = 5_000_000
"""Per image: features, matches and tracks in structure from motion and bundle adjustment."""


@dataclass(frozen=True, kw_only=True)
class DenseOptions:
    """Pointmaps without a network."""

    pointmap_size_px: int = 400
    """Long side of the dense pointmaps."""
    dense: bool = True
    """Off: cameras and tracks alone, with pointmaps of no confidence."""
    neighbours: int = 10
    """Other images that the depth of each is checked against; matched with the best of them."""
    priors: bool = True
    """Fill plain surfaces with planes."""
    memory_gb: float = 8.0
    """Peak resident set of the process, the program itself included."""


@dataclass(frozen=True)
class SparseModel:
    """Cameras whose poses are known, and points that they see."""

    rows: Int[ndarray, " m"]
    """Of the images given, those that have a pose, ascending."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    lens: Intrinsics
    """Of the images given: the one given, or estimated."""
    tracks: Tracks
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """As those of records.Reconstruction."""


@dataclass(frozen=True)
class DenseDepth:
    """Depth of every pixel of undistorted images, and what it rests on."""

    points_in_recon: Float[ndarray, "m h w 3"]
    confidence: Float[ndarray, "m h w"]
    """Correlation times the number of images that agree; 0 for no estimate."""
    reason: UInt8[ndarray, "m h w"]
    """NO_DEPTH, MATCHED, PRIOR or BOTH of `jcr.records`."""
    depth_std: Float[ndarray, "m h w"]
    """One sigma of the depth (z), in recon units."""


def with_pointmaps(
    sparse: SparseModel,
    images: Sequence[UInt8[ndarray, "h w 3"]],
    options: DenseOptions,
    report: Progress,
    *,
    backend: str,
    planes: Float[ndarray, "m d 3"] | None = None,
) -> Reconstruction:
    """The record of a sparse model, with pointmaps of its images, row by row; `planes` as `with_depth` takes them."""
    pinhole = pinhole_inside(sparse.lens, options.pointmap_size_px)
    colors = np.stack([undistort_image(image, sparse.lens, pinhole) for image in images])
    nothing = np.zeros(colors.shape[:3], np.float32)
    without = Reconstruction(
        image_index=sparse.rows,
        recon_from_camera=sparse.recon_from_camera,
        intrinsics=sparse.lens,
        pointmap_intrinsics=pinhole,
        points_in_recon=np.zeros(colors.shape, np.float32),
        confidence=nothing,
        reason=nothing.astype(np.uint8),
        depth_std=nothing,
        colors=colors,
        tracks=sparse.tracks,
        backend=backend,
        notes=sparse.notes,
        warnings=sparse.warnings,
    )
    return with_depth(without, options, report, planes) if options.dense else without


def with_depth(
    reconstruction: Reconstruction,
    options: DenseOptions,
    report: Progress,
    planes: Float[ndarray, "m d 3"] | None = None,
) -> Reconstruction:
    """The record of cameras and tracks with pointmaps; `planes` where the tracks do not span what is in view."""
    cameras, tracks = reconstruction.recon_from_camera, reconstruction.tracks
    dense = dense_pointmaps(
        reconstruction.colors,
        cameras,
        reconstruction.pointmap_intrinsics,
        choose_neighbours(tracks, cameras, options.neighbours),
        sweep_planes(tracks, cameras) if planes is None else planes,
        report,
        priors=options.priors,
        memory_gb=options.memory_gb,
    )
    return replace(
        reconstruction,
        points_in_recon=dense.points_in_recon,
        confidence=dense.confidence,
        reason=dense.reason,
        depth_std=dense.depth_std,
    )


def dense_pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m d 3"],
    report: Progress,
    *,
    changing: bool = False,
    priors: bool = True,
    memory_gb: float = 8.0,
) -> DenseDepth:
    """Points in the recon frame, per pixel of undistorted images, with confidence, reason and sigma.

    `neighbours` and `planes` are what `views` chooses; `changing`: the images are of different times, one that sees
    through a point of another may show what was there before, and nothing is filled by `priors`.
    """
    extra("numba", "map", "dense depth")
    from jcr.reconstruct.depth.fused import fused_depth
    from jcr.reconstruct.depth.matched import match_depth

    pixels = pinhole.width * pinhole.height
    room = memory_gb * GB - resident() - ALLOWANCE - len(colors) * pixels * BYTES_OF_RESULT
    threads = max(1, min(os.cpu_count() or 1, int(room // (pixels * BYTES_OF_THREAD))))

    def progress(start: float, share: float) -> Callable[[float], None]:
        def told(fraction: float) -> None:
            relieve(memory_gb * GB)
            report("dense depth", start + share * fraction)

        return told

    inverse_depth, score = match_depth(
        colors, recon_from_camera, pinhole, neighbours, planes, threads, progress(0.0, 0.7)
    )
    found = fused_depth(
        colors,
        recon_from_camera,
        pinhole,
        neighbours,
        inverse_depth,
        score,
        changing=changing,
        priors=priors and not changing,
        threads=threads,
        report=progress(0.7, 0.3),
    )
    depth = 1 / found.inverse_depth.astype(np.float64)
    points = np.empty((*depth.shape, 3))
    for k, pose in enumerate(recon_from_camera):
        points[k] = np.einsum("ij,hwj->hwi", pose[:3, :3], depth[k, ..., None] * rays(pinhole)) + pose[:3, 3]
    return DenseDepth(
        points, found.confidence.astype(np.float64), found.reason, (found.std * depth).astype(np.float32)
    )


def plan_memory(images: int, size: tuple[int, int], options: DenseOptions, features: int = 0) -> None:
    """Say what memory the reconstruction of this many images of a size, and their map, will take before they start.

    `features` are the bytes that finding features takes at least. Raises InputError where the budget cannot be
    kept with one image at a time.
    """
    if options.dense:
        extra("numba", "map", "dense depth")  # imported now, for it is a part of the program

    width, height = size
    pixels = int(width * height * min(1.0, options.pointmap_size_px / max(size)) ** 2)
    program = resident() + ALLOWANCE
    pictures = 3 * width * height * images
    result = images * (pixels * BYTES_OF_RESULT + BYTES_OF_FEATURES_FOUND)
    one = pixels * BYTES_OF_THREAD if options.dense else 0
    budget = options.memory_gb * GB
    least = program + pictures + max(features, result + max(one, MAP))
    require(least, budget, f"a run of {images} images of {width}x{height}, with the program itself,")
    cores = os.cpu_count() or 1
    all_at_once = min(cores, images) * one
    # Freed blocks are given back only when half a budget is in use: with an ample one the stages' needs add up.
    ample = program + pictures + max(features * min(cores, images), result + all_at_once + MAP)
    announce(min(ample, int(budget)), budget)
