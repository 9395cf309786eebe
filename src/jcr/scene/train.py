"""Training of a field on rays, until the loss on validation rays stops falling."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.optim.adam import adam

from jcr.scene.fields import Field
from jcr.scene.rays import Rays, TrainingSamples, draw_samples, on_surface
from jcr.scene.seen import SeenGrid


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Networks and samples of a preset.

    The preset "paper" has the encoding, the hidden layer and the uniform negatives of the paper (`scene/paper.py`), but
    one network for all properties of surfaces, points weighted by confidence, a learning rate that falls until the
    validation loss stops falling, and bfloat16 where the processor has it.
    """

    hidden: int
    frequencies: int
    grids: tuple[tuple[int, int], ...]
    """(lattice of `feature_lattices`, features) that occupancy interpolates in."""
    surface_grids: tuple[tuple[int, int], ...]
    """(lattice, features) of the properties of surfaces."""
    rays: bool
    """TrainingSamples along the rays, instead of uniform negatives alone."""
    layer_rate: float
    grid_rate: float
    """Learning rates of Adam."""
    look: int
    """Steps between looks at the validation rays."""
    falls: int
    """Falls of the learning rate at which the training ends."""


RECIPES = {
    "default": Recipe(
        hidden=32,
        frequencies=0,
        grids=((0, 4), (1, 2)),
        surface_grids=((0, 4), (2, 4)),
        rays=True,
        layer_rate=3e-2,
        grid_rate=0.3,
        look=6,
        falls=2,
    ),
    "paper": Recipe(
        hidden=256,
        frequencies=10,
        grids=(),
        surface_grids=(),
        rays=False,
        layer_rate=5e-3,
        grid_rate=0.0,
        look=100,
        falls=3,
    ),
}
BATCH = 6144
"""Rays a step."""
GAIN = 0.03
"""Share by which the loss must fall from look to look, or the learning rate falls."""


def train(
    field: Field,
    rays: Rays,
    seen: SeenGrid,
    recipe: Recipe,
    seed: int,
    max_seconds: float,
    report: Callable[[float], None],
) -> int:
    """Fit a field to the rays until the loss on validation rays stops falling; return the number of steps."""
    device, start = rays.x.device, time.perf_counter()
    generator = torch.Generator(device).manual_seed(seed)
    field.standardise(rays.targets)
    learnt = {name: p for name, p in field.named_parameters() if p.requires_grad}
    tables = [p for name, p in learnt.items() if "tables" in name]
    layers = [p for name, p in learnt.items() if "tables" not in name]
    optimizers = [Adam(p, rate) for p, rate in ((layers, recipe.layer_rate), (tables, recipe.grid_rate)) if p]
    half_precision = recipe.hidden > 64 and _has_bfloat16(device)

    off_surface = "occupancy" in field.heads  # all else is known on surfaces only

    def draw(batch: Rays) -> TrainingSamples:
        return draw_samples(batch, seen, recipe.rays, generator) if off_surface else on_surface(batch)

    # Shuffled once, so that batches are slices and nothing is gathered again.
    rays = rays[torch.randperm(len(rays.x), generator=generator, device=device)]
    leave_one_out, rays = rays[: len(rays.x) // 50], rays[len(rays.x) // 50 :]
    test = draw(leave_one_out)
    best, falls, step = float("inf"), 0, 0
    while falls < recipe.falls and time.perf_counter() - start < max_seconds:
        first = step * BATCH % max(len(rays.x) - BATCH, 1)
        samples = draw(rays[first : first + BATCH])
        with torch.autocast(device.type, torch.bfloat16, enabled=half_precision):
            loss = total_loss(field, samples)
        loss.backward()
        for optimizer in optimizers:
            optimizer.step()
        step += 1
        if step % recipe.look == 0:
            with torch.no_grad():
                now = float(total_loss(field, test))
            if now > (1 - GAIN) * best:
                falls += 1
                for optimizer in optimizers:
                    optimizer.rate *= 0.3
            best = min(best, now)
            report(falls / recipe.falls)
    return step


def total_loss(field: Field, samples: TrainingSamples) -> Tensor:
    """Return the weighted loss: binary cross-entropy of occupancy, cross-entropy of labels, squared error of others.

    Squared errors are in units of the value's variance, so that neither metres nor kelvins drown the rest.
    """
    surface, losses = samples.surface, []
    for name, out in field(samples.x).items():
        if name == "occupancy":
            error = F.binary_cross_entropy_with_logits(out[:, 0], samples.occupied, reduction="none")
            losses.append((samples.weight * error).sum() / samples.weight.sum())
            continue
        out, target = out[: len(surface.x)], surface.targets[name]
        error = (
            F.cross_entropy(out, target, reduction="none")
            if name == "label"
            else ((out - target) / field.standard[name][1]).square().mean(1)
        )
        losses.append((surface.weight * error).sum() / surface.weight.sum())
    return torch.stack(losses).sum()


class Adam:
    """Adam (Kingma and Ba 2015), by torch's function: its class first imports a compiler, for a second or more."""

    def __init__(self, parameters: list[nn.Parameter], rate: float) -> None:
        self.parameters, self.rate = parameters, rate
        self.mean = [torch.zeros_like(p) for p in parameters]
        self.square = [torch.zeros_like(p) for p in parameters]
        self.count = [torch.zeros((), device=p.device) for p in parameters]

    @torch.no_grad()
    def step(self) -> None:
        """Make one step down the gradients, and clear them."""
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        adam(
            list[Tensor](self.parameters),
            gradients,
            self.mean,
            self.square,
            [],
            self.count,
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )
        for p in self.parameters:
            p.grad = None


def _has_bfloat16(device: torch.device) -> bool:
    """Test whether the device multiplies matrices in bfloat16."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported()
    return bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
