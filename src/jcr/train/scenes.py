"""Tabletops drawn at random and seen by a wrist camera: images, depths and poses, made in batches in torch.

Wide on purpose: tables and rooms of any colour, clutter of boxes, superquadrics and turned shapes, surfaces from
plain to richly printed, lamps, shadows and gloss, and what a webcam does to a picture.

Shapes: b scenes of v views each, n = b·v views (the views of a scene follow one another), k solids, p pixels.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from jcr.train.raycast import Counts, Hits, Solids, first_hits, is_blocked, unit
from jcr.train.textures import SIDE, TEXELS, sample

LATHE_PARTS = 3
"""Frustums on one axis that make a turned shape: a bottle, a mug, a bowl."""


@dataclass(frozen=True)
class SceneOptions:
    """From how wide a world scenes and views are drawn; pairs of numbers are the ends of a range."""

    width: int = 128
    height: int = 96
    views: int = 4
    """Of a scene; each two of them are a pair in both orders."""
    boxes: int = 4
    superquadrics: int = 3
    lathes: int = 2
    horizontal_fov_deg: tuple[float, float] = (45.0, 80.0)
    distance: tuple[float, float] = (0.2, 1.2)
    """From the camera to what it looks at, metres."""
    elevation_deg: tuple[float, float] = (30.0, 89.0)
    """Of the camera, seen from the table."""
    azimuth_spread_deg: tuple[float, float] = (10.0, 180.0)
    """How far to either side of a scene's mean direction its cameras stand."""
    roll_deg: float = 30.0
    """Standard deviation."""
    wrist_like: float = 0.7
    """Share of scenes in which the top of the image keeps its direction over the table, as on an arm that does
    not turn its wrist; in the others it is up."""
    plain: float = 0.35
    """Share of surfaces of one colour."""
    least_overlap: float = 0.2
    """Of each view of a pair, the share that the other sees too."""
    views_at_once: int | None = None
    """Rendered together; unset: one on a CPU, whose cache it fits, 128 on a GPU."""


def narrowed(options: SceneOptions, share: float) -> SceneOptions:
    """The same world with views only that far apart, of how far they may be."""
    low, high = options.elevation_deg
    near, far = options.azimuth_spread_deg
    return replace(
        options,
        elevation_deg=(high - share * (high - low), high),
        azimuth_spread_deg=(share * near, share * far),
        roll_deg=share * options.roll_deg,
    )


class Views(NamedTuple):
    """What n cameras see."""

    images: Tensor
    """(n,3,h,w) in [-1, 1]."""
    depth: Tensor
    """(n,h,w), along the optical axis, metres."""
    world_from_camera: Tensor
    """(n,4,4)"""
    focal_px: Tensor
    """(n,)"""


def disguised(views: Views, of_scene: int, generator: torch.Generator) -> Views:
    """The same views with half of the scenes mirrored and the colours of all exchanged: as good as new ones.

    A mirror turns left and right about in the images and in the world.
    """
    draw, scenes = _Draw(generator), len(views.depth) // of_scene
    mirror = draw.chance(0.5, scenes).repeat_interleave(of_scene)
    channel = draw.uniform(0, 1, scenes, 3).argsort(1).repeat_interleave(of_scene, 0)
    images = views.images.gather(1, channel[..., None, None].expand_as(views.images))
    sign = torch.ones(len(mirror), 4, device=mirror.device)
    sign[mirror, 0] = -1
    return Views(
        torch.where(mirror[:, None, None, None], images.flip(-1), images),
        torch.where(mirror[:, None, None], views.depth.flip(-1), views.depth),
        sign[:, :, None] * views.world_from_camera * sign[:, None],
        views.focal_px,
    )


class Surfaces(NamedTuple):
    """How the solids of n views look."""

    texture: Tensor
    """(n,k), numbers in the bank."""
    tile: Tensor
    """(n,k), metres that a texture spans."""
    turn: Tensor
    """(n,k), radians."""
    color: Tensor
    """(n,k,3)"""
    contrast: Tensor
    """(n,k,3), by which a texture is added to the colour."""
    gloss: Tensor
    """(n,k,2): strength and exponent."""


class Lamps(NamedTuple):
    """The light of n views: a lamp that throws shadows, one that throws none, and light from everywhere."""

    position: Tensor
    """(n,2,3)"""
    power: Tensor
    """(n,2)"""
    ambient: Tensor
    """(n,)"""
    shadow: Tensor
    """(n,): 0 none, 1 no lamp light in the shadow."""


class _Draw:
    """Random numbers of one generator."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float | int, high: float | int, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=self.generator, device=self.generator.device)

    def log_uniform(self, low: float | int, high: float | int, *shape: int) -> Tensor:
        return self.uniform(math.log(low), math.log(high), *shape).exp()

    def chance(self, share: float, *shape: int) -> Tensor:
        return self.uniform(0, 1, *shape) < share

    def whole(self, count: int, *shape: int) -> Tensor:
        return torch.randint(count, shape, generator=self.generator, device=self.generator.device)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, device=self.generator.device)


def draw_views(
    scenes: int, options: SceneOptions, textures: Float[Tensor, "m 3"], generator: torch.Generator
) -> Views:
    """Views of new scenes on the generator's device, all of them following from its state."""
    draw = _Draw(generator)
    counts = Counts(1 + options.boxes, options.superquadrics, LATHE_PARTS * options.lathes)
    solids = _solids(draw, scenes, options)
    surfaces = _surfaces(draw, scenes, sum(counts) + 1, len(textures) // TEXELS, options.plain)
    lamps = _lamps(draw, scenes)
    world_from_camera, focal_px = _cameras(draw, scenes, options)
    at_once = options.views_at_once or (1 if generator.device.type == "cpu" else 128)
    of_view = torch.arange(scenes, device=generator.device).repeat_interleave(options.views)
    parts = []
    for rows in torch.arange(len(of_view), device=generator.device).split(at_once):
        scene = of_view[rows]
        parts.append(
            render(
                Solids(*(x[scene] for x in solids)),
                counts,
                Surfaces(*(x[scene] for x in surfaces)),
                Lamps(*(x[scene] for x in lamps)),
                textures,
                world_from_camera[rows],
                focal_px[rows],
                (options.width, options.height),
            )
        )
    light, depth = (torch.cat(part) for part in zip(*parts, strict=True))
    return Views(degrade(light, options.views, draw), depth, world_from_camera, focal_px)


def render(
    solids: Solids,
    counts: Counts,
    surfaces: Surfaces,
    lamps: Lamps,
    textures: Float[Tensor, "m 3"],
    world_from_camera: Float[Tensor, "n 4 4"],
    focal_px: Float[Tensor, "n"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n h w"]]:
    """Linear light and depth at the centres of the pixels of pinholes whose principal point is the middle."""
    width, height = size
    ray = rays_in_camera(focal_px, size)
    # The ray's z in the camera is 1, so that the distance along it is the depth.
    direction = world_from_camera[:, :3, :3] @ ray
    eye = world_from_camera[:, :3, 3:]
    hits = first_hits(solids, counts, eye, direction)
    point = eye + hits.distance[:, None] * direction
    rows = torch.arange(len(point), device=point.device)[:, None]
    turn = solids.world_from_solid.flatten(2)[rows, hits.solid].mT.unflatten(1, (3, 3))
    normal = (turn * hits.normal_in_solid[:, None]).sum(2)
    seen = unit(-direction)
    facing = (normal * seen).sum(1).clamp(min=0.05)
    color = _color(surfaces, hits, textures, hits.distance / (focal_px[:, None] * facing.sqrt()))
    gloss, exponent = surfaces.gloss[rows, hits.solid].unbind(-1)
    light = lamps.ambient[:, None] * (0.7 + 0.3 * normal[:, 2])
    shine = torch.zeros_like(light)
    for lamp in range(2):
        to_lamp = lamps.position[:, lamp, :, None] - point
        towards = unit(to_lamp)
        reaches = lamps.power[:, lamp, None] * torch.ones_like(light)
        if lamp == 0:
            # Lamps are no points, so shadows have soft edges: every other row and column will do.
            sparse = (point + 1e-3 * normal).unflatten(2, (height, width))[..., ::2, ::2].flatten(2)
            blocked = is_blocked(solids, counts, sparse, lamps.position[:, 0, :, None] - sparse)
            blocked = blocked.to(light.dtype).view(-1, 1, (height + 1) // 2, (width + 1) // 2)
            soft = F.interpolate(blocked, (height, width), mode="bilinear").flatten(1)
            reaches = reaches * (1 - lamps.shadow[:, None] * soft)
        light = light + reaches * (normal * towards).sum(1).clamp(min=0)
        halfway = unit(towards + seen)
        shine = shine + reaches * gloss * (normal * halfway).sum(1).clamp(min=0) ** exponent
    image = color * light[:, None] + shine[:, None]
    return image.view(-1, 3, height, width), hits.distance.view(-1, height, width)


def rays_in_camera(focal_px: Float[Tensor, "n"], size: tuple[int, int]) -> Float[Tensor, "n 3 p"]:
    """(x, y, 1) at the centres of the pixels, row by row."""
    width, height = size
    y, x = torch.meshgrid(
        torch.arange(height, device=focal_px.device) - (height - 1) / 2,
        torch.arange(width, device=focal_px.device) - (width - 1) / 2,
        indexing="ij",
    )
    x, y = (axis.flatten() / focal_px[:, None] for axis in (x, y))
    return torch.stack([x, y, torch.ones_like(x)], 1)


def points_in_camera(views: Views) -> Float[Tensor, "n h w 3"]:
    """The true pointmap of each view in its own camera frame."""
    height, width = views.depth.shape[1:]
    rays = rays_in_camera(views.focal_px, (width, height)).mT.view(-1, height, width, 3)
    return views.depth[..., None] * rays


def seen_by(
    views: Views, first: Tensor, second: Tensor, stride: int = 1, tolerance: float = 0.02
) -> tuple[Bool[Tensor, "e h w"], Float[Tensor, "e h w 2"]]:
    """Which pixels of view `first` (e,) the view `second` (e,) sees too, and where (x, y), pixels.

    A point is seen when it falls into the image and its depth there is what the other view has, within
    `tolerance` of it. `stride` leaves out pixels of the first view.
    """
    height, width = views.depth.shape[1:]
    points = points_in_camera(views)[first][:, ::stride, ::stride]
    second_from_first = torch.linalg.inv(views.world_from_camera[second]) @ views.world_from_camera[first]
    moved = torch.einsum("eij,ehwj->ehwi", second_from_first[:, :3, :3], points)
    x, y, z = (moved + second_from_first[:, None, None, :3, 3]).unbind(-1)
    focal = views.focal_px[second, None, None]
    ahead = z.clamp(min=1e-3)
    pixel = torch.stack([focal * x / ahead + (width - 1) / 2, focal * y / ahead + (height - 1) / 2], -1)
    column, row = pixel.round().long().unbind(-1)
    inside = (z > 1e-3) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    there = views.depth[second[:, None, None], row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return inside & ((there - z).abs() < tolerance * z), pixel


def pairs_of(views: Views, options: SceneOptions) -> tuple[Tensor, Tensor]:
    """First and second views (e,) of the ordered pairs whose two views have enough in common."""
    n, v = len(views.depth), options.views
    grid = torch.arange(n, device=views.depth.device).view(-1, v)
    first, second = grid[:, :, None].expand(-1, v, v), grid[:, None].expand(-1, v, v)
    share = (
        seen_by(views, first.flatten(), second.flatten(), stride=4, tolerance=0.03)[0].float().mean((1, 2))
    )
    share = share.view(-1, v, v)
    common = torch.minimum(share, share.mT).where(first != second, -1.0)
    # The best pair stays in any case: a step needs one.
    keep = common >= common.amax().clamp(max=options.least_overlap)
    return first[keep], second[keep]


def degrade(light: Float[Tensor, "n 3 h w"], views: int, draw: _Draw) -> Float[Tensor, "n 3 h w"]:
    """Linear light as a webcam shows it, in [-1, 1]: exposure, tint, blur, vignetting, noise, tone curve, 8 bits.

    The views of a scene share the camera and, but for a little, its exposure.
    """
    n, _, height, width = light.shape
    device = light.device

    def of_scene(values: Tensor) -> Tensor:
        return values.repeat_interleave(views, 0).view(n, -1, 1, 1)

    b = n // views
    exposure = of_scene(draw.log_uniform(0.7, 1.5, b)) * draw.log_uniform(0.92, 1.08, n)[:, None, None, None]
    light = light * exposure * of_scene(draw.uniform(0.88, 1.12, b, 3))
    # Blurred, or sharpened as cameras and Lanczos filters do: a step towards or away from the mean around.
    around = F.avg_pool2d(F.pad(light, (1, 1, 1, 1), mode="replicate"), 3, 1)
    light = light + of_scene(draw.uniform(-0.3, 0.6, b)) * (around - light)
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height, device=device),
        torch.linspace(-1, 1, width, device=device),
        indexing="ij",
    )
    light = light * (1 - of_scene(draw.uniform(0, 0.3, b)) * 0.5 * (x * x + y * y))
    image = light.clamp(0, 1) ** of_scene(draw.uniform(0.45, 1.0, b))
    gray = image.mean(1, keepdim=True)
    image = gray + of_scene(draw.uniform(0.6, 1.2, b)) * (image - gray)
    image = image + of_scene(draw.uniform(0, 0.02, b)) * draw.normal(*image.shape)
    return (image.clamp(0, 1) * 255).round() / 127.5 - 1


def _solids(draw: _Draw, b: int, options: SceneOptions) -> Solids:
    """Table, boxes, superquadrics, turned shapes and the room of b scenes; the table's top is at z = 0."""
    loose, quadrics, lathes = options.boxes, options.superquadrics, options.lathes
    k = 1 + loose + quadrics + LATHE_PARTS * lathes + 1
    size = torch.full((b, k, 3), 1.0, device=draw.generator.device)
    shape = torch.zeros(b, k, 2, device=size.device)
    origin = torch.zeros(b, k, 3, device=size.device)
    things = loose + quadrics + lathes
    # Thrown around a middle, more densely in some scenes; what is absent lies far below the room.
    radius = draw.uniform(0.08, 0.32, b, 1) * draw.uniform(0, 1, b, things).sqrt()
    around = draw.uniform(0, 2 * math.pi, b, things)
    present = draw.uniform(0, 1, b, things) < draw.uniform(0.4, 1.0, b, 1)
    at = torch.stack([radius * around.cos(), radius * around.sin(), torch.where(present, 0.0, -1e3)], -1)
    # Table: often larger than the picture.
    size[:, 0, :2] = draw.log_uniform(0.3, 1.2, b, 2)
    size[:, 0, 2] = 0.02
    origin[:, 0] = torch.cat([draw.uniform(-0.15, 0.15, b, 2), size.new_full((b, 1), -0.02)], -1)
    boxes = slice(1, 1 + loose)
    size[:, boxes] = torch.cat(
        [draw.log_uniform(0.015, 0.11, b, loose, 2), draw.log_uniform(0.008, 0.11, b, loose, 1)], -1
    )
    origin[:, boxes] = at[:, :loose]
    origin[:, boxes, 2] += size[:, boxes, 2]
    rounds = slice(1 + loose, 1 + loose + quadrics)
    size[:, rounds] = draw.log_uniform(0.018, 0.08, b, quadrics, 3)
    low = draw.whole(3, b, quadrics)
    shape[:, rounds] = torch.stack([low, torch.maximum(low, draw.whole(3, b, quadrics))], -1).float()
    origin[:, rounds] = at[:, loose : loose + quadrics]
    origin[:, rounds, 2] += size[:, rounds, 2]
    turned = slice(1 + loose + quadrics, k - 1)
    radii = draw.log_uniform(0.018, 0.06, b, lathes, 1) * draw.uniform(0.35, 1.3, b, lathes, LATHE_PARTS + 1)
    straight = draw.chance(0.4, b, lathes, 1)
    radii = torch.where(straight, radii[..., :1], radii)
    heights = draw.log_uniform(0.01, 0.09, b, lathes, LATHE_PARTS)
    size[:, turned] = torch.stack([radii[..., :-1], radii[..., 1:], heights], -1).flatten(1, 2)
    hollow = draw.chance(0.4, b, lathes, 1).float().expand(-1, -1, LATHE_PARTS)
    shape[:, turned, 0] = hollow.flatten(1)
    stand = at[:, None, loose + quadrics :].transpose(1, 2).expand(-1, -1, LATHE_PARTS, -1).clone()
    stand[..., 1:, 2] += heights[..., :-1].cumsum(-1)
    origin[:, turned] = stand.flatten(1, 2)
    # The room: a floor below the table, or just under it, walls and a ceiling.
    floor, ceiling = -draw.log_uniform(0.05, 1.0, b), draw.uniform(2.0, 3.0, b)
    size[:, -1] = torch.stack(
        [draw.log_uniform(0.9, 3.0, b), draw.log_uniform(0.9, 3.0, b), (ceiling - floor) / 2], -1
    )
    origin[:, -1, 2] = (ceiling + floor) / 2
    return Solids(_turned_upright(draw, b, k, loose, options), origin, size, shape)


def _turned_upright(
    draw: _Draw, b: int, k: int, loose: int, options: SceneOptions
) -> Float[Tensor, "b k 3 3"]:
    """Rotations about z, with some of the boxes and superquadrics fallen over; the room's is the world's."""
    yaw = draw.uniform(0, 2 * math.pi, b, k)
    yaw[:, 0] = draw.normal(b) * 0.2
    yaw[:, -1] = 0
    fallen = draw.chance(0.15, b, k)
    fallen[:, 0] = False
    fallen[:, 1 + loose + options.superquadrics :] = False
    tip = torch.where(fallen, draw.uniform(0, math.pi, b, k), 0.0)
    zero = torch.zeros_like(yaw)
    about_z = _matrix(yaw.cos(), -yaw.sin(), zero, yaw.sin(), yaw.cos(), zero, zero, zero, zero + 1)
    about_x = _matrix(zero + 1, zero, zero, zero, tip.cos(), -tip.sin(), zero, tip.sin(), tip.cos())
    return about_z @ about_x


def _matrix(*entries: Tensor) -> Tensor:
    """(...,3,3) from nine tensors, row by row."""
    return torch.stack(entries, -1).unflatten(-1, (3, 3))


def _surfaces(draw: _Draw, b: int, k: int, textures: int, plain: float) -> Surfaces:
    lightness = draw.uniform(0.03, 0.95, b, k, 1)
    tint = draw.uniform(-1, 1, b, k, 3) * draw.uniform(0, 1, b, k, 1) ** 2
    color = (lightness * (1 + 0.8 * tint)).clamp(0.01, 1.0)
    contrast = draw.log_uniform(0.05, 1.0, b, k, 1) * color.clamp(min=0.15) * draw.uniform(0.5, 1.3, b, k, 3)
    contrast = torch.where(draw.chance(plain, b, k, 1), 0.0, contrast)
    # Whole scenes without any texture too: what feature matching cannot do.
    contrast = torch.where(draw.chance(0.15, b, 1, 1), 0.0, contrast)
    tile = draw.log_uniform(0.03, 0.5, b, k)
    tile[:, 0] = draw.log_uniform(0.1, 1.5, b)
    tile[:, -1] = draw.log_uniform(0.3, 3.0, b)
    gloss = torch.stack(
        [
            torch.where(draw.chance(0.5, b, k), 0.0, draw.uniform(0, 0.5, b, k)),
            draw.log_uniform(4, 80, b, k),
        ],
        -1,
    )
    return Surfaces(
        draw.whole(textures, b, k), tile, draw.uniform(0, 2 * math.pi, b, k), color, contrast, gloss
    )


def _lamps(draw: _Draw, b: int) -> Lamps:
    aside = draw.uniform(-1.2, 1.2, b, 2, 2)
    position = torch.cat([aside, draw.uniform(0.6, 2.0, b, 2, 1)], -1)
    power = torch.stack([draw.uniform(0.2, 0.9, b), draw.uniform(0, 0.4, b)], -1)
    return Lamps(position, power, draw.uniform(0.25, 0.7, b), draw.uniform(0, 1, b))


def _cameras(draw: _Draw, b: int, options: SceneOptions) -> tuple[Tensor, Tensor]:
    """world_from_camera (n,4,4) and focal lengths (n,) of cameras that look at about the middle of the things."""
    v = options.views
    n = b * v
    low, high = options.distance
    distance = draw.log_uniform(low / 0.8, high / 1.25, b, 1) * draw.log_uniform(0.8, 1.25, b, v)
    elevation = torch.deg2rad(draw.uniform(*options.elevation_deg, b, v))
    spread = torch.deg2rad(draw.uniform(*options.azimuth_spread_deg, b, 1))
    mean_azimuth = draw.uniform(0, 2 * math.pi, b, 1)
    azimuth = mean_azimuth + spread * draw.uniform(-1, 1, b, v)
    away = torch.stack(
        [elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], -1
    )
    aim_spread = 0.12 * distance[..., None]
    target = aim_spread * draw.normal(b, v, 3) * torch.tensor([1.0, 1.0, 0.3], device=distance.device)
    target[..., 2] = target[..., 2].abs()
    # The top of the image: the way that most cameras look along the table, or up.
    along = torch.stack([-mean_azimuth.cos(), -mean_azimuth.sin(), torch.zeros_like(mean_azimuth)], -1)
    up = along.new_tensor([0.0, 0.0, 1.0])
    top = torch.where(draw.chance(options.wrist_like, b, 1, 1), along, up)
    z = -away
    x = F.normalize(torch.linalg.cross(z, top.expand_as(z)), dim=-1)
    roll = torch.deg2rad(options.roll_deg * draw.normal(b, v, 1))
    y = torch.linalg.cross(z, x)
    x, y = roll.cos() * x + roll.sin() * y, roll.cos() * y - roll.sin() * x
    world_from_camera = torch.eye(4, device=z.device).repeat(n, 1, 1)
    world_from_camera[:, :3, :3] = torch.stack([x, y, z], -1).flatten(0, 1)
    world_from_camera[:, :3, 3] = (target + distance[..., None] * away).flatten(0, 1)
    half_angle = torch.deg2rad(draw.uniform(*options.horizontal_fov_deg, b)) / 2
    focal_px = options.width / 2 / half_angle.tan()
    return world_from_camera, focal_px.repeat_interleave(v)


def _color(
    surfaces: Surfaces, hits: Hits, textures: Float[Tensor, "m 3"], footprint: Float[Tensor, "n p"]
) -> Float[Tensor, "n 3 p"]:
    """Of the surfaces hit, whose textures lie on the plane of the solid's axes that the surface faces most.

    `footprint` is how many metres of the surface a pixel covers.
    """
    rows = torch.arange(len(footprint), device=footprint.device)[:, None]
    x, y, z = hits.point_in_solid.unbind(1)
    nx, ny, nz = hits.normal_in_solid.abs().unbind(1)
    faces_x = nx > torch.maximum(ny, nz)
    u = torch.where(faces_x, y, x)
    v = torch.where(~faces_x & (nz >= ny), y, z)
    tile, turn = surfaces.tile[rows, hits.solid], surfaces.turn[rows, hits.solid]
    uv = torch.stack([u * turn.cos() - v * turn.sin(), u * turn.sin() + v * turn.cos()], -1) / tile[..., None]
    # The turn also says where in the texture a surface begins.
    print_ = sample(
        textures, surfaces.texture[rows, hits.solid], uv + turn[..., None], footprint * SIDE / tile
    )
    color = surfaces.color[rows, hits.solid] + surfaces.contrast[rows, hits.solid] * print_
    return color.clamp(0.005, 1).mT
