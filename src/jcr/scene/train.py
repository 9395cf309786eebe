"""Training of fields on the rays of a cloud, until the loss on validation rays no longer falls."""

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
from jcr.scene.options import check_workspace
from jcr.scene.seen_space import CROSSED, HIT, SeenGrid

CLEARANCE = 0.1
"""Distance (cells) of the nearest positives and negatives of occupancy behind and before a surface point."""
NEAR = 2.0
"""Distance (cells) behind and before a surface point within which further positives and negatives are drawn."""
BATCH = 6144
"""Number of rays per training step."""
GAIN = 0.03
"""Share by which the validation loss must fall from one test to the next; otherwise the learning rate is reduced."""
COLOR_VARIANCE = 0.03
"""Variance of a colour channel in images of tabletops, the unit of its squared error beside the cross-entropy of labels;
2.8 times as much costs 0.4 dB of colour."""
RATES = (3e-2, 0.3)
"""Initial learning rates of Adam: for layers, and for feature grids."""
LOOK, FALLS = 6, 2
"""Steps between tests of the validation loss, and number of reductions of the learning rate that ends the training."""


@dataclass(frozen=True, kw_only=True)
class Rays:
    """Training data: rays from surface points to their cameras, one per row, on the training device."""

    x: Float[Tensor, "n 3"]
    """Surface points (m, base frame)."""
    ahead: Float[Tensor, "n 3"]
    """Unit vectors from the points towards their cameras."""
    reach: Float[Tensor, "n 1"]
    """Length (m) of the rays inside the workspace, from the point to its camera at most."""
    weight: Float[Tensor, " n"]
    """Weights in the loss, with mean 1 over all rays."""
    measured: Float[Tensor, " n"]
    """1 if the ray shows free space, 0 if not (see `PointCloud.cleared`)."""
    targets: dict[str, Tensor]
    """Properties of the points to be learnt: color (n,3) in [0, 1], and label (n,) if there are labels."""

    def __getitem__(self, rows: Tensor | slice) -> "Rays":
        columns = {name: value[rows] for name, value in vars(self).items() if name != "targets"}
        return Rays(targets={name: target[rows] for name, target in self.targets.items()}, **columns)


def workspace_box(
    cloud: PointCloud, workspace: tuple[float, float, float, float, float, float] | None
) -> Float[ndarray, "2 3"]:
    """Return lower and upper corner (2,3) of the workspace (m, base frame), by default computed from the cloud.

    `workspace` is (xmin, ymin, zmin, xmax, ymax, zmax), or None for the computed box. That box encloses the cameras
    and, along each axis, 99 % of the near points, with a margin of 5 cm. Near points are closer to their camera than
    1.5 times the median distance. Raises InputError for an invalid `workspace` or an empty cloud.
    """
    if workspace is not None:
        check_workspace(workspace)
        return np.array(workspace, dtype=np.float64).reshape(2, 3)
    if len(cloud.points_in_base) == 0:
        raise InputError("the cloud holds no points; a map needs at least some hundreds")
    # The background behind the scene, and a few outliers, must not enlarge the workspace.
    distance = np.linalg.norm(cloud.points_in_base - cloud.camera_centers_in_base[cloud.image], axis=1)
    near = cloud.points_in_base[distance < 1.5 * np.median(distance)]
    lower, upper = np.percentile(near, [0.5, 99.5], axis=0)
    cameras = cloud.camera_centers_in_base[np.unique(cloud.image)]
    return np.stack([np.minimum(lower, cameras.min(0)) - 0.05, np.maximum(upper, cameras.max(0)) + 0.05])


def rows_inside(cloud: PointCloud, box: Float[ndarray, "2 3"]) -> Int[ndarray, " n"]:
    """Return the indices of the cloud's points inside `box`, the lower and upper corner (m, base frame).

    Raises InputError if fewer than 100 points are inside.
    """
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
    box: Float[ndarray, "2 3"],
    cell: float,
    device: str,
) -> Rays:
    """Return the training rays of the points inside `box` (m), with colour and label of each point as targets.

    `box` are lower and upper corner (base frame), and `cell` is the side (m) of a map cell. The weight of a point is
    proportional to w / (1 + (margin² + depth_std²) / cell²). Here margin and depth_std are its standard deviations (m)
    from calibration and depth. The factor w is its confidence divided by the median confidence, limited to 0.25 to 4.
    """
    inside = rows_inside(cloud, box)
    x, origin = cloud.points_in_base[inside], cloud.camera_centers_in_base[cloud.image[inside]]
    toward = origin - x
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    leave = np.full_like(toward, np.inf)  # a ray parallel to a side of the box does not meet this side
    np.divide(np.where(toward > 0, box[1], box[0]) - x, toward, out=leave, where=toward != 0)
    confidence = cloud.confidence[inside]
    weight = np.clip(confidence / max(np.median(confidence), 1e-12), 0.25, 4.0)
    depth_std = 0.0 if cloud.depth_std is None else cloud.depth_std[inside]
    margin = 0.0 if cloud.margin is None else cloud.margin[inside]
    weight /= 1.0 + (margin**2 + depth_std**2) / cell**2

    def tensor(array: ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    targets = {"color": tensor(cloud.color[inside] / np.float32(255))}
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


Samples = tuple[Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]
"""Training samples of occupancy: positions (m), their occupancy (0 or 1), and weights."""


def draw_samples(rays: Rays, seen: SeenGrid, generator: torch.Generator) -> Samples:
    """Return positions (m) near a batch of rays, their occupancy (1 or 0), and their weights, to train the occupancy.

    Half of the rays have a positive just behind the point and a negative just before it. Each other ray has both at
    one random distance, and a negative anywhere between camera and point. Positives and negatives mirror each other at
    the points, so the trained occupancy is 0.5 at the surface whatever the noise of the points is. (With positives at
    the points themselves, points with an error of 1.6 mm moved the surface by 2 mm towards the cameras.) Behind a point
    where another ray crossed there is no positive. Some positions anywhere in the workspace are negatives too.
    """
    device, cell, n = rays.x.device, 2 * seen.cell, len(rays.x)

    def uniform(rows: int, columns: int = 1) -> Tensor:
        return torch.rand(rows, columns, generator=generator, device=device)

    a, b = rays[: n // 2], rays[n // 2 :]
    short, step = CLEARANCE * cell * b.ahead, NEAR * cell * uniform(len(a.x)) * a.ahead
    # A position behind one point may be free by the ray of another, as for thin walls seen from both sides.
    state = seen.at(a.x - step)
    solid = ((state & CROSSED) == 0) | ((state & HIT) != 0)
    far = a.x + (CLEARANCE * cell + a.reach * uniform(len(a.x))) * a.ahead
    # On the ray of a prior only cells that other rays crossed are free. Negatives near the prior are used anyway: the
    # field needs them to end the surface, and queries use its value only in cells that were crossed.
    free_far = torch.maximum(a.measured, ((seen.at(far) & CROSSED) != 0).float())
    anywhere = seen.lower + seen.size * uniform(n // 8, 3)
    positives = [(b.x - short, b.weight), (a.x - step, a.weight * solid)]
    negatives = [(b.x + short, b.weight), (a.x + step, a.weight), (far, a.weight * free_far)]
    negatives.append((anywhere, torch.ones(n // 8, device=device)))
    x, weight = (torch.cat(parts) for parts in zip(*positives, *negatives, strict=True))
    occupied = torch.zeros(len(x), device=device)
    occupied[:n] = 1.0
    return x, occupied, weight


def train(
    field: Field, rays: Rays, seen: SeenGrid, seed: int, max_seconds: float, report: Callable[[float], None]
) -> int:
    """Train the network `field` until the loss on 2 % validation rays no longer falls; return the number of steps.

    The learning rate is reduced when the validation loss falls by less than 3 % between tests; the second reduction
    ends the training. `max_seconds` limits the time; `seed` sets samples and order of the rays. `report` is called with
    the fraction of the work that is done.
    """
    device, start = rays.x.device, time.perf_counter()
    generator = torch.Generator(device).manual_seed(seed)
    learnt = [
        (p, RATES["tables" in name], torch.zeros_like(p), torch.zeros_like(p))
        for name, p in field.named_parameters()
        if p.requires_grad
    ]

    def draw(batch: Rays) -> Samples | None:
        """Return samples of occupancy for a batch of rays; None for a network of other properties."""
        return draw_samples(batch, seen, generator) if "occupancy" in field.heads else None

    # The rays are shuffled once, so that each batch is a slice without a copy.
    rays = rays[torch.randperm(len(rays.x), generator=generator, device=device)]
    leave_one_out, rays = rays[: len(rays.x) // 50], rays[len(rays.x) // 50 :]
    test = draw(leave_one_out)
    best, falls, step = float("inf"), 0, 0
    while falls < FALLS and time.perf_counter() - start < max_seconds:
        first = step * BATCH % max(len(rays.x) - BATCH, 1)
        batch = rays[first : first + BATCH]
        total_loss(field, batch, draw(batch)).backward()
        step += 1
        # Adam (Kingma and Ba 2015) is written out because torch's class imports a compiler for a second or more.
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


def total_loss(field: Field, rays: Rays, samples: Samples | None) -> Tensor:
    """Return the training loss of occupancy at `samples`, or, if they are None, of other properties at the rays' points.

    The loss is binary cross-entropy for occupancy, cross-entropy for labels, and for colours the squared error divided
    by their variance. Each is a weighted mean; they are added.
    """
    if samples is not None:
        x, occupied, weight = samples
        logit = field(x)["occupancy"][:, 0]
        return F.binary_cross_entropy_with_logits(logit, occupied, weight, reduction="sum") / weight.sum()
    total = torch.zeros((), device=rays.x.device)
    for name, out in field(rays.x).items():
        target = rays.targets[name]
        error = (
            F.cross_entropy(out, target, reduction="none")
            if name == "label"
            else (out - target).square().mean(1) / COLOR_VARIANCE
        )
        total = total + (rays.weight * error).sum() / rays.weight.sum()
    return total
