"""The DUSt3R and MASt3R back ends: pairs of images, global alignment, correspondences."""

from dataclasses import dataclass, field

import numpy as np

from jcr.errors import RejectedError
from jcr.memory import give_back, resident
from jcr.progress import Progress
from jcr.reconstruct.dust3r.pair_graph import PairOptions
from jcr.reconstruct.dust3r.predictor import predict_pairs
from jcr.reconstruct.dust3r.weights import load_weights
from jcr.reconstruct.from_pairs import reconstruction_from_pairs
from jcr.reconstruct.global_alignment.alignment import AlignOptions
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.reconstruct.hub import Weights
from jcr.reconstruct.preprocess import PreparedImages, image_grid, prepare_images
from jcr.records import Capture, Reconstruction


@dataclass(frozen=True, kw_only=True)
class Dust3rOptions:
    """Pairwise pointmaps of a network, aligned."""

    weights: Weights
    device: str = "cpu"
    """Where the network runs: cpu or cuda."""
    pairs: PairOptions = field(default_factory=PairOptions)
    backend: str = "dust3r"
    """Its row of the table of back ends."""


def predict(
    capture: Capture, options: Dust3rOptions, progress: Progress | None = None, *, aligned: bool = False
) -> tuple[PreparedImages, PairPredictions, tuple[str, ...]]:
    """The images as the network saw them, its pointmaps of pairs, and notes for the user.

    `aligned` says that alignment and map follow, within the same memory. Raises InputError for images or weights
    that cannot be used, or a memory budget that is too small.
    """
    program = resident()
    loaded = load_weights(options.weights, options.device)
    images = prepare_images(capture, lambda size: image_grid(size, options.pairs.image_size))
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
    return images, predictions, (options.weights.note, *notes)


def reconstruct_dust3r(
    capture: Capture, options: Dust3rOptions, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses, pointmaps and tracks of a capture, up to one similarity, or in metres with MASt3R.

    Raises InputError as `predict` does.
    """
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
            AlignOptions(),
            backend=options.backend,
            notes=notes,
            progress=progress,
        )
    except RejectedError as error:  # what was used, and its licence, are worth knowing all the same
        raise error.with_more(*notes) from None
