"""Tree of the frames of ROS's tf: the pose of one frame in another at any stamp."""

from array import array
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.capture.pose_track import PosesAt, PoseTrack, Stamps, pose_track
from jcr.errors import InputError
from jcr.geometry import inverse, transform


class TfTree:
    """Transforms of /tf and /tf_static in plain arrays: an hour of a robot has a few million."""

    def __init__(self) -> None:
        """Start without frames."""
        self.parent: dict[str, str] = {}
        self.static: set[str] = set()
        self._stamps: dict[str, array[int]] = {}
        self._numbers: dict[str, array[float]] = {}

    def add(self, transforms: list[Any], static: bool) -> None:
        """Add the transforms of one message; a frame has one parent, the last that was given."""
        for stamped in transforms:
            child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
            if self.parent.get(child, parent) != parent:
                self._stamps[child], self._numbers[child] = array("q"), array("d")
            self.parent[child] = parent
            stamp, t, q = stamped.header.stamp, stamped.transform.translation, stamped.transform.rotation
            self._stamps.setdefault(child, array("q")).append(stamp.sec * 10**9 + stamp.nanosec)
            self._numbers.setdefault(child, array("d")).extend((t.x, t.y, t.z, q.x, q.y, q.z, q.w))
            if static:
                self.static.add(child)

    def frames(self) -> list[str]:
        """Return the names of all frames, sorted."""
        return sorted(self.parent.keys() | set(self.parent.values()))

    def poses_at(self, base: str | None, gripper: str | None, source: Path) -> PosesAt:
        """Return a function from stamps to gripper poses in the base; InputError where no transforms join the two."""
        frames = self.frames()
        for option, frame in (("--base-frame", base), ("--gripper-frame", gripper)):
            if frame not in frames:
                given = "is not given" if frame is None else f"{frame} is not in the bag"
                raise InputError(
                    f"{source}: {option} {given}; the frames of its tf are {', '.join(frames) or 'none'}"
                )
        assert base is not None and gripper is not None
        up, down = self._to_root(base), self._to_root(gripper)
        if up[-1] != down[-1]:
            raise InputError(
                f"{source}: no transforms join {base} (below {up[-1]}) and {gripper} (below {down[-1]})"
            )
        joint = next(frame for frame in up if frame in down)
        base_edges = [self._edge(frame, source) for frame in up[: up.index(joint)]]
        gripper_edges = [self._edge(frame, source) for frame in down[: down.index(joint)]]

        def poses_at(stamp_ns: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
            joint_from_base, gap_base = _chain(base_edges, stamp_ns)
            joint_from_gripper, gap_gripper = _chain(gripper_edges, stamp_ns)
            return inverse(joint_from_base) @ joint_from_gripper, np.maximum(gap_base, gap_gripper)

        return poses_at

    def _to_root(self, frame: str) -> list[str]:
        """Return the frame and all above it."""
        chain = [frame]
        while chain[-1] in self.parent and len(chain) <= len(self.parent):
            chain.append(self.parent[chain[-1]])
        return chain

    def _edge(self, child: str, source: Path) -> tuple[PoseTrack, bool]:
        """Return the samples of parent_from_child of a frame, and whether it is static."""
        numbers = np.frombuffer(self._numbers[child]).reshape(-1, 7)
        where = f"{source}: tf from {self.parent[child]} to {child}"
        if not np.isfinite(numbers).all() or (np.linalg.norm(numbers[:, 3:], axis=1) < 0.5).any():
            raise InputError(f"{where}: holds a transform that is none; record again")
        poses = transform(Rotation.from_quat(numbers[:, 3:]).as_matrix(), numbers[:, :3])
        return pose_track(np.frombuffer(self._stamps[child], np.int64), poses), child in self.static


def _chain(
    edges: list[tuple[PoseTrack, bool]], stamp_ns: Stamps
) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
    """Return the product of edges that lead upward from a frame, and the widest gap among the moving ones."""
    poses, gap = np.tile(np.eye(4), (len(stamp_ns), 1, 1)), np.zeros(len(stamp_ns), np.int64)
    for track, static in edges:
        if static:
            poses = track.a_from_b[-1] @ poses
            continue
        parent_from_child, edge_gap = track.at(stamp_ns)
        poses, gap = parent_from_child @ poses, np.maximum(gap, edge_gap)
    return poses, gap
