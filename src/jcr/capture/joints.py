"""Gripper poses of recorded joint angles, by the forward kinematics of yourdfpy."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.conventions import RADIANS_LIMIT
from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import Stamps, bracket
from jcr.capture.urdf_chain import chain_of, joints_to, load_urdf
from jcr.errors import InputError

if TYPE_CHECKING:
    import yourdfpy


@dataclass(frozen=True, kw_only=True)
class RecordedArm:
    """Arm of a URDF, its base and gripper frames, and the units in which its joints are recorded."""

    urdf: "yourdfpy.URDF"
    base: str
    gripper: str
    joints: tuple[str, ...]
    """Names of the joints that move the gripper, in the order of the chain."""
    unit: Float[ndarray, " j"]
    """Radians or metres per recorded unit of each joint."""
    turn: Float[ndarray, " j"]
    """Recorded units of a full turn of each joint; 0 for a sliding joint."""

    def columns(self, names: Sequence[str], where: str) -> list[int]:
        """Return the indices of the arm's joints in recorded `names`; raise InputError where some are missing."""
        missing = [joint for joint in self.joints if joint not in names]
        if missing:
            raise InputError(
                f"{where}: no angle of {', '.join(missing)}, which move {self.gripper} in the URDF; recorded are "
                f"{', '.join(names)}"
            )
        return [list(names).index(joint) for joint in self.joints]

    def angles(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n j"] | None:
        """Return joint angles (rad) of recorded positions; None where the URDF has no single such chain."""
        try:
            chain_of(self.urdf, len(self.joints), "the URDF")
        except InputError:
            return None
        return recorded * self.unit

    def poses(self, recorded: Float[ndarray, "n j"]) -> Float[ndarray, "n 4 4"]:
        """Return base_from_gripper (n,4,4) of recorded positions; raise InputError on degrees read as radians."""
        positions = recorded * self.unit
        if (largest := float(np.abs(positions).max(initial=0.0))) > 2 * RADIANS_LIMIT:
            raise InputError(
                f"joint angles go up to {largest:.0f} rad; if they are degrees, add --pose-units m-deg"
            )
        poses = np.empty((len(positions), 4, 4))
        for pose, row in zip(poses, positions, strict=True):
            self.urdf.update_cfg(dict(zip(self.joints, row, strict=True)))
            pose[:] = self.urdf.get_transform(self.gripper, self.base)
        return poses


def read_arm(options: ReadOptions) -> RecordedArm:
    """Read the arm between the frames of the options; raise InputError where the URDF has no such arm."""
    file = options.urdf
    assert file is not None
    urdf = load_urdf(file)
    base, gripper = options.base_frame or urdf.base_link, options.gripper_frame
    for option, link in (("--base-frame", base), ("--gripper-frame", gripper)):
        if link not in urdf.link_map:
            given = "is not given" if link is None else f"{link} is not in it"
            raise InputError(f"{file}: {option} {given}; its links are {', '.join(urdf.link_map)}")
    chain = joints_to(urdf, str(gripper))
    parents = [joint.parent for joint in chain]
    if base not in (*parents, gripper):
        raise InputError(
            f"{file}: no joints lead from {base} to {gripper}; name the robot's base with --base-frame"
        )
    chain = chain[parents.index(base) :] if base in parents else []
    moving = [joint for joint in chain if joint.type != "fixed"]
    names = tuple(dict.fromkeys(joint.mimic.joint if joint.mimic else joint.name for joint in moving))
    if not names:
        raise InputError(
            f"{file}: nothing moves between {base} and {gripper}; name a link behind the last joint"
        )
    if unknown := [name for name in names if name not in urdf.actuated_joint_names]:
        raise InputError(
            f"{file}: a joint mimics {unknown[0]}, which is not an independent joint of the URDF; correct it"
        )
    angle = np.radians(1.0) if options.pose_units.endswith("deg") else 1.0
    length = 1e-3 if options.pose_units.startswith("mm") else 1.0
    slides = np.array([urdf.joint_map[name].type == "prismatic" for name in names])
    return RecordedArm(
        urdf=urdf,
        base=str(base),
        gripper=str(gripper),
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
        """Return interpolated joint angles (rad); None where the URDF has no single such chain."""
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
