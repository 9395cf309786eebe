"""Dense pointmaps of images whose cameras are known, whichever back end found them."""

import os
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.allocator import give_back
from jcr.camera import rays
from jcr.progress import Progress
from jcr.records import Intrinsics, Pointmaps

MOST_THREADS = 16
"""Images that are matched at once. Each takes about 400 bytes per pixel while it is matched."""


def dense_pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m 2 3"],
    report: Progress,
    *,
    changing: bool = False,
    priors: bool = True,
    threads: int | None = None,
) -> Pointmaps:
    """Estimate points in the recon frame for the pixels of undistorted images, with confidence, reason and sigma.

    The confidence is the correlation times the number of images that agree, 0 for no estimate.

    `neighbours` and `planes` are what `views` chooses; `changing`: the images are of different times, one that sees
    through a point of another may show what was there before, and nothing is filled by `priors`. The number of
    `threads` (default: one per core, at most MOST_THREADS) changes no bit.
    """
    from jcr.depth.fused import fused_depth
    from jcr.depth.matched import match_depth

    threads = threads or min(os.cpu_count() or 1, MOST_THREADS)

    def progress(start: float, share: float) -> Callable[[float], None]:
        return lambda fraction: report("dense depth", start + share * fraction)

    inverse_depth, score = match_depth(
        colors, recon_from_camera, pinhole, neighbours, planes, threads, progress(0.0, 0.7)
    )
    give_back()
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
    # In the precision of depth.npz, so that a run that reads the file gives the same map.
    return pointmaps_of(
        (1 / found.inverse_depth.astype(np.float64)).astype(np.float32),
        found.std.astype(np.float16),
        found.confidence.astype(np.float16),
        found.reason,
        colors,
        recon_from_camera,
        pinhole,
    )


def pointmaps_of(
    depth: Float[ndarray, "m h w"],
    relative_std: Float[ndarray, "m h w"],
    confidence: Float[ndarray, "m h w"],
    reason: UInt8[ndarray, "m h w"],
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
) -> Pointmaps:
    """Return the pointmaps of depths (z, recon units) with their relative standard deviation, on known cameras."""
    points, direction = np.empty((*depth.shape, 3)), rays(pinhole)
    for k, pose in enumerate(recon_from_camera):
        points[k] = (depth[k, ..., None].astype(np.float64) * direction) @ pose[:3, :3].T + pose[:3, 3]
    return Pointmaps(
        intrinsics=pinhole,
        points_in_recon=points,
        confidence=confidence.astype(np.float64),
        colors=colors,
        reason=reason,
        depth_std=relative_std.astype(np.float32) * depth,
    )
