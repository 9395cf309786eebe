"""A bank of textures with mip levels: noise, stripes, wood, tiles, blobs and lines of marks like print."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

SIDE = 128
"""Texels of the finest level; each next one has half as many, down to 1."""
LEVELS = SIDE.bit_length()
_STARTS = [sum((SIDE >> k) ** 2 for k in range(level)) for level in range(LEVELS + 1)]
TEXELS = _STARTS[-1]
"""Of one texture."""


def make_textures(count: int, generator: torch.Generator) -> Float[Tensor, "m 3"]:
    """RGB in [-1, 1], of mean 0, of `count` textures that tile: texels of all levels, one texture after another."""
    device = generator.device

    def uniform(low: float | int, high: float | int, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, device=device)

    axis = (torch.arange(SIDE, device=device) + 0.5) / SIDE
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    images = []
    for k in range(count):
        cloud = _noise(generator, 3, 2.0)
        kind = k % 6
        if kind == 0:  # clouds of all sizes
            image = _noise(generator, 3, float(uniform(0.5, 2.0)))
        elif kind == 1:  # stripes and tiles, a little bent
            turns_u, turns_v = (int(x) for x in uniform(0, 9, 2))
            phase = turns_u * u + turns_v * v + 0.2 * float(uniform(0, 1)) * cloud[0]
            wave = (2 * math.pi * phase).sin()
            if uniform(0, 1) < 0.5:
                wave = wave * (2 * math.pi * (turns_v * u - turns_u * v)).sin()
            image = (float(uniform(1, 8)) * wave).tanh() * uniform(-1, 1, 3)[:, None, None]
        elif kind == 2:  # wood
            rings = float(uniform(3, 12)) * (v + 0.15 * _noise(generator, 1, 2.5)[0]) + 0.5 * cloud[1]
            fibres = F.avg_pool2d(_noise(generator, 1, 0.2)[None], (1, 31), 1, (0, 15))[0, 0]
            image = ((2 * math.pi * rings).sin() + 2 * fibres) * uniform(0.3, 1, 3)[:, None, None]
        elif kind == 3:  # words: dashes in lines on a plain ground
            rows = int(uniform(4, 14))
            line = (v * rows).floor().long()
            ink = uniform(0, 1, rows, SIDE)[line, (u * SIDE).long() // int(uniform(2, 6))] > 0.45
            printed = (v * rows).frac() < float(uniform(0.35, 0.7))
            image = torch.where(ink & printed, 1.0, 0.0) * uniform(-1, 1, 3)[:, None, None] + 0.1 * cloud
        elif kind == 4:  # blobs and boxes of many colours, as on packaging
            image = uniform(-1, 1, 3)[:, None, None].expand(3, SIDE, SIDE).clone()
            for _ in range(int(uniform(5, 30))):
                center, half = uniform(0, 1, 2), uniform(0.02, 0.25, 2)
                # The nearest copy of the blob, so that it tiles.
                du, dv = (((x - c + 0.5) % 1 - 0.5) / h for x, c, h in zip((u, v), center, half, strict=True))
                inside = (
                    du * du + dv * dv < 1 if uniform(0, 1) < 0.5 else torch.maximum(du.abs(), dv.abs()) < 1
                )
                image = torch.where(inside, uniform(-1, 1, 3)[:, None, None], image)
        else:  # speckles
            speckle = _noise(generator, 1, 0.0) - float(uniform(0.5, 1.5))
            image = (8 * speckle).tanh() * uniform(-1, 1, 3)[:, None, None] + 0.2 * cloud
        image = image - image.mean((1, 2), keepdim=True)
        images.append(image / image.abs().amax().clamp(min=1e-3))
    level, texels = torch.stack(images), []
    for _ in range(LEVELS):
        texels.append(level.flatten(2).mT)
        level = F.avg_pool2d(level, 2) if level.shape[-1] > 1 else level
    return torch.cat(texels, 1).flatten(0, 1)


def _noise(generator: torch.Generator, channels: int, slope: float) -> Float[Tensor, "c side side"]:
    """Periodic noise of variance 1 whose amplitude falls with frequency^-slope."""
    white = torch.randn((channels, SIDE, SIDE), generator=generator, device=generator.device)
    frequency = torch.fft.fftfreq(SIDE, 1 / SIDE, device=generator.device)
    radius = (frequency[:, None] ** 2 + frequency**2).sqrt().clamp(min=1)
    noise = torch.fft.ifft2(torch.fft.fft2(white) / radius**slope).real
    return noise / noise.std((1, 2), keepdim=True)


def sample(
    textures: Float[Tensor, "m 3"],
    number: Int[Tensor, "*n"],
    uv: Float[Tensor, "*n 2"],
    texels_per_pixel: Float[Tensor, "*n"],
) -> Float[Tensor, "*n 3"]:
    """Bilinear samples of numbered textures at `uv`, whose unit is one tile, of the level that fits the pixels."""
    level = texels_per_pixel.clamp(min=1).log2().round().long().clamp(max=LEVELS - 1)
    starts = torch.tensor(_STARTS, device=uv.device)
    side = torch.bitwise_right_shift(torch.full_like(level, SIDE), level)
    start = number * TEXELS + starts[level]
    x = (uv % 1) * side[..., None] - 0.5
    low = x.floor()
    weight = x - low
    corner = low.long()
    u0, v0 = (corner % side[..., None]).unbind(-1)
    u1, v1 = ((corner + 1) % side[..., None]).unbind(-1)
    wu, wv = weight[..., :1], weight[..., 1:]
    top, bottom = (
        textures[start + v * side + u0] * (1 - wu) + textures[start + v * side + u1] * wu for v in (v0, v1)
    )
    return top * (1 - wv) + bottom * wv
