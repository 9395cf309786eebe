"""Dense pointmaps of images whose cameras are known, whichever back end found them."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import pinhole_inside, rays, undistort_image
from jcr.extras import extra
from jcr.memory import ALLOWANCE, GB, MAP, announce, require, resident
from jcr.progress import Progress
from jcr.reconstruct.depth.views import (
    BYTES_OF_PLANE,
    BYTES_OF_RESULT,
    BYTES_OF_THREAD,
    PLANES,
    choose_neighbours,
    sweep_planes,
)
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
    neighbours: int = 5
    """Other images that each is compared with for its pointmap."""
    device: str = "cpu"
    """Where the plane sweep runs: cpu or cuda."""
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


def with_pointmaps(
    sparse: SparseModel,
    images: Sequence[UInt8[ndarray, "h w 3"]],
    options: DenseOptions,
    report: Progress,
    *,
    backend: str,
    planes: Float[ndarray, "m d 3"] | None = None,
) -> Reconstruction:
    """The record of a sparse model, with pointmaps of its images, which are given row by row.

    `planes` where the tracks do not span what is in view.
    """
    pinhole = pinhole_inside(sparse.lens, options.pointmap_size_px)
    colors = np.stack([undistort_image(image, sparse.lens, pinhole) for image in images])
    if options.dense:
        points, confidence = dense_pointmaps(
            colors,
            sparse.recon_from_camera,
            pinhole,
            choose_neighbours(sparse.tracks, sparse.recon_from_camera, options.neighbours),
            sweep_planes(sparse.tracks, sparse.recon_from_camera) if planes is None else planes,
            options.device,
            report,
            memory_gb=options.memory_gb,
        )
    else:
        points, confidence = np.zeros(colors.shape, np.float32), np.zeros(colors.shape[:3], np.float32)
    return Reconstruction(
        image_index=sparse.rows,
        recon_from_camera=sparse.recon_from_camera,
        intrinsics=sparse.lens,
        pointmap_intrinsics=pinhole,
        points_in_recon=points,
        confidence=confidence,
        colors=colors,
        tracks=sparse.tracks,
        backend=backend,
        notes=sparse.notes,
    )


def dense_pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m d 3"],
    device: str,
    report: Progress,
    changing: bool = False,
    memory_gb: float = 8.0,
) -> tuple[Float[ndarray, "m h w 3"], Float[ndarray, "m h w"]]:
    """Points in the recon frame and their confidence, per pixel of undistorted images.

    `neighbours` and `planes` are what `views` chooses; `changing`: the images are of different times. Confidence
    is the plane sweep's, 0 for no estimate.
    """
    extra("torch", "map", "dense depth")
    from jcr.reconstruct.depth.plane_sweep import PlaneSweepOptions, plane_sweep

    depth, confidence = plane_sweep(
        colors,
        recon_from_camera,
        pinhole,
        neighbours,
        planes,
        PlaneSweepOptions(device=device, changing=changing, memory_gb=memory_gb),
        lambda fraction: report("dense depth", fraction),
    )
    points = np.empty((*depth.shape, 3))
    for k, pose in enumerate(recon_from_camera):
        points[k] = np.einsum("ij,hwj->hwi", pose[:3, :3], depth[k, ..., None] * rays(pinhole)) + pose[:3, 3]
    return points, confidence


def plan_memory(images: int, size: tuple[int, int], options: DenseOptions, features: int = 0) -> None:
    """Say what memory the reconstruction of so many images of a size, and their map, will take before they start.

    `features` are the bytes that finding features takes at least. Raises InputError where the budget cannot be
    kept with one image at a time.
    """
    if options.dense:
        extra("torch", "map", "dense depth")  # imported now, for it is a large part of the program

    width, height = size
    pixels = int(width * height * min(1.0, options.pointmap_size_px / max(size)) ** 2)
    program = resident() + ALLOWANCE
    pictures = 3 * width * height * images
    result = images * (pixels * BYTES_OF_RESULT + BYTES_OF_FEATURES_FOUND)
    of_thread, of_planes = pixels * BYTES_OF_THREAD, pixels * PLANES * BYTES_OF_PLANE
    one = of_thread + of_planes if options.dense else 0
    budget = options.memory_gb * GB
    least = program + pictures + max(features, result + max(one, MAP))
    require(least, budget, f"a run of {images} images of {width}x{height}, with the program itself,")
    cores = os.cpu_count() or 1
    all_at_once = min(cores, images) * of_thread + images * of_planes if options.dense else 0
    # Freed blocks are given back only when half a budget is in use: with an ample one the stages' needs add up.
    ample = program + pictures + max(features * min(cores, images), result + all_at_once + MAP)
    announce(min(ample, int(budget)), budget)
