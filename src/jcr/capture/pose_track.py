"""Interpolation of a moving frame at the stamps of images."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial.transform import Rotation, Slerp

from jcr.geometry import inverse, motion_length, transform

Stamps = Int[ndarray, " n"]
PosesAt = Callable[[Stamps], tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]]
"""Poses at stamps (ns), and the distance (ns) of the samples around each; NEVER outside of the recording."""

NEVER = np.iinfo(np.int64).max
SPEED_OVER_NS = 50_000_000
"""Time to either side over which speed is measured, ns: long for an encoder's last digit, short for a stop."""


@dataclass(frozen=True)
class PoseTrack:
    """Samples of a_from_b in ascending time."""

    stamp_ns: Stamps
    a_from_b: Float[ndarray, "n 4 4"]

    def at(self, stamp_ns: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
        """Return poses at stamps (ns), linear in position and by slerp in rotation, and the gaps (ns) around each."""
        before, share, gap = bracket(self.stamp_ns, stamp_ns)
        if len(self.stamp_ns) == 1:
            return np.repeat(self.a_from_b, len(stamp_ns), axis=0), gap
        # Slerp on the row number: seconds since 1970 in float64 would round to 0.2 µs.
        rows = np.arange(len(self.stamp_ns))
        rotation = Slerp(rows, Rotation.from_matrix(self.a_from_b[:, :3, :3]))(before + share).as_matrix()
        low, high = self.a_from_b[before, :3, 3], self.a_from_b[np.minimum(before + 1, rows[-1]), :3, 3]
        return transform(rotation, low + share[:, None] * (high - low)), gap


def pose_track(stamp_ns: Stamps, a_from_b: Float[ndarray, "n 4 4"]) -> PoseTrack:
    """Return samples in order of time; the first of those with the same stamp stays."""
    stamps, rows = np.unique(stamp_ns, return_index=True)
    return PoseTrack(stamps, a_from_b[rows])


def bracket(
    sample_ns: Int[ndarray, " k"], stamp_ns: Stamps
) -> tuple[Int[ndarray, " n"], Float[ndarray, " n"], Int[ndarray, " n"]]:
    """Return the row of the sample before each stamp, the share of the way to the next, and their distance in ns."""
    last = len(sample_ns) - 1
    before = np.clip(np.searchsorted(sample_ns, stamp_ns, side="right") - 1, 0, max(last - 1, 0))
    width = sample_ns[np.minimum(before + 1, last)] - sample_ns[before]
    share = np.clip((stamp_ns - sample_ns[before]) / np.maximum(width, 1), 0.0, 1.0)
    exact = (share == 0) | (share == 1)
    gap = np.where(exact, 0, width)
    outside = (stamp_ns < sample_ns[0]) | (stamp_ns > sample_ns[last])
    return before, share, np.where(outside, NEVER, gap)


def speed(poses_at: PosesAt, stamp_ns: Stamps) -> Float[ndarray, " n"]:
    """Return the speed (m/s) of the frame, rotation counted at ARM; at the ends of the recording from one side."""
    start, end = poses_at(stamp_ns - SPEED_OVER_NS), poses_at(stamp_ns + SPEED_OVER_NS)
    motion = inverse(start[0]) @ end[0]
    return np.asarray(motion_length(motion)) / (2e-9 * SPEED_OVER_NS)
