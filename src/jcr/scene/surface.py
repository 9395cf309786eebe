"""Surface of a trained map as triangles and points, and level slices; torch is imported when a map is there."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from jcr.errors import InputError

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap, Unknown

SLICE_PIXELS = 240
"""Pixels along the longer side of a slice."""


@dataclass(frozen=True, kw_only=True)
class SurfacePoints:
    """Points on the surface where the predicted occupancy is one half, on the sides that some camera has seen."""

    points_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    point_size: float
    """Side (m) of the squares that are drawn in place of the points."""


@dataclass(frozen=True, kw_only=True)
class Slice:
    """Map at one height: columns along the base's x axis, rows along its y axis, downwards in y."""

    occupancy: Float[ndarray, "h w"]
    distance: Float[ndarray, "h w"]
    """Signed distance (m); NaN outside of the workspace."""
    unknown: Bool[ndarray, "h w"]


def surface_mesh(
    scene: "SceneMap",
) -> tuple[Float[ndarray, "v 3"], Integer[ndarray, "f 3"], UInt8[ndarray, "v 3"]]:
    """Return vertices (v,3) m in the base frame, triangles (f,3) facing free space, and RGB of the vertices (v,3).

    Marching cubes (scikit-image) on the logit of occupancy at steps of half a cell. Behind each surface, where
    no ray passed, the field crosses one half again: only triangles where rays ended are kept.
    Raises InputError where there are none.
    """
    import torch
    from skimage.measure import marching_cubes

    from jcr.scene.fields import in_chunks
    from jcr.scene.seen import HIT, SeenGrid, dilate

    seen = scene.seen
    hit = dilate((seen.state & HIT) != 0, 1)
    near = dilate(hit, 1)
    center = seen.lower + seen.cell * (near.nonzero().flip(1) + 0.5)

    volume = torch.full(near.shape, -1.0, device=center.device)
    if len(center):
        (volume[near],) = in_chunks(lambda x: (scene.fields(x, ("occupancy",))["occupancy"][:, 0],), center)
    if volume.max() < 0:
        raise InputError(
            "the map holds no surface to make a mesh of; see in the report what the images showed"
        )
    zyx, faces, _, _ = marching_cubes(volume.cpu().numpy(), 0.0)
    vertices = scene.box[0] + seen.cell * (zyx[:, ::-1] + 0.5)
    middle = torch.as_tensor(vertices[faces].mean(1), dtype=torch.float32, device=center.device)
    kept = SeenGrid(seen.lower, seen.cell, hit.to(torch.uint8)).at(middle).bool().cpu().numpy()
    used, faces = np.unique(faces[kept], return_inverse=True)
    color = np.nan_to_num(scene.query(vertices[used]).color)
    return vertices[used], faces.reshape(-1, 3), np.rint(255 * color).astype(np.uint8)


def sample_surface(scene: "SceneMap", count: int) -> SurfacePoints:
    """Return at most `count` points, drawn evenly over the seen surface of the map; none where it has no surface."""
    try:
        vertices, faces, color = surface_mesh(scene)
    except InputError:
        vertices, faces, color = np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    draw = np.random.default_rng(0)
    drawn = draw.choice(len(faces), count, p=area / area.sum()) if len(faces) else np.zeros(0, int)
    share = draw.dirichlet(np.ones(3), len(drawn))[..., None]
    x = (share * corners[drawn]).sum(1)
    return SurfacePoints(
        points_in_base=x,
        color=(share * color[faces[drawn]]).sum(1).round().astype(np.uint8),
        label=scene.query(x).label,
        point_size=point_size(x),
    )


def level_slice(scene: "SceneMap", height: float, unknown: "Unknown") -> Slice:
    """Return the map at z = height (m), with unknown space counted as given."""
    low, high = scene.box
    pitch = float((high - low)[:2].max() / SLICE_PIXELS)
    a, b = (np.arange(low[k] + pitch / 2, high[k], pitch) for k in (0, 1))
    x = np.full((len(b), len(a), 3), height)
    x[..., 0], x[..., 1] = np.meshgrid(a, b[::-1])
    answer, shape = scene.query(x.reshape(-1, 3), unknown), x.shape[:2]
    return Slice(
        occupancy=answer.occupancy.reshape(shape),
        distance=answer.distance.reshape(shape),
        unknown=answer.unknown.reshape(shape),
    )


def point_size(points: Float[ndarray, "n 3"]) -> float:
    """Return the side (m) of squares that, drawn in place of the points, close most gaps between them."""
    if len(points) < 2:
        return 0.01
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # built in a third of the time
    nearest = tree.query(points[:: max(len(points) // 1000, 1)], k=2)[0][:, 1]
    return round(2.2 * float(np.median(nearest)), 5)
