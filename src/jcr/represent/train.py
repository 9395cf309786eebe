"""Training the map: rays become samples of space, and one loop fits the fields of both presets to them."""

import math
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor
from torch.nn import functional as F

from jcr.errors import InputError
from jcr.progress import Progress
from jcr.records import PointCloud
from jcr.represent.fields import Fields, FieldShape, Lattice
from jcr.represent.scene import SceneMap
from jcr.represent.seen import CROSSED, HIT, SeenGrid, carve, dilate, halve


@dataclass(frozen=True)
class MapOptions:
    """How the map is trained."""

    preset: Literal["default", "paper"] = "default"
    """default: feature grids, free space learnt along the rays; paper: the paper's sinusoidal network with uniform
    negatives, slower and coarser."""
    joint: bool = False
    """One network for all properties instead of one for each."""
    workspace: tuple[float, float, float, float, float, float] | None = None
    """Box of the map in the base frame (m): xmin ymin zmin xmax ymax zmax; by default it holds the points and the
    cameras."""
    cell: float = 0.01
    """Side (m) of the finest feature cells; what was seen is kept at half of it."""
    max_cells: int = 4_000_000
    """Enlarge the cells until the workspace holds no more than so many."""
    max_seconds: float = 60.0
    """Stop the training after this time at the latest; it stops by itself on a plateau."""
    map_seed: int = 0
    """Seed of the samples and of the initial weights."""


@dataclass(frozen=True)
class Recipe:
    """What a preset is made of."""

    hidden: int
    frequencies: int
    grids: tuple[tuple[int, int], ...]
    """(lattice of `feature_lattices`, features) that occupancy, or a joint network, interpolates in."""
    surface_grids: tuple[tuple[int, int], ...]
    """The same for what is known on surfaces only."""
    rays: bool
    """Samples along the rays, instead of uniform negatives alone."""
    layer_rate: float
    grid_rate: float
    """Learning rates of Adam."""
    look: int
    """Steps between looks at the held-out rays."""


RECIPES = {
    "default": Recipe(
        32, 0, ((0, 4), (1, 2)), ((1, 4), (2, 4)), rays=True, layer_rate=3e-2, grid_rate=0.3, look=10
    ),
    "paper": Recipe(256, 10, (), (), rays=False, layer_rate=5e-3, grid_rate=0.0, look=100),
}
BATCH = 8192
"""Rays a step."""
GAIN = 0.03
"""Share by which the loss must fall from look to look, or the learning rate falls."""
FALLS = 3
"""Falls of the learning rate at which the training ends."""
BEHIND = 2.0
"""Cells behind a surface that still count as occupied."""
CLEARANCE = 0.1
"""Cells before a surface that no negative is drawn from, so that noise does not eat the surface."""
NEAR = 2.0
"""Cells before a surface from which half of the negatives along the rays are drawn."""


@dataclass(frozen=True)
class Rays:
    """The cloud on the training device, one row per point."""

    x: Float[Tensor, "n 3"]
    ahead: Float[Tensor, "n 3"]
    """Unit vector towards the camera."""
    reach: Float[Tensor, "n 1"]
    """Metres from the point to its camera, or to where the ray enters the workspace."""
    weight: Float[Tensor, " n"]
    targets: dict[str, Tensor]
    """What each point says of itself: color (n,3), label (n,), further values (n,d)."""

    def __getitem__(self, rows: Tensor) -> "Rays":
        targets = {name: target[rows] for name, target in self.targets.items()}
        return Rays(self.x[rows], self.ahead[rows], self.reach[rows], self.weight[rows], targets)


@dataclass(frozen=True)
class Samples:
    """Places of known occupancy; the first are the surface points themselves, which carry the other properties."""

    x: Float[Tensor, "k 3"]
    occupied: Float[Tensor, " k"]
    weight: Float[Tensor, " k"]
    surface: Rays


def build_scene(
    cloud: PointCloud,
    options: MapOptions | None = None,
    progress: Progress | None = None,
    values: dict[str, Float[ndarray, "n d"]] | None = None,
    device: str = "cpu",
) -> SceneMap:
    """The map of a cloud: what was seen, and fields of occupancy, colour, label and any further `values` (n,d).

    Raises InputError when hardly any point lies in the workspace or a value is not finite.
    """
    options = options or MapOptions()
    recipe = RECIPES[options.preset]
    torch.manual_seed(options.map_seed)
    generator = torch.Generator(device).manual_seed(options.map_seed)

    def tensor(array: ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    box = workspace_box(cloud, options.workspace)
    cell = max(options.cell, float(np.prod(box[1] - box[0]) / options.max_cells) ** (1 / 3))
    box[1] = box[0] + np.ceil((box[1] - box[0]) / cell - 1e-6) * cell
    rays = workspace_rays(cloud, values or {}, box, cell, device)

    start = time.perf_counter()
    if progress:
        progress("what was seen", 0.0)
    # Rays that end beyond the workspace cross it all the same.
    image = torch.as_tensor(cloud.image, device=device)
    centers = tensor(cloud.camera_centers_in_base)
    seen = carve(tensor(cloud.points_in_base), image, centers, tensor(box), cell / 2)
    carved = time.perf_counter()
    lattices = feature_lattices(seen) if recipe.grids else []
    outputs = {name: target.shape[-1] for name, target in rays.targets.items() if name != "label"}
    heads = {"occupancy": 1} | outputs
    if "label" in rays.targets:
        heads["label"] = len(cloud.label_names)
    groups = [heads] if options.joint else [{"occupancy": heads.pop("occupancy")}, heads]
    shapes = [
        FieldShape(
            group,
            recipe.hidden,
            recipe.frequencies,
            recipe.grids if "occupancy" in group else recipe.surface_grids,
        )
        for group in groups
    ]
    fields = Fields(shapes, seen.box, lattices).to(device)
    steps = train(fields, rays, seen, recipe, generator, options.max_seconds, progress)
    history = {
        "preset": options.preset,
        "steps": str(steps),
        "carving_s": f"{carved - start:.3f}",
        "training_s": f"{time.perf_counter() - carved:.3f}",
    }
    return SceneMap(fields, seen, cloud.label_names, history)


def feature_lattices(seen: SeenGrid) -> list[Lattice]:
    """Three lattices: four cells a step everywhere, one cell near surfaces, half a cell on them."""
    hit = (seen.state & HIT) != 0
    nz, ny, nx = ((n // 2 + 3) // 4 for n in hit.shape)
    everywhere = torch.ones(nz, ny, nx, dtype=torch.bool, device=hit.device)
    cell = 2 * seen.cell
    return [
        Lattice.around(everywhere, seen.lower, 4 * cell),
        Lattice.around(dilate(halve(hit), math.ceil(NEAR)), seen.lower, cell),
        Lattice.around(dilate(hit, 1), seen.lower, cell / 2),
    ]


def train(
    fields: Fields,
    rays: Rays,
    seen: SeenGrid,
    recipe: Recipe,
    generator: torch.Generator,
    max_seconds: float,
    progress: Progress | None = None,
) -> int:
    """Fit the fields to the rays until the loss on held-out rays stops falling; gives the number of steps."""
    tables = [p for name, p in fields.named_parameters() if "tables" in name]
    layers = [p for name, p in fields.named_parameters() if "tables" not in name]
    groups = ((layers, recipe.layer_rate), (tables, recipe.grid_rate))
    adam = torch.optim.Adam([{"params": p, "lr": rate} for p, rate in groups if p], fused=True)
    half_precision = recipe.hidden > 64 and _has_bfloat16(rays.x.device)

    order = torch.randperm(len(rays.x), generator=generator, device=rays.x.device)
    held_out, order = order[: len(order) // 50], order[len(order) // 50 :]
    test = draw_samples(rays[held_out], seen, recipe, generator)
    best, falls, step, start = float("inf"), 0, 0, time.perf_counter()
    while falls < FALLS and time.perf_counter() - start < max_seconds:
        first = step * BATCH % max(len(order) - BATCH, 1)
        samples = draw_samples(rays[order[first : first + BATCH]], seen, recipe, generator)
        with torch.autocast(rays.x.device.type, torch.bfloat16, enabled=half_precision):
            loss = total_loss(fields, samples)
        adam.zero_grad()
        loss.backward()
        adam.step()
        step += 1
        if step % recipe.look == 0:
            with torch.no_grad():
                now = float(total_loss(fields, test))
            if now > (1 - GAIN) * best:
                falls += 1
                for group in adam.param_groups:
                    group["lr"] *= 0.3
            best = min(best, now)
            if progress:
                progress("map", falls / FALLS)
    return step


def total_loss(fields: Fields, samples: Samples) -> Tensor:
    """Binary cross-entropy of occupancy, cross-entropy of labels, squared error of all else, weighted by point."""
    surface = samples.surface
    losses = []
    for shape, field in zip(fields.shapes, fields.of, strict=True):
        # Only occupancy is known off the surface.
        x = samples.x if "occupancy" in shape.heads else surface.x
        for name, out in field(x).items():
            if name == "occupancy":
                error = F.binary_cross_entropy_with_logits(out[:, 0], samples.occupied, reduction="none")
                losses.append((samples.weight * error).sum() / samples.weight.sum())
                continue
            out, target = out[: len(surface.x)], surface.targets[name]
            if name == "label":
                error = F.cross_entropy(out, target, reduction="none")
            else:
                error = (out - target).square().mean(1)
            losses.append((surface.weight * error).sum() / surface.weight.sum())
    return torch.stack(losses).sum()


def draw_samples(rays: Rays, seen: SeenGrid, recipe: Recipe, generator: torch.Generator) -> Samples:
    """Positives and negatives of occupancy for a batch of rays.

    The paper's: the points, and as many places drawn uniformly in the box (noise-contrastive estimation). With
    rays: all from the camera to shortly before the point is free, half of it drawn close to the surface; and
    behind the point, where no ray passed, the surface goes on for some cells. So the field crosses one half at
    the surface itself, not at some distance that the density of the points sets.
    """
    device, cell, n = rays.x.device, 2 * seen.cell, len(rays.x)

    def uniform(rows: int, columns: int = 1) -> Tensor:
        return torch.rand(rows, columns, generator=generator, device=device)

    def anywhere(rows: int) -> Tensor:
        return seen.lower + seen.size * uniform(rows, 3)

    if not recipe.rays:
        positives, negatives = [rays.x], [anywhere(n)]
        weights = [rays.weight, torch.ones(n, device=device)]
    else:
        a, b = rays[torch.arange(n // 2, device=device)], rays[torch.arange(n // 2, n, device=device)]
        behind = a.x - BEHIND * cell * uniform(len(a.x)) * a.ahead
        # What is behind one point may lie before another: thin walls, seen from both sides.
        state = seen.at(behind)
        solid = ((state & CROSSED) == 0) | ((state & HIT) != 0)
        near = b.x + cell * (CLEARANCE + NEAR * uniform(len(b.x)).square()) * b.ahead
        far = a.x + (CLEARANCE * cell + a.reach * uniform(len(a.x))) * a.ahead
        positives, negatives = [rays.x, behind], [near, far, anywhere(n // 8)]
        weights = [rays.weight, a.weight * solid, b.weight, a.weight, torch.ones(n // 8, device=device)]
    x = torch.cat(positives + negatives)
    occupied = torch.zeros(len(x), device=device)
    occupied[: sum(map(len, positives))] = 1.0
    return Samples(x, occupied, torch.cat(weights), rays)


def workspace_box(
    cloud: PointCloud, workspace: tuple[float, float, float, float, float, float] | None
) -> Float[ndarray, "2 3"]:
    """Lower and upper corner of the map: as asked, or around the scene and the cameras with 5 cm to spare.

    The scene is what lies within one and a half times the median distance from the cameras.
    """
    if workspace is not None:
        box = np.array(workspace, dtype=np.float64).reshape(2, 3)
        if not np.isfinite(box).all() or (box[0] >= box[1]).any():
            raise InputError(
                f"workspace {workspace}: give metres as xmin ymin zmin xmax ymax zmax, each minimum below its maximum"
            )
        return box
    if not np.isfinite(cloud.points_in_base).all():
        raise InputError("the cloud holds points that are not finite; remove them before the map is built")
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
    """The rays of the points that lie in the box; reliable points weigh more.

    A point counts by its confidence (relative to the median, within a factor of four) and by how small its
    `margin` is against a cell: there is no use in sharpness that the calibration does not have.
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
    with np.errstate(divide="ignore", invalid="ignore"):
        leave = np.nanmin(np.where(toward > 0, (box[1] - x) / toward, (box[0] - x) / toward), axis=1)
    reach = distance[:, 0] * np.minimum(leave, 1.0)

    confidence = cloud.confidence[inside]
    weight = np.clip(confidence / max(np.median(confidence), 1e-12), 0.25, 4.0)
    weight /= 1.0 + (cloud.margin[inside] / cell) ** 2

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
        tensor(x), tensor(toward / distance), tensor(reach[:, None]), tensor(weight / weight.mean()), tensors
    )


def _has_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
