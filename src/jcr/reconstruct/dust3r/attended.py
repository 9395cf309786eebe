"""Rough correspondences from where a network's cross-attention looks."""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor

from jcr.reconstruct.dust3r.network import Dust3r, Features
from jcr.reconstruct.epipolar import Matches

LEAST_WEIGHT = 0.15
"""Geometric mean of both ways' attention below which tokens are not taken for the same."""


@torch.inference_mode()
def attended_matches(
    network: Dust3r, images: Float[Tensor, "n 3 h w"], block: int, batch: int = 64
) -> Matches:
    """The tokens of all pairs of images that look at each other most, and the pixels where they look.

    A token's attention is averaged over the place that it looks at most and the eight around that, which gives a
    fraction of a token. Every two tokens give two matches: the middle of each with the pixels of the other.
    """
    features = network.encode(images)
    first, second = (torch.from_numpy(x) for x in np.triu_indices(len(images), 1))
    found = []
    for rows in torch.arange(len(first)).split(batch):
        one, other = (Features(features.tokens[x[rows]], features.grid) for x in (first, second))
        there, back = (x.double().cpu().numpy() for x in network.matching_attention(one, other, block))
        found.append(of_pairs(first[rows].numpy(), second[rows].numpy(), there, back, features.grid))
    rows, columns = features.grid
    i, j, px_i, px_j, weight = (np.concatenate(x) for x in zip(*found, strict=True))
    patch = network.patch
    px_i, px_j = ((x + 0.5) * patch - 0.5 for x in (px_i, px_j))
    return Matches(i, j, px_i, px_j, weight, (columns * patch, rows * patch))


def of_pairs(
    first: Int[ndarray, " e"],
    second: Int[ndarray, " e"],
    there: Float[ndarray, "e n n"],
    back: Float[ndarray, "e n n"],
    grid: tuple[int, int],
) -> tuple[ndarray, ...]:
    """Images, places (column, row in tokens) and weights of the matches of some pairs, given both attentions."""
    rows, columns = grid
    both = there * back.transpose(0, 2, 1)
    of_one, of_other = both.argmax(2), both.argmax(1)
    mutual = np.take_along_axis(of_other, of_one, 1) == np.arange(rows * columns)
    weight = np.sqrt(np.take_along_axis(both, of_one[..., None], 2)[..., 0])
    e, one = np.nonzero(mutual & (weight > LEAST_WEIGHT))
    other, weight = of_one[e, one], weight[e, one]
    place = np.stack(np.divmod(np.arange(rows * columns), columns)[::-1], -1).astype(float)

    def around(attention: Float[ndarray, "k m"], center: ndarray) -> Float[ndarray, "k 2"]:
        near = np.abs(place[None] - place[center][:, None]).max(-1) <= 1
        share = attention * near
        return share @ place / share.sum(1, keepdims=True)

    return (
        np.concatenate([first[e], first[e]]),
        np.concatenate([second[e], second[e]]),
        np.concatenate([place[one], around(back[e, other], one)]),
        np.concatenate([around(there[e, one], other), place[other]]),
        np.concatenate([weight, weight]),
    )
