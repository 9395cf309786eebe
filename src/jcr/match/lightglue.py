"""LightGlue: which keypoints of two images are the same, by attention within and between them; inference alone.

Lindenberger, Sarlin and Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV 2023. For ALIKED as
published; for XFeat its authors' smaller one. The state dict has the published keys.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

LEAST_SCORE = 0.1
"""Of a match, as published."""
CONFIDENT = 0.95
"""Share of keypoints that must be sure of their match for the remaining layers to be left out."""


class _SelfAttention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.Wqkv, self.out_proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.ffn = _feed_forward(width)

    def forward(self, x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
        q, k, v = self.Wqkv(x).unflatten(-1, (self.heads, -1, 3)).transpose(0, 1).unbind(-1)
        q, k = (of * cosine + _quarter_rotation(of) * sine for of in (q, k))
        message = _attention(q, k, v)
        return x + self.ffn(torch.cat([x, self.out_proj(message.transpose(0, 1).flatten(1))], -1))


class _CrossAttention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.to_qk, self.to_v, self.to_out = (nn.Linear(width, width) for _ in range(3))
        self.ffn = _feed_forward(width)

    def forward(self, x0: Tensor, x1: Tensor) -> tuple[Tensor, Tensor]:
        split = [
            of.unflatten(-1, (self.heads, -1)).transpose(0, 1) for of in (self.to_qk(x0), self.to_qk(x1))
        ]
        values = [of.unflatten(-1, (self.heads, -1)).transpose(0, 1) for of in (self.to_v(x0), self.to_v(x1))]
        (q0, q1), (v0, v1) = split, values
        # Each direction by itself: the fused kernel never writes the m x n matrix, which both would share.
        messages = _attention(q0, q1, v1), _attention(q1, q0, v0)
        m0, m1 = (self.to_out(m.transpose(0, 1).flatten(1)) for m in messages)
        return x0 + self.ffn(torch.cat([x0, m0], -1)), x1 + self.ffn(torch.cat([x1, m1], -1))


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attn, self.cross_attn = _SelfAttention(width, heads), _CrossAttention(width, heads)

    def forward(self, first: "_Side", second: "_Side") -> list["_Side"]:
        within = [self.self_attn(side.x, side.cosine, side.sine) for side in (first, second)]
        across = self.cross_attn(*within)
        return [replace(side, x=x) for side, x in zip((first, second), across, strict=True)]


@dataclass(frozen=True)
class _Side:
    """The keypoints of one of the two images that may still have a match."""

    x: Float[Tensor, "k w"]
    """Their states."""
    cosine: Float[Tensor, "k h"]
    sine: Float[Tensor, "k h"]
    """By which queries and keys are rotated for their positions."""
    row: Int[Tensor, " k"]
    """Among all keypoints of the image."""

    def only(self, kept: Bool[Tensor, " k"]) -> "_Side":
        """Some of them."""
        return _Side(self.x[kept], self.cosine[kept], self.sine[kept], self.row[kept])


class _Assignment(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.matchability, self.final_proj = nn.Linear(width, 1), nn.Linear(width, width)

    def forward(self, x0: Tensor, x1: Tensor) -> Float[Tensor, "m n"]:
        """Logarithm of the probability that each is the other's match."""
        alike = self.final_proj(x0) @ self.final_proj(x1).T / math.sqrt(x0.shape[-1])
        has_match = F.logsigmoid(self.matchability(x0)) + F.logsigmoid(self.matchability(x1)).T
        return alike.log_softmax(1) + alike.log_softmax(0) + has_match

    def probability_of_match(self, x: Tensor) -> Float[Tensor, " k"]:
        """That a keypoint has a match at all."""
        return self.matchability(x)[:, 0].sigmoid()


class _Confidence(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.token = nn.Sequential(nn.Linear(width, 1), nn.Sigmoid())

    def forward(self, x: Tensor) -> Tensor:
        return self.token(x)


class _Position(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.Wr = nn.Linear(2, width // 2, bias=False)


class LightGlue(nn.Module):
    """Keypoints and descriptors of two images to matches."""

    def __init__(
        self,
        descriptor: int,
        width: int,
        heads: int,
        layers: int,
        *,
        least_matchable: float,
        ends_early: bool,
    ) -> None:
        """`least_matchable`: keypoints of less probability of having a match leave after each layer. `ends_early`: the
        remaining layers are left out once keypoints are sure, which the network must have been trained for."""
        super().__init__()
        self.input_proj = nn.Linear(descriptor, width)
        self.posenc = _Position(width // heads)
        self.transformers = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.log_assignment = nn.ModuleList(_Assignment(width) for _ in range(layers))
        self.token_confidence = nn.ModuleList(_Confidence(width) for _ in range(layers - 1))
        self._least_matchable, self._ends_early = least_matchable, ends_early

    @torch.inference_mode()
    def forward(
        self,
        x0_px: Float[Tensor, "m 2"],
        x1_px: Float[Tensor, "n 2"],
        descriptor0: Float[Tensor, "m d"],
        descriptor1: Float[Tensor, "n d"],
        size0: tuple[int, int],
        size1: tuple[int, int],
    ) -> tuple[Int[Tensor, "k 2"], Float[Tensor, " k"]]:
        """Rows of keypoints that match, and how likely each match is; sizes are width and height of the images."""
        sides = [
            _Side(self.input_proj(of), *self._encoding(x_px, size), torch.arange(len(x_px)))
            for of, x_px, size in ((descriptor0, x0_px, size0), (descriptor1, x1_px, size1))
        ]
        last, layers, count = 0, len(self.transformers), len(x0_px) + len(x1_px)
        for last, layer in enumerate(self.transformers):
            if not all(len(side.x) for side in sides):
                return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0)
            sides = layer(*sides)
            if last == layers - 1:
                break
            unsure = [self._unsure(side, last) for side in sides] if self._ends_early else None
            if unsure is not None and sum(int(of.sum()) for of in unsure) < (1 - CONFIDENT) * count:
                break
            assignment = cast(_Assignment, self.log_assignment[last])
            matchable = [assignment.probability_of_match(side.x) > self._least_matchable for side in sides]
            kept = matchable if unsure is None else [a | b for a, b in zip(matchable, unsure, strict=True)]
            sides = [side.only(of) for side, of in zip(sides, kept, strict=True)]
        likely = self.log_assignment[last](sides[0].x, sides[1].x)
        score, match = likely.max(1)
        row = torch.arange(len(score))
        mutual = (likely.argmax(0)[match] == row) & (score > math.log(LEAST_SCORE))
        return torch.stack([sides[0].row[row[mutual]], sides[1].row[match[mutual]]], 1), score[mutual].exp()

    def _unsure(self, side: "_Side", layer: int) -> Bool[Tensor, " k"]:
        """Keypoints whose match may still change."""
        least = 0.8 + 0.1 * math.exp(-4 * layer / len(self.transformers))
        return self.token_confidence[layer](side.x)[:, 0] < least

    def _encoding(self, x_px: Float[Tensor, "k 2"], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Cosine and sine (k, width of a head) by which queries and keys are rotated."""
        middle = torch.tensor(size) / 2
        phase = self.posenc.Wr((x_px - middle) / middle.max()).repeat_interleave(2, -1)
        return phase.cos(), phase.sin()


def _attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Of heads by tokens by channels; the fused kernel takes values whose channels are beside each other alone."""
    return F.scaled_dot_product_attention(q[None], k[None], v[None].contiguous())[0]


def _feed_forward(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), nn.Linear(2 * width, width)
    )


def _quarter_rotation(x: Tensor) -> Tensor:
    """Neighbouring channels as coordinates of a plane, rotated by 90°."""
    a, b = x.unflatten(-1, (-1, 2)).unbind(-1)
    return torch.stack([-b, a], -1).flatten(-2)
