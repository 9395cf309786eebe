"""Dense pointmaps of images whose cameras are known, whichever back end found them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.progress import Progress
from jcr.reconstruct.lens import rays
from jcr.reconstruct.planesweep import PlaneSweepOptions, plane_sweep
from jcr.records import Intrinsics


def dense_pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m d 3"],
    device: str,
    report: Progress,
    changing: bool = False,
) -> tuple[Float[ndarray, "m h w 3"], Float[ndarray, "m h w"]]:
    """Points in the recon frame and their confidence, per pixel of undistorted images.

    `neighbours` and `planes` are what `views` chooses; `changing`: the images are of different times. Confidence
    is the plane sweep's, 0 for no estimate.
    """
    depth, confidence = plane_sweep(
        colors,
        recon_from_camera,
        pinhole,
        neighbours,
        planes,
        PlaneSweepOptions(device=device, changing=changing),
        lambda fraction: report("dense depth", fraction),
    )
    x_in_camera = depth[..., None] * rays(pinhole)
    x_in_recon = np.einsum("mij,mhwj->mhwi", recon_from_camera[:, :3, :3], x_in_camera)
    return x_in_recon + recon_from_camera[:, None, None, :3, 3], confidence
