"""The DUSt3R and MASt3R back ends: prediction of pairwise pointmaps, global alignment, refinement by matches."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from numpy import ndarray

from jcr.allocator import give_back
from jcr.errors import InputError, RejectedError
from jcr.hub import Weights
from jcr.pointmaps.dust3r.network import Dust3r, EncodedImages
from jcr.pointmaps.dust3r.pair_graph import pairs_to_predict
from jcr.pointmaps.dust3r.weights import load_weights
from jcr.pointmaps.grid import PreparedImages, prepare_images
from jcr.pointmaps.pairs import PairPredictions
from jcr.pointmaps.reconstruction import align_pairs, reconstruct_pointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction

MAX_BATCH = {"cpu": 1, "cuda": 16}
"""Number of pairs in a batch, by device. A CPU gains nothing from more: one pair of 768 tokens keeps its cores busy."""


def reconstruct_dust3r(
    capture: Capture,
    weights: Weights,
    device: str,
    backend: str,
    progress: Progress | None = None,
) -> Reconstruction:
    """Return camera poses and pointmaps of a capture, in metres with MASt3R and in an arbitrary unit with DUSt3R.

    Raises InputError for images or weights that cannot be used.
    """
    network = load_weights(weights, device)
    images = prepare_images(capture)
    edges = pairs_to_predict(capture.base_from_gripper)
    predictions, notes = predict_pairs(network, images, capture.images, edges, progress)
    del network
    give_back()  # the memory of the network
    notes = (weights.note, *notes)
    try:
        maps = align_pairs(predictions, images, progress)
        maps = replace(maps, notes=(*notes, *maps.notes))
        return reconstruct_pointmaps(capture, images, maps, backend, progress)
    except RejectedError as error:  # a rejection also names the weights and their licence
        raise error.with_more(*notes) from None


def predict_pairs(
    network: Dust3r,
    images: PreparedImages,
    names: tuple[str, ...],
    edges: Int[ndarray, "e 2"],
    progress: Progress | None = None,
) -> tuple[PairPredictions, tuple[str, ...]]:
    """Predict the pointmaps of the ordered image pairs `edges`; return them with notes for the user.

    The encoder runs once per image, and the decoder once per pair. The batch is halved when CUDA runs out of memory;
    InputError is raised when one pair does not fit.
    """
    report = progress or silent
    features, sizes = dict[int, EncodedImages](), [MAX_BATCH[network.device.type]]
    height, width = images.colors.shape[1:3]
    arrays = [np.empty((len(edges), height, width, *point), np.float32) for point in ((3,), ()) * 2]

    def encode(rows: Int[ndarray, " b"]) -> None:
        colors = torch.from_numpy(images.colors[rows]).to(network.device).permute(0, 3, 1, 2)
        tokens, grid = network.encode((colors / 255 - 0.5) / 0.5)
        features.update(
            (row, EncodedImages(own[None], grid)) for row, own in zip(rows.tolist(), tokens, strict=True)
        )

    def decode(rows: Int[ndarray, " b"]) -> None:
        first, second = (
            EncodedImages(torch.cat([features[row].tokens for row in side]), features[side[0]].grid)
            for side in edges[rows].T.tolist()
        )
        view1, view2 = network.decode(first, second)
        for array, values in zip(arrays, (*view1, *view2), strict=True):
            array[rows] = values.cpu().numpy()

    _in_batches(encode, len(images.colors), sizes, lambda share: report("encode images", share))
    _in_batches(decode, len(edges), sizes, lambda share: report("predict pairs", share))
    notes = tuple(f"out of memory on the {network.device}: {size} pairs at a time" for size in sizes[1:])
    pts3d, conf, pts3d_in_other_view, conf2 = arrays
    predictions = PairPredictions(
        edges=edges,
        pts3d=pts3d,
        conf=conf,
        pts3d_in_other_view=pts3d_in_other_view,
        conf2=conf2,
        images=names,
        colors=images.colors,
        intrinsics=images.intrinsics,
        grid=images.grid,
        is_metric=network.is_metric,
    )
    return predictions, notes


def _in_batches(
    work: Callable[[Int[ndarray, " b"]], None],
    count: int,
    sizes: list[int],
    report: Callable[[float], None],
) -> None:
    """Call `work` on the row numbers below `count`, in batches of the last size in `sizes`.

    When memory runs out, half of this size is appended to `sizes`, and the batch is repeated.
    """
    done = 0
    while done < count:
        rows = np.arange(done, min(done + sizes[-1], count))
        try:
            with torch.inference_mode():
                work(rows)
            done += len(rows)
            report(done / count)
            continue
        except torch.cuda.OutOfMemoryError:
            sizes.append(sizes[-1] // 2)
        # Outside of the except clause, whose traceback keeps the tensors of the failed batch alive.
        torch.cuda.empty_cache()
        if sizes[-1] == 0:
            raise InputError(
                "out of memory with one pair of images; close other programs, or use --device cpu"
            )
