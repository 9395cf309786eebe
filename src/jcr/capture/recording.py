"""Extraction of a recording's best frames: arm at rest, sharp image, smallest uncertainty of the calibration."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.capture.checks import checked_capture
from jcr.capture.images import BLURRED, encode_png, read_image, sharpness
from jcr.capture.intrinsics import intrinsics_of_file
from jcr.capture.options import MIN_FRAMES, ReadOptions
from jcr.capture.pose_track import NEVER
from jcr.errors import InputError
from jcr.estimation.pose_equations import ASSUMED_NOISE, expected_covariance, pose_residuals
from jcr.files import path_inside, write_bytes
from jcr.geometry import inverse, motion_length
from jcr.progress import Progress
from jcr.records import Capture, FrameNames, Intrinsics

STILL = 0.005
"""Speed (m/s) below which the arm is at rest; rotation counts as in motion_length. At half a metre this moves the image
by a tenth of a pixel in 20 ms."""
LOOKS = 5
"""Number of frames of one stop whose sharpness is compared."""
ENOUGH = 8
"""Number of different views at rest that suffice: a frame in motion is blurred, and its pose less exact. With eight
images a wrong one is recognised."""
SAME_VIEW = 0.005
"""Smallest distance (m) between two views, as by motion_length; the sharpest of closer frames is kept."""
UNIT = np.array([1e-3] * 3 + [np.radians(0.1)] * 3 + [2e-3])
"""Errors of translation (m), rotation (rad) and log scale that have equal weight: 1 mm, 0.1°, 0.2 %."""
WEAK = 1e-6
"""Prior information (1/m², 1/rad²) about each calibration parameter, which keeps the covariance finite."""
Picture = tuple[int, bytes | UInt8[ndarray, "h w 3"] | InputError, str]
"""Image of a frame: the frame's row, the bytes of the encoded file or RGB pixels, and the file's ending. An image that
cannot be read is the error with the reason."""
UNREADABLE = -1.0
"""Sharpness of an image that cannot be read."""
Rows = Int[ndarray, " _"]
Poses = Float[ndarray, "n 4 4"]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Frames of a bag or data set: gripper pose, speed and time of each frame, and functions that read its image."""

    source: Path
    options: ReadOptions
    names: Sequence[str]
    """File names of the frames, without endings."""
    base_from_gripper: Poses
    speed: Float[ndarray, " n"]
    """Speed of the gripper, m/s, rotation counted as in jcr.geometry.motion_length."""
    gap_ns: Int[ndarray, " n"]
    """Time (ns) between the two pose samples around each frame; 0 where the pose is not interpolated."""
    images_of_rows: Callable[[Rows], Iterator[Picture]]
    """Function that yields the images of the given rows, which are ascending."""
    intrinsics_of_size: Callable[[tuple[int, int]], Intrinsics | None] = lambda _: None
    """Function from an image size (width, height) to the recorded intrinsics; used without `options.camera_info`."""
    joints: Float[ndarray, "n j"] | None = None
    """Joint angles (rad) of the arm in `options.urdf`, one row per frame; None if they are unknown."""
    frame_names: FrameNames = FrameNames()
    """Names of base and camera frame, as far as the recording states them."""


def capture_of_recording(recording: Recording, into: Path, report: Progress) -> Capture:
    """Write the best frames of a recording, at most `options.frames`, to the folder `into`; return them as a capture.

    `report` receives the progress. Raises InputError if no frame has pose samples around it within
    `options.max_gap_ms`. It also raises InputError if images are missing, or if too few frames are still and sharp.
    """
    options, gap_ns = recording.options, recording.gap_ns
    fresh, limit = gap_ns <= 1e6 * options.max_gap_ms, f"{options.max_gap_ms:.0f} ms"
    if not fresh.any():
        far = f"those around an image are {gap_ns.min() / 1e6:.0f} ms apart"
        far = "no image lies between two poses" if gap_ns.min() == NEVER else far
        raise InputError(
            f"{recording.source}: every pose is stale (over {limit}): {far}; check the clocks, or raise --max-gap-ms"
        )
    worst = gap_ns[gap_ns < NEVER].max(initial=0) / 1e6
    stale = f"{int((~fresh).sum())} of {len(fresh)} images have no pose within {limit} (gaps up to {worst:.0f} ms): "

    faults, looked = dict[int, str](), 0

    def sharpness_of(rows: Rows) -> Float[ndarray, " k"]:
        nonlocal looked
        values, looked = [], looked + len(rows)
        for k, (row, image, _) in enumerate(recording.images_of_rows(rows)):
            try:
                values.append(sharpness(_pixels_of(image, f"{recording.source}: {recording.names[row]}")))
            except InputError as error:
                faults[row] = str(error)
                values.append(UNREADABLE)
            report("frames", 0.1 + 0.7 * k / len(rows))
        if len(values) < len(rows):
            raise InputError(
                f"{recording.source}: {len(rows) - len(values)} of {len(rows)} images that it lists are not where its "
                "index says; it is damaged: repair it (`mcap recover`, `ros2 bag reindex`) or record again"
            )
        return np.array(values)

    poses = recording.base_from_gripper
    try:
        rows, remarks = best_frames(poses, recording.speed, fresh, sharpness_of, options.frames)
    except InputError:
        if len(faults) < max(looked, 1):
            raise
        raise InputError(f"{faults[min(faults)]} (none of {looked} images can be read)") from None
    images = list[str]()
    for k, (row, image, ending) in enumerate(recording.images_of_rows(rows)):
        images.append(f"images/{recording.names[row]}{ending}")
        if isinstance(image, InputError):  # it was read before
            raise image
        data = image if isinstance(image, bytes) else encode_png(image)
        write_bytes(path_inside(into, images[-1], str(recording.source)), data)
        report("frames", 0.8 + 0.2 * (k + 1) / len(rows))
    known = recording.intrinsics_of_size
    if options.camera_info is not None:
        known = partial(intrinsics_of_file, options.camera_info)
    capture, kept = checked_capture(into, images, poses[rows], str(recording.source))
    notes = (f"{len(kept)} of {len(fresh)} frames chosen", *([] if fresh.all() else [f"{stale}left out"]))
    if faults:
        notes = (*notes, f"left out: {len(faults)} images that cannot be read: {faults[min(faults)]}")
    return replace(
        capture,
        joints=None if recording.joints is None else recording.joints[rows[kept]],
        urdf=None if recording.joints is None else options.urdf,
        intrinsics=known(capture.image_size),
        frame_names=recording.frame_names,
        notes=(*notes, *remarks, *capture.notes),
    )


def _pixels_of(image: bytes | UInt8[ndarray, "h w 3"] | InputError, where: str) -> UInt8[ndarray, "h w 3"]:
    """Return the RGB pixels of an image of a recording; raise InputError if it cannot be read."""
    if isinstance(image, InputError):
        raise image
    return read_image(image, where) if isinstance(image, bytes) else image


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
    With fewer than ENOUGH different views at rest, the slowest frames between stops are added. Raises InputError if
    fewer than three frames are left.
    """
    steps = np.asarray(motion_length(inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]))
    # A camera that is triggered at the stops has no frames between them: the arm's moves part the stops, too.
    moved = np.append(steps > SAME_VIEW, False)
    still = _runs(usable & (speed < STILL), moved)
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
    if len(views) < min(count, ENOUGH):
        # Add the slowest frame of each of about 4 · count equal pieces of the motion.
        moving = _runs(usable & (speed >= STILL))
        piece = max(sum(map(len, moving)) // (4 * count), 1)
        parts = [part for run in moving for part in np.array_split(run, max(len(run) // piece, 1))]
        moments += [part[[speed[part].argmin()]] for part in parts]
        views = different_views()
    if len(views) < MIN_FRAMES:
        raise InputError(
            f"{len(views)} different views are still and sharp among {len(speed)} frames; at least {MIN_FRAMES} are "
            "needed: record again with a pause at each of twelve views"
        )
    information = _pose_information(base_from_gripper[views])
    frames, known = np.zeros(0, int), WEAK * np.eye(13)
    for of_kind in (speed[views] < STILL, speed[views] >= STILL):  # frames at rest come first
        gain = information[of_kind]
        chosen = _most_informative(gain, known, count - len(frames))
        frames, known = np.append(frames, views[of_kind][chosen]), known + gain.sum(0)
    notes = []
    if left_out:
        notes.append(f"{left_out} moments of the recording are blurred and were left out")
    at_rest = int((speed[views] < STILL).sum())
    if at_rest < count and (fastest := float(speed[frames].max())) >= STILL:
        notes.append(
            f"the arm stands still at {at_rest} different views where {count} frames are wanted; the others were "
            f"taken at up to {1e3 * fastest:.0f} mm/s: pause for half a second at each view"
        )
    return np.sort(frames), tuple(notes)


def _pose_information(base_from_gripper: Poses) -> Float[ndarray, "n 13 13"]:
    """Return the information matrix of X (6), log scale and base_from_recon (6) by each of n gripper poses.

    X is gripper_from_camera, assumed to be the identity. Both transforms have the order translation (m), rotation
    vector (rad). The poses have the random errors ASSUMED_NOISE (m, rad). The reconstruction frame is arbitrary; here
    it is the base frame, in metres.
    """
    _, j = pose_residuals(np.eye(4), 1.0, np.eye(4), base_from_gripper, base_from_gripper)
    j /= np.repeat(ASSUMED_NOISE, 3)[:, None]
    return np.swapaxes(j, 1, 2) @ j


def _most_informative(
    gain: Float[ndarray, "n 13 13"], before: Float[ndarray, "13 13"], count: int
) -> list[int]:
    """Return the indices of up to `count` of n poses, best first, by greedy selection.

    `gain` are the information matrices of the poses, `before` is that of earlier ones. Each choice reduces most the sum
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
