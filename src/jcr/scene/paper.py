"""Published representation of a scene: one network per property, trained as in the JCR paper (section IV-C)."""

import time

import numpy as np
import torch
from torch.nn import functional as F

from jcr.records import PointCloud
from jcr.scene.fields import Field
from jcr.scene.train import rows_inside, workspace_box

FREQUENCIES, HIDDEN, BATCH, RATE = 10, 256, 6144, 5e-3
"""Number of frequencies of NeRF's position encoding; hidden units; points per training step; learning rate of Adam."""


class PaperField(Field):
    """Network for one property as in the paper: sinusoids of the position, 256 hidden ReLU units, linear output."""

    def __init__(self, box: torch.Tensor, name: str, outputs: int, generator: torch.Generator | None = None):
        """Initialise the layers of the property `name` from `generator`; the network has `outputs` outputs.

        `box` (2,3) m is the workspace, whose longest side is scaled to [-1, 1].
        """
        super().__init__({name: outputs}, HIDDEN, box, frequencies=FREQUENCIES, generator=generator)


def train_paper(
    cloud: PointCloud,
    steps: int = 1000,
    seed: int = 0,
    box: np.ndarray | None = None,
    max_seconds: float = np.inf,
) -> dict[str, PaperField]:
    """Return trained networks by property: "occupancy", "color" and, if the cloud has several labels, "label".

    `box` are lower and upper corner (m, base frame)
    of the workspace; None computes them from the cloud. The training ends after `steps` steps or `max_seconds`. The
    loss is the sum of three terms: squared error of colours, cross-entropy of labels, and binary cross-entropy of
    occupancy. Points are occupied, and as many positions drawn uniformly in the workspace are free.
    """
    box = workspace_box(cloud, None) if box is None else box
    inside, start = rows_inside(cloud, box), time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(box, dtype=torch.float32)
    x = torch.tensor(cloud.points_in_base[inside], dtype=torch.float32)
    color, label = torch.tensor(cloud.color[inside] / 255).float(), torch.tensor(cloud.label[inside])
    outputs = {"occupancy": 1, "color": 3} | ({"label": n} if (n := len(cloud.label_names)) > 1 else {})
    fields = {name: PaperField(torch.stack([low, high]), name, n, generator) for name, n in outputs.items()}
    learnt = [p for field in fields.values() for p in field.parameters() if p.requires_grad]
    optimizer, taken = torch.optim.Adam(learnt, RATE), 0
    while (taken := taken + 1) <= steps and time.perf_counter() - start < max_seconds:
        rows = torch.randint(len(x), (BATCH,), generator=generator)
        negatives = low + (high - low) * torch.rand(BATCH, 3, generator=generator)
        out = {name: field(x[rows])[name] for name, field in fields.items()}
        error = F.softplus(-out["occupancy"][:, 0]) + (out["color"] - color[rows]).square().mean(1)
        if "label" in out:
            error = error + F.cross_entropy(out["label"], label[rows], reduction="none")
        free = F.softplus(fields["occupancy"](negatives)["occupancy"]).mean()
        optimizer.zero_grad()
        (error.mean() + free).backward()
        optimizer.step()
    return {name: field.requires_grad_(False).eval() for name, field in fields.items()}
