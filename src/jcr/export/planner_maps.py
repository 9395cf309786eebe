"""Export of the map for planners and Rerun: OctoMap, voxel grid of distances, spheres, mesh of the surface.

OctoMap, voxel grid and spheres are computed by queries of `SceneMap`, so they agree with these.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from jaxtyping import Float, Integer
from numpy import ndarray

from jcr.errors import InputError
from jcr.export.options import ExportOptions
from jcr.extras import extra
from jcr.records import PointCloud
from jcr.scene.scene_map import FREE, OCCUPIED, SceneMap
from jcr.scene.surface import surface_mesh

if TYPE_CHECKING:
    from jcr.export.nerfstudio_colmap import PosedImages

MAX_VOXELS = 50_000_000
_GRIPPER_AXES_M = 0.05
_SIGN = "positive outside of what is solid, negative inside, metres"


def write_octomap(path: Path, scene: SceneMap, notes: dict[str, str], options: ExportOptions) -> None:
    """Write a binary OctoMap (.bt) in the base frame with cubic voxels.

    A voxel is occupied if its inscribed sphere touches a seen surface, and free if the sphere touches neither a surface
    nor unseen space. All other voxels are left out, so OctoMap treats them as unknown. `notes` become comments. Raises
    InputError without pyoctomap, and if there would be too many voxels.
    """
    octomap: Any = extra("pyoctomap", "planning", "an OctoMap")
    voxel = _voxel(scene, options.voxel_size)
    # OctoMap's voxels lie between multiples of their side; only those inside the workspace are queried.
    low, high = np.ceil(scene.box[0] / voxel - 1e-6), np.floor(scene.box[1] / voxel + 1e-6)
    centers = _centers(low * voxel, (high - low).astype(int), voxel).reshape(-1, 3)
    state = scene.check_spheres(centers, voxel / 2, unknown="report")
    tree = octomap.OcTree(voxel)
    tree.updateNodes(centers[state == FREE], False, True)
    tree.updateNodes(centers[state == OCCUPIED], True, True)
    tree.updateInnerOccupancy()
    first, rest = tree.writeBinary().split(b"\n", 1)
    comments = "".join(f"# {name}: {text}\n" for name, text in notes.items())
    path.write_bytes(first + b"\n" + comments.encode() + rest)


def write_esdf(path: Path, scene: SceneMap, notes: dict[str, str], options: ExportOptions) -> None:
    """Write the signed distance (m) at the centres of voxels in the base frame as .npz, positive outside of solids.

    Unseen space counts as occupied by default. The arrays follow cuRobo's VoxelGrid: `values` (nx,ny,nz), x slowest;
    `origin` (3,), the centre of the first voxel; `voxel_size`; `dims` (3,), the grid's sides (m); `pose` (7,), its
    centre and quaternion w x y z. The texts `sign` and `unknown` follow, and those of `notes` (frame, unit and others).
    """
    voxel, unknown = _voxel(scene, options.voxel_size), options.unknown or "occupied"
    count = np.floor((scene.box[1] - scene.box[0]) / voxel + 1e-6).astype(int)
    centers = _centers(scene.box[0], count, voxel)
    values = scene.query(centers.reshape(-1, 3), unknown).distance.reshape(count)
    dims = voxel * count
    _write_npz(
        path,
        notes,
        values=values.astype(np.float32),
        origin=centers[0, 0, 0],
        voxel_size=voxel,
        dims=dims,
        pose=[*(scene.box[0] + dims / 2), 1.0, 0.0, 0.0, 0.0],
        sign=_SIGN,
        unknown=unknown,
    )


def _write_npz(path: Path, notes: dict[str, str], **arrays: object) -> None:
    """Write arrays and notes as .npz."""
    content: dict[str, Any] = {name: np.array(value) for name, value in (arrays | notes).items()}
    with open(path, "wb") as file:  # np.savez_compressed would append .npz to a path
        np.savez_compressed(file, **content)


def write_spheres(path: Path, scene: SceneMap, notes: dict[str, str], options: ExportOptions) -> None:
    """Write spheres that cover solid space as .npz: `centers` (n,3) m in the base frame, and `radii` (n,) m.

    Spheres exceed solid space by at most `options.excess`, by default two cells of the map. Unseen space counts as free
    by default. Space is sampled in steps of a quarter of the excess.
    """
    unknown = options.unknown or "free"
    excess = 2 * scene.cell if options.excess is None else options.excess
    step = _voxel(scene, excess / 4)
    count = np.ceil((scene.box[1] - scene.box[0]) / step - 1e-6).astype(int)
    points = _centers(scene.box[0], count, step)
    distance = scene.query(points.reshape(-1, 3), unknown).distance.reshape(count)
    index, radii = cover_with_spheres(distance, step, excess)
    _write_npz(path, notes, centers=points[tuple(index.T)], radii=radii, unknown=unknown)


def cover_with_spheres(
    distance: Float[ndarray, "x y z"], step: float, excess: float
) -> tuple[Integer[ndarray, "k 3"], Float[ndarray, " k"]]:
    """Return the voxel indices of the centres, and radii (m), of spheres that contain every voxel touching solid space.

    `distance` d is the signed distance (m), negative inside, from solid space at the centres of voxels with side `step`
    (m). A sphere with centre c and radius excess - d(c) exceeds solid space by at most `excess`. The cover is greedy:
    the deepest voxel that is not yet covered becomes the next centre. A voxel is covered if its whole cube is inside a
    sphere.
    """
    half = 0.5 * np.sqrt(3.0) * step
    left = distance <= half
    candidates = np.argwhere(left)
    candidates = candidates[np.argsort(distance[left], kind="stable")]
    radii, chosen = excess - distance, []
    for at in candidates:
        if left[tuple(at)]:
            reach = float(radii[tuple(at)] - half) / step
            low, high = np.maximum(at - int(reach), 0), np.minimum(at + int(reach) + 1, left.shape)
            x, y, z = np.ogrid[*map(slice, low - at, high - at)]
            left[*map(slice, low, high)] &= x * x + y * y + z * z > reach * reach
            chosen.append(at)
    index = np.array(chosen, dtype=int).reshape(-1, 3)
    return index, radii[tuple(index.T)].astype(np.float64)


def write_glb(path: Path, scene: SceneMap, notes: dict[str, str]) -> None:
    """Write the seen surface with vertex colours as binary glTF (m).

    Vertices are in the robot's base frame with z up, as planners load them; viewers of glTF take y for up and show the
    surface lying on its side. `notes` are stored as metadata. Raises InputError if the map has no surface.
    """
    vertices, faces, colors = surface_mesh(scene)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    axes = {"axes": "the robot's, z up (not rotated to glTF's y up)"}
    exported = trimesh.Scene({"map": mesh}, metadata=notes | axes).export(file_type="glb")
    assert isinstance(exported, bytes)
    path.write_bytes(exported)


def _centers(lower: ndarray, count: ndarray, voxel: float) -> Float[ndarray, "x y z 3"]:
    """Return the centres (x,y,z,3) in m of a grid of cubic voxels of side `voxel` (m); the axes follow x, y, z.

    `count` (3,) is the number of voxels along each axis. `lower` (3,) is the corner of the grid with the smallest
    coordinates (m).
    """
    axes = [corner + voxel * (np.arange(n) + 0.5) for corner, n in zip(lower, count, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1)


def _voxel(scene: SceneMap, side: float | None) -> float:
    """Return the side (m) of voxels: `side` or, if None, the map's cell."""
    side = scene.cell if side is None else side
    extent = scene.box[1] - scene.box[0]
    if not 0 < side <= extent.min():
        raise InputError(f"voxels of {side:g} m: give a length between 0 and {extent.min():.2f} m")
    if np.prod(extent / side) > MAX_VOXELS:
        raise InputError(f"voxels of {side:g} m: over {MAX_VOXELS // 10**6} million; take a larger size")
    return side


def write_rrd(
    path: Path, views: "PosedImages", cloud: PointCloud, scene: SceneMap, notes: dict[str, str]
) -> None:
    """Write a recording for the Rerun viewer (.rrd): point cloud, surface, gripper poses and images with cameras.

    Poses and points are in the base frame (m); `notes` are stored as text.
    """
    rr: Any = import_module("rerun")
    vertices, faces, colors = surface_mesh(scene)
    intrinsics = views.intrinsics
    recording = rr.RecordingStream("jcr")
    recording.save(path)
    about = "\n".join(f"{name}: {text}" for name, text in notes.items())
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
