"""Training of fields on the rays of a cloud, until the loss on validation rays stops falling."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from jcr.errors import InputError
from jcr.records import PointCloud
from jcr.scene.fields import Field
from jcr.scene.seen import CROSSED, HIT, SeenGrid

BEHIND = 2.0
"""Cells behind a surface that still count as occupied."""
CLEARANCE = 0.1
"""Cells before a surface that no negative is drawn from, so that noise does not eat the surface."""
NEAR = 2.0
"""Cells before a surface from which half of the negatives along the rays are drawn."""
BATCH = 6144
"""Rays a step."""
GAIN = 0.03
"""Share by which the loss must fall from look to look, or the learning rate falls."""


RATES = (3e-2, 0.3)
"""Learning rates of Adam for layers and grids."""
LOOK, FALLS = 6, 2
"""Steps between looks at the validation rays, and falls of the learning rate at which the training ends."""


@dataclass(frozen=True, kw_only=True)
class Rays:
    """The cloud on the training device, one row per point."""

    x: Float[Tensor, "n 3"]
    ahead: Float[Tensor, "n 3"]
    """Unit vector towards the camera."""
    reach: Float[Tensor, "n 1"]
    """Metres from the point to its camera, or to where the ray enters the workspace."""
    weight: Float[Tensor, " n"]
    measured: Float[Tensor, " n"]
    """1; 0 for a prior, whose ray shows no free space."""
    targets: dict[str, Tensor]
    """Properties of each point: color (n,3), label (n,), further values (n,d)."""

    def __getitem__(self, rows: Tensor | slice) -> "Rays":
        """Return some of the rays."""
        columns = {name: value[rows] for name, value in vars(self).items() if name != "targets"}
        return Rays(targets={name: target[rows] for name, target in self.targets.items()}, **columns)


def workspace_box(
    cloud: PointCloud, workspace: tuple[float, float, float, float, float, float] | None
) -> Float[ndarray, "2 3"]:
    """Return lower and upper corner of the map: as given, or around scene and cameras with a margin of 5 cm.

    The scene is what lies within one and a half times the median distance from the cameras.
    """
    if workspace is not None:
        box = np.array(workspace, dtype=np.float64).reshape(2, 3)
        if not np.isfinite(box).all() or (box[0] >= box[1]).any():
            raise InputError(
                f"workspace {workspace}: give metres as xmin ymin zmin xmax ymax zmax, each minimum below its maximum"
            )
        return box
    if len(cloud.points_in_base) == 0:
        raise InputError("the cloud holds no points; a map needs at least some hundreds")
    # The background behind the scene, and a few stray points, must not stretch the workspace.
    distance = np.linalg.norm(cloud.points_in_base - cloud.camera_centers_in_base[cloud.image], axis=1)
    near = cloud.points_in_base[distance < 1.5 * np.median(distance)]
    lower, upper = np.percentile(near, [0.5, 99.5], axis=0)
    cameras = cloud.camera_centers_in_base[np.unique(cloud.image)]
    return np.stack([np.minimum(lower, cameras.min(0)) - 0.05, np.maximum(upper, cameras.max(0)) + 0.05])


def rows_inside(cloud: PointCloud, box: Float[ndarray, "2 3"]) -> Int[ndarray, " n"]:
    """Return the rows of the points in the box; raise InputError where these are hardly any."""
    x = cloud.points_in_base
    inside = np.flatnonzero(((x > box[0]) & (x < box[1])).all(1))
    if len(inside) < 100:
        raise InputError(
            f"only {len(inside)} of {len(x)} points lie in the workspace {box.round(3).tolist()}; give a --workspace "
            "around the scene, in metres of the base frame"
        )
    return inside


def workspace_rays(
    cloud: PointCloud,
    values: dict[str, Float[ndarray, "n d"]],
    box: Float[ndarray, "2 3"],
    cell: float,
    device: str,
) -> Rays:
    """Return the rays of the points that lie in the box; reliable points weigh more.

    A point counts by its confidence (relative to the median, within a factor of four) and by how small its
    `margin` and the depth's sigma are against a cell: there is no use in sharpness that the measurement does not have.
    """
    inside = rows_inside(cloud, box)
    x, origin = cloud.points_in_base[inside], cloud.camera_centers_in_base[cloud.image[inside]]
    toward = origin - x
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    leave = np.full_like(toward, np.inf)  # a ray along a wall of the box never meets it
    np.divide(np.where(toward > 0, box[1], box[0]) - x, toward, out=leave, where=toward != 0)
    confidence = cloud.confidence[inside]
    weight = np.clip(confidence / max(np.median(confidence), 1e-12), 0.25, 4.0)
    depth_std = 0.0 if cloud.depth_std is None else cloud.depth_std[inside]
    weight /= 1.0 + (cloud.margin[inside] ** 2 + depth_std**2) / cell**2

    def tensor(array: ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    targets = {"color": tensor(cloud.color[inside] / np.float32(255))}
    for name, value in values.items():
        if len(value) != len(cloud.points_in_base) or value.ndim != 2 or not np.isfinite(value).all():
            raise InputError(f"values {name!r}: one finite row per point is needed, got shape {value.shape}")
        targets[name] = tensor(value[inside])
    if len(cloud.label_names) > 1:
        targets["label"] = torch.as_tensor(cloud.label[inside], dtype=torch.int64, device=device)
    return Rays(
        x=tensor(x),
        ahead=tensor(toward / distance),
        reach=tensor(distance * np.minimum(leave.min(axis=1, keepdims=True), 1.0)),
        weight=tensor(weight / weight.mean()),
        measured=tensor(cloud.cleared[inside]),
        targets=targets,
    )


Samples = tuple[Float[Tensor, "_ 3"], Float[Tensor, " _"], Float[Tensor, " _"]]
"""Places, their known occupancy (0 or 1) and weight; the first are surface points, which carry other properties."""


def draw_samples(rays: Rays, seen: SeenGrid, generator: torch.Generator) -> Samples:
    """Return positives and negatives of occupancy along a batch of rays.

    All from the camera to shortly before the point is free, half of it drawn close to the surface; behind the point,
    where no ray passed, the surface goes on for some cells. So the field crosses one half at the surface itself. With
    uniform negatives, as in the paper, the density of the points sets the distance at which it does.
    """
    device, cell, n = rays.x.device, 2 * seen.cell, len(rays.x)

    def uniform(rows: int, columns: int = 1) -> Tensor:
        return torch.rand(rows, columns, generator=generator, device=device)

    a, b = rays[: n // 2], rays[n // 2 :]
    behind = a.x - BEHIND * cell * uniform(len(a.x)) * a.ahead
    # What is behind one point may lie before another: thin walls, seen from both sides.
    state = seen.at(behind)
    solid = ((state & CROSSED) == 0) | ((state & HIT) != 0)
    near = b.x + cell * (CLEARANCE + NEAR * uniform(len(b.x)).square()) * b.ahead
    far = a.x + (CLEARANCE * cell + a.reach * uniform(len(a.x))) * a.ahead
    # Before a prior only what other rays crossed is free. Close to it the field learns where the surface ends all the
    # same: what it says there counts only where the seen grid was crossed.
    free_far = torch.maximum(a.measured, ((seen.at(far) & CROSSED) != 0).float())
    anywhere = seen.lower + seen.size * uniform(n // 8, 3)
    positives = [(rays.x, rays.weight), (behind, a.weight * solid)]
    negatives = [(near, b.weight), (far, a.weight * free_far), (anywhere, torch.ones(n // 8, device=device))]
    x, weight = (torch.cat(parts) for parts in zip(*positives, *negatives, strict=True))
    occupied = torch.zeros(len(x), device=device)
    occupied[: sum(len(places) for places, _ in positives)] = 1.0
    return x, occupied, weight


def train(
    field: Field,
    rays: Rays,
    seen: SeenGrid,
    seed: int,
    max_seconds: float,
    report: Callable[[float], None],
) -> int:
    """Fit a field to the rays until the loss on validation rays stops falling; return the number of steps."""
    device, start = rays.x.device, time.perf_counter()
    generator = torch.Generator(device).manual_seed(seed)
    field.standardise(rays.targets)
    learnt = [
        (p, RATES["tables" in name], torch.zeros_like(p), torch.zeros_like(p))
        for name, p in field.named_parameters()
        if p.requires_grad
    ]

    def draw(batch: Rays) -> Samples:
        if "occupancy" in field.heads:
            return draw_samples(batch, seen, generator)
        return batch.x, torch.ones_like(batch.weight), batch.weight  # all else is known on surfaces only

    # Shuffled once, so that batches are slices and nothing is gathered again.
    rays = rays[torch.randperm(len(rays.x), generator=generator, device=device)]
    leave_one_out, rays = rays[: len(rays.x) // 50], rays[len(rays.x) // 50 :]
    test = draw(leave_one_out)
    best, falls, step = float("inf"), 0, 0
    while falls < FALLS and time.perf_counter() - start < max_seconds:
        first = step * BATCH % max(len(rays.x) - BATCH, 1)
        batch = rays[first : first + BATCH]
        total_loss(field, batch, draw(batch)).backward()
        step += 1
        # Adam (Kingma and Ba 2015); torch's class first imports a compiler, for a second or more.
        with torch.no_grad():
            for p, rate, mean, square in learnt:
                assert p.grad is not None
                mean.lerp_(p.grad, 0.1)
                square.mul_(0.999).addcmul_(p.grad, p.grad, value=1e-3)
                spread = (square / (1 - 0.999**step)).sqrt_().add_(1e-8)
                p.addcdiv_(mean, spread, value=-rate * 0.3**falls / (1 - 0.9**step))
                p.grad = None
        if step % LOOK == 0:
            with torch.no_grad():
                now = float(total_loss(field, leave_one_out, test))
            falls += now > (1 - GAIN) * best
            best = min(best, now)
            report(falls / FALLS)
    return step


def total_loss(field: Field, rays: Rays, samples: Samples) -> Tensor:
    """Return the weighted loss: binary cross-entropy of occupancy, cross-entropy of labels, squared error of others.

    Squared errors are in units of the value's variance, so that neither metres nor kelvins drown the rest.
    """
    (x, occupied, of_samples), losses = samples, []
    for name, out in field(x).items():
        weight = of_samples if name == "occupancy" else rays.weight
        if name == "occupancy":
            error = F.binary_cross_entropy_with_logits(out[:, 0], occupied, reduction="none")
        else:
            out, target = out[: len(rays.x)], rays.targets[name]
            error = (
                F.cross_entropy(out, target, reduction="none")
                if name == "label"
                else ((out - target) / field.standard[name][1]).square().mean(1)
            )
        losses.append((weight * error).sum() / weight.sum())
    return torch.stack(losses).sum()
