"""Spheres that cover the collision shapes of a robot's URDF, and their positions for joint values."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from jcr.capture.urdf_chain import joints_to, load_urdf
from jcr.errors import InputError
from jcr.geometry import apply, rotation_exp, transform
from jcr.scene.spheres import cover_with_spheres

if TYPE_CHECKING:
    import trimesh
    import yourdfpy

VOXELS = 100_000
"""Largest number of voxels in the bounding box of a shape."""

JointValues = Float[ndarray, "*batch dof"] | Mapping[str, Float[ndarray, "*batch"] | float]


@dataclass(frozen=True, kw_only=True)
class RobotJoint:
    """Joint between two links, which are rows of `RobotSpheres.links`."""

    parent: int
    child: int
    parent_from_joint: Float[ndarray, "4 4"]
    axis: Float[ndarray, "3"]
    slides: bool
    column: int | None
    """Column of the joint values; None for a fixed joint."""
    factor: float
    offset: float
    """Value of the joint = factor · column + offset, for joints that mimic another one."""


@dataclass(frozen=True, kw_only=True)
class RobotSpheres:
    """Spheres fixed to links, and the joints, parents before children."""

    links: tuple[str, ...]
    joint_names: tuple[str, ...]
    """Joints that move, in the order of the URDF: the order of joint values."""
    joints: tuple[RobotJoint, ...]
    link: Int[ndarray, " s"]
    """Row of `links` that each sphere is fixed to."""
    centers_in_link: Float[ndarray, "s 3"]
    radii: Float[ndarray, " s"]

    def without(self, names: tuple[str, ...]) -> "RobotSpheres":
        """Return the robot without the spheres of some links; raise InputError for a link that it does not have."""
        unknown = set(names) - set(self.links)
        if unknown:
            raise InputError(f"links {sorted(unknown)}: the robot has only {', '.join(self.links)}")
        kept = ~np.isin(self.link, [self.links.index(name) for name in names])
        return replace(
            self, link=self.link[kept], centers_in_link=self.centers_in_link[kept], radii=self.radii[kept]
        )

    def centers(self, joint_values: JointValues) -> Float[ndarray, "*batch s 3"]:
        """Return sphere centres (…,s,3) in the frame of the robot's root link, for joint values (…,dof) rad or m.

        Values are in the order of `joint_names`, or a mapping from these names to values (…). Raises
        InputError for other names, another number of values, or one that is not finite.
        """
        values = self._in_order(joint_values)
        batch = values.shape[:-1]
        root_from_link = np.broadcast_to(np.eye(4), (len(self.links), *batch, 4, 4)).copy()
        for joint in self.joints:
            pose = root_from_link[joint.parent] @ joint.parent_from_joint
            if joint.column is not None:
                along = (joint.factor * values[..., joint.column] + joint.offset)[..., None] * joint.axis
                still = np.zeros(3)
                pose = pose @ (
                    transform(np.eye(3), along) if joint.slides else transform(rotation_exp(along), still)
                )
            root_from_link[joint.child] = pose
        pose = np.moveaxis(root_from_link[self.link], 0, -3)
        return (pose[..., :3, :3] @ self.centers_in_link[:, :, None])[..., 0] + pose[..., :3, 3]

    def _in_order(self, joint_values: JointValues) -> Float[ndarray, "*batch dof"]:
        """Return joint values in the order of `joint_names`; raise InputError for unusable ones."""
        names = ", ".join(self.joint_names)
        if isinstance(joint_values, Mapping):
            wrong = set(joint_values) ^ set(self.joint_names)
            if wrong:
                raise InputError(f"joints {sorted(wrong)}: missing or unknown; the robot's are {names}")
            columns = [np.asarray(joint_values[name], float) for name in self.joint_names]
            joint_values = np.stack(np.broadcast_arrays(*columns), -1)
        values = np.asarray(joint_values, float)
        if values.ndim == 0 or values.shape[-1] != len(self.joint_names):
            raise InputError(
                f"joint values of shape {values.shape}: expected (…, {len(self.joint_names)}), for {names}"
            )
        if not np.isfinite(values).all():
            raise InputError("joint values: one is not finite; give radians, or metres where a joint slides")
        return values


def load_robot(urdf: str | Path, excess: float = 0.01) -> RobotSpheres:
    """Load the robot of a URDF file, its collision shapes covered by spheres that stick out by about `excess` (m).

    Boxes, cylinders, spheres and meshes; a link without collision shape has no spheres. The result is kept, so
    that the robot of unchanged files is quick to load again. Raises InputError where the file or a mesh of it cannot be
    read, or nothing is there to collide with.
    """
    path = Path(urdf)
    if not path.is_file():
        raise InputError(f"{path}: no such URDF file")
    if not excess > 0:
        raise InputError(f"excess {excess}: give metres above 0, e.g. 0.01")
    return _load(path.resolve(), _times_ns(path.resolve()), excess)


def _times_ns(path: Path) -> tuple[int, ...]:
    """Return when the URDF file and each of its meshes that exists were changed."""
    import yourdfpy

    names = re.findall(r'filename\s*=\s*["\']([^"\']+)', path.read_text("utf-8", errors="replace"))
    meshes = (Path(yourdfpy.filename_handler_magic(name, dir=path.parent)) for name in names)
    return tuple(file.stat().st_mtime_ns for file in (path, *meshes) if file.is_file())


@lru_cache(maxsize=8)
def _load(path: Path, times_ns: tuple[int, ...], excess: float) -> RobotSpheres:
    """Return the spheres of the robot in an existing file; `times_ns` tells changed files apart."""
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
        while on not in found:  # a mesh file may be a tree of its own
            on = graph.transforms.parents[on]
        link_from_shape, name = graph.get(frame_to=node, frame_from=on)
        found[on] += 1
        center, radius = spheres_of_shape(shapes[name], np.asarray(link_from_shape), excess)
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


def _joints(robot: "yourdfpy.URDF", links: tuple[str, ...], path: Path) -> tuple[RobotJoint, ...]:
    """Return the joints of a robot, parents before children."""
    joints = []
    for joint in sorted(robot.robot.joints, key=lambda joint: len(joints_to(robot, joint.child))):
        if joint.type not in ("revolute", "continuous", "prismatic", "fixed"):
            raise InputError(f"{path}: joint {joint.name} is {joint.type}, which is not supported")
        leader, factor, offset = joint.name, 1.0, 0.0
        if (mimic := joint.mimic) is not None:
            leader, offset = mimic.joint, mimic.offset or 0.0
            factor = 1.0 if mimic.multiplier is None else mimic.multiplier
        moves = joint.type != "fixed"
        if moves and leader not in robot.actuated_joint_names:
            raise InputError(f"{path}: joint {joint.name} mimics {leader}, which is not an independent joint")
        axis = np.array([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, float)
        joints.append(
            RobotJoint(
                parent=links.index(joint.parent),
                child=links.index(joint.child),
                parent_from_joint=np.eye(4) if joint.origin is None else np.asarray(joint.origin, float),
                axis=axis / np.linalg.norm(axis),
                slides=joint.type == "prismatic",
                column=robot.actuated_joint_names.index(leader) if moves else None,
                factor=factor,
                offset=offset,
            )
        )
    return tuple(joints)


def spheres_of_shape(
    shape: "trimesh.Trimesh", link_from_shape: Float[ndarray, "4 4"], excess: float
) -> tuple[Float[ndarray, "s 3"], Float[ndarray, " s"]]:
    """Return centres (s,3) in the link and radii (s,) m of spheres that together hold a solid shape.

    They stick out of it by at most `excess` (m) and half a voxel of the search: a sixth of the excess, for shapes up to
    15 cm.
    """
    from trimesh.primitives import Sphere  # half a second, and maps of captures without a URDF do without

    if isinstance(shape, Sphere):
        ball: Any = shape.primitive
        return apply(link_from_shape, np.asarray(ball.center)[None]), np.array([float(ball.radius)])
    pitch = max(excess / 3, float(np.prod(shape.extents) / VOXELS) ** (1 / 3))
    voxels = cast(Any, shape.voxelized(pitch)).fill()
    solid = np.pad(voxels.matrix, 1)
    depth = np.asarray(distance_transform_edt(solid))
    distance = np.where(solid, pitch * (0.5 - depth), np.inf)
    index, radii = cover_with_spheres(distance, pitch, excess)
    centers = apply(np.asarray(voxels.transform), index - 1.0)
    return apply(link_from_shape, centers), radii
