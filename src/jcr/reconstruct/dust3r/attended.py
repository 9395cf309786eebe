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

    Attention is averaged with that of the mirrored images. A token's place is averaged over what it looks at most and
    the eight around that, which gives a fraction of a token; every two tokens give two matches, the middle of each
    with the place of the other. Tokens at an edge of the image are left out: half of what they see is cut off,
    which draws places inwards and made focal lengths a tenth too long.
    """
    as_seen, mirrored = network.encode(images), network.encode(images.flip(-1))
    grid, patch = as_seen.grid, network.patch
    first, second = (torch.from_numpy(x) for x in np.triu_indices(len(images), 1))
    found = []
    for rows in torch.arange(len(first)).split(batch):
        ways = []
        for features in (as_seen, mirrored):
            one, other = (Features(features.tokens[x[rows]], grid) for x in (first, second))
            ways.append(
                [
                    x.unflatten(2, grid).unflatten(1, grid)
                    for x in network.matching_attention(one, other, block)
                ]
            )
        there, back = (
            ((x + y.flip(2, 4)) / 2).flatten(3).flatten(1, 2).double().cpu().numpy()
            for x, y in zip(*ways, strict=True)
        )
        found.append(of_pairs(first[rows].numpy(), second[rows].numpy(), there, back, grid))
    i, j, place_i, place_j, weight = (np.concatenate(x) for x in zip(*found, strict=True))
    px_i, px_j = ((x + 0.5) * patch - 0.5 for x in (place_i, place_j))
    return Matches(i, j, px_i, px_j, weight, (grid[1] * patch, grid[0] * patch))


def of_pairs(
    first: Int[ndarray, " e"],
    second: Int[ndarray, " e"],
    there: Float[ndarray, "e n n"],
    back: Float[ndarray, "e n n"],
    grid: tuple[int, int],
) -> tuple[ndarray, ...]:
    """Images, places (column, row in tokens) and weights of the matches of some pairs, given both attentions."""
    rows, columns = grid
    row, column = np.divmod(np.arange(rows * columns), columns)
    place = np.stack([column, row], -1).astype(float)
    inner = (np.minimum(row, rows - 1 - row) > 0) & (np.minimum(column, columns - 1 - column) > 0)
    both = there * back.transpose(0, 2, 1)
    of_one, of_other = both.argmax(2), both.argmax(1)
    mutual = np.take_along_axis(of_other, of_one, 1) == np.arange(rows * columns)
    weight = np.sqrt(np.take_along_axis(both, of_one[..., None], 2)[..., 0])
    e, one = np.nonzero(mutual & (weight > LEAST_WEIGHT) & inner & inner[of_one])
    other, weight = of_one[e, one], weight[e, one]

    def around(attention: Float[ndarray, "k n"], center: Int[ndarray, " k"]) -> Float[ndarray, "k 2"]:
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
