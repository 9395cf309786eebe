"""Published representation of a scene: one network per property, trained as in the JCR paper (section IV-C)."""

import time

import numpy as np
import torch
from torch.nn import functional as F

from jcr.records import PointCloud
from jcr.scene.fields import Field
from jcr.scene.train import rows_inside

FREQUENCIES, HIDDEN, BATCH, RATE = 10, 256, 6144, 5e-3
"""Number of frequencies of NeRF's position encoding; hidden units; points per training step; learning rate of Adam."""


def train_paper(
    cloud: PointCloud, box: np.ndarray, steps: int = 1000, seed: int = 0, max_seconds: float = np.inf
) -> dict[str, Field]:
    """Return trained networks by property: "occupancy", "color" and, if the cloud has several labels, "label".

    A network has sinusoids of the position, 256 hidden ReLU units, and a linear output. `box` are lower and upper
    corner (m, base frame) of the workspace. The training ends after `steps` steps or `max_seconds`. The loss is the sum
    of three terms: squared error of colours, cross-entropy of labels, and binary cross-entropy of occupancy. Points are
    occupied, and as many positions drawn uniformly in the workspace are free.
    """
    inside, start = rows_inside(cloud, box), time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(box, dtype=torch.float32)
    x = torch.tensor(cloud.points_in_base[inside], dtype=torch.float32)
    color, label = torch.tensor(cloud.color[inside] / 255).float(), torch.tensor(cloud.label[inside])
    outputs = {"occupancy": 1, "color": 3} | ({"label": n} if (n := len(cloud.label_names)) > 1 else {})
    options = {"box": torch.stack([low, high]), "frequencies": FREQUENCIES, "generator": generator}
    fields = {name: Field({name: n}, HIDDEN, **options) for name, n in outputs.items()}
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
