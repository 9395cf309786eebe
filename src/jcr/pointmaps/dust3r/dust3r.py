"""The DUSt3R and MASt3R back ends: pairwise pointmaps, global alignment, refinement."""

from dataclasses import replace

from jcr.allocator import give_back
from jcr.errors import RejectedError
from jcr.hub import Weights
from jcr.pointmaps.dust3r.pair_graph import PairGraph
from jcr.pointmaps.dust3r.predictor import predict_pairs
from jcr.pointmaps.dust3r.weights import load_weights
from jcr.pointmaps.grid import prepare_images
from jcr.pointmaps.reconstruction import align_pairs, reconstruct_pointmaps
from jcr.progress import Progress
from jcr.records import Capture, Reconstruction


def reconstruct_dust3r(
    capture: Capture,
    weights: Weights,
    device: str,
    pair_graph: PairGraph,
    backend: str,
    progress: Progress | None = None,
) -> Reconstruction:
    """Return camera poses and pointmaps of a capture, up to one similarity, or in metres with MASt3R.

    Raises InputError for images or weights that cannot be used.
    """
    loaded = load_weights(weights, device)
    images = prepare_images(capture)
    predictions, notes = predict_pairs(
        loaded, images, capture.images, capture.base_from_gripper, pair_graph, progress
    )
    del loaded
    give_back()  # the network's memory
    notes = (weights.note, *notes)
    try:
        maps = align_pairs(predictions, images, progress)
        maps = replace(maps, notes=(*notes, *maps.notes))
        return reconstruct_pointmaps(capture, images, maps, backend, progress)
    except RejectedError as error:  # the weights and their licence belong to a rejection, too
        raise error.with_more(*notes) from None
