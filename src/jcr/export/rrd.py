"""Recording for the Rerun viewer: cloud, surface, cameras with their images, grippers."""

from pathlib import Path
from typing import Any

from jcr.export.provenance import Provenance
from jcr.export.views import PosedImages
from jcr.extras import extra
from jcr.files import written_whole
from jcr.records import PointCloud
from jcr.scene.scene_map import SceneMap
from jcr.scene.surface import surface_mesh

_GRIPPER_AXES_M = 0.05


def write_rrd(
    path: Path,
    views: PosedImages,
    cloud: PointCloud,
    scene: SceneMap,
    provenance: Provenance,
) -> None:
    """Write a .rrd; raise InputError without rerun-sdk, which is 500 MB and therefore an extra of its own."""
    rr: Any = extra("rerun", "rerun", "a .rrd file")
    vertices, faces, colors = surface_mesh(scene)
    intrinsics = views.intrinsics
    with written_whole(path) as temporary:
        recording = rr.RecordingStream("jcr")
        recording.save(temporary)
        about = "\n".join(f"{name}: {text}" for name, text in provenance.notes.items())
        recording.log("about", rr.TextDocument(about), static=True)
        recording.log("base", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        recording.log("base/cloud", rr.Points3D(cloud.points_in_base, colors=cloud.color), static=True)
        surface = rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, vertex_colors=colors)
        recording.log("base/surface", surface, static=True)
        poses = zip(views.images, views.base_from_camera, views.base_from_gripper, strict=True)
        for image, base_from_camera, gripper in poses:
            at = rr.Transform3D(translation=gripper[:3, 3], mat3x3=gripper[:3, :3])
            recording.log(f"base/grippers/{image}", at, rr.TransformAxes3D(_GRIPPER_AXES_M), static=True)
            at = rr.Transform3D(translation=base_from_camera[:3, 3], mat3x3=base_from_camera[:3, :3])
            pinhole = rr.Pinhole(
                image_from_camera=intrinsics.matrix,
                resolution=[intrinsics.width, intrinsics.height],
                camera_xyz=rr.ViewCoordinates.RDF,
            )
            pixels = rr.EncodedImage(path=views.folder / image)
            recording.log(f"base/cameras/{image}", at, pinhole, pixels, static=True)
        recording.disconnect()
