"""The seen surface as a mesh with vertex colours."""

from pathlib import Path

import trimesh

from jcr.export.provenance import Provenance
from jcr.files import write_bytes
from jcr.represent.scene import SceneMap
from jcr.represent.surface import surface_mesh


def write_glb(path: Path, scene: SceneMap, provenance: Provenance) -> None:
    """Write the seen surface of a map as binary glTF.

    Its vertices are those of the robot's frame, z up, as planners load them; glTF's own viewers take y for up and
    show it lying on its side. Raises InputError where the map has no surface.
    """
    vertices, faces, colors = surface_mesh(scene)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    axes = {"axes": "the robot's, z up (not rotated to glTF's y up)"}
    exported = trimesh.Scene({"map": mesh}, metadata=provenance.notes | axes).export(file_type="glb")
    assert isinstance(exported, bytes)
    write_bytes(path, exported)
