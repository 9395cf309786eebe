"""Extraction of the best frames of a recording (bag or data set) into a capture folder."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.capture.checks import checked_capture
from jcr.capture.frame_choice import UNREADABLE, Poses, Rows, best_frames
from jcr.capture.images import encode_png, read_image, sharpness
from jcr.capture.intrinsics import intrinsics_of_file
from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import NEVER
from jcr.errors import InputError, count_of
from jcr.files import path_inside, write_bytes
from jcr.progress import Progress
from jcr.records import Capture, FrameNames, Intrinsics

Picture = tuple[int, bytes | UInt8[ndarray, "h w 3"] | InputError, str]
"""Image of a frame: the frame's row, the bytes of the encoded file or RGB pixels, and the file's ending. An image that
cannot be read is the error with the reason."""


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


def capture_of_recording(recording: Recording, into: Path, report: Progress) -> Capture:
    """Write the best frames of a recording, at most `options.frames`, to the folder `into`; return them as a capture.

    Raises InputError if no frame has pose samples around it within `options.max_gap_ms`. It also raises InputError if
    images are missing, or if too few frames are still and sharp.
    """
    options, (fresh, stale) = recording.options, _fresh_frames(recording)
    faults, looked = dict[int, str](), 0

    def sharpness_of(rows: Rows) -> Float[ndarray, " k"]:
        nonlocal looked
        values, looked = [], looked + len(rows)
        for k, (row, image, _) in enumerate(recording.images_of_rows(rows)):
            try:
                if isinstance(image, InputError):
                    raise image
                where = f"{recording.source}: {recording.names[row]}"
                values.append(sharpness(read_image(image, where) if isinstance(image, bytes) else image))
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
    images = _written(recording, rows, into, report)
    known = recording.intrinsics_of_size
    if options.camera_info is not None:
        known = partial(intrinsics_of_file, options.camera_info)
    capture, kept = checked_capture(into, images, poses[rows], str(recording.source))
    notes = (f"{len(kept)} of {len(fresh)} frames chosen", *stale)
    if faults:
        notes = (
            *notes,
            f"left out: {count_of(len(faults), 'image')} that cannot be read: {faults[min(faults)]}",
        )
    return replace(
        capture,
        joints=None if recording.joints is None else recording.joints[rows[kept]],
        urdf=None if recording.joints is None else options.urdf,
        intrinsics=known(capture.image_size),
        frame_names=recording.frame_names,
        notes=(*notes, *remarks, *capture.notes),
    )


def _fresh_frames(recording: Recording) -> tuple[Bool[ndarray, " n"], tuple[str, ...]]:
    """Return the mask of the frames with pose samples around them within `max_gap_ms`, and a note of the others."""
    gap_ns, most_ms = recording.gap_ns, recording.options.max_gap_ms
    fresh, limit = gap_ns <= 1e6 * most_ms, f"{most_ms:.0f} ms"
    if not fresh.any():
        far = f"those around an image are {gap_ns.min() / 1e6:.0f} ms apart"
        far = "no image lies between two poses" if gap_ns.min() == NEVER else far
        raise InputError(
            f"{recording.source}: every pose is stale (over {limit}): {far}; check the clocks, or raise --max-gap-ms"
        )
    worst = gap_ns[gap_ns < NEVER].max(initial=0) / 1e6
    lost = f"{int((~fresh).sum())} of {len(fresh)} images have no pose within {limit} (gaps up to {worst:.0f} ms)"
    return fresh, () if fresh.all() else (f"{lost}: left out",)


def _written(recording: Recording, rows: Rows, into: Path, report: Progress) -> list[str]:
    """Write the images of the frames `rows` to the folder `into`; return their paths relative to it."""
    images = list[str]()
    for k, (row, image, ending) in enumerate(recording.images_of_rows(rows)):
        images.append(f"images/{recording.names[row]}{ending}")
        if isinstance(image, InputError):  # it was read before
            raise image
        data = image if isinstance(image, bytes) else encode_png(image)
        write_bytes(path_inside(into, images[-1], str(recording.source)), data)
        report("frames", 0.8 + 0.2 * (k + 1) / len(rows))
    return images
