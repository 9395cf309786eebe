"""The seen surface of a map as triangles: where the learned occupancy crosses one half and a ray ended."""

import numpy as np
import torch
from jaxtyping import Float, Integer, UInt8
from numpy import ndarray
from skimage.measure import marching_cubes
from torch import Tensor

from jcr.errors import InputError
from jcr.scene.fields import in_chunks
from jcr.scene.scene_map import SceneMap
from jcr.scene.seen import HIT, SeenGrid, dilate


def surface_mesh(
    scene: SceneMap,
) -> tuple[Float[ndarray, "v 3"], Integer[ndarray, "f 3"], UInt8[ndarray, "v 3"]]:
    """Return vertices (v,3) m in the base frame, triangles (f,3) facing free space, and RGB of the vertices (v,3).

    Marching cubes (scikit-image) on the logit of occupancy at steps of half a cell. Behind each surface, where
    no ray passed, the field crosses one half again: only triangles where rays ended are kept.
    Raises InputError where there are none.
    """
    seen = scene.seen
    hit = dilate((seen.state & HIT) != 0, 1)
    near = dilate(hit, 1)
    center = seen.lower + seen.cell * (near.nonzero().flip(1) + 0.5)

    def logit(x: Float[Tensor, "n 3"]) -> tuple[Tensor]:
        return (scene.fields(x, ("occupancy",))["occupancy"][:, 0],)

    volume = torch.full(near.shape, -1.0, device=center.device)
    if len(center):
        volume[near] = in_chunks(logit, center)[0]
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
