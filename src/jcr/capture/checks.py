"""Checks of all formats: frames that can be used, rigid poses in metres, one camera at one resolution."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.conventions import METRES_LIMIT, far_rows, likely_unit, tolerated
from jcr.capture.images import ROTATED, HowStored, other_size, read_image, read_stored
from jcr.capture.options import MAX_FRAMES, MIN_FRAMES
from jcr.capture.plain_files import contained, first_few
from jcr.errors import InputError
from jcr.findings import Finding, FindingKind
from jcr.geometry import require_rigid, step_between
from jcr.records import Capture

MIRRORED = (2, 4, 5, 7)
SAME_POSE = (0.5e-3, np.radians(0.05))
"""Position (m) and rotation (rad) within which gripper poses count as the same."""


def checked_capture(
    folder: Path,
    images: Sequence[str],
    base_from_gripper: Float[ndarray, "n 4 4"],
    where: str,
    faults: Mapping[int, str] | None = None,
) -> tuple[Capture, list[int]]:
    """Return a capture of `images` in `folder`, without intrinsics, and its rows among the images and poses.

    Every image is decoded once. A few frames that cannot be used are left out with a note: those of `faults` (row to
    message), and images that are missing, damaged, of another size, or there twice. Raises InputError where more of
    them cannot be used; `where` begins the messages, the file that names the images. One image will do here.
    """
    require_frames(len(images), where, at_least=1)
    for k, name in enumerate(images):
        contained(folder, name, f"{where}: frame {k}")
    found = dict(faults or {})
    far, _, many = far_rows(base_from_gripper[:, :3, 3])
    if many:
        check_metres(base_from_gripper[far], where)
    for k in far:
        found[k] = (
            f"{where}: the pose of {images[k]} is over {METRES_LIMIT:.0f} m from the base; record it again"
        )
    stored = _decoded(folder, images, found)
    rows = [k for k in range(len(images)) if k not in found]
    if found and (len(found) > tolerated(len(images)) or len(rows) < min(MIN_FRAMES, len(images))):
        others = (
            f" ({len(found)} of {len(images)} frames cannot be used: {first_few([images[k] for k in found])})"
        )
        raise InputError(found[min(found)] + (others if len(found) > 1 else ""))
    kept = [images[k] for k in rows]
    capture = Capture(
        folder=folder,
        images=tuple(kept),
        base_from_gripper=base_from_gripper[rows],
        image_size=stored[rows[0]][0],
        orientation=_common_orientation(folder, kept, [stored[k][1] for k in rows]),
        bits=tuple(sorted({stored[k][1].bits for k in rows})),
        notes=tuple(f"left out: {found[k]}" for k in sorted(found)),
    )
    return capture, rows


def _decoded(
    folder: Path, images: Sequence[str], found: dict[int, str]
) -> dict[int, tuple[tuple[int, int], HowStored]]:
    """Return size (px) and storage of each image, decoded once; images that cannot be used are added to `found`."""
    stored, digests = dict[int, tuple[tuple[int, int], HowStored]](), dict[bytes, int]()
    for k in range(len(images)):
        if k in found:
            continue
        try:
            pixels, how = read_stored(folder / images[k])
        except InputError as error:
            found[k] = str(error)
            continue
        stored[k] = (pixels.shape[1], pixels.shape[0]), how
        same = digests.setdefault(hashlib.sha256(pixels.tobytes()).digest(), k)
        if same != k:
            found[k] = (
                f"{folder / images[k]}: the same image as {images[same]}; drop one of the frames or take it again"
            )
    sizes = {k: size for k, (size, _) in stored.items()}
    for k, size in sizes.items():
        (usual, _), *_ = Counter(sizes.values()).most_common(1)
        if size != usual:
            like = images[next(j for j in sizes if sizes[j] == usual)]
            found[k] = str(other_size(f"{folder / images[k]}: image", size, usual, like))
    return stored


def require_frames(count: int, where: str, at_least: int = MIN_FRAMES) -> None:
    """Raise InputError for fewer than `at_least` frames, or too many."""
    if count > MAX_FRAMES:
        raise InputError(f"{where}: {count} frames; choose {MAX_FRAMES} at most, 8 to 15 are good")
    if count < at_least:
        raise InputError(f"{where}: {count} frames; at least {at_least} are needed, 8 to 12 are good")


def require_motion(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """Raise InputError where three gripper poses or more are all the same."""
    metres, radians = np.abs(step_between(base_from_gripper[:1], base_from_gripper).reshape(-1, 2, 3)).max(
        axis=(0, 2), initial=0.0
    )
    if len(base_from_gripper) >= MIN_FRAMES and metres < SAME_POSE[0] and radians < SAME_POSE[1]:
        raise InputError(
            f"{where}: all {len(base_from_gripper)} gripper poses are the same (within {1e3 * metres:.2g} mm and "
            f"{np.degrees(radians):.2g}°); read the pose again for each image"
        )


def read_rigid(value: Any, where: str) -> Float[ndarray, "4 4"]:
    """Return a rigid 4x4 from nested lists; InputError with the distance from rigid and a guess of the cause."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: not a 4x4 matrix of numbers; write four rows of four") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}, not 4x4; write four rows of four numbers")
    return require_rigid(matrix, where)


def check_metres(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """Raise InputError where a gripper pose is too far from the base to be in metres."""
    far, farthest, _ = far_rows(base_from_gripper[:, :3, 3])
    if far:
        name, short, a_metre = likely_unit(farthest)
        raise InputError(
            f"{where}: the gripper is up to {farthest:.4g} from the base; these look like {name}: "
            f"divide the translations by {a_metre} (a pose table: --pose-units {short}-rad or {short}-deg)"
        )


def image_sizes(folder: Path, images: Sequence[str]) -> list[tuple[int, int]]:
    """Return width and height (px) of every image, each decoded once; InputError where one is no image."""
    return [read_image(folder / name).shape[1::-1] for name in images]


def _common_orientation(folder: Path, images: Sequence[str], stored: Sequence[HowStored]) -> int:
    """Return the EXIF orientation of all images; InputError where they differ, as the axes of a camera cannot."""
    first = stored[0].orientation
    for name, how in zip(images, stored, strict=True):
        if (other := how.orientation) != first:
            raise InputError(
                f"{folder / name}: EXIF orientation {other}, but {images[0]} has {first}: rotated to be shown, their "
                "cameras' axes differ; remove the tag from all images (exiftool -Orientation= FILES)"
            )
    if first in MIRRORED:
        raise InputError(
            f"{folder / images[0]}: EXIF orientation {first}: {ROTATED[first]}, and no camera sees a mirrored world; "
            "remove the tag (exiftool -Orientation= FILES)"
        )
    return first


def how_rotated(capture: Capture) -> Finding | None:
    """Return the finding on images that their EXIF tag rotates; None without such a tag."""
    if capture.orientation == 1:
        return None
    return Finding(
        kind=FindingKind.IMAGES_ROTATED,
        severity="warns",
        value=float(capture.orientation),
        details={"rotated": ROTATED[capture.orientation]},
    )


def how_scaled(capture: Capture) -> str | None:
    """Return a note on the bits that are read of 16-bit images; None of 8-bit images."""
    if max(capture.bits) == 8:
        return None
    return f"images of 16 bits, {' or '.join(map(str, capture.bits))} of them used: read by the upper eight of those"
