"""Solid space of a simulated scene, and the surface that its images show."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from PIL import Image
from scipy.spatial.distance import cdist

from jcr.camera import rays
from jcr.geometry import apply, inverse, transform
from simulation.meshes import Mesh
from simulation.scenes import Scene
from simulation.truth import Truth, true_depth, true_labels


def solid_labels(scene: Scene, x_in_base: Float[ndarray, "n 3"]) -> Int[ndarray, "n"]:
    """Return the label of the solid that each point (n,3) m lies within: the table, an object, or 0 for none."""
    table_frame = transform(np.eye(3), scene.table_center_in_base)
    solids = [(table_frame, scene.table), *((thing.base_from_object, thing.parts) for thing in scene.objects)]
    labels = np.zeros(len(x_in_base), np.int64)
    for label, (base_from_solid, parts) in enumerate(solids, start=1):
        x_in_solid = apply(inverse(base_from_solid), x_in_base)
        corners = np.concatenate([part.mesh.vertices for part in parts])
        near = ((x_in_solid >= corners.min(0)) & (x_in_solid <= corners.max(0))).all(1)
        windings = sum(
            (winding_number(part.mesh, x_in_solid[near]) for part in parts), start=np.zeros(near.sum())
        )
        labels[np.flatnonzero(near)[windings > 0.5]] = label
    return labels


def winding_number(mesh: Mesh, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Return how often the surface winds around each point: 1 within a closed one, 0 outside; parts add up.

    The triangles' solid angles (van Oosterom and Strackee 1983, eq. 8) over 4π, as in Jacobson et al. 2013.
    """
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    # With the corners seen from x, a' = a - x, both the volume a'·(b'×c') and a'·b' are polynomials in x.
    normal = np.cross(a, b) + np.cross(b, c) + np.cross(c, a)
    volume = (a * np.cross(b, c)).sum(-1)

    def dot(p: ndarray, q: ndarray, x: ndarray) -> Float[ndarray, "k f"]:
        return (p * q).sum(-1) - x @ (p + q).T + (x * x).sum(-1, keepdims=True)

    windings = np.empty(len(points))
    # In blocks that stay within the cache.
    for start in range(0, len(points), 128):
        x = points[start : start + 128]
        la, lb, lc = cdist(x, mesh.vertices)[:, mesh.faces].transpose(2, 0, 1)
        cosines = la * lb * lc + dot(a, b, x) * lc + dot(b, c, x) * la + dot(c, a, x) * lb
        windings[start : start + 128] = np.arctan2(volume - x @ normal.T, cosines).sum(-1) / (2 * np.pi)
    return windings


@dataclass(frozen=True)
class Surface:
    """Points at all pixels of a simulated capture, and the truth about each."""

    x_in_base: Float[ndarray, "n 3"]
    color: UInt8[ndarray, "n 3"]
    label: Int[ndarray, " n"]
    image: Int[ndarray, " n"]


def true_surface(truth: Truth) -> Surface:
    """Return the surface that the images show; it needs the depth that `--truth scene` leaves out."""
    parts = []
    for k, base_from_camera in enumerate(truth.base_from_camera):
        depth = true_depth(truth, k)
        shown = depth > 0
        with Image.open(truth.folder / truth.images[k]) as image:
            color = np.asarray(image)[shown]
        x_in_base = apply(base_from_camera, depth[shown][:, None] * rays(truth.intrinsics)[shown])
        label = true_labels(truth, k)[shown].astype(np.int64)
        parts.append((x_in_base, color, label, np.full(len(label), k)))
    return Surface(*map(np.concatenate, zip(*parts, strict=True)))


def surface_in_workspace(truth: Truth) -> Surface:
    """Return the surface of table and objects in the workspace that the images show."""
    surface, (low, high) = true_surface(truth), truth.workspace_in_base
    there = (surface.label > 0) & ((surface.x_in_base >= low) & (surface.x_in_base <= high)).all(1)
    return Surface(*(one[there] for one in vars(surface).values()))
