"""The DUSt3R and MASt3R back ends: pairwise pointmaps, global alignment, tracks."""

from dataclasses import dataclass

from jcr.allocator import give_back
from jcr.errors import RejectedError
from jcr.hub import Weights
from jcr.pointmaps.dust3r.pair_graph import PairGraph
from jcr.pointmaps.dust3r.predictor import predict_pairs
from jcr.pointmaps.dust3r.weights import load_weights
from jcr.pointmaps.grid import PreparedImages, prepare_images
from jcr.pointmaps.pairs import PairPredictions
from jcr.pointmaps.reconstruction import PredictionSource, align_pairs, reconstruct_pointmaps
from jcr.progress import Progress
from jcr.records import Capture, Reconstruction


@dataclass(frozen=True, kw_only=True)
class Dust3rOptions:
    """Options of the DUSt3R and MASt3R back ends."""

    weights: Weights
    device: str = "cpu"
    """Device of the network: cpu or cuda."""
    pair_graph: PairGraph = "auto"
    backend: str = "dust3r"
    """Name of the row in the table of back ends."""


def predict(
    capture: Capture, options: Dust3rOptions, progress: Progress | None = None
) -> tuple[PreparedImages, PairPredictions, tuple[str, ...]]:
    """Return the images as the network sees them, its pairwise pointmaps, and notes for the user.

    Raises InputError for images or weights that cannot be used.
    """
    loaded = load_weights(options.weights, options.device)
    images = prepare_images(capture)
    predictions, notes = predict_pairs(
        loaded, images, capture.images, capture.base_from_gripper, options.pair_graph, progress
    )
    return images, predictions, (options.weights.note, *notes)


def reconstruct_dust3r(
    capture: Capture, options: Dust3rOptions, progress: Progress | None = None
) -> Reconstruction:
    """Return camera poses, pointmaps and tracks of a capture, up to one similarity, or in metres with MASt3R.

    Raises InputError as `predict` does.
    """
    images, predictions, notes = predict(capture, options, progress)
    give_back()  # the network's memory
    try:
        maps, source = align_pairs(
            predictions, images, PredictionSource(backend=options.backend, notes=notes), progress
        )
        return reconstruct_pointmaps(capture, images, maps, source, progress)
    except RejectedError as error:  # the weights and their licence belong to a rejection, too
        raise error.with_more(*notes) from None
