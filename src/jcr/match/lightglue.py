"""LightGlue: which keypoints of two images are the same, by attention within and between them; inference alone.

Lindenberger, Sarlin and Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV 2023. For ALIKED as
published; for XFeat its authors' smaller one. The state dict has the published keys.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
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
        message = F.scaled_dot_product_attention(q[None], k[None], v[None])[0]
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
        alike = split[0] @ split[1].transpose(1, 2) / math.sqrt(split[0].shape[-1])
        messages = alike.softmax(-1) @ values[1], alike.transpose(1, 2).softmax(-1) @ values[0]
        m0, m1 = (self.to_out(m.transpose(0, 1).flatten(1)) for m in messages)
        return x0 + self.ffn(torch.cat([x0, m0], -1)), x1 + self.ffn(torch.cat([x1, m1], -1))


class _Layer(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.self_attn, self.cross_attn = _SelfAttention(width, heads), _CrossAttention(width, heads)

    def forward(
        self, x0: Tensor, x1: Tensor, rotation0: tuple[Tensor, Tensor], rotation1: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        return self.cross_attn(self.self_attn(x0, *rotation0), self.self_attn(x1, *rotation1))


class _Assignment(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.matchability, self.final_proj = nn.Linear(width, 1), nn.Linear(width, width)

    def forward(self, x0: Tensor, x1: Tensor) -> Float[Tensor, "m n"]:
        """Logarithm of the probability that each is the other's match."""
        alike = self.final_proj(x0) @ self.final_proj(x1).T / math.sqrt(x0.shape[-1])
        has_match = F.logsigmoid(self.matchability(x0)) + F.logsigmoid(self.matchability(x1)).T
        return alike.log_softmax(1) + alike.log_softmax(0) + has_match


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

    def __init__(self, descriptor: int, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.input_proj = nn.Linear(descriptor, width)
        self.posenc = _Position(width // heads)
        self.transformers = nn.ModuleList(_Layer(width, heads) for _ in range(layers))
        self.log_assignment = nn.ModuleList(_Assignment(width) for _ in range(layers))
        self.token_confidence = nn.ModuleList(_Confidence(width) for _ in range(layers - 1))

    @torch.inference_mode()
    def forward(
        self,
        x0_px: Float[Tensor, "m 2"],
        x1_px: Float[Tensor, "n 2"],
        descriptor0: Float[Tensor, "m d"],
        descriptor1: Float[Tensor, "n d"],
        size0: tuple[int, int],
        size1: tuple[int, int],
        early: bool = True,
    ) -> tuple[Int[Tensor, "k 2"], Float[Tensor, " k"]]:
        """Rows of matched keypoints and their scores; sizes are width, height. `early`: stop when most are sure."""
        if not len(x0_px) or not len(x1_px):
            return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0)
        x0, x1 = self.input_proj(descriptor0), self.input_proj(descriptor1)
        rotation0, rotation1 = self._encoding(x0_px, size0), self._encoding(x1_px, size1)
        last, layers = 0, len(self.transformers)
        for last, layer in enumerate(self.transformers):
            x0, x1 = layer(x0, x1, rotation0, rotation1)
            if early and last < layers - 1:
                sure = self.token_confidence[last](torch.cat([x0, x1])) >= 0.8 + 0.1 * math.exp(
                    -4 * last / layers
                )
                if sure.float().mean() > CONFIDENT:
                    break
        score, match = (assignment := self.log_assignment[last](x0, x1)).max(1)
        row = torch.arange(len(x0))
        mutual = (assignment.argmax(0)[match] == row) & (score > math.log(LEAST_SCORE))
        return torch.stack([row[mutual], match[mutual]], 1), score[mutual].exp()

    def _encoding(self, x_px: Float[Tensor, "k 2"], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Cosine and sine (k, width of a head) by which queries and keys are rotated."""
        middle = torch.tensor(size) / 2
        phase = self.posenc.Wr((x_px - middle) / middle.max()).repeat_interleave(2, -1)
        return phase.cos(), phase.sin()


def _feed_forward(width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(2 * width, 2 * width), nn.LayerNorm(2 * width), nn.GELU(), nn.Linear(2 * width, width)
    )


def _quarter_rotation(x: Tensor) -> Tensor:
    """Neighbouring channels as coordinates of a plane, rotated by 90°."""
    a, b = x.unflatten(-1, (-1, 2)).unbind(-1)
    return torch.stack([-b, a], -1).flatten(-2)
