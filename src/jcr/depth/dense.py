"""Dense pointmaps of images whose cameras are known, whichever back end found them."""

import os
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays
from jcr.depth.views import BYTES_OF_RESULT, BYTES_OF_THREAD
from jcr.memory import ALLOWANCE, GB, relieve, resident
from jcr.progress import Progress
from jcr.records import Intrinsics, Pointmaps


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
    memory_gb: float = 8.0,
) -> Pointmaps:
    """Points in the recon frame, per pixel of undistorted images, with confidence, reason and sigma.

    The confidence is the correlation times the number of images that agree, 0 for no estimate.

    `neighbours` and `planes` are what `views` chooses; `changing`: the images are of different times, one that sees
    through a point of another may show what was there before, and nothing is filled by `priors`.
    """
    from jcr.depth.fused import fused_depth
    from jcr.depth.matched import match_depth

    pixels = pinhole.width * pinhole.height
    available = memory_gb * GB - resident() - ALLOWANCE - len(colors) * pixels * BYTES_OF_RESULT
    threads = max(1, min(os.cpu_count() or 1, int(available // (pixels * BYTES_OF_THREAD))))

    def progress(start: float, share: float) -> Callable[[float], None]:
        def relieve_and_report(fraction: float) -> None:
            relieve(memory_gb * GB)
            report("dense depth", start + share * fraction)

        return relieve_and_report

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
    return Pointmaps(
        intrinsics=pinhole,
        points_in_recon=_points(depth, recon_from_camera, pinhole),
        confidence=found.confidence.astype(np.float64),
        colors=colors,
        reason=found.reason,
        depth_std=(found.std * depth).astype(np.float32),
    )


def _points(
    depth: Float[ndarray, "m h w"], recon_from_camera: Float[ndarray, "m 4 4"], pinhole: Intrinsics
) -> Float[ndarray, "m h w 3"]:
    """The points of every pixel in the recon frame."""
    points, direction = np.empty((*depth.shape, 3)), rays(pinhole)
    for k, pose in enumerate(recon_from_camera):
        points[k] = (depth[k, ..., None] * direction) @ pose[:3, :3].T + pose[:3, 3]
    return points
