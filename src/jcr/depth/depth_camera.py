"""Fusion of depth images of a depth camera into pointmaps, with their scale corrected by the robot's motions."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.camera import project, rays
from jcr.capture.images import read_depth_images
from jcr.geometry import apply, inverse
from jcr.records import MATCHED, PRIOR, Capture, DepthCheck, Reconstruction

TOO_WRONG = 20.0
"""Largest error of scale of the depth images, percent; a larger one means another unit or images of another camera."""
AGREEING_SIGMAS = 3.0
"""Number of standard deviations up to which matched and measured depth count as the same surface."""
SLOPE = 0.05
"""Relative difference of depth between neighbouring pixels above which a pixel mixes the two surfaces at an edge."""
UNSTATED_STD = 0.02
"""Relative standard deviation of depths that come without one."""
REACH_M = (0.1, 6.0)
"""Range of depths that are used, m: depth cameras for robot arms measure between these limits."""


def with_measured_depth(
    capture: Capture, reconstruction: Reconstruction, check: DepthCheck | None, scale: float
) -> tuple[Reconstruction, tuple[str, ...]]:
    """Return the reconstruction with the measured depth images merged into its pointmaps, and notes for the user.

    `check` compares the depth images with the robot's motions; None means that no comparison is reliable. The depth
    images are not used without `check`, or if it finds a scale error above 20 %. The depth is divided by one plus this
    error. `scale` is in metres per recon unit. Measured and matched depth within 3 standard deviations are averaged,
    weighted by inverse variance; otherwise the matched depth stays. Measured depth replaces the depth of fitted planes,
    and fills pixels without depth.
    """
    if capture.depths is None:
        return reconstruction, ()
    if check is None:
        return reconstruction, ("the depth images are not used: the robot cannot tell their scale",)
    if abs(check.off_percent) > TOO_WRONG:
        return reconstruction, (
            f"the depth images are not used: their lengths are {check.off_percent:+.0f} % off by the robot; they must "
            "be in mm and aligned with the colour images",
        )
    dense = reconstruction.dense
    points, confidence = dense.points_in_recon.copy(), dense.confidence.copy()
    std = np.zeros_like(confidence) if dense.depth_std is None else dense.depth_std.copy()
    known = confidence > 0
    reason = np.where(known, MATCHED, 0).astype(np.uint8) if dense.reason is None else dense.reason.copy()
    usual = float(np.median(confidence[known])) if known.any() else 1.0
    against = both = 0
    ray = rays(dense.intrinsics)
    at = np.rint(project(reconstruction.intrinsics, ray)).astype(int)
    for k, row in enumerate(reconstruction.image_index):
        if row >= len(capture.depths) or (name := capture.depths[row]) is None:
            continue
        depth, inside = _sampled(read_depth_images(capture.folder / name, capture.image_size), at)
        z = depth / (1 + 0.01 * check.off_percent)
        sigma = check.std_m(z)
        recon_from_camera = reconstruction.recon_from_camera[k]
        there = scale * apply(inverse(recon_from_camera), points[k].astype(float))[..., 2]
        matched = known[k] & (reason[k] != PRIOR)
        of_matched = np.where(std[k] > 0, scale * std[k].astype(float), UNSTATED_STD * there)
        agrees = inside & matched & (np.abs(z - there) < AGREEING_SIGMAS * np.hypot(sigma, of_matched))
        against += int((inside & matched & ~agrees).sum())
        both += int((inside & matched).sum())
        share = np.where(agrees, sigma**2 / (sigma**2 + of_matched**2), 0.0)
        z = share * there + (1 - share) * z
        sigma = np.where(agrees, of_matched * np.sqrt(share), sigma)
        new = agrees | (inside & ~matched)
        points[k][new] = apply(recon_from_camera, (z / scale)[..., None] * ray)[new]
        std[k][new] = sigma[new] / scale
        confidence[k][new & ~matched] = usual
        reason[k][new] = MATCHED
    measured = replace(dense, points_in_recon=points, confidence=confidence, depth_std=std, reason=reason)
    note = (
        f"measured and matched depth differ at {100 * against / max(both, 1):.0f} % of the pixels that have both; there "
        "the matched one is kept"
    )
    return replace(reconstruction, pointmaps=measured), (note,) * (against > 0.2 * both)


def _sampled(depth: Float[ndarray, "h w"], at: ndarray) -> tuple[Float[ndarray, "p q"], Bool[ndarray, "p q"]]:
    """Return the depth (m) of a depth image (m, 0: none) at the integer pixels `at` (p,q,2), and where it is valid.

    `at` has u, then v, in its last axis. A depth is valid if it is within REACH_M, and the 3 x 3 depths around are
    known and differ by less than 5 %.
    """
    height, width = depth.shape
    u, v = at[..., 0], at[..., 1]
    inside = (u >= 1) & (v >= 1) & (u < width - 1) & (v < height - 1)
    u, v = u.clip(1, width - 2), v.clip(1, height - 2)
    around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]).astype(float)
    z = around[4]
    whole = (around > 0).all(0) & (np.ptp(around, axis=0) < SLOPE * z)
    return z, inside & whole & (z > REACH_M[0]) & (z < REACH_M[1])
