"""Selection of the frames of a recording: the arm at rest, sharp images, the least uncertain calibration."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.capture.images import BLURRED
from jcr.capture.options import MIN_FRAMES
from jcr.errors import InputError
from jcr.estimation.equation import ASSUMED_NOISE, expected_covariance
from jcr.estimation.next_poses import choose, pose_information, total_uncertainty
from jcr.geometry import inverse, motion_length

STILL = 0.005
"""Speed of an arm at rest, m/s, rotation counted at ARM: a tenth of a pixel in 20 ms, half a metre away."""
LOOKS = 5
"""Number of frames of one stop that are compared for sharpness."""
SAME_VIEW = 0.005
"""Smallest distance between two views, m, rotation counted at ARM; the sharpest of nearer frames is kept."""
WEAK = 1e-6
"""Information (1/m², 1/rad²) about each unknown before any view, which keeps its covariance finite."""

Rows = Int[ndarray, " _"]
Poses = Float[ndarray, "n 4 4"]


def best_frames(
    base_from_gripper: Poses,
    speed: Float[ndarray, " n"],
    usable: Bool[ndarray, " n"],
    sharpness_of: Callable[[Rows], Float[ndarray, " k"]],
    count: int,
) -> tuple[Rows, tuple[str, ...]]:
    """Return the rows of the best `count` frames in order of time, and remarks on the choice.

    `speed` is in m/s with rotation counted at ARM; `sharpness_of` is called once, with ascending rows. A stop gives one
    frame at most; where there are too few stops, the slowest frames between them are added. Raises InputError when
    fewer than three frames are left.
    """
    still = _runs(usable & (speed < STILL))
    moments = [run[np.linspace(0, len(run) - 1, LOOKS + 2).astype(int)[1:-1]] for run in still]
    if len(still) < count:
        moments += _slowest(_runs(usable & (speed >= STILL)), speed, count)
    rows = np.unique(np.concatenate([*moments, np.zeros(0, int)]))
    sharpness = np.zeros(len(speed))
    sharpness[rows] = sharpness_of(rows)
    sharpest = np.array([moment[sharpness[moment].argmax()] for moment in moments], dtype=int)
    least = BLURRED * np.median(sharpness[sharpest]) if len(sharpest) else 0.0
    sharp = sharpest[sharpness[sharpest] >= least]
    views = _different(base_from_gripper, sharp[np.argsort(-sharpness[sharp], kind="stable")])
    if len(views) < MIN_FRAMES:
        raise InputError(
            f"{len(views)} different views are still and sharp among {len(speed)} frames; at least {MIN_FRAMES} are "
            "needed: record again with a pause at each of a dozen views"
        )
    information = pose_information(base_from_gripper[views], np.eye(4), ASSUMED_NOISE)
    frames, known = np.zeros(0, int), WEAK * np.eye(13)
    for of_kind in (speed[views] < STILL, speed[views] >= STILL):  # frames at rest come first
        chosen = _most_informative(known, information[of_kind], count - len(frames))
        frames = np.append(frames, views[of_kind][chosen])
        known = known + information[of_kind].sum(0)
    notes = []
    if len(sharp) < len(sharpest):
        notes.append(f"{len(sharpest) - len(sharp)} moments of the recording are blurred and were left out")
    at_rest = int((speed[views] < STILL).sum())
    if at_rest < count and (fastest := float(speed[frames].max())) >= STILL:
        notes.append(
            f"the arm stands still at {at_rest} different views where {count} frames are wanted; the others were "
            f"taken at up to {1e3 * fastest:.0f} mm/s: pause for half a second at each view"
        )
    return np.sort(frames), tuple(notes)


def _most_informative(known: Float[ndarray, "13 13"], gain: Float[ndarray, "k 13 13"], count: int) -> Rows:
    """Return the rows of the `count` views that leave the least uncertainty beside what is known."""

    def uncertainty_of(rows: Rows) -> float:
        return total_uncertainty(expected_covariance(known + gain[rows].sum(0)))

    return np.array(choose(count, len(gain), uncertainty_of), dtype=int)


def _runs(mask: Bool[ndarray, " n"]) -> list[Rows]:
    """Return the unbroken runs of rows where `mask` holds."""
    rows = np.flatnonzero(mask)
    return [run for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(run)]


def _slowest(runs: list[Rows], speed: Float[ndarray, " n"], count: int) -> list[Rows]:
    """Return the slowest frame of each of about `4 · count` equal pieces of the rows, as runs of one frame."""
    piece = max(sum(map(len, runs)) // (4 * count), 1)
    pieces = [part for run in runs for part in np.array_split(run, max(len(run) // piece, 1))]
    return [part[[speed[part].argmin()]] for part in pieces]


def _different(base_from_gripper: Poses, rows: Int[ndarray, " r"]) -> Rows:
    """Return the `rows`, best first, without those near a better one."""
    kept = rows[:0]
    for row in rows:
        motion = inverse(base_from_gripper[kept]) @ base_from_gripper[row]
        far = motion_length(motion)
        if (far > SAME_VIEW).all():
            kept = np.append(kept, row)
    return kept
