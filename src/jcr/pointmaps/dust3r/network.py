"""Network of DUSt3R (Wang et al., CVPR 2024): pointmaps of two images in the first camera's frame.

Encoder and decoders are those of CroCo v2 (Weinzaepfel et al., ICCV 2023). The head is linear or a dense prediction
transformer (DPT, Ranftl et al., ICCV 2021). Attribute names are the keys of the published state dicts. Shapes: b images
or pairs, n tokens = h/16 · w/16, c channels.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from jcr.pointmaps.image_grid import PATCH

Tokens = Float[Tensor, "b n c"]
FeatureMap = Float[Tensor, "b c h w"]
Rotary = Float[Tensor, "2 n 2 frequencies"]
"""Cosines and sines per token, coordinate (y, x) and frequency."""


class EncodedImages(NamedTuple):
    """Output of the encoder for a batch of images; it does not depend on how images are paired."""

    tokens: Tensor
    """Encoder tokens (b,n,c)."""
    grid: tuple[int, int]
    """Numbers of rows and columns of tokens."""


class Pointmap(NamedTuple):
    """Points (b,h,w,3) in the first image's camera frame, up to scale, and their confidence (b,h,w) ≥ 1."""

    points: Tensor
    confidence: Tensor


@dataclass(frozen=True, kw_only=True)
class Config:
    """Configuration of a published DUSt3R or MASt3R network; an unsupported value raises ValueError."""

    enc_embed_dim: int = 768
    enc_depth: int = 12
    enc_num_heads: int = 12
    dec_embed_dim: int = 512
    dec_depth: int = 8
    dec_num_heads: int = 16
    head_type: str = "linear"
    pos_embed: str = "RoPE100"
    mlp_ratio: float = 4.0
    patch_size: int = PATCH
    output_mode: str = "pts3d"
    depth_mode: Sequence[object] = ("exp", -float("inf"), float("inf"))
    conf_mode: Sequence[object] = ("exp", 1, float("inf"))
    # Settings of the published training, without effect here.
    img_size: object = None
    patch_embed_cls: str = "PatchEmbedDust3R"
    landscape_only: bool = False
    freeze: str = "none"

    def __post_init__(self) -> None:
        covered = {
            "pos_embed": (re.fullmatch(r"RoPE\d+(?:\.\d+)?", self.pos_embed), "RoPE100"),
            "head_type": (self.head_type in ("linear", "dpt"), "linear or dpt"),
            "patch_size": (self.patch_size == PATCH, PATCH),
            "output_mode": (self.output_mode == "pts3d", "pts3d"),
            "depth_mode": (list(self.depth_mode) == ["exp", -float("inf"), float("inf")], "exp, unbounded"),
            "conf_mode": (list(self.conf_mode) == ["exp", 1, float("inf")], "exp from 1"),
            "dec_depth": (self.head_type == "linear" or self.dec_depth > 9, "over 9 with a dpt head"),
        }
        for name, (known, remedy) in covered.items():
            if not known:
                raise ValueError(f"{name} = {getattr(self, name)!r} is not covered; it must be {remedy}")


class Dust3r(nn.Module):
    """Network of DUSt3R or MASt3R, built from the fields of a published configuration (`Config`).

    Raises ValueError for a configuration that is not supported, TypeError for an unknown field.
    """

    def __init__(self, **fields: Any) -> None:
        super().__init__()
        config = Config(**fields)
        enc_dim, dec_dim = config.enc_embed_dim, config.dec_embed_dim
        self.rope_base = float(config.pos_embed.removeprefix("RoPE"))
        self.head_dims = (enc_dim // config.enc_num_heads, dec_dim // config.dec_num_heads)
        self.is_metric = False
        """True if the predicted points are in metres."""

        self.patch_embed = PatchEmbed(enc_dim)
        self.mask_token = nn.Parameter(torch.zeros(1, 1, dec_dim))  # used only in pre-training
        self.enc_blocks = nn.ModuleList(
            EncoderBlock(enc_dim, config.enc_num_heads, config.mlp_ratio) for _ in range(config.enc_depth)
        )
        self.enc_norm = nn.LayerNorm(enc_dim, eps=1e-6)
        self.decoder_embed = nn.Linear(enc_dim, dec_dim)
        self.dec_blocks, self.dec_blocks2 = (
            nn.ModuleList(
                DecoderBlock(dec_dim, config.dec_num_heads, config.mlp_ratio) for _ in range(config.dec_depth)
            )
            for _ in range(2)
        )
        self.dec_norm = nn.LayerNorm(dec_dim, eps=1e-6)
        linear = config.head_type == "linear"
        self.downstream_head1, self.downstream_head2 = (
            LinearHead(dec_dim) if linear else DptHead(enc_dim, dec_dim, config.dec_depth) for _ in range(2)
        )

    def forward(
        self, image1: Float[Tensor, "b 3 h w"], image2: Float[Tensor, "b 3 h2 w2"]
    ) -> tuple[Pointmap, Pointmap]:
        """Return the pointmaps of both images of each pair, in the first camera's frame.

        Colours are RGB, scaled to [-1, 1]. Raises ValueError unless height and width are multiples of 16. Portrait
        images are accepted.
        """
        return self.decode(self.encode(image1), self.encode(image2))

    def encode(self, images: Float[Tensor, "b 3 h w"]) -> EncodedImages:
        """Return the encoder tokens of images (RGB, -1 to 1); each image is encoded once for all its pairs.

        Raises ValueError unless height and width are multiples of 16.
        """
        if images.shape[-2] % PATCH or images.shape[-1] % PATCH:
            raise ValueError(f"images are {tuple(images.shape[-2:])}; both must be multiples of {PATCH}")
        grid = (images.shape[-2] // PATCH, images.shape[-1] // PATCH)
        rotary = rotary_embedding(grid, self.head_dims[0], self.rope_base, images.device)
        x = self.patch_embed(images)
        for block in self.enc_blocks:
            x = block(x, rotary)
        return EncodedImages(self.enc_norm(x), grid)

    def decode(self, features1: EncodedImages, features2: EncodedImages) -> tuple[Pointmap, Pointmap]:
        """Return the pointmaps of the first and the second image of each pair, both in the first camera's frame."""
        rotary1, rotary2 = (
            rotary_embedding(f.grid, self.head_dims[1], self.rope_base, f.tokens.device)
            for f in (features1, features2)
        )
        x1, x2 = (self.decoder_embed(f.tokens) for f in (features1, features2))
        # The heads read the encoder's tokens and those after each decoder block, the last ones normalised.
        layers1, layers2 = [features1.tokens], [features2.tokens]
        for block1, block2 in zip(self.dec_blocks, self.dec_blocks2, strict=True):
            x1, x2 = block1(x1, x2, rotary1, rotary2), block2(x2, x1, rotary2, rotary1)
            layers1.append(x1)
            layers2.append(x2)
        layers1[-1], layers2[-1] = self.dec_norm(x1), self.dec_norm(x2)
        return (
            self.downstream_head1(layers1, features1.grid),
            self.downstream_head2(layers2, features2.grid),
        )

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.mask_token.device


def rotary_embedding(grid: tuple[int, int], head_dim: int, base: float, device: torch.device) -> Rotary:
    """Return cosines and sines (RoPE, Su et al. 2021) of the angle p · base^(−2k/D), shape (2, n, 2, D/2).

    The axes are cosine and sine; the n tokens, row by row; the coordinate p (row, then column) of the token; the
    frequency k. An attention head has `head_dim` = 2 D channels.
    """
    position = torch.cartesian_prod(*(torch.arange(size, device=device) for size in grid))
    exponent = torch.arange(0, head_dim // 2, 2, device=device).float() / (head_dim // 2)
    angle = position[..., None] * base**-exponent
    return torch.stack([angle.cos(), angle.sin()])


def rotate(x: Float[Tensor, "b heads n d"], rotary: Rotary) -> Float[Tensor, "b heads n d"]:
    """Return queries or keys x rotated by their positions: the first half of the channels by y, the second half by x.

    The axes of x are batch, attention head, token and channel. `rotary` comes from `rotary_embedding`.
    """
    # Each half of the channels holds pairs (a, b), all a before all b: a cos - b sin and b cos + a sin. Whole rows
    # and a small matrix are several times as quick as slices of a few channels.
    cos, sin = rotary.to(x.dtype).repeat_interleave(2, -2).flatten(-2)
    frequencies = rotary.shape[-1]
    quarter = torch.eye(2 * frequencies, dtype=x.dtype, device=x.device).roll(frequencies, 1)
    quarter[frequencies:] *= -1
    return torch.addcmul(x * cos, x @ torch.block_diag(quarter, quarter), sin)


class PatchEmbed(nn.Module):
    """Embedding of each 16x16 patch of an image as a token."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, PATCH, PATCH)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Tokens:
        """Return one token for each 16x16 patch of images (b,3,h,w), row by row, as an array (b,n,c)."""
        return self.proj(images).flatten(2).mT


class Attention(nn.Module):
    """Multi-head self-attention with rotary positions."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tokens, rotary: Rotary) -> Tokens:
        """Return the self-attention of the tokens x (b,n,c); `rotary` are their positions (`rotary_embedding`)."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        out = F.scaled_dot_product_attention(rotate(q, rotary), rotate(k, rotary), v)
        return self.proj(out.transpose(1, 2).flatten(2))


class CrossAttention(nn.Module):
    """Multi-head attention of one image's tokens to those of the other image."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq, self.projk, self.projv, self.proj = (nn.Linear(dim, dim) for _ in range(4))

    def forward(self, x: Tokens, y: Tokens, rotary_x: Rotary, rotary_y: Rotary) -> Tokens:
        """Return the attention of tokens x to tokens y of the other image, with the shape of x."""
        q, k, v = (
            project(tokens).unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for project, tokens in ((self.projq, x), (self.projk, y), (self.projv, y))
        )
        out = F.scaled_dot_product_attention(rotate(q, rotary_x), rotate(k, rotary_y), v)
        return self.proj(out.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Perceptron with one hidden layer."""

    def __init__(self, dim: int, ratio: float) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, int(dim * ratio))
        self.fc2 = nn.Linear(int(dim * ratio), dim)

    def forward(self, x: Tokens) -> Tokens:
        """Return the output of the perceptron for each token, with the shape of x (b,n,c)."""
        return self.fc2(F.gelu(self.fc1(x)))


class EncoderBlock(nn.Module):
    """Transformer block of the encoder."""

    def __init__(self, dim: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1, self.norm2 = (nn.LayerNorm(dim, eps=1e-6) for _ in range(2))
        self.attn = Attention(dim, heads)
        self.mlp = Mlp(dim, mlp_ratio)

    def forward(self, x: Tokens, rotary: Rotary) -> Tokens:
        """Return the tokens x (b,n,c) after self-attention and perceptron; `rotary` are their position embeddings."""
        x = x + self.attn(self.norm1(x), rotary)
        return x + self.mlp(self.norm2(x))


class DecoderBlock(nn.Module):
    """Transformer block of a decoder, with cross-attention to the other image."""

    def __init__(self, dim: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm3, self.norm_y = (nn.LayerNorm(dim, eps=1e-6) for _ in range(4))
        self.attn = Attention(dim, heads)
        self.cross_attn = CrossAttention(dim, heads)
        self.mlp = Mlp(dim, mlp_ratio)

    def forward(self, x: Tokens, y: Tokens, rotary_x: Rotary, rotary_y: Rotary) -> Tokens:
        """Return the tokens x after self-attention, cross-attention to the other image's tokens y, and perceptron."""
        x = x + self.attn(self.norm1(x), rotary_x)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(y), rotary_x, rotary_y)
        return x + self.mlp(self.norm3(x))


def pointmap(raw: Float[Tensor, "b 4 h w"]) -> Pointmap:
    """Return points (b,h,w,3) and confidence (b,h,w) from the four raw channels x, y, z, c of a head.

    The vector (x, y, z) of length d is scaled to the length exp(d) − 1; the confidence is 1 + exp(c).
    """
    xyz, c = raw.permute(0, 2, 3, 1).split([3, 1], -1)
    length = xyz.norm(dim=-1, keepdim=True)
    return Pointmap(xyz * (length.expm1() / length.clamp(min=1e-8)), 1 + c[..., 0].exp())


class LinearHead(nn.Module):
    """Linear head: each token of the last layer gives the four raw outputs of its 16x16 pixels."""

    def __init__(self, dec_dim: int) -> None:
        super().__init__()
        self.proj = nn.Linear(dec_dim, 4 * PATCH**2)

    def forward(self, layers: list[Tensor], grid: tuple[int, int]) -> Pointmap:
        """Return the pointmaps of images from the tokens (b,n,c) in the last entry of `layers`."""
        tokens = self.proj(layers[-1])
        return pointmap(F.pixel_shuffle(tokens.mT.unflatten(-1, grid), PATCH))


class DptHead(nn.Module):
    """Head of the dense prediction transformer (Ranftl et al. 2021), which reads the tokens of four layers."""

    def __init__(self, enc_dim: int, dec_dim: int, dec_depth: int) -> None:
        super().__init__()
        self.layers = (0, dec_depth // 2, 3 * dec_depth // 4, dec_depth)
        self.dpt = Dpt((enc_dim, dec_dim, dec_dim, dec_dim))

    def forward(self, layers: list[Tensor], grid: tuple[int, int]) -> Pointmap:
        """Return the pointmaps of images from the tokens (b,n,c) in four entries of `layers`."""
        return pointmap(self.dpt([layers[layer].mT.unflatten(-1, grid) for layer in self.layers]))


class Dpt(nn.Module):
    """Fusion of the token grids of four layers into one map at pixel resolution, from the coarsest to the finest."""

    def __init__(self, dims: Sequence[int], width: int = 256) -> None:
        super().__init__()
        pyramid = (96, 192, 384, 768)
        larger = ([nn.ConvTranspose2d(96, 96, 4, 4)], [nn.ConvTranspose2d(192, 192, 2, 2)])
        resizes = (*larger, [], [nn.Conv2d(768, 768, 3, 2, 1)])
        self.act_postprocess = nn.ModuleList(
            nn.Sequential(nn.Conv2d(dim, out, 1), *resize)
            for dim, out, resize in zip(dims, pyramid, resizes, strict=True)
        )
        self.scratch = Scratch(pyramid, width)
        self.head = nn.Sequential(
            nn.Conv2d(width, width // 2, 3, 1, 1),
            nn.UpsamplingBilinear2d(scale_factor=2),
            nn.Conv2d(width // 2, 128, 3, 1, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(128, 4, 1),
        )

    def forward(self, maps: list[Tensor]) -> Float[Tensor, "b 4 h w"]:
        """Return the four raw outputs of each pixel (x, y, z, c of `pointmap`) from the token grids of four layers.

        The grids have shape (b, channels, rows, columns), from the earliest layer to the last.
        """
        return self.head(self.scratch([f(x) for f, x in zip(self.act_postprocess, maps, strict=True)]))


class Scratch(nn.Module):
    """Fusion of four feature maps, finest first, after convolutions to a common number of channels."""

    def __init__(self, pyramid: Sequence[int], width: int) -> None:
        super().__init__()
        self.layer_rn = nn.ModuleList(nn.Conv2d(c, width, 3, 1, 1, bias=False) for c in pyramid)
        # Checkpoints hold the four convolutions under a second name too.
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = self.layer_rn
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (Fusion(width) for _ in range(4))

    def forward(self, levels: list[Tensor]) -> FeatureMap:
        """Return the fused feature map, at twice the resolution of the finest one.

        `levels` are four feature maps (b,c,h,w), finest first, each with about half the resolution of the one before.
        """
        level1, level2, level3, level4 = (conv(x) for conv, x in zip(self.layer_rn, levels, strict=True))
        # With an odd grid the stride-2 level is a row or column too large.
        x = self.refinenet4(level4)[..., : level3.shape[-2], : level3.shape[-1]]
        x = self.refinenet3(x + self.refinenet3.resConfUnit1(level3))
        x = self.refinenet2(x + self.refinenet2.resConfUnit1(level2))
        return self.refinenet1(x + self.refinenet1.resConfUnit1(level1))


class Fusion(nn.Module):
    """Refinement of the sum of a feature map and the coarser ones, with twice the resolution as output.

    `resConfUnit1` refines a feature map before the caller adds it; the coarsest map needs no such refinement.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.resConfUnit1, self.resConfUnit2 = ResidualUnit(width), ResidualUnit(width)
        self.out_conv = nn.Conv2d(width, width, 1)

    def forward(self, x: FeatureMap) -> Float[Tensor, "b c 2*h 2*w"]:
        """Return the refined map at twice the resolution, by bilinear interpolation."""
        # A 1x1 convolution commutes with bilinear upsampling; before it, it costs a quarter.
        x = self.out_conv(self.resConfUnit2(x))
        return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


class ResidualUnit(nn.Module):
    """Two convolutions with a residual connection."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, 1, 1)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1)

    def forward(self, x: FeatureMap) -> FeatureMap:
        """Return x plus the output of the two convolutions."""
        return x + self.conv2(F.relu_(self.conv1(F.relu(x))))
