"""Rays of a cloud, and the samples of space on which the fields are trained."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from jcr.errors import InputError
from jcr.records import PointCloud
from jcr.scene.seen import CROSSED, HIT, SeenGrid

BEHIND = 2.0
"""Cells behind a surface that still count as occupied."""

CLEARANCE = 0.1
"""Cells before a surface that no negative is drawn from, so that noise does not eat the surface."""

NEAR = 2.0
"""Cells before a surface from which half of the negatives along the rays are drawn."""


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
        targets = {name: target[rows] for name, target in self.targets.items()}
        columns = ("x", "ahead", "reach", "weight", "measured")
        return Rays(targets=targets, **{name: getattr(self, name)[rows] for name in columns})


@dataclass(frozen=True)
class TrainingSamples:
    """Places of known occupancy; the first are the surface points themselves, which carry the other properties."""

    x: Float[Tensor, "k 3"]
    occupied: Float[Tensor, " k"]
    weight: Float[Tensor, " k"]
    surface: Rays


def on_surface(rays: Rays) -> TrainingSamples:
    """Return the surface points alone as samples."""
    return TrainingSamples(rays.x, torch.ones_like(rays.weight), rays.weight, rays)


def draw_samples(rays: Rays, seen: SeenGrid, along_rays: bool, generator: torch.Generator) -> TrainingSamples:
    """Return positives and negatives of occupancy for a batch of rays.

    The paper's: the points, and as many places drawn uniformly in the box (noise-contrastive estimation). Along
    the rays: all from the camera to shortly before the point is free, half of it drawn close to the surface; and
    behind the point, where no ray passed, the surface goes on for some cells. So the field crosses one half at
    the surface itself, not at some distance that the density of the points sets.
    """
    device, cell, n = rays.x.device, 2 * seen.cell, len(rays.x)

    def uniform(rows: int, columns: int = 1) -> Tensor:
        return torch.rand(rows, columns, generator=generator, device=device)

    def anywhere(rows: int) -> Tensor:
        return seen.lower + seen.size * uniform(rows, 3)

    if not along_rays:
        positives, negatives = [rays.x], [anywhere(n)]
        weights = [rays.weight, torch.ones(n, device=device)]
    else:
        a, b = rays[: n // 2], rays[n // 2 :]
        behind = a.x - BEHIND * cell * uniform(len(a.x)) * a.ahead
        # What is behind one point may lie before another: thin walls, seen from both sides.
        state = seen.at(behind)
        solid = ((state & CROSSED) == 0) | ((state & HIT) != 0)
        near = b.x + cell * (CLEARANCE + NEAR * uniform(len(b.x)).square()) * b.ahead
        far = a.x + (CLEARANCE * cell + a.reach * uniform(len(a.x))) * a.ahead
        positives, negatives = [rays.x, behind], [near, far, anywhere(n // 8)]
        # Before a prior only what other rays crossed is free. Close to it the field learns where the surface ends
        # all the same: what it says there counts only where the seen grid was crossed.
        free_far = torch.maximum(a.measured, ((seen.at(far) & CROSSED) != 0).float())
        weights = [
            rays.weight,
            a.weight * solid,
            b.weight,
            a.weight * free_far,
            torch.ones(n // 8, device=device),
        ]
    x = torch.cat(positives + negatives)
    occupied = torch.zeros(len(x), device=device)
    occupied[: sum(map(len, positives))] = 1.0
    return TrainingSamples(x, occupied, torch.cat(weights), rays)


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
    x = cloud.points_in_base
    inside = np.flatnonzero(((x > box[0]) & (x < box[1])).all(1))
    if len(inside) < 100:
        raise InputError(
            f"only {len(inside)} of {len(x)} points lie in the workspace {box.round(3).tolist()}; give a --workspace "
            "around the scene, in metres of the base frame"
        )
    x, origin = x[inside], cloud.camera_centers_in_base[cloud.image[inside]]
    toward = origin - x
    distance = np.linalg.norm(toward, axis=1, keepdims=True)
    leave = np.full_like(toward, np.inf)  # a ray along a wall of the box never meets it
    np.divide(np.where(toward > 0, box[1], box[0]) - x, toward, out=leave, where=toward != 0)
    leave = leave.min(axis=1)
    reach = distance[:, 0] * np.minimum(leave, 1.0)

    confidence = cloud.confidence[inside]
    weight = np.clip(confidence / max(np.median(confidence), 1e-12), 0.25, 4.0)
    depth_std = 0.0 if cloud.depth_std is None else cloud.depth_std[inside]
    weight /= 1.0 + (cloud.margin[inside] ** 2 + depth_std**2) / cell**2
    measured = cloud.cleared[inside]

    targets: dict[str, ndarray] = {"color": cloud.color[inside] / np.float32(255)}
    for name, value in values.items():
        if len(value) != len(cloud.points_in_base) or value.ndim != 2 or not np.isfinite(value).all():
            raise InputError(f"values {name!r}: one finite row per point is needed, got shape {value.shape}")
        targets[name] = value[inside].astype(np.float32)

    def tensor(array: ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    tensors = {name: tensor(target) for name, target in targets.items()}
    if len(cloud.label_names) > 1:
        tensors["label"] = torch.as_tensor(cloud.label[inside], dtype=torch.int64, device=device)
    return Rays(
        x=tensor(x),
        ahead=tensor(toward / distance),
        reach=tensor(reach[:, None]),
        weight=tensor(weight / weight.mean()),
        measured=tensor(measured),
        targets=tensors,
    )
