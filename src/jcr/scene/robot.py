"""Spheres that cover the collision shapes of a robot's URDF, and their positions at given joint values."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Float, Int, Integer
from numpy import ndarray
from numpy.typing import ArrayLike
from scipy.ndimage import distance_transform_edt

from jcr.capture.urdf_chain import joints_to, load_urdf
from jcr.errors import InputError
from jcr.geometry import apply, rotation_exp, transform

if TYPE_CHECKING:
    import trimesh
    import yourdfpy

VOXELS = 100_000
"""Largest number of voxels in the bounding box of a shape."""

EXCESS = 0.01
"""Length (m) by which spheres exceed the shape that they cover."""
Joint = tuple[int, int, Float[ndarray, "4 4"], Float[ndarray, "3"], bool, int | None, float, float]
"""Joint of a URDF: row of its parent link, row of its child link, parent_from_joint, unit axis, whether it slides,
column of its value (None: fixed), factor and offset. The value of a joint that mimics another one is factor times the
column's value plus offset; factor is 1 and offset 0 for other joints."""


@dataclass(frozen=True, kw_only=True)
class RobotSpheres:
    """Robot model for collision tests: spheres that are fixed to the links, and the joints that move the links."""

    links: tuple[str, ...]
    """Names of the links."""
    joint_names: tuple[str, ...]
    """Names of the independent joints in the order of the URDF, which is the order of joint values."""
    joints: tuple[Joint, ...]
    """All joints, those of parent links before those of their children."""
    link: Int[ndarray, " s"]
    """Row of `links` that each sphere is fixed to."""
    centers_in_link: Float[ndarray, "s 3"]
    """Centre (m) of each sphere in the frame of its link."""
    radii: Float[ndarray, " s"]
    """Radius (m) of each sphere."""

    def without(self, names: tuple[str, ...]) -> "RobotSpheres":
        """Return the robot without the spheres of the named links; raise InputError for an unknown link."""
        if unknown := set(names) - set(self.links):
            raise InputError(f"links {sorted(unknown)}: the robot has only {', '.join(self.links)}")
        kept = ~np.isin(self.link, [self.links.index(name) for name in names])
        return replace(
            self, link=self.link[kept], centers_in_link=self.centers_in_link[kept], radii=self.radii[kept]
        )

    def centers(self, joint_values: ArrayLike) -> Float[ndarray, "*batch s 3"]:
        """Return sphere centres (…,s,3) m in the frame of the robot's root link, for joint values (…,dof) rad or m.

        The values are in the order of `joint_names`. Raises InputError for a wrong number of values, or a value that is
        not finite.
        """
        values = np.asarray(joint_values, float)
        if values.ndim == 0 or values.shape[-1] != len(self.joint_names):
            names = ", ".join(self.joint_names)
            raise InputError(
                f"joint values of shape {values.shape}: expected (…, {len(self.joint_names)}), for {names}"
            )
        if not np.isfinite(values).all():
            raise InputError("joint values: one is not finite; give radians, or metres where a joint slides")
        root_from_link = np.broadcast_to(np.eye(4), (len(self.links), *values.shape[:-1], 4, 4)).copy()
        for parent, child, parent_from_joint, axis, slides, column, factor, offset in self.joints:
            pose = root_from_link[parent] @ parent_from_joint
            if column is not None:
                along = (factor * values[..., column] + offset)[..., None] * axis
                turned, moved = (np.eye(3), along) if slides else (rotation_exp(along), np.zeros(3))
                pose = pose @ transform(turned, moved)
            root_from_link[child] = pose
        pose = np.moveaxis(root_from_link[self.link], 0, -3)
        return (pose[..., :3, :3] @ self.centers_in_link[:, :, None])[..., 0] + pose[..., :3, 3]


def load_robot(urdf: str | Path) -> RobotSpheres:
    """Load the robot of a URDF file, with spheres that cover its collision shapes and exceed them by about 1 cm.

    Shapes are boxes, cylinders, spheres and meshes; a link without collision shape has no spheres. Raises InputError if
    the file or one of its meshes cannot be read, or if no link has a collision shape.
    """
    path = Path(urdf)
    if not path.is_file():
        raise InputError(f"{path}: no such URDF file")
    import yourdfpy

    tree = load_urdf(path)
    links = tuple(link.name for link in tree.robot.links)
    joints = _joints(tree, links, path)
    robot: Any = yourdfpy.URDF.load(
        str(path),
        build_scene_graph=False,
        build_collision_scene_graph=True,
        load_meshes=False,
        load_collision_meshes=True,
        force_collision_mesh=False,
    )
    graph, shapes = robot.collision_scene.graph, robot.collision_scene.geometry
    link, centers, radii = [], [], []
    found = dict.fromkeys(links, 0)
    for node in graph.nodes_geometry:
        on = node
        while on not in found:  # the shape may be in a tree of nodes of its mesh file, below the link
            on = graph.transforms.parents[on]
        link_from_shape, name = graph.get(frame_to=node, frame_from=on)
        found[on] += 1
        center, radius = spheres_of_shape(shapes[name], np.asarray(link_from_shape))
        link.append(np.full(len(radius), links.index(on)))
        centers.append(center)
        radii.append(radius)
    for each in tree.robot.links:
        if found[each.name] < len(each.collisions):
            raise InputError(f"{path}: a collision mesh of link {each.name} cannot be found; fix its path")
    if not radii:
        raise InputError(f"{path}: no link has a <collision> shape, so nothing can collide")
    return RobotSpheres(
        links=links,
        joint_names=tuple(tree.actuated_joint_names),
        joints=joints,
        link=np.concatenate(link),
        centers_in_link=np.concatenate(centers),
        radii=np.concatenate(radii),
    )


def _joints(robot: "yourdfpy.URDF", links: tuple[str, ...], path: Path) -> tuple[Joint, ...]:
    """Return the joints of a robot, parents before children; a joint names its two links by their indices in `links`.

    `links` are the names of the links. Raises InputError for an unsupported type of joint, or a joint that mimics a
    dependent one. The message begins with `path`.
    """
    joints = []
    for joint in sorted(robot.robot.joints, key=lambda joint: len(joints_to(robot, joint.child))):
        if joint.type not in ("revolute", "continuous", "prismatic", "fixed"):
            raise InputError(f"{path}: joint {joint.name} is {joint.type}, which is not supported")
        leader, factor, offset = joint.name, 1.0, 0.0
        if (mimic := joint.mimic) is not None:
            leader, offset = mimic.joint, mimic.offset or 0.0
            factor = 1.0 if mimic.multiplier is None else mimic.multiplier
        column = None
        if joint.type != "fixed":
            if leader not in robot.actuated_joint_names:
                raise InputError(
                    f"{path}: joint {joint.name} mimics {leader}, which is not an independent joint"
                )
            column = robot.actuated_joint_names.index(leader)
        axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, float)
        parent_from_joint = np.eye(4) if joint.origin is None else np.asarray(joint.origin, float)
        ends = links.index(joint.parent), links.index(joint.child)
        slides = joint.type == "prismatic"
        joints.append((*ends, parent_from_joint, axis / np.linalg.norm(axis), slides, column, factor, offset))
    return tuple(joints)


def spheres_of_shape(
    shape: "trimesh.Trimesh", link_from_shape: Float[ndarray, "4 4"]
) -> tuple[Float[ndarray, "s 3"], Float[ndarray, " s"]]:
    """Return centres (s,3) m in the link's frame and radii (s,) m of spheres that together contain a solid shape.

    `shape` is in metres, and `link_from_shape` is its pose in the link's frame. The spheres exceed the shape by at most
    EXCESS plus half a voxel. Half a voxel is a sixth of the excess for shapes up to 15 cm. A shape that is a sphere is
    returned unchanged.
    """
    from trimesh.primitives import Sphere  # takes half a second, and is not needed without a URDF

    if isinstance(shape, Sphere):
        ball: Any = shape.primitive
        return apply(link_from_shape, np.asarray(ball.center)[None]), np.array([float(ball.radius)])
    pitch = max(EXCESS / 3, float(np.prod(shape.extents) / VOXELS) ** (1 / 3))
    voxels = cast(Any, shape.voxelized(pitch)).fill()
    solid = np.pad(voxels.matrix, 1)
    distance = np.where(solid, pitch * (0.5 - np.asarray(distance_transform_edt(solid))), np.inf)
    index, radii = cover_with_spheres(distance, pitch, EXCESS)
    return apply(link_from_shape, apply(np.asarray(voxels.transform), index - 1.0)), radii


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
