"""What every reader of captures demands, whatever the format: sound files, rigid metres, one camera."""

import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.images import ROTATED, HowStored, read_image, read_stored
from jcr.capture.options import MAX_FRAMES, MIN_FRAMES
from jcr.capture.plain_files import LONGEST, contained
from jcr.capture.robot_poses import likely_unit
from jcr.errors import InputError
from jcr.geometry import require_rigid, step_between
from jcr.records import COEFFICIENTS, Capture, DistortionModel, Finding, Intrinsics, Kind, coefficients_of

NAMED = 10
"""Images that a message names; of more it gives the number."""
MIRRORED = (2, 4, 5, 7)
SAME_POSE = (0.5e-3, np.radians(0.05))
"""m, rad: within this, poses are one at which the arm rests."""
MAX_REACH = 10.0
"""Metres; no arm reaches farther from its base, so larger numbers are millimetres."""


def checked_capture(
    folder: Path, images: Sequence[str], base_from_gripper: Float[ndarray, "n 4 4"], where: str
) -> Capture:
    """A capture of `images` in `folder`, without intrinsics; InputError as `jcr.read_capture` has it.

    `where` begins the messages: the file that names the images. One image will do here.
    """
    if not images:
        require_frames(0, where)
    require_images(folder, images, where)
    check_metres(base_from_gripper, where)
    size, stored = _decoded(folder, images)
    return Capture(
        folder=folder,
        images=tuple(images),
        base_from_gripper=base_from_gripper,
        image_size=size,
        orientation=_common_orientation(folder, images, stored),
        bits=tuple(sorted({one.bits for one in stored})),
    )


def require_images(folder: Path, images: Sequence[str], where: str) -> None:
    """InputError where images are named twice, not there, too many or out of the folder: before anything takes long."""
    twice = [name for name, count in Counter(images).items() if count > 1]
    if twice:
        raise InputError(
            f"{where}: names {first_few(sorted(twice))} more than once; keep one frame per image"
        )
    rows = [k for k, name in enumerate(images) if not os.path.exists(folder / name)]
    if not rows:
        require_frames(len(images), where, 0)
    for k in rows[:NAMED] or range(len(images)):
        contained(folder, images[k], f"{where}: frame {k}")
    missing = [images[k] for k in rows]
    if len(missing) == 1:
        raise InputError(f"{folder / missing[0]}: no such image; correct its name in {where} or add the file")
    if missing:
        raise InputError(
            f"{where}: {len(missing)} of {len(images)} images are not there: {first_few(missing)}; correct the names "
            "or add the files"
        )


def first_few(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(name[:LONGEST] for name in names[:NAMED]) + more


def require_frames(count: int, where: str, at_least: int = MIN_FRAMES) -> None:
    """Raises InputError where there are fewer frames than a calibration, or whatever else, needs, or too many."""
    if count > MAX_FRAMES:
        raise InputError(f"{where}: {count} frames; choose {MAX_FRAMES} at most, 8 to 15 are good")
    if count < at_least:
        raise InputError(f"{where}: {count} frames; at least {at_least} are needed, 8 to 12 are good")


def require_motion(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """Raises InputError where three gripper poses or more are one and the same."""
    metres, radians = np.abs(step_between(base_from_gripper[:1], base_from_gripper).reshape(-1, 2, 3)).max(
        axis=(0, 2), initial=0.0
    )
    if len(base_from_gripper) >= MIN_FRAMES and metres < SAME_POSE[0] and radians < SAME_POSE[1]:
        raise InputError(
            f"{where}: all {len(base_from_gripper)} gripper poses are the same (within {1e3 * metres:.2g} mm and "
            f"{np.degrees(radians):.2g}°); read the pose again for each image"
        )


def checked_intrinsics(
    focal_and_centre: Sequence[Any],
    distortion: Sequence[Any],
    size: tuple[int, int],
    where: str,
    model: DistortionModel = "pinhole",
) -> Intrinsics:
    """Intrinsics of images of `size` from fx, fy, cx, cy and the model's coefficients; InputError if they cannot be."""
    names = COEFFICIENTS[model]
    try:
        fx, fy, cx, cy = (float(value) for value in focal_and_centre)
        coefficients = [float(k) for k in distortion]
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{where}: need numbers fx, fy, cx, cy and distortion [{','.join(names)}], or null"
        ) from None
    if len(coefficients) != len(names):
        raise InputError(
            f"{where}: distortion has {len(coefficients)} numbers, not the {len(names)} of a {model} intrinsics, "
            f'{",".join(names)}; "model" may be {", ".join(COEFFICIENTS)}'
        )
    if not np.isfinite([fx, fy, cx, cy, *coefficients]).all() or fx <= 0 or fy <= 0:
        raise InputError(
            f"{where}: fx and fy must be positive and all numbers finite; or give null to estimate them"
        )
    width, height = size
    if not (0 < cx < width and 0 < cy < height):
        raise InputError(
            f"{where}: the principal point ({cx:.4g}, {cy:.4g}) lies outside the {width}x{height} images; "
            "scale the intrinsics to this resolution"
        )
    return Intrinsics(fx, fy, cx, cy, width, height, coefficients_of(coefficients), model)


def read_rigid(value: Any, where: str) -> Float[ndarray, "4 4"]:
    """A rigid 4x4 from nested lists; InputError saying how far from rigid it is and what it looks like."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: not a 4x4 matrix of numbers; write four rows of four") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: shape {matrix.shape}, not 4x4; write four rows of four numbers")
    return require_rigid(matrix, where)


def check_metres(base_from_gripper: Float[ndarray, "n 4 4"], where: str) -> None:
    """InputError when positions are too far from the base to be metres."""
    farthest = float(np.abs(base_from_gripper[:, :3, 3]).max())
    if farthest > MAX_REACH:
        name, short, a_metre = likely_unit(farthest)
        raise InputError(
            f"{where}: the gripper is up to {farthest:.4g} from the base; these look like {name}: "
            f"divide the translations by {a_metre} (a pose table: --pose-units {short}-rad or {short}-deg)"
        )


def _decoded(folder: Path, images: Sequence[str]) -> tuple[tuple[int, int], list[HowStored]]:
    """The common size (px) of all images and how each is stored; every image is decoded once: a truncated one is found
    now, not after minutes of matching."""
    sizes, digests, how_stored = {}, {}, []
    for name in images:
        pixels, stored = read_stored(folder / name)
        how_stored.append(stored)
        sizes[name] = (pixels.shape[1], pixels.shape[0])
        same = digests.setdefault(hashlib.sha256(pixels.tobytes()).digest(), name)
        if same != name:
            raise InputError(
                f"{folder / name}: the same image as {same}; drop one of the frames or take it again"
            )
    first = sizes[images[0]]
    for name, size in sizes.items():
        if size != first:
            raise InputError(
                f"{folder / name}: {size[0]}x{size[1]} pixels, but {images[0]} has {first[0]}x{first[1]}; "
                "all images must come from one camera at one resolution"
            )
    return first, how_stored


def image_sizes(folder: Path, images: Sequence[str]) -> list[tuple[int, int]]:
    """Width and height of every image, each decoded once; InputError where one is no image."""
    return [read_image(folder / name).shape[1::-1] for name in images]


def _common_orientation(folder: Path, images: Sequence[str], stored: Sequence[HowStored]) -> int:
    """The EXIF orientation of all images; InputError where they differ, as a camera's axes cannot."""
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
    """What a user must know of a capture whose images are rotated to be shown."""
    if capture.orientation == 1:
        return None
    return Finding(
        kind=Kind.IMAGES_ROTATED,
        severity="warns",
        value=float(capture.orientation),
        details={"rotated": ROTATED[capture.orientation]},
    )


def how_scaled(capture: Capture) -> str | None:
    """What was done to images of 16 bits that use fewer."""
    if max(capture.bits) == 8:
        return None
    return f"images of 16 bits, {' or '.join(map(str, capture.bits))} of them used: read by the upper eight of those"
