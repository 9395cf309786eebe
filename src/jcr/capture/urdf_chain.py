"""Arms in URDF files: their kinematic chain as an `Arm`, and gripper poses from recorded joint angles."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.documents.table import decode_text, read_limited
from jcr.capture.notations import RADIANS_LIMIT
from jcr.capture.options import ReadOptions, chosen_name
from jcr.capture.pose_track import Stamps, bracket
from jcr.errors import InputError, count_of
from jcr.estimation.kinematics import Arm, forward_kinematics
from jcr.geometry import require_rigid

if TYPE_CHECKING:
    import yourdfpy

ANY_ANGLE = (-2 * np.pi, 2 * np.pi)


def load_urdf(file: Path) -> "yourdfpy.URDF":
    """Read a URDF without its meshes; raise InputError for invalid origins, axes or limits, and for joints in a loop."""
    import lxml.etree as etree  # pyright: ignore[reportMissingImports]
    import yourdfpy

    try:
        # yourdfpy would repair invalid XML and print two lines on stderr; such a file is refused here.
        etree.fromstring(
            decode_text(file, read_limited(file)).encode(),
            etree.XMLParser(resolve_entities=False, no_network=True),
        )
        plain = yourdfpy.URDF.load(file, load_meshes=False, build_scene_graph=False)
        for joint in plain.robot.joints:
            where, axis = f"{file}: joint {joint.name}", np.asarray(joint.axis, float)
            if joint.origin is not None:
                require_rigid(np.reshape(joint.origin, (4, 4)), f"{where}: origin")
            if not (
                axis.shape == (3,)
                and np.isfinite([*axis, *_limits(joint)]).all()
                and (axis.any() or joint.type == "fixed")
            ):
                what = "its axis is no direction, or its limits are not finite; correct them there"
                raise InputError(f"{where}: {what}")
            joints_to(plain, joint.child)
        return yourdfpy.URDF(plain.robot, load_meshes=False, build_collision_scene_graph=False)
    except InputError:
        raise
    except Exception as error:  # the XML library raises errors of many types
        raise InputError(f"{file}: not a readable URDF ({error}); expand xacro first") from None


def joints_to(urdf: "yourdfpy.URDF", link: str) -> list["yourdfpy.Joint"]:
    """Return all joints, fixed ones too, from the root of a URDF to a link, root first; raise InputError for a loop."""
    by_child = {joint.child: joint for joint in urdf.robot.joints}
    chain = []
    while link in by_child:
        if len(chain) > len(by_child):
            raise InputError(f"the joints of {link} lead back to it; a robot is a tree")
        chain.insert(0, by_child[link])
        link = by_child[link].parent
    return chain


def read_chain(where: "Path | yourdfpy.URDF", dof: int) -> Arm:
    """Return the arm of `dof` rotating joints in a URDF (file or its content).

    Its base is the URDF's root link, its gripper the child link of the last rotating joint. Raises InputError if the
    URDF has no such chain or several, or if a joint does not rotate.
    """
    urdf = load_urdf(where) if isinstance(where, Path) else where
    chains = [joints_to(urdf, link.name) for link in urdf.robot.links]
    # A chain ends with its last moving joint: links that are fixed to it belong to the gripper.
    chains = [chain for chain in chains if chain and chain[-1].type != "fixed"]
    chains = [chain for chain in chains if sum(joint.type != "fixed" for joint in chain) == dof]
    if len(chains) != 1:
        found = f"chains to {', '.join(chain[-1].child for chain in chains)}" if chains else "no chain"
        raise InputError(f"{where}: {found} with {count_of(dof, 'joint')}; give one angle for each joint")
    return _arm_of(chains[0], where)


def _arm_of(chain: "Sequence[yourdfpy.Joint]", where: object) -> Arm:
    """Return the arm of a URDF's joints, from the base to the gripper, fixed ones too."""
    frames, frame, moving = [], np.eye(4), [joint for joint in chain if joint.type != "fixed"]
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
        frame = np.eye(4)
    limits = np.array([_limits(joint) for joint in moving], float)
    return Arm(
        name="robot of the URDF",
        parent_from_joint=np.stack(frames),
        axes=np.array([joint.axis / np.linalg.norm(joint.axis) for joint in moving], float),
        last_from_gripper=frame,
        limits=limits,
        rest=np.where((limits[:, 0] <= 0) & (limits[:, 1] >= 0), 0.0, limits.mean(1)),
    )


def _limits(joint: "yourdfpy.Joint") -> tuple[float, float]:
    """Return the lower and upper limit (rad) of a joint; ±2π if the URDF states no limits."""
    limit = joint.limit
    if joint.type == "continuous" or limit is None or limit.lower is None or limit.upper is None:
        return ANY_ANGLE
    return (limit.lower, limit.upper) if not limit.upper <= limit.lower else ANY_ANGLE


@dataclass(frozen=True, kw_only=True)
class RecordedArm:
    """Arm of a URDF from its base link to its gripper link, with the names and the unit of its recorded joint angles."""

    arm: Arm
    urdf: "yourdfpy.URDF"
    base: str
    gripper: str
    joints: tuple[str, ...]
    """Names of the joints, in the order of the chain."""
    unit: float
    """Factor from recorded angles to radians."""

    def columns(self, names: Sequence[str], where: str) -> list[int]:
        """Return the indices in `names` (recorded joints) of the arm's joints; raise InputError if one is missing."""
        missing = [joint for joint in self.joints if joint not in names]
        if missing:
            raise InputError(
                f"{where}: no angle of {', '.join(missing)}, which move {self.gripper} in the URDF; recorded are "
                f"{', '.join(names)}"
            )
        return [list(names).index(joint) for joint in self.joints]

    def angles(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n j"] | None:
        """Convert recorded angles, a column per joint in the order of `joints`, to radians.

        The result is None if the URDF has not exactly one chain with as many joints.
        """
        try:
            read_chain(self.urdf, len(self.joints))
        except InputError:
            return None
        return recorded * self.unit

    def poses(self, recorded: Float[ndarray, "n j"], where: str) -> Float[ndarray, "n 4 4"]:
        """Compute base_from_gripper (m) from recorded angles, one column per joint in order of `joints`."""
        angles = recorded * self.unit
        if (largest := float(np.abs(angles).max(initial=0.0))) > 2 * RADIANS_LIMIT:
            raise InputError(
                f"{where}: joint angles up to {largest:.0f} rad; for degrees add --pose-units m-deg"
            )
        return forward_kinematics(self.arm, angles)

    def interpolated(
        self, samples: Sequence[tuple[Int[ndarray, " _"], Float[ndarray, " _"]]], stamp_ns: Stamps
    ) -> tuple[Float[ndarray, "n j"], Int[ndarray, " n"]]:
        """Return the recorded angles at n time stamps (ns), and the largest gap (ns) between joint samples around each.

        `samples` are the ascending time stamps (ns) and recorded angles of each of the j joints. Angles are interpolated
        linearly; a joint turns the shorter way, also across ±π.
        """
        rows, gap = np.zeros((len(stamp_ns), len(samples))), np.zeros(len(stamp_ns), np.int64)
        turn = 2 * np.pi / self.unit
        for k, (stamps, angles) in enumerate(samples):
            before, share, width = bracket(stamps, stamp_ns)
            step = angles[np.minimum(before + 1, len(stamps) - 1)] - angles[before]
            rows[:, k] = angles[before] + share * (step - turn * np.round(step / turn))
            gap = np.maximum(gap, width)
        return rows, gap


def read_arm(options: ReadOptions) -> RecordedArm:
    """Read the arm of `options.urdf` between its links `options.base_frame` (None: root) and `options.gripper_frame`.

    The unit of recorded angles is that of `options.pose_units`; "auto": rad.
    """
    file = options.urdf
    assert file is not None
    urdf = load_urdf(file)
    asked = ("--base-frame", options.base_frame or urdf.base_link), ("--gripper-frame", options.gripper_frame)
    base, gripper = (chosen_name([*urdf.link_map], link, (), f"{file}: a link", name) for name, link in asked)
    chain = joints_to(urdf, gripper)
    parents = [joint.parent for joint in chain]
    if base not in (*parents, gripper):
        raise InputError(f"{file}: no joints lead from {base} to {gripper}; name the base with --base-frame")
    chain = chain[parents.index(base) :] if base in parents else []
    names = tuple(joint.name for joint in chain if joint.type != "fixed")
    if not names:
        raise InputError(f"{file}: nothing moves between {base} and {gripper}; name a link after a joint")
    unit = float(np.radians(1.0)) if options.pose_units.endswith("deg") else 1.0
    return RecordedArm(
        arm=_arm_of(chain, file), urdf=urdf, base=base, gripper=gripper, joints=names, unit=unit
    )
