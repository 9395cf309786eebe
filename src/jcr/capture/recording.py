"""From a recording to a capture: the best frames are chosen, and put in a folder with a capture.json."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt16
from numpy import ndarray

from jcr.capture.best_frames import best_frames
from jcr.capture.checks import checked_capture
from jcr.capture.depth_images import FOLDER as DEPTH
from jcr.capture.images import encode_png, sharpness
from jcr.capture.options import ReadOptions
from jcr.capture.recorded_cameras import Lens, Pictures, RecordedCamera, kept_pictures
from jcr.errors import InputError
from jcr.files import write_bytes
from jcr.progress import Progress
from jcr.records import Capture


def capture_of_recording(
    source: Path,
    names: list[str],
    base_from_gripper: Float[ndarray, "n 4 4"],
    speed: Float[ndarray, " n"],
    gap_ns: Int[ndarray, " n"],
    pictures: Pictures,
    lens_of_size: Lens,
    options: ReadOptions,
    into: Path,
    report: Progress,
    joints: Float[ndarray, "n j"] | None = None,
    depth_at: Callable[[int], UInt16[ndarray, "h w"] | None] | None = None,
    camera_name: str | None = None,
    others: Sequence[RecordedCamera] = (),
) -> Capture:
    """The best frames of a recording in the folder `into`; `names` are those of the frames, without ending.
    `joints` (rad) are those of the arm in `options.urdf`, where they are known; `depth_at` gives the depth (mm) aligned
    with the frame of a row. `others` are further cameras, for whose sake this one may need a name.

    Frames whose pose is interpolated over more than `options.max_gap_ms` are stale. Raises InputError when all
    are, or when too few are still and sharp.
    """
    fresh = gap_ns <= 1e6 * options.max_gap_ms
    if not fresh.any():
        gap = gap_ns.min()
        far = (
            "no image lies between two poses"
            if gap > 1e15
            else f"those around an image are {gap / 1e6:.0f} ms apart"
        )
        raise InputError(
            f"{source}: every pose is stale (over {options.max_gap_ms:.0f} ms): {far}; check the clocks, or raise "
            "--max-gap-ms"
        )
    notes = []
    if not fresh.all():
        worst = gap_ns[gap_ns < 1e15].max(initial=0) / 1e6
        notes.append(
            f"{int((~fresh).sum())} of {len(fresh)} images have no pose within {options.max_gap_ms:.0f} ms (gaps up to "
            f"{worst:.0f} ms): left out"
        )

    def sharpness_of(rows: Int[ndarray, " k"]) -> Float[ndarray, " k"]:
        values = []
        for k, (_, picture, _) in enumerate(pictures(rows)):
            values.append(sharpness(picture))
            report("frames", 0.1 + 0.7 * k / len(rows))
        if len(values) < len(rows):
            raise InputError(
                f"{source}: {len(rows) - len(values)} of {len(rows)} images that it lists are not where its index says; "
                "it is damaged: repair it (`mcap recover`, `ros2 bag reindex`) or record again"
            )
        return np.array(values)

    rows, remarks = best_frames(base_from_gripper, speed, fresh, sharpness_of, options.frames)
    images: list[str] = []
    depths: list[str | None] = []
    for k, (row, picture, ending) in enumerate(pictures(rows)):
        images.append(f"images/{names[row]}{ending}")
        data = picture if isinstance(picture, bytes) else encode_png(picture)
        write_bytes(into / images[-1], data)
        depth = None if depth_at is None else depth_at(row)
        depths.append(None if depth is None else f"{DEPTH}/{names[row]}.png")
        if depth is not None:
            write_bytes(into / f"{DEPTH}/{names[row]}.png", encode_png(depth))
        report("frames", 0.8 + 0.2 * (k + 1) / len(rows))
    capture = checked_capture(into, images, base_from_gripper[rows], str(source))
    notes = (f"{len(rows)} of {len(fresh)} frames chosen", *notes, *remarks)
    if joints is not None:
        capture = replace(capture, joints=joints[rows], urdf=options.urdf)
    if any(depths):
        capture = replace(capture, depths=tuple(depths))
    if others:
        further = kept_pictures(others, rows, names, into, str(source))
        capture = replace(capture, camera_name=camera_name or capture.camera_name, others=further)
    return replace(capture, intrinsics=lens_of_size(capture.image_size), notes=notes)
