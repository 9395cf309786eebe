"""Checks of captures of all formats: readable frames, rigid poses in metres, one camera at one resolution."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.capture.notations import FAR_FRAME, METRES_LIMIT
from jcr.capture.options import MAX_FRAMES, MIN_FRAMES, tolerated
from jcr.errors import InputError, count_of, first_few, other_size
from jcr.files import capture_file
from jcr.geometry import step_between
from jcr.records import Capture

SAME_POSE = (0.5e-3, np.radians(0.05))
"""Position (m) and rotation (rad) within which two gripper poses count as equal."""


def checked_capture(
    folder: Path,
    images: Sequence[str],
    base_from_gripper: Float[ndarray, "n 4 4"],
    where: str,
    faults: Mapping[int, str] | None = None,
) -> tuple[Capture, list[int]]:
    """Check images and gripper poses; return a capture without intrinsics, and the input index of each of its frames.

    A frame is an image (path relative to `folder`) with its pose. The frames in `faults` (index to message) and
    positions over 10 m from the base are left out with a note. So are images that are missing, damaged, duplicated or
    of another size than most. Raises InputError if more frames are faulty than `tolerated` permits, or if they leave
    fewer than three.
    """
    require_frames(len(images), where, at_least=1)
    for k, name in enumerate(images):
        capture_file(folder, name, f"{where}: frame {k}")
    names = [f"{where}: the pose of {name}" for name in images]
    found = {**(faults or {}), **far_faults(base_from_gripper[:, :3, 3], where, names)}
    sizes, digests = dict[int, tuple[int, int]](), dict[bytes, int]()
    for k in sorted(set(range(len(images))) - found.keys()):
        try:
            pixels = read_image(folder / images[k])
        except InputError as error:
            found[k] = str(error)
            continue
        sizes[k] = pixels.shape[1], pixels.shape[0]
        same = digests.setdefault(hashlib.sha256(pixels.tobytes()).digest(), k)
        if same != k:
            text = f"the same image as {images[same]}; drop one of the frames or take it again"
            found[k] = f"{folder / images[k]}: {text}"
    usual = Counter(sizes.values()).most_common(1)
    for k, size in sizes.items():
        if size != usual[0][0]:
            like = images[next(j for j in sizes if sizes[j] == usual[0][0])]
            found[k] = str(other_size(f"{folder / images[k]}: image", size, usual[0][0], like))
    rows = [k for k in range(len(images)) if k not in found]
    if found and (len(found) > tolerated(len(images)) or len(rows) < min(MIN_FRAMES, len(images))):
        names = first_few([images[k] for k in found])
        others = f" ({len(found)} of {len(images)} frames cannot be used: {names})" if len(found) > 1 else ""
        raise InputError(found[min(found)] + others)
    capture = Capture(
        folder=folder,
        images=tuple(images[k] for k in rows),
        base_from_gripper=base_from_gripper[rows],
        image_size=sizes[rows[0]],
        notes=tuple(f"left out: {found[k]}" for k in sorted(found)),
    )
    return capture, rows


def require_frames(count: int, where: str, at_least: int = MIN_FRAMES) -> None:
    """Raise InputError if `count` frames are fewer than `at_least` or more than 1000."""
    if count > MAX_FRAMES:
        raise InputError(f"{where}: {count_of(count, 'frame')}; choose 5 to 15, {MAX_FRAMES} at most")
    if count < at_least:
        needed = f"at least {at_least} are needed; take 5 to 15" if at_least > 1 else "at least one is needed"
        raise InputError(f"{where}: {count_of(count, 'frame')}; {needed}")


def require_motion(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """Raise InputError if there are three or more gripper poses and all equal the first.

    Equal means within 0.5 mm and 0.05° in each component of the translation and the rotation vector.
    """
    steps = np.abs(step_between(base_from_gripper[:1], base_from_gripper)).max(axis=0, initial=0.0)
    metres, radians = steps[:3].max(), steps[3:].max()
    if len(base_from_gripper) >= MIN_FRAMES and metres < SAME_POSE[0] and radians < SAME_POSE[1]:
        within = f"within {1e3 * metres:.2g} mm and {np.degrees(radians):.2g}°"
        raise InputError(
            f"{where}: all {len(base_from_gripper)} gripper poses are the same ({within}); read the pose again for each "
            "image"
        )


def far_faults(position: Float[ndarray, "n 3"], where: str, names: list[str]) -> dict[int, str]:
    """Return a message for each position (m, base frame) that is more than 10 m from the base, by the index of its row.

    Raises InputError if more rows are that far than `tolerated` permits, or the only row is. Wrong units or a far base
    frame are then the cause. NaN counts as 0.
    """
    distance = np.linalg.norm(np.nan_to_num(position), axis=1)
    rows = np.flatnonzero(distance > METRES_LIMIT).tolist()
    if len(rows) > tolerated(len(distance)) or (rows and len(distance) == 1):
        spread = float(np.ptp(position[np.isfinite(position).all(1)], axis=0).max())
        is_map = len(distance) > 1 and spread < METRES_LIMIT
        cause = FAR_FRAME if is_map else "these look like millimetres: divide the translations by 1000"
        raise InputError(f"{where}: the gripper is up to {distance.max():.4g} m from the base; {cause}")
    text = "m from the base, the others are nearer; record it again"
    return {k: f"{names[k]} is {distance[k]:.4g} {text}" for k in rows}
