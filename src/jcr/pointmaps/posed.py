"""Pointmaps that share one frame, with a camera pose each, made into a Reconstruction."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import apply, inverse
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pointmap_matches import tracks_from_pointmaps
from jcr.records import Intrinsics, Pointmaps, Reconstruction

LARGEST_MISFIT = 0.02
"""Median distance of points' projections from their own pixels, over the width, at which poses are wrong."""

SAMPLES = 20_000
"""Pixels of all images that the pinhole is fitted to, about."""


@dataclass(frozen=True)
class PosedPointmaps:
    """A camera and a pointmap of each image, in one frame."""

    image_index: Int[ndarray, " m"]
    """Rows of the capture, ascending."""
    recon_from_camera: Float[ndarray, "m 4 4"]
    points_in_recon: Float[ndarray, "m h w 3"]
    confidence: Float[ndarray, "m h w"]


def reconstruction_from_pointmaps(
    images: PreparedImages,
    maps: PosedPointmaps,
    *,
    source: str,
    backend: str,
    is_metric: bool,
    notes: tuple[str, ...] = (),
    warnings: tuple[str, ...] = (),
) -> Reconstruction:
    """The record, with tracks from the pointmaps and, where they are not known, intrinsics from them too.

    Raises InputError, naming `source`, when the points do not project onto their own pixels.
    """
    recon_from_camera, points_in_recon, confidence = (
        maps.recon_from_camera,
        maps.points_in_recon,
        maps.confidence,
    )
    pinhole, misfit_px = fit_pinhole(recon_from_camera, points_in_recon, confidence)
    width = points_in_recon.shape[2]
    if misfit_px > LARGEST_MISFIT * width:
        _, inverted_px = fit_pinhole(inverse(recon_from_camera), points_in_recon, confidence)
        remedy = "give poses and points of one frame"
        if inverted_px <= LARGEST_MISFIT * width:
            remedy = "they are camera_from_recon (world to camera); invert them"
        raise InputError(
            f"{source}: by recon_from_camera the points lie {misfit_px:.0f} px from their pixels; {remedy}"
        )
    pinhole = images.intrinsics or pinhole
    return Reconstruction(
        image_index=maps.image_index,
        recon_from_camera=recon_from_camera,
        intrinsics=images.intrinsics_of_capture or images.grid.original_intrinsics(pinhole),
        pointmaps=Pointmaps(
            intrinsics=pinhole, points_in_recon=points_in_recon, confidence=confidence, colors=images.colors
        ),
        tracks=tracks_from_pointmaps(recon_from_camera, points_in_recon, confidence, images.original_px),
        backend=backend,
        is_metric=is_metric,
        notes=notes,
        warnings=(*images.warnings, *warnings),
    )


def fit_pinhole(
    recon_from_camera: Float[ndarray, "m 4 4"],
    points_in_recon: Float[ndarray, "m h w 3"],
    confidence: Float[ndarray, "m h w"],
) -> tuple[Intrinsics, float]:
    """The pinhole that best projects points onto their pixels, and the median misfit in pixels.

    u = fx · x/z + cx is linear in the unknowns; residuals beyond the common spread lose their weight (Geman
    and McClure). The misfit is infinite where half the points lie behind their camera.
    """
    count, height, width = confidence.shape
    stride = max(1, int(np.sqrt(confidence.size / SAMPLES)))
    v, u = np.mgrid[:height:stride, :width:stride].reshape(2, -1)
    rays, pixels, weights = [], [], []
    for k in range(count):
        x_in_camera = apply(inverse(recon_from_camera[k]), points_in_recon[k, v, u])
        known = (confidence[k, v, u] > 0) & (x_in_camera[:, 2] > 0)
        rays.append(x_in_camera[known, :2] / x_in_camera[known, 2:])
        pixels.append(np.stack([u, v], -1)[known])
        weights.append(confidence[k, v, u][known])
    ray, pixel, prior = (np.concatenate(parts) for parts in (rays, pixels, weights))
    if len(ray) < max(100, 0.5 * (confidence[:, v, u] > 0).sum()):
        guess = Intrinsics(float(width), float(width), (width - 1) / 2, (height - 1) / 2, width, height)
        return guess, float("inf")
    focal, center = np.empty(2), np.empty(2)
    misfit = np.zeros_like(ray)
    for _ in range(5):
        scale = np.median(np.linalg.norm(misfit, axis=1)) + 1e-6
        weight = prior / (1 + (misfit**2).sum(1) / (2 * scale) ** 2) ** 2
        for axis in range(2):
            mean_ray, mean_px = (np.average(values[:, axis], weights=weight) for values in (ray, pixel))
            centred = ray[:, axis] - mean_ray
            focal[axis] = (weight * centred) @ pixel[:, axis] / ((weight * centred) @ centred)
            center[axis] = mean_px - focal[axis] * mean_ray
        misfit = ray * focal + center - pixel
    (fx, fy), (cx, cy) = focal.tolist(), center.tolist()
    error = float("inf") if min(fx, fy) <= 0 else float(np.median(np.linalg.norm(misfit, axis=1)))
    return Intrinsics(fx, fy, cx, cy, width, height), error
