"""Arms in URDF files: chains of rotating joints as the estimation's `Arm`."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.plain_files import read_text
from jcr.errors import InputError
from jcr.estimation.kinematics import Arm
from jcr.geometry import require_rigid

if TYPE_CHECKING:
    import yourdfpy

ANY_ANGLE = (-2 * np.pi, 2 * np.pi)


def read_chain(file: Path, dof: int) -> Arm:
    """Read the arm of `dof` joints in a URDF file; its gripper frame is the link behind the last joint.

    Raises InputError where the file is no URDF, has no such chain or several, or has a joint in it that does not
    rotate.
    """
    return chain_of(load_urdf(file), dof, str(file))


def load_urdf(file: Path) -> "yourdfpy.URDF":
    """Read the robot of a URDF file, without its meshes.

    Raises InputError where the file is no URDF, or where a joint is not finite and rigid or its joints form a loop.
    """
    import lxml.etree as etree  # pyright: ignore[reportMissingImports]
    import yourdfpy

    try:
        # yourdfpy repairs what is no XML, with two lines of its own on stderr.
        etree.fromstring(read_text(file).encode(), etree.XMLParser(resolve_entities=False, no_network=True))
        plain = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=False)
        for joint in plain.robot.joints:
            _check(joint, f"{file}: joint {joint.name}")
            joints_to(plain, joint.child)
        return yourdfpy.URDF(plain.robot, load_meshes=False, build_collision_scene_graph=False)
    except InputError:
        raise
    except Exception as error:  # the parser raises whatever its XML library does
        raise InputError(f"{file}: not a readable URDF ({error}); expand xacro first") from None


def joints_to(urdf: "yourdfpy.URDF", link: str) -> list["yourdfpy.Joint"]:
    """Return the joints from the root of a URDF to a link; raise InputError where they lead back to it."""
    by_child = {joint.child: joint for joint in urdf.robot.joints}
    chain = []
    while link in by_child:
        if len(chain) > len(by_child):
            raise InputError(f"the joints of {link} lead back to it; a robot is a tree")
        chain.insert(0, by_child[link])
        link = by_child[link].parent
    return chain


def chain_of(urdf: "yourdfpy.URDF", dof: int, where: str) -> Arm:
    """Return the arm of `dof` joints in a loaded URDF, as `read_chain`; `where` begins the messages."""
    chains = {link.name: joints_to(urdf, link.name) for link in urdf.robot.links}
    # A chain ends with its last moving joint: links that are fixed behind it belong to the gripper.
    chains = {
        link: chain
        for link, chain in chains.items()
        if chain and chain[-1].type != "fixed" and sum(joint.type != "fixed" for joint in chain) == dof
    }
    if len(chains) != 1:
        found = f"chains to {', '.join(chains)}" if chains else "no chain"
        raise InputError(f"{where}: {found} with {dof} joints; give as many joints per frame as the arm has")
    (chain,) = chains.values()
    frames, axes, limits = [], [], []
    frame: Float[ndarray, "4 4"] = np.eye(4)
    for joint in chain:
        frame = frame @ (np.eye(4) if joint.origin is None else joint.origin)
        if joint.type == "fixed":
            continue
        if joint.type not in ("revolute", "continuous") or joint.mimic is not None:
            raise InputError(
                f"{where}: joint {joint.name} is {'coupled to another' if joint.mimic else joint.type}; errors of arms "
                "are modelled for rotating joints only: leave the URDF out"
            )
        frames.append(frame)
        axes.append(joint.axis / np.linalg.norm(joint.axis))
        limits.append(_limits(joint))
        frame = np.eye(4)
    both = np.array(limits, float)
    rest = np.where((both[:, 0] <= 0) & (both[:, 1] >= 0), 0.0, both.mean(1))
    return Arm(
        name="robot of the URDF",
        parent_from_joint=np.stack(frames),
        axes=np.array(axes, float),
        last_from_gripper=frame,
        limits=both,
        rest=rest,
    )


def _check(joint: "yourdfpy.Joint", where: str) -> None:
    """Raise InputError where the origin, axis or limits of a joint cannot be."""
    if joint.origin is not None:
        require_rigid(np.reshape(joint.origin, (4, 4)), f"{where}: origin")
    axis = np.asarray(joint.axis, float)
    if axis.shape != (3,) or not (np.isfinite(axis).all() and np.linalg.norm(axis) > 1e-9):
        raise InputError(f"{where}: its axis is no direction; correct it there")
    if not np.isfinite(_limits(joint)).all():
        raise InputError(f"{where}: its limits are not finite; correct them there")


def _limits(joint: "yourdfpy.Joint") -> tuple[float, float]:
    """Return the limits (rad) of a joint, a turn to either side where it has none."""
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return ANY_ANGLE
    return (limit.lower, limit.upper) if not limit.upper <= limit.lower else ANY_ANGLE
