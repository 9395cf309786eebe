"""The DUSt3R and MASt3R back ends: pairs of images, global alignment, correspondences."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import NotTrustedError
from jcr.memory import give_back, resident
from jcr.progress import Progress, silent
from jcr.reconstruct.checkpoints import CHECKPOINTS
from jcr.reconstruct.dust3r.predict import predict_pairs
from jcr.reconstruct.dust3r.weights import load_weights
from jcr.reconstruct.global_alignment.alignment import AlignOptions
from jcr.reconstruct.global_alignment.pairs import PairOptions, PairPredictions
from jcr.reconstruct.global_alignment.with_robot import align_with_robot
from jcr.reconstruct.pointmap_matches import tracks_from_pairs
from jcr.reconstruct.preprocess import (
    ImageGrid,
    PreparedImages,
    cover_grid,
    image_grid,
    prepare_images,
)
from jcr.records import Capture, Intrinsics, Reconstruction


@dataclass(frozen=True)
class Dust3rOptions:
    """Pairwise pointmaps of a network, aligned."""

    model: Literal["compact", "dust3r", "mast3r"] = "dust3r"
    weights: str | None = None
    """File, folder or hub id; unset: the published ones of the model."""
    device: str = "cpu"
    """Where the network runs: cpu or cuda."""
    pairs: PairOptions = field(default_factory=PairOptions)
    align: AlignOptions = field(default_factory=AlignOptions)


def predict(
    capture: Capture, options: Dust3rOptions, progress: Progress | None = None, *, aligned: bool = False
) -> tuple[PreparedImages, PairPredictions, tuple[str, ...]]:
    """The images as the network saw them, its pointmaps of pairs, and notes for the user.

    `aligned` says that alignment and map follow, within the same memory. Raises InputError for images or weights
    that cannot be used, or a memory budget that is too small.
    """
    program = resident()
    loaded = load_weights(options.weights or CHECKPOINTS[options.model].hub_id, options.device)
    size = options.pairs.image_size

    def grid(original: tuple[int, int]) -> ImageGrid:
        return cover_grid(original, loaded.size) if loaded.size else image_grid(original, size)

    images = prepare_images(capture, grid)
    predictions, notes = predict_pairs(
        loaded,
        images,
        capture.images,
        capture.base_from_gripper,
        options.pairs,
        progress,
        program=program,
        aligned=aligned,
    )
    return images, predictions, (f"weights {loaded.source}: licence {loaded.licence}", *notes)


def reconstruct(
    capture: Capture, options: Dust3rOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses, pointmaps and tracks of a capture, up to one similarity, or in metres with MASt3R.

    Raises InputError as `predict` does.
    """
    options = options or Dust3rOptions()
    images, predictions, notes = predict(capture, options, progress, aligned=True)
    give_back()  # the network
    rows = np.arange(len(capture))
    poses = capture.base_from_gripper
    try:
        return reconstruction_from_pairs(
            images,
            rows,
            predictions,
            poses,
            options.align,
            backend=options.model,
            notes=notes,
            progress=progress,
        )
    except NotTrustedError as error:  # what was used, and its licence, are worth knowing all the same
        raise NotTrustedError("; ".join([str(error), *notes])) from None


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
        intrinsics=images.lens or images.grid.original_intrinsics(pinhole),
        pointmap_intrinsics=pinhole,
        points_in_recon=points_in_recon,
        confidence=alignment.confidence,
        colors=images.colors,
        tracks=tracks,
        backend=backend,
        is_metric=predictions.is_metric,
        notes=(*images.notes, *notes, *alignment.notes),
        evidence=aligned.evidence,
    )
