"""`benchmarks pairs`: what it saves to encode every image once instead of both images of every pair."""

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from jcr.reconstruct.dust3r.network import Dust3r
from jcr.reconstruct.dust3r.pair_graph import PairOptions, complete_pairs
from jcr.reconstruct.dust3r.predictor import GB, estimate_memory, predict_pairs
from jcr.reconstruct.dust3r.weights import LoadedNetwork
from jcr.reconstruct.global_alignment.pairs import PairPredictions
from jcr.reconstruct.preprocess import PreparedImages, image_grid

IMAGES, MANY_IMAGES, HEIGHT, WIDTH = 6, 10, 64, 96
"""MANY_IMAGES with --long."""
VIT_LARGE = {
    "enc_embed_dim": 1024,
    "enc_depth": 24,
    "enc_num_heads": 16,
    "dec_embed_dim": 768,
    "dec_depth": 12,
    "dec_num_heads": 12,
    "head_type": "dpt",
}
"""The published network: what is saved depends on how its encoder, decoder and heads compare."""


@dataclass(frozen=True)
class Measured:
    """One way of predicting the pairs of the same images with the same network."""

    pairs: PairPredictions
    wall_s: float
    cpu_s: float
    peak_gb: float


def run(long: bool = False) -> str:
    """Both ways over all ordered pairs of small images, as a Markdown table."""
    count = MANY_IMAGES if long else IMAGES
    network = random_network(VIT_LARGE)
    colors = np.random.default_rng(0).integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8)
    images = PreparedImages(
        colors=colors, grid=image_grid((WIDTH, HEIGHT), WIDTH), intrinsics_of_capture=None, pinhole=None
    )
    once = measure(lambda: encode_once(network, images))
    per_pair = measure(lambda: encode_per_pair(network, images))
    difference = np.abs(once.pairs.pts3d_in_other_view - per_pair.pairs.pts3d_in_other_view).max()
    size = np.abs(per_pair.pairs.pts3d_in_other_view).mean()
    estimate = estimate_memory(network, count, len(once.pairs.edges), HEIGHT, WIDTH)
    expected = (estimate.weights + estimate.features + estimate.per_pair + estimate.pointmaps) / GB
    return (
        f"> Encoding every image once predicts the pairs of {count} images {per_pair.wall_s / once.wall_s:.1f} times "
        "as fast as both images of every pair.\n\n"
        f"{count} images of {WIDTH}x{HEIGHT}, {len(once.pairs.edges)} ordered pairs, ViT-L with DPT heads, "
        f"random weights, float32, {torch.get_num_threads()} threads\n\n"
        "| way | wall time | processor time | peak memory |\n"
        "|---|---|---|---|\n"
        f"| every image once | {once.wall_s:.1f} s | {once.cpu_s:.1f} s | {once.peak_gb:.2f} GB |\n"
        f"| both images of every pair | {per_pair.wall_s:.1f} s | {per_pair.cpu_s:.1f} s | |\n"
        f"| ratio | {per_pair.wall_s / once.wall_s:.2f} | {per_pair.cpu_s / once.cpu_s:.2f} | |\n\n"
        f"Coordinates differ by at most {difference:.1e}, their mean size is {size:.2f}. Memory estimated "
        f"beforehand for weights, features, one pair and all pointmaps: {expected:.2f} GB.\n"
    )


def random_network(config: dict) -> Dust3r:
    """A network whose weights are small and uniform; torch's own initialisation of this many takes longer."""
    torch.manual_seed(0)
    with torch.device("meta"):
        network = Dust3r(**config)
    network = network.to_empty(device="cpu").eval().requires_grad_(False)
    for parameter in network.parameters():
        parameter.uniform_(-0.03, 0.03)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def measure(way: Callable[[], PairPredictions]) -> Measured:
    """Run it once and time it."""
    wall, cpu = time.perf_counter(), time.process_time()
    pairs = way()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return Measured(pairs, wall, cpu, 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / GB)


def encode_once(network: Dust3r, images: PreparedImages) -> PairPredictions:
    """As `jcr predict` does, without its cache."""
    loaded = LoadedNetwork(network, is_metric=False)
    count = len(images.colors)
    names, poses = tuple(map(str, range(count))), np.tile(np.eye(4), (count, 1, 1))
    return predict_pairs(loaded, images, names, poses, PairOptions(pair_graph="complete", cache_gb=0))[0]


@torch.inference_mode()
def encode_per_pair(network: Dust3r, images: PreparedImages) -> PairPredictions:
    """As the published loop does: the whole network on both images of every pair."""
    edges = complete_pairs(len(images.colors))
    tensors = (torch.from_numpy(images.colors).permute(0, 3, 1, 2) / 255 - 0.5) / 0.5
    views = [network(tensors[n, None], tensors[m, None]) for n, m in edges.tolist()]
    (points, conf), (points2, conf2) = (
        (torch.cat([v[k].points for v in views]).numpy(), torch.cat([v[k].confidence for v in views]).numpy())
        for k in (0, 1)
    )
    return PairPredictions(edges=edges, pts3d=points, conf=conf, pts3d_in_other_view=points2, conf2=conf2)
