"""Reconstruction from pairwise pointmaps: global alignment, then tracks by reciprocal nearest neighbours."""

from dataclasses import replace

from jaxtyping import Int
from numpy import ndarray

from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.global_alignment.alignment import AlignOptions
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pairs import PairPredictions
from jcr.pointmaps.pointmap_matches import tracks_from_pairs
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Intrinsics, Pointmaps, Reconstruction


def reconstruction_from_pairs(
    images: PreparedImages,
    image_index: Int[ndarray, " m"],
    predictions: PairPredictions,
    options: AlignOptions | None = None,
    *,
    backend: str,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Reconstruction:
    """Align pairwise pointmaps and match them; `images` maps their pixels to the capture's images."""
    report = progress or silent
    alignment = global_align(replace(predictions, intrinsics=images.intrinsics), options, progress)
    height, width = predictions.conf.shape[1:]
    fx, fy = alignment.focal_px.mean(0).tolist()
    cx, cy = alignment.principal_point_px
    pinhole = images.intrinsics or Intrinsics(fx, fy, cx, cy, width, height)
    points_in_recon = alignment.points_in_recon()
    report("match pairs", 0.0)
    tracks = tracks_from_pairs(predictions, points_in_recon, images.original_px)
    report("match pairs", 1.0)
    return Reconstruction(
        image_index=image_index,
        recon_from_camera=alignment.recon_from_camera,
        intrinsics=images.intrinsics_of_capture or images.grid.original_intrinsics(pinhole),
        pointmaps=Pointmaps(
            intrinsics=pinhole,
            points_in_recon=points_in_recon,
            confidence=alignment.confidence,
            colors=images.colors,
        ),
        tracks=tracks,
        backend=backend,
        is_metric=predictions.is_metric,
        notes=(*notes, *alignment.notes),
        warnings=(*images.warnings, *alignment.warnings),
        evidence=CameraEvidence(alignment.recon_from_camera, alignment.covariance),
    )
