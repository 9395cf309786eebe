"""Where rays meet boxes, superquadrics, frustums of cones and the walls of a room, all in one batch.

A solid has its own frame. Boxes and superquadrics are centred on it; a frustum stands on its xy plane. The last
solid is the room, a box seen from within. Coordinates are kept apart (dimension 2) and pixels last, so that
every operation runs along memory.

Shapes: n views, k solids, p rays.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

NEAR = 1e-4
"""Hits nearer than this, in units of the direction's length, are where the ray began."""
_NEWTON_STEPS = 5


class Counts(NamedTuple):
    """Solids of each kind in a scene, in the order in which they are numbered; then comes the room."""

    boxes: int
    superquadrics: int
    frustums: int


class Solids(NamedTuple):
    """What stands in each of n views."""

    world_from_solid: Tensor
    """Rotations (n,k,3,3)."""
    origin_in_world: Tensor
    """(n,k,3), metres."""
    size: Tensor
    """(n,k,3): half the extent along each axis; of a frustum the bottom's and the top's radius and its height."""
    shape: Tensor
    """(n,k,2): of a superquadric the levels a ≤ b ≤ 2 of its exponents 2·2^a in xy and 2·2^b in z; of a frustum
    1 where the top is open, and 0."""


class Hits(NamedTuple):
    """The first surface that each ray meets."""

    distance: Tensor
    """(n,p), in units of the direction's length; infinite: none."""
    solid: Tensor
    """(n,p), its number."""
    point_in_solid: Tensor
    """(n,3,p)"""
    normal_in_solid: Tensor
    """(n,3,p), of length 1, towards where the ray came from."""


def first_hits(
    solids: Solids, counts: Counts, origin: Float[Tensor, "n 3 #p"], direction: Float[Tensor, "n 3 p"]
) -> Hits:
    """The first hit of each ray origin + t·direction, in world coordinates."""
    o, d = _in_solids(solids, origin, direction)
    distance, solid = _distances(solids, counts, o, d).min(1)
    pick = solid[:, None, None].expand(-1, 1, 3, -1)
    o, d = o.expand_as(d).gather(1, pick)[:, 0], d.gather(1, pick)[:, 0]
    point = o + distance[:, None] * d
    normal = _normals(solids, counts, solid, point)
    facing = torch.where((normal * d).sum(1, keepdim=True) > 0, -1.0, 1.0)
    return Hits(distance, solid, point, normal * facing)


def is_blocked(
    solids: Solids, counts: Counts, origin: Float[Tensor, "n 3 p"], direction: Float[Tensor, "n 3 p"]
) -> Tensor:
    """Whether a solid other than the room is met before origin + direction (n,p)."""
    inner = Solids(*(x[:, :-1] for x in solids))
    return (_distances(inner, counts, *_in_solids(inner, origin, direction)) < 1).any(1)


def unit(x: Float[Tensor, "n 3 p"]) -> Float[Tensor, "n 3 p"]:
    """Vectors of length 1."""
    a, b, c = x.unbind(1)
    return x * (a * a + b * b + c * c).clamp(min=1e-20).rsqrt()[:, None]


def _in_solids(solids: Solids, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Origins (n,k,3,p or 1) and directions (n,k,3,p) in the frames of the solids."""
    n, k = solids.size.shape[:2]
    turn = solids.world_from_solid.mT.reshape(n, 3 * k, 3)
    shift = solids.world_from_solid.mT @ solids.origin_in_world[..., None]
    o = (turn @ origin).view(n, k, 3, -1) - shift
    return o, (turn @ direction).view(n, k, 3, -1)


def _distances(solids: Solids, counts: Counts, o: Tensor, d: Tensor) -> Float[Tensor, "n k p"]:
    """Distance to each solid; infinite where it is missed."""
    ends = (counts.boxes, counts.boxes + counts.superquadrics, sum(counts))
    parts, start = [], 0
    for end, kind in zip(ends, (_box, _superquadric, _frustum), strict=True):
        rows = slice(start, end)
        parts.append(kind(o[:, rows], d[:, rows], solids.size[:, rows, :, None], solids.shape[:, rows]))
        start = end
    if start < o.shape[1]:
        parts.append(_slabs(o[:, start:], d[:, start:], solids.size[:, start:, :, None])[1])
    return torch.cat(parts, 1)


def _slabs(o: Tensor, d: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where lines enter and leave a box (Kay and Kajiya 1986); they miss it where they leave first."""
    inverse = 1 / torch.where(d.abs() < 1e-9, 1e-9, d)
    middle, reach = -o * inverse, half * inverse.abs()
    return (middle - reach).amax(2), (middle + reach).amin(2)


def _box(o: Tensor, d: Tensor, half: Tensor, shape: Tensor) -> Tensor:
    enter, leave = _slabs(o, d, half)
    return torch.where((leave > enter) & (enter > NEAR), enter, torch.inf)


def _superquadric(o: Tensor, d: Tensor, half: Tensor, shape: Tensor) -> Tensor:
    """By Newton's method: the inside-outside function (Barr 1981) is convex along the ray for exponents of 2 up.

    From the point where the ray enters the bounding box no step goes too far.
    """
    enter, leave = _slabs(o, d, half)
    o, d = o / half, d / half
    t, missed = enter, (leave <= enter) | (enter <= NEAR)
    value = slope = torch.zeros_like(t)
    for _ in range(_NEWTON_STEPS):
        value, gradient = _inside_outside(o + t[:, :, None] * d, shape[..., None])
        slope = (gradient * d).sum(2)
        t = t + torch.where(slope < 0, (value - 1).clamp(min=0) / -slope.clamp(max=-1e-6), 0.0)
        missed = missed | ((slope >= 0) & (value > 1.001))
    return torch.where(missed | (value > 1.02), torch.inf, t)


def _inside_outside(x: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
    """(|x|^p + |y|^p)^(q/p) + |z|^q at points (n,k,3,p), and its gradient.

    p and q are 2·2^level, the levels being `shape` (n,k,2,#p).
    """
    level, level_z = shape.unbind(2)
    power, over_square = _repeated_square(x[:, :, :2] ** 2, level[:, :, None])
    power_z, over_square_z = _repeated_square(x[:, :, 2] ** 2, level_z)
    outer, outer_over_ring = _repeated_square(power.sum(2), level_z - level)
    # d(x^p)/dx = p x^(p-2) x, and d(ring^r)/d(ring) = r ring^(r-1).
    q = 2 * 2**level_z
    gradient_xy = (q * outer_over_ring)[:, :, None] * over_square * x[:, :, :2]
    gradient_z = q * over_square_z * x[:, :, 2]
    return outer + power_z, torch.cat([gradient_xy, gradient_z[:, :, None]], 2)


def _repeated_square(s: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
    """s^(2^level) and s^(2^level - 1) for levels 0, 1 and 2."""
    squared = s * s
    one, two = level >= 1, level >= 2
    return (
        torch.where(two, squared * squared, torch.where(one, squared, s)),
        torch.where(two, squared * s, torch.where(one, s, 1.0)),
    )


def _frustum(o: Tensor, d: Tensor, size: Tensor, shape: Tensor) -> Tensor:
    """The wall, met from outside or inside, the bottom and, unless it is open, the top."""
    bottom, top, height = size.unbind(2)
    widening = (top - bottom) / height.clamp(min=1e-6)
    (ox, oy, oz), (dx, dy, dz) = o.unbind(2), d.unbind(2)
    radius = bottom + widening * oz
    a = dx * dx + dy * dy - (widening * dz) ** 2
    a = torch.where(a.abs() < 1e-8, 1e-8, a)
    b = ox * dx + oy * dy - widening * dz * radius
    c = ox * ox + oy * oy - radius * radius
    discriminant = b * b - a * c
    root = discriminant.clamp(min=0).sqrt()
    nearest = torch.full_like(root, torch.inf)
    for t in ((-b - root) / a, (-b + root) / a):
        z = oz + t * dz
        on_wall = (discriminant > 0) & (t > NEAR) & (z >= 0) & (z <= height) & (bottom + widening * z >= 0)
        nearest = torch.where(on_wall, torch.minimum(nearest, t), nearest)
    dz = torch.where(dz.abs() < 1e-9, 1e-9, dz)
    for z, rim, closed in ((0.0, bottom, True), (height, top, shape[:, :, :1] < 0.5)):
        t = (z - oz) / dz
        on_cap = (t > NEAR) & ((ox + t * dx) ** 2 + (oy + t * dy) ** 2 <= rim * rim) & closed
        nearest = torch.where(on_cap, torch.minimum(nearest, t), nearest)
    return torch.where(height > 1e-5, nearest, torch.inf)


def _normals(
    solids: Solids, counts: Counts, solid: Int[Tensor, "n p"], point: Float[Tensor, "n 3 p"]
) -> Float[Tensor, "n 3 p"]:
    """Of the surfaces of the numbered solids, either way round."""
    size = _of_solid(solids.size, solid)
    shape = _of_solid(solids.shape, solid)
    scaled = point / size.clamp(min=1e-6)
    reach = scaled.abs()
    of_box = (reach == reach.amax(1, keepdim=True)).to(point.dtype)
    _, gradient = _inside_outside(scaled[:, None], shape[:, None])
    of_superquadric = gradient[:, 0] / size.clamp(min=1e-6)
    bottom, top, height = size.unbind(1)
    widening = (top - bottom) / height.clamp(min=1e-6)
    x, y, z = point.unbind(1)
    on_cap = (torch.minimum(z.abs(), (z - height).abs()) < 1e-5) & (shape[:, 0] < 0.5)
    on_cap = on_cap | (z.abs() < 1e-5)
    wall = torch.stack([x, y, -widening * (bottom + widening * z)], 1)
    of_frustum = torch.where(on_cap[:, None], point.new_tensor([0, 0, 1.0])[:, None], wall)
    number = solid[:, None]
    first = counts.boxes
    normal = torch.where((number >= first) & (number < first + counts.superquadrics), of_superquadric, of_box)
    round_ = (number >= first + counts.superquadrics) & (number < sum(counts))
    return unit(torch.where(round_, of_frustum, normal))


def _of_solid(values: Float[Tensor, "n k c"], solid: Int[Tensor, "n p"]) -> Float[Tensor, "n c p"]:
    """Rows of a table of solids for each ray."""
    return values.gather(1, solid[..., None].expand(-1, -1, values.shape[-1])).mT
