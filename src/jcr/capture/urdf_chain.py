"""The chain of revolute joints in a URDF, as the kinematics of an arm."""

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
    """The arm of `dof` joints in a URDF file; its gripper frame is the link behind the last joint.

    InputError where the file is no URDF, has no such chain or several, or has a joint in it that does not rotate.
    """
    return chain_of(load_urdf(file, build_scene_graph=False), dof, str(file))


def load_urdf(file: Path, build_scene_graph: bool) -> "yourdfpy.URDF":
    """The robot of a URDF file, without its meshes.

    InputError where the file is none, or where its joints are not finite and rigid or lead back to where they began.
    """
    import lxml.etree as etree  # pyright: ignore[reportMissingImports]
    import yourdfpy

    try:
        # yourdfpy repairs what is no XML, with two lines of its own on stderr.
        etree.fromstring(read_text(file).encode(), etree.XMLParser(resolve_entities=False, no_network=True))
        urdf = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=False)
        by_child = {joint.child: joint for joint in urdf.robot.joints}
        for joint in urdf.robot.joints:
            _check(joint, f"{file}: joint {joint.name}")
            _chain(by_child, joint.child)
        if build_scene_graph:
            urdf = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=True)
    except InputError:
        raise
    except Exception as error:  # the parser raises whatever its XML library does
        raise InputError(f"{file}: not a readable URDF ({error}); expand xacro first") from None
    return urdf


def _check(joint: "yourdfpy.Joint", where: str) -> None:
    if joint.origin is not None:
        if np.shape(joint.origin) != (4, 4):
            raise InputError(f"{where}: its origin is no position and angles; correct it there")
        require_rigid(joint.origin, f"{where}: origin")
    axis = np.asarray(joint.axis, float)
    if axis.shape != (3,) or not (np.isfinite(axis).all() and np.linalg.norm(axis) > 1e-9):
        raise InputError(f"{where}: its axis is no direction; correct it there")
    limit = joint.limit
    ends = [] if limit is None else [end for end in (limit.lower, limit.upper) if end is not None]
    if not np.isfinite(ends).all():
        raise InputError(f"{where}: its limits are not finite; correct them there")


def chain_of(urdf: "yourdfpy.URDF", dof: int, where: str) -> Arm:
    """The arm of `dof` joints in a loaded URDF, as `read_chain`; `where` begins the messages."""
    by_child = {joint.child: joint for joint in urdf.robot.joints}
    chains = {link.name: _chain(by_child, link.name) for link in urdf.robot.links}
    # A chain ends with its last moving joint: what is fixed behind that belongs to the gripper.
    chains = {
        link: chain
        for link, chain in chains.items()
        if chain and chain[-1].type != "fixed" and sum(joint.type != "fixed" for joint in chain) == dof
    }
    if len(chains) != 1:
        found = f"chains to {', '.join(chains)}" if chains else "no chain"
        raise InputError(f"{where}: {found} with {dof} joints; give as many joints per frame as the arm has")
    (chain,) = chains.values()
    return _arm(chain, where)


def _chain(by_child: dict, link: str) -> list:
    chain = []
    while link in by_child:
        if len(chain) > len(by_child):
            raise InputError(f"the joints of {link} lead back to it; a robot is a tree")
        chain.insert(0, by_child[link])
        link = by_child[link].parent
    return chain


def _limits(joint: "yourdfpy.Joint") -> tuple[float, float]:
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return ANY_ANGLE
    return (limit.lower, limit.upper) if limit.upper > limit.lower else ANY_ANGLE


def _arm(chain: list, where: str) -> Arm:
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
