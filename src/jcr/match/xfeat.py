"""XFeat: keypoints and descriptors at the cost of a small network, inference alone.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
The state dict has the published keys.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

CELL = 8
"""Pixels of a side of the cells in which keypoints are found."""
MULTIPLE = 32
"""Image sides must be multiples of this."""
LEAST_SCORE = 0.05
"""Of the keypoint heat map, the published threshold."""


class _Layer(nn.Module):
    """Convolution, batch normalisation without a gain, ReLU."""

    def __init__(self, inside: int, outside: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(inside, outside, kernel, padding=kernel // 2, stride=stride, bias=False),
            nn.BatchNorm2d(outside, affine=False),
            nn.ReLU(),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x)


class XFeat(nn.Module):
    """Images (b,1|3,h,w) to descriptors, keypoint logits and reliability, each on a grid of 8 pixels."""

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(1)
        self.skip1 = nn.Sequential(nn.AvgPool2d(4, stride=4), nn.Conv2d(1, 24, 1))
        self.block1 = nn.Sequential(
            _Layer(1, 4), _Layer(4, 8, stride=2), _Layer(8, 8), _Layer(8, 24, stride=2)
        )
        self.block2 = nn.Sequential(_Layer(24, 24), _Layer(24, 24))
        self.block3 = nn.Sequential(_Layer(24, 64, stride=2), _Layer(64, 64), _Layer(64, 64, 1))
        self.block4 = nn.Sequential(_Layer(64, 64, stride=2), _Layer(64, 64), _Layer(64, 64))
        self.block5 = nn.Sequential(
            _Layer(64, 128, stride=2), _Layer(128, 128), _Layer(128, 128), _Layer(128, 64, 1)
        )
        self.block_fusion = nn.Sequential(_Layer(64, 64), _Layer(64, 64), nn.Conv2d(64, 64, 1))
        self.heatmap_head = nn.Sequential(
            _Layer(64, 64, 1), _Layer(64, 64, 1), nn.Conv2d(64, 1, 1), nn.Sigmoid()
        )
        self.keypoint_head = nn.Sequential(
            _Layer(64, 64, 1), _Layer(64, 64, 1), _Layer(64, 64, 1), nn.Conv2d(64, CELL**2 + 1, 1)
        )

    def forward(
        self, image: Float[Tensor, "b c h w"]
    ) -> tuple[Float[Tensor, "b 64 h8 w8"], Float[Tensor, "b 65 h8 w8"], Float[Tensor, "b 1 h8 w8"]]:
        grey = self.norm(image.mean(1, keepdim=True))
        x3 = self.block3(self.block2(self.block1(grey) + self.skip1(grey)))
        x4 = self.block4(x3)
        x5 = self.block5(x4)
        size = x3.shape[-2:]
        coarse = [F.interpolate(x, size, mode="bilinear") for x in (x4, x5)]
        features = self.block_fusion(x3 + coarse[0] + coarse[1])
        return features, self.keypoint_head(F.pixel_unshuffle(grey, CELL)), self.heatmap_head(features)


@torch.inference_mode()
def detect(
    network: XFeat, image: Float[Tensor, "3 h w"], count: int
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 64"]]:
    """The `count` best keypoints of values in 0..1, and their unit descriptors; pixel centres are whole numbers.

    Published keypoints are whole pixels; here each is moved to the centre of its 3x3 neighbourhood in the heat map,
    for calibration needs fractions of a pixel.
    """
    features, logits, reliability = network(image[None])
    heat = F.pixel_shuffle(F.softmax(logits, 1)[:, : CELL**2], CELL)
    is_peak = (heat == F.max_pool2d(heat, 5, stride=1, padding=2)) & (heat > LEAST_SCORE)
    is_peak[..., :2, :] = is_peak[..., -2:, :] = is_peak[..., :2] = is_peak[..., -2:] = False
    y, x = is_peak[0, 0].nonzero(as_tuple=True)
    grid = _grid(torch.stack([x, y], -1), heat)
    score = heat[0, 0, y, x] * F.grid_sample(reliability, grid, align_corners=False)[0, 0, 0]
    best = score.argsort(descending=True, stable=True)[:count]
    x, y = x[best], y[best]
    near = torch.arange(-1, 2)
    patch = heat[0, 0, y[:, None, None] + near[:, None], x[:, None, None] + near]
    weight = patch / patch.sum((1, 2), keepdim=True)
    dx, dy = (weight * near).sum((1, 2)), (weight * near[:, None]).sum((1, 2))
    at = F.grid_sample(F.normalize(features, dim=1), grid[:, :, best], mode="bicubic", align_corners=False)
    return torch.stack([x + dx, y + dy], -1), F.normalize(at[0, :, 0].T, dim=-1)


def _grid(x_px: Float[Tensor, "k 2"] | Int[Tensor, "k 2"], image: Tensor) -> Float[Tensor, "1 1 k 2"]:
    """As the network was trained with: corners at the centres of pixels, which grid_sample takes for their edges."""
    height, width = image.shape[-2:]
    return (2 * x_px / torch.tensor([width - 1, height - 1], dtype=torch.float32) - 1)[None, None]
