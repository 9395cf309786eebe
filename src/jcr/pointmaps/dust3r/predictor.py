"""Prediction of the pairwise pointmaps of a capture: one encoder pass per image, one decoder pass per ordered pair."""

import logging
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from jcr.errors import InputError
from jcr.pointmaps.dust3r.network import Features
from jcr.pointmaps.dust3r.pair_graph import PairGraph, pairs_of_graph
from jcr.pointmaps.dust3r.weights import LoadedNetwork
from jcr.pointmaps.grid import PreparedImages
from jcr.pointmaps.pairs import PairPredictions
from jcr.progress import Progress, silent

logger = logging.getLogger(__name__)

MAX_BATCH = {"cpu": 1, "cuda": 16}
"""Pairs at a time. More do not help a CPU, whose cores one pair of 768 tokens keeps busy."""


def predict_pairs(
    loaded: LoadedNetwork,
    images: PreparedImages,
    names: tuple[str, ...],
    base_from_gripper: Float[ndarray, "n 4 4"],
    pair_graph: PairGraph = "auto",
    progress: Progress | None = None,
) -> tuple[PairPredictions, tuple[str, ...]]:
    """Predict the pointmaps of the pairs of a capture's images, and return them with notes for the user.

    Where CUDA runs out of memory the batch is halved, then the CPU takes over. Raises InputError where the memory does
    not suffice for one pair.
    """
    predictor = _Predictor(loaded, images, names, progress or silent)
    return predictor.predict(pairs_of_graph(pair_graph, base_from_gripper)), predictor.notes


class _Predictor:
    """Encoded images, the size of a batch that fits the memory, and the device in use."""

    def __init__(
        self, loaded: LoadedNetwork, images: PreparedImages, names: tuple[str, ...], progress: Progress
    ) -> None:
        self.loaded, self.images, self.names, self.progress = loaded, images, names, progress
        self.network = loaded.network
        self.device = self.network.device
        self.batch = MAX_BATCH[self.device.type]
        self.features: dict[int, Features] = {}
        self.notes: tuple[str, ...] = ()

    def predict(self, edges: Int[ndarray, "e 2"]) -> PairPredictions:
        """Return the pointmaps of some pairs."""
        height, width = self.images.colors.shape[1:3]
        shapes = ((height, width, 3), (height, width)) * 2
        arrays = [np.empty((len(edges), *shape), np.float32) for shape in shapes]
        self._in_batches("encode images", np.arange(len(self.images.colors)), self._encode)
        self._in_batches(
            "predict pairs", np.arange(len(edges)), lambda rows: self._decode(rows, edges, arrays)
        )
        pts3d, conf, pts3d_in_other_view, conf2 = arrays
        return PairPredictions(
            edges=edges,
            pts3d=pts3d,
            conf=conf,
            pts3d_in_other_view=pts3d_in_other_view,
            conf2=conf2,
            images=self.names,
            colors=self.images.colors,
            intrinsics=self.images.intrinsics,
            grid=self.images.grid,
            is_metric=self.loaded.is_metric,
        )

    @torch.inference_mode()
    def _encode(self, rows: Int[ndarray, " b"]) -> None:
        """Encode some images and keep their features."""
        images = torch.from_numpy(self.images.colors[rows]).to(self.device).permute(0, 3, 1, 2)
        features = self.network.encode((images / 255 - 0.5) / 0.5, many_pairs=True)
        for k, row in enumerate(rows.tolist()):
            self.features[row] = _map_features(lambda x, k=k: x[k : k + 1], features)

    @torch.inference_mode()
    def _decode(self, rows: Int[ndarray, " b"], edges: Int[ndarray, "e 2"], arrays: list[ndarray]) -> None:
        """Decode some pairs into their rows of `arrays`."""
        first, second = (
            _map_features(
                lambda *x: torch.cat(x), *(self.features[image] for image in edges[rows, side].tolist())
            )
            for side in (0, 1)
        )
        view1, view2 = self.network.decode(first, second)
        for array, values in zip(arrays, (*view1, *view2), strict=True):
            array[rows] = values.cpu().numpy()

    def _in_batches(self, stage: str, rows: Int[ndarray, " r"], work: Callable[[ndarray], None]) -> None:
        """Call `work` with `rows` in batches as large as the memory allows."""
        done = 0
        while done < len(rows):
            part = rows[done : done + self.batch]
            try:
                work(part)
            except torch.cuda.OutOfMemoryError:
                fits = False
            else:
                fits = True
            if fits:
                done += len(part)
                self.progress(stage, done / len(rows))
            else:
                # Outside of the except clause, whose traceback keeps the tensors of the failed batch alive.
                self._reduce_memory()

    def _reduce_memory(self) -> None:
        """Halve the batch, or continue on the CPU; raise InputError where neither is possible."""
        if self.batch > 1:
            self.batch //= 2
            self._warn(f"out of memory on the {self.device}: going on with {self.batch} pairs at a time")
        elif self.device.type == "cuda":
            self._warn(f"one pair does not fit on the {self.device}: going on, slowly, on the CPU")
            self.device = torch.device("cpu")
            self.network.to(self.device)
            self.features = {row: _map_features(Tensor.cpu, x) for row, x in self.features.items()}
        else:
            raise InputError("out of memory with one pair of images; close other programs")
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _warn(self, note: str) -> None:
        """Log a note at once, for the work that follows takes longer, and keep it for the result."""
        logger.warning(note)
        self.notes += (note,)


def _map_features(function: Callable[..., Tensor], *features: Features) -> Features:
    """Return features whose tensors are `function` of the tensors of `features`."""

    def gathered(*parts: Tensor | None) -> Tensor | None:
        there = [part for part in parts if part is not None]
        return function(*there) if there else None

    finest1, finest2 = (gathered(*(f.finest[view] for f in features)) for view in (0, 1))
    return Features(function(*(f.tokens for f in features)), features[0].grid, (finest1, finest2))
