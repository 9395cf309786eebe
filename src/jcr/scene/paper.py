"""Published representation of a scene: a network for each property, trained as JCR (section IV-C) describes."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from jcr.records import PointCloud
from jcr.scene.fields import SinusoidalEncoding, linear
from jcr.scene.train import workspace_box

FREQUENCIES, HIDDEN, BATCH, RATE = 10, 256, 6144, 5e-3
"""Frequencies of NeRF's encoding of position; hidden units; points a step; learning rate of Adam."""


class PaperField(nn.Module):
    """Sinusoidal encoding, one hidden layer of 256 ReLU, one linear layer."""

    def __init__(self, box: Float[Tensor, "2 3"], outputs: int, generator: torch.Generator | None = None):
        """Initialise the layers from `generator`; positions are scaled by `box` (m)."""
        super().__init__()
        self.encoding = SinusoidalEncoding(FREQUENCIES, box)
        self.hidden = linear(self.encoding.features, HIDDEN, generator)
        self.output = linear(HIDDEN, outputs, generator)

    def forward(self, x_in_base: Float[Tensor, "n 3"]) -> Float[Tensor, "n outputs"]:
        """Return a logit of occupancy, RGB, or logits of classes."""
        return self.output(F.relu(self.hidden(self.encoding(x_in_base).T)))


def train_paper(
    cloud: PointCloud, weighted: bool = False, steps: int = 2000, seed: int = 0
) -> dict[str, PaperField]:
    """Return fields of occupancy, color and, where the cloud has several, label; `weighted` by confidence.

    Occupancy has the points as positives and as many uniform negatives of the workspace (binary cross-entropy);
    color takes the mean squared error, label the cross-entropy.
    """
    box = workspace_box(cloud, None)
    inside = ((cloud.points_in_base > box[0]) & (cloud.points_in_base < box[1])).all(1)
    generator, low, high = torch.Generator().manual_seed(seed), *torch.tensor(box, dtype=torch.float32)
    x = torch.tensor(cloud.points_in_base[inside], dtype=torch.float32)
    weight = torch.tensor(cloud.confidence[inside] if weighted else np.ones(len(x)), dtype=torch.float32)
    color, label = torch.tensor(cloud.color[inside] / 255).float(), torch.tensor(cloud.label[inside])
    outputs = {"occupancy": 1, "color": 3, "label": len(cloud.label_names)}
    outputs = {name: n for name, n in outputs.items() if name != "label" or n > 1}
    fields = {name: PaperField(torch.stack([low, high]), n, generator) for name, n in outputs.items()}
    optimizer = torch.optim.Adam([p for field in fields.values() for p in field.parameters()], RATE)
    for _ in range(steps):
        rows = torch.randint(len(x), (BATCH,), generator=generator)
        negatives = low + (high - low) * torch.rand(BATCH, 3, generator=generator)
        solid, free = (fields["occupancy"](points)[:, 0] for points in (x[rows], negatives))
        error = F.softplus(-solid) + (fields["color"](x[rows]) - color[rows]).square().mean(1)
        if "label" in fields:
            error = error + F.cross_entropy(fields["label"](x[rows]), label[rows], reduction="none")
        optimizer.zero_grad()
        ((weight[rows] * error).sum() / weight[rows].sum() + F.softplus(free).mean()).backward()
        optimizer.step()
    return {name: field.requires_grad_(False).eval() for name, field in fields.items()}
