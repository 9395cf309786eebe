"""Extraction of the best frames of a recording into a capture folder."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from numpy import ndarray

from jcr.capture.best_frames import best_frames
from jcr.capture.checks import checked_capture
from jcr.capture.images import DEPTH, encode_png, sharpness
from jcr.capture.options import ReadOptions
from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.progress import Progress
from jcr.records import Capture, Intrinsics

Picture = tuple[int, bytes | UInt8[ndarray, "h w 3"], str]
"""Row of a frame, its encoded file's bytes or RGB pixels, and the file's ending."""
BESIDE_ALL_POSES_NS = 1e15
"""Gap (ns) beyond which the frame is before the first pose or after the last."""


def chosen_name(names: Sequence[str], asked: str | None, usual: Sequence[str], what: str, option: str) -> str:
    """Return the topic or key that an option asks for, or the only usual one; raise InputError that lists all names."""
    if asked in names:
        return str(asked)
    if asked is None and len(usual) == 1:
        return usual[0]
    wrong = "" if asked is None else f"{asked} is not there; "
    raise InputError(f"{what}: {wrong}choose one with {option}: {', '.join(names) or 'there are none'}")


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Frames of a recording, a row each, whose images are read on demand."""

    source: Path
    options: ReadOptions
    names: Sequence[str]
    """Names of the frames' files, without their endings."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    speed: Float[ndarray, " n"]
    """Speed of the gripper, m/s, rotation counted as in jcr.geometry.motion_length."""
    gap_ns: Int[ndarray, " n"]
    """Time between the two poses around each frame; 0 where none is interpolated."""
    images_of_rows: Callable[[Int[ndarray, " k"]], Iterator[Picture]]
    """Images of ascending rows, one by one."""
    intrinsics_of_size: Callable[[tuple[int, int]], Intrinsics | None]
    """Intrinsics of images of a size (width, height)."""
    joints: Float[ndarray, "n j"] | None = None
    """Joint angles (rad) of the arm in `options.urdf`, where they are known."""
    depth_at: Callable[[int], UInt16[ndarray, "h w"] | None] | None = None
    """Depth (mm) aligned with the frame of a row."""

    @property
    def fresh(self) -> Bool[ndarray, " n"]:
        """Frames whose pose is not interpolated over more than `options.max_gap_ms`."""
        return self.gap_ns <= 1e6 * self.options.max_gap_ms


def capture_of_recording(recording: Recording, into: Path, report: Progress) -> Capture:
    """Extract the best frames of a recording into the folder `into`.

    Raises InputError when the poses of all frames are stale, or when too few frames are still and sharp.
    """
    fresh, source = recording.fresh, str(recording.source)
    notes = _stale(recording)
    rows, remarks = best_frames(
        recording.base_from_gripper,
        recording.speed,
        fresh,
        lambda rows: _sharpness(recording, rows, report),
        recording.options.frames,
    )
    images, depths = _written(recording, rows, into, report)
    capture, kept = checked_capture(into, images, recording.base_from_gripper[rows], source)
    rows, depths = rows[kept], [depths[k] for k in kept]
    if recording.joints is not None:
        capture = replace(capture, joints=recording.joints[rows], urdf=recording.options.urdf)
    if any(depths):
        capture = replace(capture, depths=tuple(depths))
    return replace(
        capture,
        intrinsics=recording.intrinsics_of_size(capture.image_size),
        notes=(f"{len(rows)} of {len(fresh)} frames chosen", *notes, *remarks, *capture.notes),
    )


def _stale(recording: Recording) -> list[str]:
    """Return a note on the frames whose pose is stale; InputError where all are."""
    fresh, gap_ns, limit_ms = recording.fresh, recording.gap_ns, recording.options.max_gap_ms
    if fresh.all():
        return []
    if not fresh.any():
        gap = gap_ns.min()
        far = (
            "no image lies between two poses"
            if gap > BESIDE_ALL_POSES_NS
            else f"those around an image are {gap / 1e6:.0f} ms apart"
        )
        raise InputError(
            f"{recording.source}: every pose is stale (over {limit_ms:.0f} ms): {far}; check the clocks, or raise "
            "--max-gap-ms"
        )
    worst = gap_ns[gap_ns < BESIDE_ALL_POSES_NS].max(initial=0) / 1e6
    return [
        f"{int((~fresh).sum())} of {len(fresh)} images have no pose within {limit_ms:.0f} ms (gaps up to "
        f"{worst:.0f} ms): left out"
    ]


def _sharpness(recording: Recording, rows: Int[ndarray, " k"], report: Progress) -> Float[ndarray, " k"]:
    """Return the sharpness of the images of these rows."""
    values = []
    for k, (_, image, _) in enumerate(recording.images_of_rows(rows)):
        values.append(sharpness(image))
        report("frames", 0.1 + 0.7 * k / len(rows))
    if len(values) < len(rows):
        raise InputError(
            f"{recording.source}: {len(rows) - len(values)} of {len(rows)} images that it lists are not where its "
            "index says; it is damaged: repair it (`mcap recover`, `ros2 bag reindex`) or record again"
        )
    return np.array(values)


def _written(
    recording: Recording, rows: Int[ndarray, " k"], into: Path, report: Progress
) -> tuple[list[str], list[str | None]]:
    """Write the images of these rows and their depth; return the files, None for a missing depth."""
    images, depths = list[str](), list[str | None]()
    for k, (row, image, ending) in enumerate(recording.images_of_rows(rows)):
        name = recording.names[row]
        images.append(f"images/{name}{ending}")
        write_bytes(into / images[-1], image if isinstance(image, bytes) else encode_png(image))
        depth = None if recording.depth_at is None else recording.depth_at(row)
        depths.append(None if depth is None else f"{DEPTH}/{name}.png")
        if depth is not None:
            write_bytes(into / f"{DEPTH}/{name}.png", encode_png(depth))
        report("frames", 0.8 + 0.2 * (k + 1) / len(rows))
    return images, depths
