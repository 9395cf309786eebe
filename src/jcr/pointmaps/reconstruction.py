"""Reconstruction from pointmaps: bundle adjustment of matches where the images match, else the predicted cameras."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.camera import without_distortion
from jcr.errors import InputError
from jcr.geometry import apply
from jcr.pointmaps.global_alignment.align import PIXELS, global_align
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pairs import PairPredictions
from jcr.pointmaps.posed import FOCAL_STD, PosedPointmaps, fit_pinhole, published_covariance
from jcr.pointmaps.refine import refine
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, Pointmaps, Reconstruction, Tracks

NO_TRACKS = Tracks(
    image=np.zeros(0, int), x_px=np.zeros((0, 2)), point=np.zeros(0, int), points_in_recon=np.zeros((0, 3))
)

UNCONFIRMED = (
    f"the focal length is that of the network and known to {100 * FOCAL_STD:.0f} % only, for too few matches between "
    "the images confirm it; give the intrinsics"
)


def align_pairs(
    predictions: PairPredictions,
    images: PreparedImages,
    progress: Progress | None = None,
    pixels: int = PIXELS,
) -> PosedPointmaps:
    """Return pointmaps and camera poses in one frame, from pairwise pointmaps by global alignment.

    The focal length is estimated from the pointmaps, even if the intrinsics are known: with another focal length the
    pointmaps do not fit each other, and the cameras move. `pixels` is the number of pixels used per image.
    """
    alignment = global_align(replace(predictions, intrinsics=images.intrinsics), pixels, progress)
    return PosedPointmaps(
        grid=images.grid,
        recon_from_camera=alignment.recon_from_camera,
        x_in_camera=alignment.x_in_camera(),
        confidence=alignment.confidence,
        is_metric=predictions.is_metric,
        covariance=alignment.covariance,
        notes=alignment.notes,
        warnings=alignment.warnings,
    )


def reconstruct_pointmaps(
    capture: Capture,
    images: PreparedImages,
    maps: PosedPointmaps,
    backend: str,
    progress: Progress | None = None,
    image_index: Int[ndarray, " m"] | None = None,
) -> Reconstruction:
    """Return the reconstruction of the capture's images `image_index` (None: all) from their pointmaps and matches.

    `images` has colours on the grid of `maps`. Raises InputError where the points fit no pinhole camera.
    """
    report = progress or silent
    rows = np.arange(len(capture)) if image_index is None else image_index
    part = capture.of_rows(rows)
    found, misfit_px = fit_pinhole(maps)
    predicted = maps.grid.original_intrinsics(found) if np.isfinite(misfit_px) else None
    if (pinhole := images.pinhole or predicted) is None:
        raise InputError(f"--backend {backend}: its points lie on no pinhole's rays; give the intrinsics")
    maps = maps.on_rays(maps.grid.grid_intrinsics(pinhole))
    refined = refine(part, images, maps, pinhole, report)
    if refined is None:
        intrinsics = images.intrinsics_of_capture or pinhole
        covariance = published_covariance(maps) if maps.covariance is None else maps.covariance
        tracks, evidence = NO_TRACKS, CameraEvidence(maps.recon_from_camera, covariance)
        note = "too few matches between the images: the cameras are as predicted"
        if images.pinhole is None:
            maps = replace(maps, warnings=(*maps.warnings, UNCONFIRMED))
    else:
        (made, maps), evidence = refined, None
        tracks, intrinsics = made.tracks, made.intrinsics
        pinhole = images.pinhole or without_distortion(intrinsics)
        maps = maps.on_rays(maps.grid.grid_intrinsics(pinhole))
        note = f"cameras refined by {len(tracks.image)} matches"
    points = np.stack([apply(*each) for each in zip(maps.recon_from_camera, maps.x_in_camera, strict=True)])
    pointmaps = Pointmaps(
        intrinsics=maps.grid.grid_intrinsics(pinhole),
        points_in_recon=np.where((maps.confidence > 0)[..., None], points, 0).astype(np.float32),
        confidence=maps.confidence,
        colors=images.colors,
    )
    return Reconstruction(
        image_index=rows,
        recon_from_camera=maps.recon_from_camera,
        intrinsics=intrinsics,
        pointmaps=pointmaps,
        tracks=tracks,
        backend=backend,
        is_metric=maps.is_metric,
        notes=(*maps.notes, note),
        warnings=(*images.warnings, *maps.warnings),
        evidence=evidence,
        predicted_focal=None if refined or predicted is None else (predicted.fx, FOCAL_STD),
    )
