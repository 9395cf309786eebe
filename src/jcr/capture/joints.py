"""Forward kinematics of a URDF, for recordings of joint angles instead of gripper poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.conventions import RADIANS_LIMIT
from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import Stamps, bracket
from jcr.capture.urdf_chain import chain_of, joints_to, load_urdf, source_of
from jcr.errors import InputError
from jcr.geometry import rotation_exp, transform

if TYPE_CHECKING:
    import yourdfpy


@dataclass(frozen=True, kw_only=True)
class RecordedArm:
    """Joints of a URDF from the robot's base to its gripper, and the units in which their positions are recorded."""

    urdf: "yourdfpy.URDF"
    chain: tuple["yourdfpy.Joint", ...]
    joints: tuple[str, ...]
    """Names of the joints that move the gripper, in the order of the chain."""
    unit: Float[ndarray, " j"]
    """Radians or metres per recorded unit of each."""
    turn: Float[ndarray, " j"]
    """Recorded units of a full turn of each; 0 for a joint that slides."""

    def columns(self, names: Sequence[str], where: str) -> list[int]:
        """Return where the arm's joints stand among recorded `names`; InputError with those that are missing."""
        missing = [joint for joint in self.joints if joint not in names]
        if missing:
            raise InputError(
                f"{where}: no angle of {', '.join(missing)}, which move {self.chain[-1].child} in the URDF; recorded "
                f"are {', '.join(names)}"
            )
        return [list(names).index(joint) for joint in self.joints]

    def angles(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n j"] | None:
        """Return joint angles (rad) of recorded positions; None where the arm is no chain of rotating joints."""
        try:
            chain_of(self.urdf, len(self.joints), "the URDF")
        except InputError:
            return None
        return recorded * self.unit

    def poses(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n 4 4"]:
        """Return base_from_gripper (n,4,4) of recorded positions; InputError on degrees instead of radians."""
        positions = recorded * self.unit
        if (largest := float(np.abs(positions).max(initial=0.0))) > 2 * RADIANS_LIMIT:
            raise InputError(
                f"joint angles go up to {largest:.0f} rad; if they are degrees, add --pose-units m-deg"
            )
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        for joint in self.chain:
            poses = poses @ (np.eye(4) if joint.origin is None else joint.origin)
            if joint.type == "fixed":
                continue
            name, factor, offset = source_of(self.urdf, joint)
            axis = np.asarray(joint.axis, float) / np.linalg.norm(joint.axis)
            along = (factor * positions[:, self.joints.index(name)] + offset)[:, None] * axis
            slides, zero = joint.type == "prismatic", np.zeros_like(along)
            poses = poses @ transform(rotation_exp(zero if slides else along), along if slides else zero)
        return poses


def read_arm(options: ReadOptions) -> RecordedArm:
    """Read the arm in the URDF of the options; InputError listing its links where they name none or no arm."""
    file = options.urdf
    assert file is not None
    urdf = load_urdf(file)
    children = {joint.child for joint in urdf.robot.joints}
    root = next((link.name for link in urdf.robot.links if link.name not in children), None)
    base = options.base_frame or root
    for option, link in (("--base-frame", base), ("--gripper-frame", options.gripper_frame)):
        if link not in urdf.link_map:
            given = "is not given" if link is None else f"{link} is not in it"
            raise InputError(f"{file}: {option} {given}; its links are {', '.join(urdf.link_map)}")
    chain = joints_to(urdf, str(options.gripper_frame))
    parents = [joint.parent for joint in chain]
    if base not in parents and base != options.gripper_frame:
        raise InputError(
            f"{file}: no joints lead from {base} to {options.gripper_frame}; name the robot's base with --base-frame"
        )
    chain = chain[parents.index(base) :] if base in parents else []
    moving = [joint for joint in chain if joint.type != "fixed"]
    if other := [joint for joint in moving if joint.type not in ("revolute", "continuous", "prismatic")]:
        raise InputError(
            f"{file}: joint {other[0].name} is {other[0].type}; only rotating and sliding ones are known"
        )
    names = tuple(dict.fromkeys(source_of(urdf, joint)[0] for joint in moving))
    if not names:
        raise InputError(
            f"{file}: nothing moves between {base} and {options.gripper_frame}; name a link behind the last joint"
        )
    angle = np.radians(1.0) if options.pose_units.endswith("deg") else 1.0
    length = 1e-3 if options.pose_units.startswith("mm") else 1.0
    slides = np.array([urdf.joint_map[name].type == "prismatic" for name in names])
    return RecordedArm(
        urdf=urdf,
        chain=tuple(chain),
        joints=names,
        unit=np.where(slides, length, angle),
        turn=np.where(slides, 0.0, 2 * np.pi / angle),
    )


@dataclass(frozen=True)
class JointTrack:
    """Joint positions of an arm in ascending time; each joint may be published by itself."""

    arm: RecordedArm
    stamp_ns: tuple[Stamps, ...]
    positions: tuple[Float[ndarray, " n"], ...]

    def at(self, stamp_ns: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
        """Return poses with every joint interpolated between its samples, and the widest gap (ns) of the joints."""
        rows, gap = self._between(stamp_ns)
        return self.arm.poses(rows), gap

    def angles(self, stamp_ns: Stamps) -> Float[ndarray, "n j"] | None:
        """Return interpolated joint angles (rad); None where the arm is no chain of rotating joints."""
        return self.arm.angles(self._between(stamp_ns)[0])

    def _between(self, stamp_ns: Stamps) -> tuple[Float[ndarray, "n j"], Int[ndarray, " n"]]:
        """Return recorded positions, linear between samples; a joint turns the shorter way, also across ±π."""
        rows, gap = np.zeros((len(stamp_ns), len(self.positions))), np.zeros(len(stamp_ns), np.int64)
        for k, (samples, positions) in enumerate(zip(self.stamp_ns, self.positions, strict=True)):
            before, share, width = bracket(samples, stamp_ns)
            step = positions[np.minimum(before + 1, len(samples) - 1)] - positions[before]
            if (turn := self.arm.turn[k]) > 0:
                step = step - turn * np.round(step / turn)
            rows[:, k] = positions[before] + share * step
            gap = np.maximum(gap, width)
        return rows, gap
