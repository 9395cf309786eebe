"""Pairwise pointmaps of a capture: an encoder per image, a decoder per ordered pair, a memory budget."""

import logging
import math
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from jcr.errors import InputError
from jcr.memory import ALLOWANCE, GB, announce, relieve, require, resident
from jcr.progress import Progress, silent
from jcr.reconstruct.dust3r.network import PATCH, DptHead, Dust3r, Features
from jcr.reconstruct.dust3r.pair_cache import PairCache, user_cache
from jcr.reconstruct.dust3r.pair_graph import (
    FEW_IMAGES,
    PairOptions,
    complete_pairs,
    overlapping_pairs,
    window_pairs,
)
from jcr.reconstruct.dust3r.weights import LoadedNetwork, fingerprint
from jcr.reconstruct.from_pairs import memory_after
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.reconstruct.preprocess import PreparedImages

logger = logging.getLogger(__name__)

MAX_BATCH = {"cpu": 1, "cuda": 16}
"""Pairs at a time. More do not help a CPU, whose cores one pair of 768 tokens keeps busy."""


@dataclass(frozen=True)
class MemoryEstimate:
    """Bytes that predicting pairs will take."""

    weights: int
    features: int
    """Bytes of the features of all images."""
    per_pair: int
    """Working memory of the decoder and heads, per pair of a batch."""
    pointmaps: int
    """Bytes of the pointmaps of all pairs, in main memory."""

    @property
    def one_pair(self) -> int:
        """With the network, on the device that computes."""
        return self.weights + self.features + self.per_pair


def estimate_memory(network: Dust3r, images: int, pairs: int, height: int, width: int) -> MemoryEstimate:
    """What predicting `pairs` pairs of `images` images of height x width pixels will take."""
    # In main memory the convolutions are there twice, as they are laid out and in the file that is mapped.
    twice = network.device.type == "cpu"
    weights = sum(
        x.numel() * x.element_size() * (2 if twice and x.ndim == 4 else 1) for x in network.parameters()
    )
    pixels, tokens = height * width, height * width // PATCH**2
    enc_dim, dec_dim = network.decoder_embed.in_features, network.decoder_embed.out_features
    # Every layer of both views is kept for the heads; a block works on about 12 arrays of its width.
    blocks = 4 * tokens * (2 * (len(network.dec_blocks) + 1) * dec_dim + 12 * max(enc_dim, dec_dim))
    # A DPT head's widest moment: 128 channels at full resolution before and after a convolution, its
    # workspace, and 256 channels at half of it. Measured 0.37 GB at 512x384.
    dpt = isinstance(network.downstream_head1, DptHead)
    head = pixels * 1900 if dpt else pixels * 32
    finest = 2 * 256 * pixels // 16 if dpt else 0
    features = 4 * images * (tokens * enc_dim + finest)
    return MemoryEstimate(weights, features, blocks + head, pairs * pixels * 8 * 4)


def predict_pairs(
    loaded: LoadedNetwork,
    images: PreparedImages,
    names: tuple[str, ...],
    base_from_gripper: Float[ndarray, "n 4 4"],
    options: PairOptions | None = None,
    progress: Progress | None = None,
    *,
    program: int | None = None,
    aligned: bool = False,
) -> tuple[PairPredictions, tuple[str, ...]]:
    """Pointmaps of the pairs of a capture's images, and notes on what was left out or did not fit.

    `program` is the resident set (bytes) before the weights were loaded; `aligned` says that the pairs will be,
    and mapped, within the same budget. Pairs found in the cache are not computed again. On CUDA that runs out of
    memory the batch is halved, then the CPU takes over. Raises InputError for options out of range, and when one
    pair does not fit the budget.
    """
    options = options or PairOptions()
    for name, value in (("window", options.window), ("memory-gb", options.memory_gb)):
        if value <= 0:
            raise InputError(f"--{name} {value}: must be positive")
    if options.cache_gb < 0:
        raise InputError(f"--cache-gb {options.cache_gb}: give a size, or 0 for no cache")
    count = len(images.colors)
    program = resident() if program is None else program
    predictor = _Predictor(loaded, images, names, options, progress or silent, program, aligned)
    graph = options.pair_graph
    if graph == "auto":
        graph = "complete" if count <= FEW_IMAGES else "robot"
    if graph == "complete":
        return predictor.predict(complete_pairs(count)), predictor.notes
    if graph == "window":
        return predictor.predict(window_pairs(count, options.window)), predictor.notes
    neighbours = predictor.predict(window_pairs(count, 1))
    edges, note = overlapping_pairs(neighbours, base_from_gripper)
    return predictor.predict(edges, neighbours), (note, *predictor.notes)


class _Predictor:
    """The state that calls share: encoded images, the size of a batch that fits, the device still in use."""

    def __init__(
        self,
        loaded: LoadedNetwork,
        images: PreparedImages,
        names: tuple[str, ...],
        options: PairOptions,
        progress: Progress,
        program: int,
        aligned: bool,
    ) -> None:
        self.loaded, self.images, self.names = loaded, images, names
        self.network = loaded.network
        self.device = self.network.device
        self.budget = options.memory_gb * GB
        self.progress = progress
        self.program, self.aligned = program, aligned
        self.features: dict[int, Features] = {}
        self.batch = 0
        self.notes: tuple[str, ...] = ()
        self.cache = (
            PairCache(options.cache or user_cache(), int(options.cache_gb * GB)) if options.cache_gb else None
        )
        # The leading number changes with anything here that changes what is predicted.
        self.key = f"1 {fingerprint(self.network)} {self.network.mixed_precision}"
        self.image_keys = [blake2b(image.tobytes()).digest() for image in images.colors]

    def predict(self, edges: Int[ndarray, "e 2"], known: PairPredictions | None = None) -> PairPredictions:
        """Pointmaps of `edges`, from `known` or the cache where they are there."""
        height, width = self.images.colors.shape[1:3]
        estimate = estimate_memory(self.network, len(self.images.colors), len(edges), height, width)
        in_memory, needed = self._plan(estimate, len(edges))
        shapes = ((height, width, 3), (height, width)) * 2
        arrays = [_new_array((len(edges), *shape), in_memory) for shape in shapes]
        pts3d, conf, pts3d_in_other_view, conf2 = arrays
        predictions = PairPredictions(
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
        rows = {} if known is None else {tuple(edge): row for row, edge in enumerate(known.edges.tolist())}
        missing, damaged = [], 0
        for e, edge in enumerate(edges.tolist()):
            found = None
            if known is not None and (row := rows.get(tuple(edge))) is not None:
                found = [array[row] for array in known.pointmaps]
            elif self.cache is not None:
                try:
                    found = self.cache.read(self._pair_key(edge), shapes)
                except ValueError:
                    damaged += 1
            if found is None:
                missing.append(e)
            else:
                for array, values in zip(arrays, found, strict=True):
                    array[e] = values
                predictions.release()
        if damaged and self.cache is not None:
            self._warn(
                f"{damaged} of the pairs in the cache {self.cache.folder} were damaged: predicted again"
            )
        if missing or self.aligned:
            where = "" if in_memory else f", and {estimate.pointmaps / GB:.2g} GB of pointmaps in a file"
            announce(needed, self.budget, where)
        unseen = np.setdiff1d(edges[missing], list(self.features))
        self._in_batches("encode images", unseen, self._encode)

        def decode(rows: Int[ndarray, " b"]) -> None:
            self._decode(rows, edges, arrays)
            predictions.release()

        self._in_batches("predict pairs", np.array(missing, dtype=np.int64), decode)
        if self.cache is not None:
            self.cache.prune()
        return predictions

    def _plan(self, estimate: MemoryEstimate, pairs: int) -> tuple[bool, int]:
        """Whether the pointmaps are kept in memory and how much of it will be needed; sets the size of a batch.

        Pointmaps that would fill half the budget, or leave too little for the rest, lie in a file that the system
        pages in and out. Raises InputError when not even one pair at a time fits.
        """
        count, height, width = self.images.colors.shape[:3]
        program = self.program + ALLOWANCE
        afterwards = memory_after(count, pairs, height * width) if self.aligned else 0
        on_cpu = self.device.type == "cpu"
        least = program + max(estimate.one_pair if on_cpu else 0, afterwards)
        require(least, self.budget, "one pair of images, with the program itself,")
        in_memory = estimate.pointmaps <= min(self.budget / 2, self.budget - least)
        stays = estimate.weights + estimate.features
        if on_cpu:
            stays += program + in_memory * estimate.pointmaps
        else:
            require(estimate.one_pair, self.budget, f"one pair of images on the {self.device}")
        self.batch = min(int((self.budget - stays) // estimate.per_pair), MAX_BATCH[self.device.type])
        return in_memory, least + in_memory * estimate.pointmaps

    def _pair_key(self, edge: list[int]) -> str:
        made_by = f"{self.key} {self.device.type}".encode()
        images = b"".join(self.image_keys[image] for image in edge)
        return blake2b(made_by + images, digest_size=20).hexdigest()

    @torch.inference_mode()
    def _encode(self, rows: Int[ndarray, " b"]) -> None:
        images = torch.from_numpy(self.images.colors[rows]).to(self.device).permute(0, 3, 1, 2)
        features = self.network.encode((images / 255 - 0.5) / 0.5, many_pairs=True)
        for k, row in enumerate(rows.tolist()):
            self.features[row] = _each(lambda x, k=k: x[k : k + 1], features)

    @torch.inference_mode()
    def _decode(self, rows: Int[ndarray, " b"], edges: Int[ndarray, "e 2"], arrays: list[ndarray]) -> None:
        first, second = (
            _each(lambda *x: torch.cat(x), *(self.features[image] for image in edges[rows, side].tolist()))
            for side in (0, 1)
        )
        view1, view2 = self.network.decode(first, second)
        for array, values in zip(arrays, (*view1, *view2), strict=True):
            array[rows] = values.cpu().numpy()
        if self.cache is not None:
            for row in rows:
                self.cache.write(self._pair_key(edges[row].tolist()), [array[row] for array in arrays])

    def _in_batches(self, stage: str, rows: Int[ndarray, " r"], work: Callable[[ndarray], None]) -> None:
        """Do `work` on `rows` in batches as large as memory turns out to allow."""
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
                relieve(self.budget)
                self.progress(stage, done / len(rows))
            else:
                # Outside of the except clause, whose traceback keeps the tensors of the failed batch alive.
                self._ask_less()

    def _ask_less(self) -> None:
        if self.batch > 1:
            self.batch //= 2
            self._warn(f"out of memory on the {self.device}: going on with {self.batch} pairs at a time")
        elif self.device.type == "cuda":
            self._warn(f"one pair does not fit on the {self.device}: going on, slowly, on the CPU")
            self.device = torch.device("cpu")
            self.network.to(self.device)
            self.features = {row: _each(Tensor.cpu, features) for row, features in self.features.items()}
        else:
            raise InputError(
                "out of memory with one pair of images; close other programs or use --image-size 224"
            )
        if torch.cuda.is_available():
            torch.cuda.empty_cache()

    def _warn(self, note: str) -> None:
        """At once, as what follows takes longer, and in the notes of the result."""
        logger.warning(note)
        self.notes += (note,)


def _each(function: Callable[..., Tensor], *features: Features) -> Features:
    """Features whose tensors are `function` of those of `features`."""

    def gathered(*parts: Tensor | None) -> Tensor | None:
        there = [part for part in parts if part is not None]
        return function(*there) if there else None

    finest1, finest2 = (gathered(*(f.finest[view] for f in features)) for view in (0, 1))
    return Features(function(*(f.tokens for f in features)), features[0].grid, (finest1, finest2))


def _new_array(shape: tuple[int, ...], in_memory: bool) -> ndarray:
    """Uninitialised float32, in memory or in a nameless file that goes with the array."""
    if in_memory:
        return np.empty(shape, np.float32)
    with tempfile.TemporaryFile() as stream:
        try:  # to write on a full disk through a mapping would kill the process
            _reserve(stream.fileno(), 4 * math.prod(shape))
        except OSError as error:
            raise InputError(
                f"{tempfile.gettempdir()}: no space for pointmaps that do not fit --memory-gb ({error.strerror}); make "
                "space, name another folder in TMPDIR, or raise --memory-gb"
            ) from None
        return np.memmap(stream, np.float32, "w+", shape=shape)


def _reserve(file: int, size: int) -> None:
    """Take `size` bytes of the disk for an open, empty file; raises OSError where they are not free."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
        return
    # macOS has no such call: zeros reserve as much, but take the time of writing them.
    zeros = bytes(1 << 20)
    while size:
        size -= os.write(file, zeros[:size])
