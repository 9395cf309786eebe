"""The DUSt3R and MASt3R back ends: published weights, pairwise pointmaps, global alignment, refinement by matches."""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from jcr.errors import InputError, RejectedError
from jcr.estimation.closed_form import motions
from jcr.features.pair_choice import NEIGHBOURS, near_pairs
from jcr.hub import HUB_FILES, Weights
from jcr.memory import give_back
from jcr.pointmaps.dust3r.network import Dust3r, EncodedImages
from jcr.pointmaps.image_grid import PreparedImages, prepare_images
from jcr.pointmaps.pair_predictions import PairPredictions, complete_pairs, window_pairs
from jcr.pointmaps.reconstruction import align_pairs, reconstruct_pointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction

MAX_BATCH = {"cpu": 1, "cuda": 16}
"""Number of pairs in a batch, by device. A CPU gains nothing from more: one pair of 768 tokens keeps its cores busy."""
FEW_IMAGES = 12
"""Largest number of images for which every pair is predicted (132 ordered pairs)."""
_ANNOUNCED = set[str]()
"""Notes about source and licence of weights that this process has printed."""


def reconstruct_dust3r(
    capture: Capture, weights: Weights, device: str, backend: str, progress: Progress = silent
) -> Reconstruction:
    """Return camera poses and pointmaps of a capture, in metres with MASt3R and in an arbitrary unit with DUSt3R.

    `weights` decide which of both networks runs, on the torch device `device`. Raises InputError for images or weights
    that cannot be used.
    """
    edges = pairs_to_predict(capture.base_from_gripper)
    predictions, images, notes = predict_capture(capture, edges, weights, device, progress)
    try:
        maps = align_pairs(predictions, images, progress)
        maps = replace(maps, notes=(*notes, *maps.notes))
        return reconstruct_pointmaps(capture, images, maps, backend, progress)
    except RejectedError as error:  # a rejection also names the weights and their licence
        raise error.with_more(*notes) from None


def predict_capture(
    capture: Capture,
    edges: Int[ndarray, "e 2"],
    weights: Weights,
    device: str,
    progress: Progress = silent,
) -> tuple[PairPredictions, PreparedImages, tuple[str, ...]]:
    """Predict the pointmaps of the pairs `edges` of a capture's images (rows); return them, the images and notes.

    The notes name the weights and their licence. Raises InputError for images or weights that cannot be used.
    """
    network = load_weights(weights, device)
    images = prepare_images(capture)
    predictions, notes = predict_pairs(network, images, capture.images, edges, progress)
    del network
    give_back()  # the memory of the network
    return predictions, images, (weights.note, *notes)


def pairs_to_predict(base_from_gripper: Float[ndarray, "n 4 4"]) -> Int[ndarray, "e 2"]:
    """Return the pairs of images (rows) to predict, in both orders: all pairs of up to FEW_IMAGES images.

    With more images, these are the pairs of near viewpoints (`near_pairs`), and of images next to each other in the
    capture. The latter connect separate groups of viewpoints.
    """
    count = len(base_from_gripper)
    if count <= FEW_IMAGES:
        return complete_pairs(count)
    near = np.reshape(near_pairs(motions(base_from_gripper), NEIGHBOURS), (-1, 2))[:, ::-1]
    edges = np.unique(np.concatenate([near, window_pairs(count, 1)[: count - 1]]), axis=0)
    return np.concatenate([edges, edges[:, ::-1]])


def predict_pairs(
    network: Dust3r,
    images: PreparedImages,
    names: tuple[str, ...],
    edges: Int[ndarray, "e 2"],
    progress: Progress = silent,
) -> tuple[PairPredictions, tuple[str, ...]]:
    """Predict the pointmaps of the ordered image pairs `edges`; return them with notes for the user.

    A row of `edges` has the first and the second image of a pair, as rows of `images`; `names` are the names of the
    images. The encoder runs once per image, and the decoder once per pair. The batch is halved when CUDA runs out of
    memory; InputError is raised when one pair does not fit.
    """
    features, sizes = dict[int, EncodedImages](), [MAX_BATCH[network.device.type]]
    height, width = images.colors.shape[1:3]
    arrays = [np.empty((len(edges), height, width, *point), np.float32) for point in ((3,), ()) * 2]

    def encode(rows: Int[ndarray, " b"]) -> None:
        colors = torch.from_numpy(images.colors[rows]).to(network.device).permute(0, 3, 1, 2)
        tokens, grid = network.encode((colors / 255 - 0.5) / 0.5)
        features.update((k, EncodedImages(t[None], grid)) for k, t in zip(rows.tolist(), tokens, strict=True))

    def decode(rows: Int[ndarray, " b"]) -> None:
        first, second = (
            EncodedImages(torch.cat([features[row].tokens for row in side]), features[side[0]].grid)
            for side in edges[rows].T.tolist()
        )
        view1, view2 = network.decode(first, second)
        for array, values in zip(arrays, (*view1, *view2), strict=True):
            array[rows] = values.cpu().numpy()

    _in_batches(encode, len(images.colors), sizes, lambda share: progress("encode images", share))
    _in_batches(decode, len(edges), sizes, lambda share: progress("predict pairs", share))
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
    work: Callable[[Int[ndarray, " b"]], None], count: int, sizes: list[int], report: Callable[[float], None]
) -> None:
    """Call `work` on batches of the integers 0 to `count` − 1; the batch size is the last number in `sizes`.

    When CUDA runs out of memory, half of this size is appended to `sizes`, and the batch is repeated.
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
            raise InputError("out of memory with one pair; close other programs, or choose device cpu")


def load_weights(weights: Weights, device: str = "cpu") -> Dust3r:
    """Load a network from a folder, or from a .safetensors file next to its config.json, onto a torch device.

    The licence is printed on stderr. Raises InputError for files that are missing, damaged or of another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    path = weights.path
    tensors = path / HUB_FILES[1] if path.is_dir() else path
    config_path = tensors.with_name(HUB_FILES[0])
    if tensors.suffix != ".safetensors" or not (tensors.is_file() and config_path.is_file()):
        raise InputError(
            f"{path}: no such weights; give a folder of {' and '.join(HUB_FILES)}, or a hub id (jcr models)"
        )
    try:
        config, state = dict(json.loads(config_path.read_text("utf-8"))), load_file(tensors)
    except (SafetensorError, OSError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged ({_line(error)}); fetch it again") from None
    # MASt3R is this network with a further head for matching, which is not used; its points are metric.
    mast3r = [key for key in state if ".head_local_features." in key]
    network = _build(config, {key: state[key] for key in state if key not in mast3r}, path)
    network.is_metric = bool(mast3r)
    try:
        # Channels last: the heads' convolutions take 0.94 s instead of 1.32 s on two cores at 512x384.
        network = network.to(torch.device(device)).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"device {device}: {_line(error)}; choose device cpu") from None
    if weights.note not in _ANNOUNCED:
        _ANNOUNCED.add(weights.note)
        sys.stderr.write(f"{weights.note}\n")
    return network


def _build(config: dict[str, object], state: dict[str, Tensor], path: Path) -> Dust3r:
    """Return the network of a configuration with the weights `state`; raise InputError for `path` if they do not fit."""
    mast3r_only = ("two_confs", "desc_conf_mode", "desc_mode", "local_feat_dim")
    config = {key: value for key, value in config.items() if key not in mast3r_only}
    config["head_type"] = str(config.get("head_type", "linear")).removeprefix("catmlp+")
    config["output_mode"] = str(config.get("output_mode", "pts3d")).partition("+")[0]
    try:
        with torch.device("meta"):
            network = Dust3r(**config)
    except (TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        raise InputError(f"{path}: its configuration is not of this network ({_line(error)})") from None
    # Checkpoints may hold a tensor with two names under one of them.
    for key in network.state_dict():
        twin = re.sub(r"\.layer_rn\.(\d)\.", lambda level: f".layer{int(level[1]) + 1}_rn.", key)
        present = state.get(twin, state.get(key))
        if present is not None and twin != key:
            state |= {key: present, twin: present}
    try:
        network.load_state_dict({key: tensor.float() for key, tensor in state.items()}, assign=True)
    except (RuntimeError, AttributeError) as error:
        raise InputError(f"{path}: its tensors are not those of its configuration ({_line(error)})") from None
    return network.eval().requires_grad_(False)


def _line(error: BaseException) -> str:
    """Return the first sentence of an error's message, on one line; the name of its type if the message is empty."""
    return " ".join(str(error).split()).split(". ")[0][:160] or type(error).__name__
