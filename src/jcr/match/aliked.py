"""ALIKED: keypoints with descriptors that are sampled where the image deforms, inference alone.

Zhao, Wu, Chen, Chen, Xu and Li, "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable
Transformation", IEEE TIM 2023; the variant n16, whose state dict has the published keys. Deformable convolution (Dai et
al., ICCV 2017) is done by one grid sampling, so that torchvision is not needed.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

CHANNELS = (16, 32, 64, 128)
WIDTH = 128
"""Of the descriptors."""
SAMPLES = 16
"""Positions around a keypoint at which its descriptor is sampled."""
MULTIPLE = 32
NMS_RADIUS = 2
TEMPERATURE = 0.1
"""Of the soft maximum that gives fractions of a pixel."""


class _DeformableConvolution(nn.Module):
    """3x3, each of the nine taps displaced by an offset of its own."""

    def __init__(self, inside: int, outside: int) -> None:
        super().__init__()
        self.offset_conv = nn.Conv2d(inside, 18, 3, padding=1)
        self.regular_conv = nn.Conv2d(inside, outside, 3, padding=1, bias=False)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d h w"]:
        b, c, h, w = x.shape
        largest = max(h, w) / 4
        offset = self.offset_conv(x).clamp(-largest, largest).reshape(b, 9, 2, h, w)  # y, x of each tap
        taps = torch.arange(9)
        rows = torch.arange(h)[None, :, None] + (taps // 3 - 1)[:, None, None] + offset[:, :, 0]
        columns = torch.arange(w)[None, None] + (taps % 3 - 1)[:, None, None] + offset[:, :, 1]
        grid = torch.stack([2 * columns / (w - 1) - 1, 2 * rows / (h - 1) - 1], -1)
        sampled = F.grid_sample(x, grid.reshape(b, 9 * h, w, 2), align_corners=True).reshape(b, c, 9, h, w)
        return torch.einsum("bckhw,dck->bdhw", sampled, self.regular_conv.weight.flatten(2))


def _convolution(inside: int, outside: int, deformable: bool) -> nn.Module:
    if deformable:
        return _DeformableConvolution(inside, outside)
    return nn.Conv2d(inside, outside, 3, padding=1, bias=False)


class _Block(nn.Module):
    """Two convolutions, with a way around them where `around`."""

    def __init__(self, inside: int, outside: int, deformable: bool = False, around: bool = True) -> None:
        super().__init__()
        self.conv1, self.bn1 = _convolution(inside, outside, deformable), nn.BatchNorm2d(outside)
        self.conv2, self.bn2 = _convolution(outside, outside, deformable), nn.BatchNorm2d(outside)
        self.downsample = nn.Conv2d(inside, outside, 1) if around else None

    def forward(self, x: Tensor) -> Tensor:
        out = self.bn2(self.conv2(F.selu(self.bn1(self.conv1(x)))))
        return F.selu(out if self.downsample is None else out + self.downsample(x))


class _Descriptors(nn.Module):
    """Descriptors of keypoints: features at learned positions around each, summed by learned weights."""

    def __init__(self) -> None:
        super().__init__()
        self.offset_conv = nn.Sequential(
            nn.Conv2d(WIDTH, 2 * SAMPLES, 3), nn.SELU(), nn.Conv2d(2 * SAMPLES, 2 * SAMPLES, 1)
        )
        self.sf_conv = nn.Conv2d(WIDTH, WIDTH, 1, bias=False)
        self.agg_weights = nn.Parameter(torch.zeros(SAMPLES, WIDTH, WIDTH))

    def forward(self, features: Float[Tensor, "c h w"], x_px: Float[Tensor, "k 2"]) -> Float[Tensor, "k c"]:
        _, h, w = features.shape
        column, row = x_px.long().unbind(-1)
        column, row = column.clamp(1, w - 3), row.clamp(1, h - 3)
        near = torch.arange(-1, 2)
        patch = features[:, row[:, None, None] + near[:, None], column[:, None, None] + near].transpose(0, 1)
        largest = max(h, w) / 4
        offset = self.offset_conv(patch)[:, :, 0, 0].clamp(-largest, largest)
        position = x_px[:, None] + offset.reshape(-1, 2, SAMPLES).transpose(1, 2)
        grid = 2 * position / torch.tensor([w - 1, h - 1]) - 1
        sampled = F.grid_sample(features[None], grid[None], align_corners=True)
        sampled = F.selu(self.sf_conv(sampled))[0]
        return F.normalize(torch.einsum("ckp,pcd->kd", sampled, self.agg_weights), dim=1)


class Aliked(nn.Module):
    """Images (b,3,h,w) of sides that are multiples of 32, values 0..1, to features and keypoint scores per pixel."""

    def __init__(self) -> None:
        super().__init__()
        c1, c2, c3, c4 = CHANNELS
        self.block1 = _Block(3, c1, around=False)
        self.block2, self.block3 = _Block(c1, c2), _Block(c2, c3, deformable=True)
        self.block4 = _Block(c3, c4, deformable=True)
        quarter = WIDTH // 4
        self.conv1, self.conv2, self.conv3, self.conv4 = (
            nn.Conv2d(c, quarter, 1, bias=False) for c in CHANNELS
        )
        self.score_head = nn.Sequential(
            nn.Conv2d(WIDTH, 8, 1, bias=False),
            nn.SELU(),
            nn.Conv2d(8, 4, 3, padding=1, bias=False),
            nn.SELU(),
            nn.Conv2d(4, 4, 3, padding=1, bias=False),
            nn.SELU(),
            nn.Conv2d(4, 1, 3, padding=1, bias=False),
        )
        self.desc_head = _Descriptors()

    def forward(
        self, image: Float[Tensor, "b 3 h w"]
    ) -> tuple[Float[Tensor, "b c h w"], Float[Tensor, "b 1 h w"]]:
        x1 = self.block1(image)
        x2 = self.block2(F.avg_pool2d(x1, 2))
        x3 = self.block3(F.avg_pool2d(x2, 4))
        x4 = self.block4(F.avg_pool2d(x3, 4))
        levels = [
            F.selu(conv(x))
            for conv, x in ((self.conv1, x1), (self.conv2, x2), (self.conv3, x3), (self.conv4, x4))
        ]
        size = image.shape[-2:]
        wide = [levels[0], *(F.interpolate(x, size, mode="bilinear", align_corners=True) for x in levels[1:])]
        features = torch.cat(wide, 1)
        return F.normalize(features, dim=1), torch.sigmoid(self.score_head(features))


@torch.inference_mode()
def detect(
    network: Aliked, image: Float[Tensor, "3 h w"], count: int
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 128"]]:
    """The `count` best keypoints of values in 0..1, and their unit descriptors; pixel centres are whole numbers."""
    features, scores = network(image[None])
    kept = _local_maxima(scores)
    edge = NMS_RADIUS
    kept[..., :edge, :] = kept[..., -edge:, :] = kept[..., :edge] = kept[..., -edge:] = 0
    width = kept.shape[-1]
    best = kept.flatten().topk(min(count, int((kept > 0).sum()))).indices
    x, y = best % width, best // width
    near = torch.arange(-edge, edge + 1)
    patch = scores[0, 0, y[:, None, None] + near[:, None], x[:, None, None] + near]
    weight = ((patch - patch.amax((1, 2), keepdim=True)) / TEMPERATURE).exp()
    weight = weight / weight.sum((1, 2), keepdim=True)
    dx, dy = (weight * near).sum((1, 2)), (weight * near[:, None]).sum((1, 2))
    x_px = torch.stack([x + dx, y + dy], -1)
    return x_px, network.desc_head(features[0], x_px)


def _local_maxima(scores: Float[Tensor, "b 1 h w"]) -> Float[Tensor, "b 1 h w"]:
    """Scores that are the largest around, or become so when larger ones and their surroundings are taken away."""

    def largest(x: Tensor) -> Tensor:
        return F.max_pool2d(x, 2 * NMS_RADIUS + 1, stride=1, padding=NMS_RADIUS)

    is_peak = scores == largest(scores)
    for _ in range(2):
        hidden = largest(is_peak.float()) > 0
        left = torch.where(hidden, 0.0, scores)
        is_peak = is_peak | ((left == largest(left)) & ~hidden)
    return torch.where(is_peak, scores, 0.0)
