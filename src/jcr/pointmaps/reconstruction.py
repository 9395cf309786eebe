"""Reconstruction from pointmaps, whoever predicted them: refined by matches of the images, or as predicted.

A prediction is no measurement: networks invent geometry where they see none, and their metre on a table is often
wrong by tens of percent. The pointmaps therefore are an initial estimate, and their confidences weigh points within
an image and nothing else. Where the images match, bundle adjustment of the matches gives the cameras with their
covariance, corrected depth and tracks (refine.py). The robot gives the scale; the metre of a metric network is only
compared.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.hand_eye import solve_hand_eye
from jcr.geometry import apply
from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.global_alignment.alignment import AlignOptions
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pairs import PairPredictions
from jcr.pointmaps.posed import PosedPointmaps, fit_pinhole
from jcr.pointmaps.refine import Refinement, refine
from jcr.progress import Progress, silent
from jcr.records import Capture, HandEye, Intrinsics, Pointmaps, Reconstruction, Tracks

NO_TRACKS = Tracks(
    image=np.zeros(0, int), x_px=np.zeros((0, 2)), point=np.zeros(0, int), points_in_recon=np.zeros((0, 3))
)


@dataclass(frozen=True, kw_only=True)
class PredictionSource:
    """Origin of pointmaps, for the record of the reconstruction."""

    backend: str
    """Name of the row in the table of back ends."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def align_pairs(
    predictions: PairPredictions,
    images: PreparedImages,
    source: PredictionSource,
    progress: Progress | None = None,
    options: AlignOptions | None = None,
) -> tuple[PosedPointmaps, PredictionSource]:
    """Align pairwise pointmaps; return them with the notes and warnings of the alignment."""
    alignment = global_align(replace(predictions, intrinsics=images.intrinsics), options, progress)
    maps = PosedPointmaps(
        grid=images.grid,
        recon_from_camera=alignment.recon_from_camera,
        x_in_camera=alignment.x_in_camera(),
        confidence=alignment.confidence,
        is_metric=predictions.is_metric,
        covariance=alignment.covariance,
    )
    return maps, replace(
        source,
        notes=(*source.notes, *alignment.notes),
        warnings=(*source.warnings, *alignment.warnings),
    )


def reconstruct_pointmaps(
    capture: Capture,
    images: PreparedImages,
    maps: PosedPointmaps,
    source: PredictionSource,
    progress: Progress | None = None,
    image_index: Int[ndarray, " m"] | None = None,
) -> Reconstruction:
    """Return the reconstruction of the images `image_index` (None: all) from their pointmaps.

    The refined cameras are used, or the predicted ones where these have the smaller leave-one-out error, or where too
    few matches are found. `images` has colours on the grid of `maps`. Raises InputError where the points lie on no
    pinhole's rays.
    """
    report = progress or silent
    rows = np.arange(len(capture)) if image_index is None else image_index
    part = replace(
        capture,
        images=tuple(capture.images[row] for row in rows),
        base_from_gripper=capture.base_from_gripper[rows],
    )
    pinhole = images.pinhole or _own_pinhole(maps, source.backend)
    maps = maps.on_rays(maps.grid.grid_intrinsics(pinhole))
    report("refine cameras", 0.0)
    refined = refine(part, images, maps, pinhole)
    report("refine cameras", 1.0)
    use_refined, note = _select(part.base_from_gripper, maps, refined)
    if refined is not None and use_refined:
        pinhole, tracks = refined.pinhole, refined.tracks
        maps = replace(
            maps,
            recon_from_camera=refined.recon_from_camera,
            x_in_camera=maps.x_in_camera * refined.depth_factor[..., None],
            covariance=refined.covariance,
        ).on_rays(maps.grid.grid_intrinsics(pinhole))
    else:
        tracks = NO_TRACKS
    return Reconstruction(
        image_index=rows,
        recon_from_camera=maps.recon_from_camera,
        intrinsics=images.intrinsics_of_capture or pinhole,
        pointmaps=_pointmaps(maps, images, pinhole),
        tracks=tracks,
        backend=source.backend,
        is_metric=maps.is_metric,
        notes=(*source.notes, note),
        warnings=(*images.warnings, *source.warnings),
        evidence=maps.evidence(),
    )


def _pointmaps(maps: PosedPointmaps, images: PreparedImages, pinhole: Intrinsics) -> Pointmaps:
    """Return the record of the pointmaps in the reconstruction's frame."""
    points = np.stack([apply(*each) for each in zip(maps.recon_from_camera, maps.x_in_camera, strict=True)])
    known = (maps.confidence > 0)[..., None]
    return Pointmaps(
        intrinsics=maps.grid.grid_intrinsics(pinhole),
        points_in_recon=np.where(known, points, 0).astype(np.float32),
        confidence=maps.confidence,
        colors=images.colors,
    )


def _own_pinhole(maps: PosedPointmaps, backend: str) -> Intrinsics:
    """Return one pinhole of the undistorted images that fits the points of all images."""
    found, misfit_px = fit_pinhole(maps)
    if not np.isfinite(misfit_px):
        raise InputError(f"--backend {backend}: its points lie on no pinhole's rays; give the intrinsics")
    return maps.grid.original_intrinsics(found)


def _select(
    gripper: Float[ndarray, "n 4 4"], maps: PosedPointmaps, refined: Refinement | None
) -> tuple[bool, str]:
    """Return whether the refined cameras have the smaller leave-one-out error, and a note with both errors."""
    if refined is None:
        return False, "too few matches between the images: the cameras are as predicted"
    predicted, adjusted = (
        solve_hand_eye(gripper, cameras.recon_from_camera, camera_covariance=cameras.covariance)
        for cameras in (maps, refined)
    )
    better = _error_m(adjusted) <= _error_m(predicted)
    note = (
        f"leave-one-out error of the cameras {_words(adjusted)} refined, {_words(predicted)} as predicted: the "
        f"{'former' if better else 'latter'} were kept; {len(refined.tracks.image)} matches, {refined.error_px:.2f} px"
    )
    return better, note


def _error_m(hand_eye: HandEye) -> float:
    """Return the leave-one-out error as one length; infinite where too few images are left."""
    return float("inf") if hand_eye.leave_one_out is None else hand_eye.leave_one_out.length_m


def _words(hand_eye: HandEye) -> str:
    """Return the leave-one-out error for a note."""
    error = hand_eye.leave_one_out
    return "unknown" if error is None else f"{error.translation_mm:.2g} mm, {error.rotation_deg:.2g}°"
