"""Choice of a recording's best frames: arm at rest, sharp image, smallest predicted uncertainty of the calibration."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.capture.images import BLURRED
from jcr.capture.options import MIN_FRAMES
from jcr.errors import InputError
from jcr.estimation.pose_equations import ASSUMED_NOISE, expected_covariance, pose_residuals
from jcr.geometry import inverse, motion_length

STILL_SPEED = 0.005
"""Speed (m/s) below which the arm is at rest; rotation counts as in motion_length. At half a metre this moves the image
by a tenth of a pixel in 20 ms."""
LOOKS = 5
"""Number of frames of one stop whose sharpness is compared."""
ENOUGH_VIEWS = 8
"""Number of different views at rest that suffice: a frame in motion is blurred, and its pose less exact. With eight
images a wrong one is recognised."""
SAME_VIEW = 0.005
"""Smallest distance (m) between two views, as by motion_length; the sharpest of closer frames is kept."""
UNIT = np.array([1e-3] * 3 + [np.radians(0.1)] * 3 + [2e-3])
"""Errors of translation (m), rotation (rad) and log scale that have equal weight: 1 mm, 0.1°, 0.2 %."""
WEAK_PRIOR = 1e-6
"""Prior information (1/m², 1/rad²) about each calibration parameter, which keeps the covariance finite."""
UNREADABLE = -1.0
"""Sharpness of an image that cannot be read."""
Rows = Int[ndarray, " _"]
Poses = Float[ndarray, "n 4 4"]


def best_frames(
    base_from_gripper: Poses,
    speed: Float[ndarray, " n"],
    usable: Bool[ndarray, " n"],
    sharpness_of: Callable[[Rows], Float[ndarray, " k"]],
    count: int,
) -> tuple[Rows, tuple[str, ...]]:
    """Return the ascending rows of at most `count` sharp frames from n in order of time, and remarks for the user.

    The frames minimise the predicted uncertainty of the calibration. `speed` is that of the gripper (m/s; 1 rad counts
    as 0.3 m). `usable` marks the frames with a valid pose. `sharpness_of` returns the sharpness of k ascending rows,
    which is UNREADABLE for an image that cannot be read. Each stop of the arm (below 5 mm/s) gives at most one frame.
    With fewer than ENOUGH_VIEWS different views at rest, the slowest frames between stops are added. Raises InputError
    if fewer than three frames are left.
    """
    steps = np.asarray(motion_length(inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]))
    # A camera that is triggered at the stops has no frames between them: the arm's moves part the stops, too.
    moved = np.append(steps > SAME_VIEW, False)
    still = _runs(usable & (speed < STILL_SPEED), moved)
    moments = [run[np.linspace(0, len(run) - 1, LOOKS + 2).astype(int)[1:-1]] for run in still]
    sharp, left_out = np.full(len(speed), np.nan), 0

    def different_views() -> Rows:
        """Return the sharpest frame of each moment, without blurred ones and those near a sharper one."""
        nonlocal left_out
        rows = np.unique(np.concatenate([*moments, np.zeros(0, int)]))
        rows = rows[np.isnan(sharp[rows])]
        sharp[rows] = sharpness_of(rows)
        sharpest = np.array([moment[sharp[moment].argmax()] for moment in moments], dtype=int)
        sharpest = sharpest[sharp[sharpest] > UNREADABLE]
        least = BLURRED * np.median(sharp[sharpest]) if len(sharpest) else 0.0
        clear = sharpest[sharp[sharpest] >= least]
        left_out, views = len(sharpest) - len(clear), clear[:0]
        for row in clear[np.argsort(-sharp[clear], kind="stable")]:
            motion = inverse(base_from_gripper[views]) @ base_from_gripper[row]
            if (np.asarray(motion_length(motion)) > SAME_VIEW).all():
                views = np.append(views, row)
        return views

    views = different_views() if moments else np.zeros(0, int)
    if len(views) < min(count, ENOUGH_VIEWS):
        moments += _slowest(_runs(usable & (speed >= STILL_SPEED)), speed, 4 * count)
        views = different_views()
    if len(views) < MIN_FRAMES:
        raise InputError(
            f"{len(views)} different views are still and sharp among {len(speed)} frames; at least {MIN_FRAMES} are "
            "needed: record again with a pause at each of twelve views"
        )
    frames = _frames_of_views(views, base_from_gripper[views], speed[views] < STILL_SPEED, count)
    notes = []
    if left_out:
        notes.append(f"{left_out} moments of the recording are blurred and were left out")
    at_rest = int((speed[views] < STILL_SPEED).sum())
    if at_rest < count and (fastest := float(speed[frames].max())) >= STILL_SPEED:
        notes.append(
            f"the arm stands still at {at_rest} different views where {count} frames are wanted; the others were "
            f"taken at up to {1e3 * fastest:.0f} mm/s: pause for half a second at each view"
        )
    return np.sort(frames), tuple(notes)


def _slowest(moving: list[Rows], speed: Float[ndarray, " n"], count: int) -> list[Rows]:
    """Return the row of the slowest frame of each of about `count` equal pieces of the runs `moving`."""
    piece = max(sum(map(len, moving)) // count, 1)
    parts = [part for run in moving for part in np.array_split(run, max(len(run) // piece, 1))]
    return [part[[speed[part].argmin()]] for part in parts]


def _frames_of_views(views: Rows, base_from_gripper: Poses, at_rest: Bool[ndarray, " n"], count: int) -> Rows:
    """Return the rows of up to `count` of n `views` that minimise the predicted uncertainty, those at rest first.

    X is assumed to be the identity, the reconstruction frame, which is arbitrary, is the base frame, in metres, and the
    poses have the random errors ASSUMED_NOISE (m, rad).
    """
    _, j = pose_residuals(np.eye(4), 1.0, np.eye(4), base_from_gripper, base_from_gripper)
    j /= np.repeat(ASSUMED_NOISE, 3)[:, None]
    information = np.swapaxes(j, 1, 2) @ j
    frames, known = np.zeros(0, int), WEAK_PRIOR * np.eye(13)
    for of_kind in (at_rest, ~at_rest):
        gain = information[of_kind]
        chosen = _most_informative(gain, known, count - len(frames))
        frames, known = np.append(frames, views[of_kind][chosen]), known + gain.sum(0)
    return frames


def _most_informative(
    gain: Float[ndarray, "n 13 13"], before: Float[ndarray, "13 13"], count: int
) -> list[int]:
    """Return the indices of up to `count` of n poses, best first, by greedy selection.

    `gain` are the information matrices of X (6: m, rad), log scale and base_from_recon (6) by each pose, `before` is
    that of earlier ones. Each choice reduces most the sum
    of the variances of gripper_from_camera and log scale in units of 1 mm, 0.1° and 0.2 % (A-optimal design: Pukelsheim,
    Optimal Design of Experiments, 1993, chapter 9).
    """
    chosen = list[int]()
    while len(chosen) < min(count, len(gain)):
        covariance = expected_covariance(before + gain[chosen].sum(0) + gain)
        uncertainty = (np.diagonal(covariance, axis1=1, axis2=2) / UNIT**2).sum(1)
        uncertainty[chosen] = np.inf
        chosen.append(int(uncertainty.argmin()))
    return chosen


def _runs(mask: Bool[ndarray, " n"], ends: Bool[ndarray, " n"] | None = None) -> list[Rows]:
    """Return the runs of consecutive rows at which `mask` is True, each as an ascending array of row indices.

    A run also ends at a row at which `ends` is True.
    """
    rows = np.flatnonzero(mask)
    parts = np.diff(rows) > 1
    if ends is not None and len(rows):
        parts = parts | ends[rows[:-1]]
    return [run for run in np.split(rows, np.flatnonzero(parts) + 1) if len(run)]
