"""Published representation of a scene: one network per property (paper section IV-C, eq. 13 to 15)."""

import time

import torch
from jaxtyping import Float
from numpy import ndarray
from torch.nn import functional as F

from jcr.progress import Progress, silent
from jcr.records import PointCloud
from jcr.scene.build import carved_workspace
from jcr.scene.fields import Field, Fields
from jcr.scene.options import MapOptions
from jcr.scene.scene_map import SceneMap
from jcr.scene.seen_space import without_doubts
from jcr.scene.train import rows_inside, workspace_box

FREQUENCIES, HIDDEN = 10, 256
"""Number of frequencies of NeRF's position encoding φ, which the paper leaves open, and number of hidden units."""
BATCH, RATE = 6144, 5e-3
"""Points per training step, and learning rate of Adam; the paper states neither."""


def train_fields(
    cloud: PointCloud,
    options: MapOptions | None = None,
    box: Float[ndarray, "2 3"] | None = None,
    device: str = "cpu",
    progress: Progress = silent,
) -> tuple[dict[str, Field], int]:
    """Return trained networks f_θ by property ("occupancy", "color", of several labels "label"), and number of steps.

    Their input is φ, sinusoids of the position, with the longest side of the workspace scaled to [-1, 1].
    `box` are lower and upper corner (m, base frame) of the workspace; None computes them from the cloud. The training
    ends after `options.steps` steps or `options.max_seconds`, on the torch device `device`. The loss is the sum of the
    binary cross-entropy of occupancy (eq. 13), the cross-entropy of labels (eq. 14) and the squared error of colours
    (eq. 15). The points are occupied, and as many positions drawn uniformly from the box are free.
    """
    options = options or MapOptions()
    box = workspace_box(cloud, options.workspace) if box is None else box
    inside, start = rows_inside(cloud, box), time.perf_counter()
    generator = torch.Generator().manual_seed(options.map_seed)
    draw = generator if device == "cpu" else torch.Generator(device).manual_seed(options.map_seed)
    low, high = corners = torch.tensor(box, dtype=torch.float32, device=device)
    x = torch.tensor(cloud.points_in_base[inside], dtype=torch.float32, device=device)
    color = torch.tensor(cloud.color[inside] / 255, dtype=torch.float32, device=device)
    label = torch.tensor(cloud.label[inside], device=device)
    outputs = {"occupancy": 1, "color": 3} | ({"label": n} if (n := len(cloud.label_names)) > 1 else {})
    # The layers are drawn on the CPU, so that the initial weights are the same on every device.
    arguments = {"hidden": HIDDEN, "box": corners.cpu(), "frequencies": FREQUENCIES, "generator": generator}
    fields = {name: Field({name: n}, **arguments).to(device) for name, n in outputs.items()}
    learnt = [p for field in fields.values() for p in field.parameters()]
    optimizer, taken = torch.optim.Adam(learnt, RATE), 0
    while taken < options.steps and time.perf_counter() - start < options.max_seconds:
        taken += 1
        rows = torch.randint(len(x), (BATCH,), generator=draw, device=device)
        negatives = low + (high - low) * torch.rand(BATCH, 3, generator=draw, device=device)
        out = {name: field(x[rows])[name] for name, field in fields.items()}
        error = F.softplus(-out["occupancy"][:, 0]) + (out["color"] - color[rows]).square().mean(1)
        if "label" in out:
            error = error + F.cross_entropy(out["label"], label[rows], reduction="none")
        free = F.softplus(fields["occupancy"](negatives)["occupancy"]).mean()
        optimizer.zero_grad()
        (error.mean() + free).backward()
        optimizer.step()
        progress("map: published networks", taken / options.steps)
    return {name: field.requires_grad_(False).eval() for name, field in fields.items()}, taken


def published_scene(
    cloud: PointCloud,
    options: MapOptions | None = None,
    progress: Progress = silent,
    device: str = "cpu",
) -> SceneMap:
    """Return the map of a cloud with the published networks, whose queries are the networks' outputs everywhere.

    The grid of seen space, which the paper does not have, is stored beside them for the property `unknown` of queries.
    Raises InputError as `build_scene` does.
    """
    options, start = options or MapOptions(), time.perf_counter()
    seen, _, box = carved_workspace(cloud, options, progress, device)
    carved = time.perf_counter()
    fields, taken = train_fields(cloud, options, box, device, progress)
    history = {"preset": "paper", "carving_s": f"{carved - start:.3f}", "steps": str(taken)}
    history["training_s"] = f"{time.perf_counter() - carved:.3f}"
    return SceneMap(Fields(list(fields.values())), without_doubts(seen), cloud.label_names, history)
