"""Poses of a moving frame at the time stamps of images: interpolated samples, and ROS's tree of tf frames."""

from array import array
from collections.abc import Callable
from functools import partial
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

from jcr.capture.options import chosen_name
from jcr.errors import InputError
from jcr.geometry import inverse, motion_length, transform

Stamps = Int[ndarray, " n"]
PosesAt = Callable[[Stamps], tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]]
"""Function from time stamps (ns) to poses and gaps. A gap is the time (ns) between the two samples around a stamp: 0 at
a sample, NEVER outside of the recording."""

NEVER = np.iinfo(np.int64).max
"""Gap (ns) of a time stamp before the first sample or after the last."""
SPEED_OVER_NS = 50_000_000
"""Half of the time (ns) over which speed is measured: long for an encoder's resolution, short against a stop."""


def interpolated_poses(
    sample_ns: Int[ndarray, " k"], a_from_b: Float[ndarray, "k 4 4"], stamp_ns: Stamps
) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
    """Return poses interpolated at n time stamps (ns), and the time (ns) between the two samples around each.

    `a_from_b` are the samples at the times `sample_ns`; of samples with equal times, the first is used. Positions are
    interpolated linearly, rotations by slerp. Outside of the samples the nearest one is returned.
    """
    times, first = np.unique(sample_ns, return_index=True)
    before, share, gap = bracket(times, stamp_ns)
    if len(times) == 1:
        return np.repeat(a_from_b[first], len(stamp_ns), axis=0), gap
    # Slerp on the row number: seconds since 1970 in float64 would round to 0.2 µs.
    rows = np.arange(len(times))
    rotation = Slerp(rows, Rotation.from_matrix(a_from_b[first, :3, :3]))(before + share).as_matrix()
    low, high = a_from_b[first[before], :3, 3], a_from_b[first[np.minimum(before + 1, rows[-1])], :3, 3]
    return transform(rotation, low + share[:, None] * (high - low)), gap


def bracket(
    sample_ns: Int[ndarray, " k"], stamp_ns: Stamps
) -> tuple[Int[ndarray, " n"], Float[ndarray, " n"], Int[ndarray, " n"]]:
    """Return the row of the sample before each of n time stamps (ns), the place between two samples, and the gap.

    `sample_ns` are the k ascending times of the samples. The place is 0 at the sample before and 1 at the next one, and
    limited to this range outside of the samples. The gap is the time (ns) between the two: 0 for a stamp at a sample,
    the largest int64 outside of the samples.
    """
    last = len(sample_ns) - 1
    before = np.clip(np.searchsorted(sample_ns, stamp_ns, side="right") - 1, 0, max(last - 1, 0))
    width = sample_ns[np.minimum(before + 1, last)] - sample_ns[before]
    share = np.clip((stamp_ns - sample_ns[before]) / np.maximum(width, 1), 0.0, 1.0)
    gap = np.where((share == 0) | (share == 1), 0, width)
    return before, share, np.where((stamp_ns < sample_ns[0]) | (stamp_ns > sample_ns[last]), NEVER, gap)


def speed(poses_at: PosesAt, stamp_ns: Stamps) -> Float[ndarray, " n"]:
    """Return the speed (m/s) of a moving frame at n time stamps (ns), averaged over 0.1 s around each.

    The speed is that of the translation plus 0.3 m times the angular speed (rad/s).
    """
    start, end = poses_at(stamp_ns - SPEED_OVER_NS), poses_at(stamp_ns + SPEED_OVER_NS)
    return np.asarray(motion_length(inverse(start[0]) @ end[0])) / (2e-9 * SPEED_OVER_NS)


def poses_of_numbers(numbers: Float[ndarray, "n 7"], where: str) -> Float[ndarray, "n 4 4"]:
    """Return transforms from x, y, z, qx, qy, qz, qw; raise InputError if one is no transform."""
    if not np.isfinite(numbers).all() or (np.linalg.norm(numbers[:, 3:], axis=1) < 0.5).any():
        raise InputError(f"{where}: holds a transform that is none; record again")
    return transform(Rotation.from_quat(numbers[:, 3:]).as_matrix(), numbers[:, :3])


class TfTree:
    """Transforms of the topics /tf and /tf_static, in plain arrays, because an hour of recording has a few million."""

    def __init__(self) -> None:
        """Create a tree without frames."""
        self._parent: dict[str, str] = {}
        self._static: set[str] = set()
        self._samples: dict[str, tuple[array[int], array[float]]] = {}
        """Samples of parent_from_child by the child frame: time stamps (ns), and x, y, z, qx, qy, qz, qw of each."""

    def add(self, transforms: list[Any], static: bool) -> None:
        """Add the transforms (geometry_msgs/TransformStamped) of one message; `static`: of the topic /tf_static.

        If a frame has another parent than before, the former parent and its samples are dropped.
        """
        for stamped in transforms:
            child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
            if self._parent.get(child) != parent:
                self._parent[child], self._samples[child] = parent, (array("q"), array("d"))
            stamp, t, q = stamped.header.stamp, stamped.transform.translation, stamped.transform.rotation
            stamps, numbers = self._samples[child]
            pose = array("d", (t.x, t.y, t.z, q.x, q.y, q.z, q.w))  # whole or none
            stamps.append(index(stamp.sec) * 10**9 + index(stamp.nanosec))
            numbers.extend(pose)
            if static:
                self._static.add(child)

    def poses_at(self, base: str | None, gripper: str | None, source: Path) -> PosesAt:
        """Return a function from time stamps (ns) to base_from_gripper and the gaps (ns) between samples around each.

        A gap is the largest of all transforms between the frames; static transforms have none. `base` and `gripper` are
        names of frames. Raises InputError if one is None or unknown, or if they are not connected.
        """
        frames, chains = sorted(self._parent.keys() | set(self._parent.values())), list[list[str]]()
        for option, frame in (("--base-frame", base), ("--gripper-frame", gripper)):
            chains.append([chosen_name(frames, frame, (), f"{source}: a frame of its tf", option)])
            while chains[-1][-1] in self._parent and len(chains[-1]) <= len(self._parent):
                chains[-1].append(self._parent[chains[-1][-1]])
        up, down = chains
        if up[-1] != down[-1]:
            raise InputError(
                f"{source}: no transforms join {base} (below {up[-1]}) and {gripper} (below {down[-1]})"
            )
        joint = next(frame for frame in up if frame in down)
        edges = [
            [self._poses_of(frame, source) for frame in chain[: chain.index(joint)]] for chain in (up, down)
        ]

        def poses_at(stamp_ns: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
            gap, products = np.zeros(len(stamp_ns), np.int64), []
            for of_chain in edges:
                products.append(np.tile(np.eye(4), (len(stamp_ns), 1, 1)))
                for parent_from_child_at in of_chain:
                    parent_from_child, edge_gap = parent_from_child_at(stamp_ns)
                    products[-1], gap = parent_from_child @ products[-1], np.maximum(gap, edge_gap)
            return inverse(products[0]) @ products[1], gap

        return poses_at

    def _poses_of(self, child: str, source: Path) -> PosesAt:
        """Return the function from time stamps (ns) to parent_from_child of a frame and the gaps (ns) of its samples."""
        of_stamps, of_numbers = self._samples[child]
        stamps, numbers = np.frombuffer(of_stamps, np.int64), np.frombuffer(of_numbers).reshape(-1, 7)
        poses = poses_of_numbers(numbers, f"{source}: tf from {self._parent[child]} to {child}")
        if child in self._static or len(stamps) == 1:
            latest = poses[stamps.argmax()]
            return lambda at: (np.tile(latest, (len(at), 1, 1)), np.zeros(len(at), np.int64))
        return partial(interpolated_poses, stamps, poses)
