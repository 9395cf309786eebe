"""Triangle meshes with texture coordinates, made from a few numbers: boxes, solids of revolution, tubes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Mesh:
    """Triangles, counter-clockwise seen from outside, in metres."""

    vertices: Float[ndarray, "v 3"]
    uv: Float[ndarray, "v 2"]
    """Texture coordinates: u along the columns, v up the rows."""
    faces: Int[ndarray, "f 3"]

    def moved(self, offset: Triple) -> "Mesh":
        """Return the mesh shifted by `offset` (3,) m."""
        return Mesh(self.vertices + np.asarray(offset), self.uv, self.faces)


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=True)]),
    )


def grid(vertices: Float[ndarray, "r c 3"], uv: Float[ndarray, "r c 2"]) -> Mesh:
    """Return a sheet of vertices, rows by columns; outside is where columns × rows points."""
    rows, columns = vertices.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return Mesh(vertices.reshape(-1, 3), uv.reshape(-1, 2), faces)


# Outward normal, then the directions of u and of v across the side.
_SIDES = {
    "+x": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-x": ((-1, 0, 0), (0, -1, 0), (0, 0, 1)),
    "+y": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-y": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "+z": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "-z": ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
}


def box(size: Triple, sides: Sequence[str] = tuple(_SIDES)) -> Mesh:
    """Return sides of a box of `size` (x, y, z) m standing on z = 0; each shows the whole texture."""
    half = np.asarray(size) / 2
    square = np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 1.0]]])
    meshes = []
    for side in sides:
        normal, right, up = (np.array(direction) * half for direction in _SIDES[side])
        corners = normal + (2 * square[..., :1] - 1) * right + (2 * square[..., 1:] - 1) * up
        meshes.append(grid(corners + [0, 0, half[2]], square))
    return _joined(meshes)


def revolved(*profiles: Sequence[tuple[float, float]], segments: int = 48) -> Mesh:
    """Return the solid of revolution about z of profiles [(radius, z), …] m, outside on the right hand along them.

    Within a profile the surface is shaded smooth; between profiles there is an edge.
    """
    around = np.linspace(0, 1, segments + 1)
    ring = np.stack([np.cos(2 * np.pi * around), np.sin(2 * np.pi * around)], -1)
    meshes = []
    for profile in profiles:
        radius, z = np.asarray(profile, float).T
        vertices = np.empty((len(radius), segments + 1, 3))
        vertices[..., :2] = radius[:, None, None] * ring
        vertices[..., 2] = z[:, None]
        along = np.r_[0.0, np.cumsum(np.hypot(np.diff(radius), np.diff(z)))]
        uv = np.stack(np.broadcast_arrays(around, (along / along[-1])[:, None]), -1)
        meshes.append(grid(vertices, uv))
    return _joined(meshes)


def tube(path: Float[ndarray, "n 3"], radius: float, segments: int = 12) -> Mesh:
    """Return a round tube of `radius` m about a path (n,3) m in a vertical plane: the handle of a mug or a case."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # The path stays in one plane, whose normal no tangent is parallel to.
    plane_normal = np.cross(path[0] - path[len(path) // 2], path[-1] - path[len(path) // 2])
    side = np.broadcast_to(plane_normal / np.linalg.norm(plane_normal), path.shape)
    other = np.cross(tangent, side)
    around = np.linspace(0, 1, segments + 1)[None, :, None]
    ring = np.cos(2 * np.pi * around) * side[:, None] + np.sin(2 * np.pi * around) * other[:, None]
    along = np.linspace(0, 1, len(path))[:, None]
    return grid(path[:, None] + radius * ring, np.stack(np.broadcast_arrays(around[..., 0], along), -1))
