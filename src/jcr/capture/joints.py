"""Joint angles and a URDF to gripper poses: forward kinematics, for robots that record no poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import Stamps, bracket
from jcr.capture.robot_poses import RADIANS_LIMIT
from jcr.capture.urdf_chain import chain_of, load_urdf
from jcr.errors import InputError

if TYPE_CHECKING:
    import yourdfpy


@dataclass(frozen=True, kw_only=True)
class Arm:
    """A chain of links from the robot's base to its gripper."""

    urdf: "yourdfpy.URDF"
    base: str
    gripper: str
    joints: tuple[str, ...]
    """Those that move it, from the base on."""

    unit: Float[ndarray, " j"]
    """Radians or metres per recorded unit of each."""

    def columns(self, names: Sequence[str], where: str) -> list[int]:
        """Where the arm's joints stand among recorded `names`; InputError naming those that are missing."""
        missing = [joint for joint in self.joints if joint not in names]
        if missing:
            raise InputError(
                f"{where}: no angle of {', '.join(missing)}, which move {self.gripper} in the URDF; recorded are "
                f"{', '.join(names)}"
            )
        return [list(names).index(joint) for joint in self.joints]

    def angles(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n j"] | None:
        """Joint angles (rad) for the recorded positions; None where the arm is no chain of rotating joints."""
        try:
            chain_of(self.urdf, len(self.joints), "the URDF")
        except InputError:
            return None
        return recorded * self.unit

    def poses(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n 4 4"]:
        """base_from_gripper (n,4,4) for the joints' recorded positions; InputError on degrees for radians."""
        positions = recorded * self.unit
        if (largest := float(np.abs(positions).max(initial=0.0))) > 2 * RADIANS_LIMIT:
            raise InputError(
                f"joint angles go up to {largest:.0f} rad; if they are degrees, add --pose-units m-deg"
            )
        poses = np.zeros((len(positions), 4, 4))
        for k, row in enumerate(positions):
            self.urdf.update_cfg(dict(zip(self.joints, row, strict=True)))
            poses[k] = self.urdf.get_transform(self.gripper, self.base)
        return poses


def read_arm(options: ReadOptions) -> Arm:
    """The arm in the URDF that the options name; InputError listing its links where they name none or no arm."""
    file = options.urdf
    assert file is not None
    urdf = load_urdf(file, build_scene_graph=True)
    by_child = {joint.child: joint for joint in urdf.robot.joints}
    base = str(options.base_frame or urdf.base_link)
    for option, link in (("--base-frame", base), ("--gripper-frame", options.gripper_frame)):
        if link not in urdf.link_map:
            given = "is not given" if link is None else f"{link} is not in it"
            raise InputError(f"{file}: {option} {given}; its links are {', '.join(urdf.link_map)}")
    gripper = link = str(options.gripper_frame)
    chain = []
    while link != base and link in by_child:
        chain.insert(0, by_child[link])
        link = by_child[link].parent
    if link != base:
        raise InputError(
            f"{file}: no joints lead from {base} to {gripper}; name the robot's base with --base-frame"
        )
    names = dict.fromkeys(
        joint.mimic.joint if joint.mimic else joint.name for joint in chain if joint.type != "fixed"
    )
    if not names:
        raise InputError(
            f"{file}: nothing moves between {base} and {gripper}; name a link behind the last joint"
        )
    angle = np.radians(1.0) if options.pose_units.endswith("deg") else 1.0
    length = 1e-3 if options.pose_units.startswith("mm") else 1.0
    unit = [length if urdf.joint_map[name].type == "prismatic" else angle for name in names]
    return Arm(urdf=urdf, base=base, gripper=gripper, joints=tuple(names), unit=np.array(unit))


@dataclass(frozen=True)
class JointTrack:
    """An arm's joints in ascending time; each joint may be published by itself."""

    arm: Arm
    stamp_ns: tuple[Stamps, ...]
    positions: tuple[Float[ndarray, " n"], ...]

    def at(self, stamp_ns: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
        """Poses with every joint linear between its samples, and the widest gap among the joints."""
        rows, gap = self._between(stamp_ns)
        return self.arm.poses(rows), gap

    def angles(self, stamp_ns: Stamps) -> Float[ndarray, "n j"] | None:
        """Joint angles (rad), likewise; None where the arm is no chain of rotating joints."""
        return self.arm.angles(self._between(stamp_ns)[0])

    def _between(self, stamp_ns: Stamps) -> tuple[Float[ndarray, "n j"], Int[ndarray, " n"]]:
        rows, gap = np.zeros((len(stamp_ns), len(self.positions))), np.zeros(len(stamp_ns), np.int64)
        for k, (samples, positions) in enumerate(zip(self.stamp_ns, self.positions, strict=True)):
            before, share, width = bracket(samples, stamp_ns)
            after = np.minimum(before + 1, len(samples) - 1)
            rows[:, k] = positions[before] + share * (positions[after] - positions[before])
            gap = np.maximum(gap, width)
        return rows, gap
