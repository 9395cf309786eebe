"""From pairwise pointmaps, whoever predicted them, to camera poses, pointmaps in one frame and tracks."""

from dataclasses import replace

from jaxtyping import Float, Int
from numpy import ndarray

from jcr.memory import MAP
from jcr.progress import Progress, silent
from jcr.reconstruct.global_alignment.align import align_with_robot
from jcr.reconstruct.global_alignment.alignment import AlignOptions
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.reconstruct.pointmap_matches import tracks_from_pairs
from jcr.reconstruct.preprocess import PreparedImages
from jcr.records import Intrinsics, Pointmaps, Reconstruction

OBSERVED, RECORDED = 80, 60
"""Bytes per pixel, when the network has gone: of a pointmap in alignment, and of an image in the reconstruction."""


def memory_after(images: int, pairs: int, pixels: int) -> int:
    """Bytes that aligning, matching and mapping pairs of `pixels` pixels take beside their pointmaps."""
    observed = min(AlignOptions.pixels, pixels)
    return max(MAP, 2 * pairs * observed * OBSERVED) + images * pixels * RECORDED


def reconstruction_from_pairs(
    images: PreparedImages,
    image_index: Int[ndarray, " m"],
    predictions: PairPredictions,
    base_from_gripper: Float[ndarray, "m 4 4"],
    options: AlignOptions,
    *,
    backend: str,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Reconstruction:
    """Align pairwise pointmaps and match them; `images` says where their pixels lie in the capture."""
    report = progress or silent
    aligned = align_with_robot(
        replace(predictions, intrinsics=images.intrinsics), base_from_gripper, options, progress
    )
    alignment = aligned.alignment
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
        evidence=aligned.evidence,
    )
