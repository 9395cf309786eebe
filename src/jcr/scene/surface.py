"""Surface of a trained map as triangles or as points; torch is imported only when a map is used."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, Integer, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from jcr.errors import InputError

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap


def surface_mesh(
    scene: "SceneMap",
) -> tuple[Float[ndarray, "v 3"], Integer[ndarray, "f 3"], UInt8[ndarray, "v 3"]]:
    """Return vertices (v,3) m in the base frame, triangles (f,3) whose front faces free space, and vertex RGB (v,3).

    A triangle has the indices of its vertices. Marching cubes (scikit-image) finds the surface of occupancy 0.5, in
    steps of half a map cell. Only triangles near the ends of rays are kept, because the field has a second, false
    surface behind each real one. Raises InputError if the map has no surface.
    """
    import torch
    from skimage.measure import marching_cubes

    from jcr.scene.fields import in_chunks
    from jcr.scene.seen_space import HIT, SeenGrid, dilate

    seen = scene.seen
    hit = dilate((seen.state & HIT) != 0, 1)
    near = dilate(hit, 1)
    center = seen.lower + seen.cell * (near.nonzero().flip(1) + 0.5)

    volume = torch.full(near.shape, -1.0, device=center.device)
    if len(center):
        (volume[near],) = in_chunks(lambda x: (scene.fields(x, ("occupancy",))["occupancy"][:, 0],), center)
    if volume.max() < 0:
        raise InputError("the map holds no surface; see in the report what the images showed")
    zyx, faces, _, _ = marching_cubes(volume.cpu().numpy(), 0.0)
    vertices = scene.box[0] + seen.cell * (zyx[:, ::-1] + 0.5)
    middle = torch.as_tensor(vertices[faces].mean(1), dtype=torch.float32, device=center.device)
    kept = SeenGrid(seen.lower, seen.cell, hit.to(torch.uint8)).at(middle).bool().cpu().numpy()
    used, faces = np.unique(faces[kept], return_inverse=True)
    color = np.nan_to_num(scene.query(vertices[used]).color)
    return vertices[used], faces.reshape(-1, 3), np.rint(255 * color).astype(np.uint8)


def sample_surface(
    scene: "SceneMap", count: int
) -> tuple[Float[ndarray, "n 3"], UInt8[ndarray, "n 3"], Int[ndarray, " n"]]:
    """Return positions (n,3) m in the base frame, RGB (n,3) and label (n,) of `count` points of the seen surface.

    The points are uniform over the area of `surface_mesh`, if there is any; labels are indices into `label_names`.
    """
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
    return x, (share * color[faces[drawn]]).sum(1).round().astype(np.uint8), scene.query(x).label


def point_size(points: Float[ndarray, "n 3"]) -> float:
    """Return the size (m) at which points (n,3) m are drawn so that few gaps remain, 0.01 for fewer than two points.

    The size is 2.2 times the median distance from a point to the nearest other point.
    """
    if len(points) < 2:
        return 0.01
    tree = KDTree(points, compact_nodes=False, balanced_tree=False)  # takes a third of the time
    nearest = tree.query(points[:: max(len(points) // 1000, 1)], k=2)[0][:, 1]
    return round(2.2 * float(np.median(nearest)), 5)
