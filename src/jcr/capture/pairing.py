"""Pairing of gripper poses with images: by the images' names, by their time stamps, or by their order."""

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from os.path import isfile
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.controllers import tolerated
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import first_few, shown
from jcr.capture.pose_track import interpolated_poses
from jcr.errors import InputError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_LATEST_NS = np.iinfo(np.int64).max
"""Largest time stamp (ns) that fits 64 bits, in the year 2262."""
Paired = tuple[list[str], Float[ndarray, "n 4 4"], Mapping[int, str], tuple[str, ...]]
"""Image paths relative to the folder, base_from_gripper of each, messages by index for images without a usable pose,
and notes for the user."""


@dataclass(frozen=True, kw_only=True)
class PoseTable:
    """Gripper poses of a file, one row each, with the image name or time stamp of each row where the file has them."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    images: tuple[str, ...] | None
    """Image names as written in the file; None if the file has no such column."""
    stamp_ns: Int[ndarray, " n"] | None
    faults: Mapping[int, str]
    """Messages by index for the rows that hold no pose; their poses are NaN."""


def pair_with_images(folder: Path, file: Path, table: PoseTable, options: ReadOptions) -> Paired:
    """Pair the poses of a file with a folder's images by name, else by time stamp, else by order of the names.

    Return image paths relative to `folder`, base_from_gripper of each, messages by index for images without a usable
    pose, and notes for the user. Poses paired by time are interpolated. Raises InputError if poses and images cannot be
    paired.
    """
    if table.images is not None:
        return _paired_by_name(folder, file, table)
    taken = image_names(folder)
    if not taken:
        raise InputError(f"{folder}: holds no images, nor does {folder / 'images'}; put them there")
    if table.stamp_ns is not None and (paired := _paired_by_time(folder, file, table, taken, options)):
        return paired
    if len(taken) != len(table.base_from_gripper):
        raise InputError(
            f"{file}: {len(table.base_from_gripper)} poses for {len(taken)} images in {folder} "
            f"({taken[0]} … {taken[-1]}), and no column says which belongs to which; add a column image with their names"
        )
    how = f"rows paired with images in order of their names: {taken[0]} … {taken[-1]}"
    return taken, table.base_from_gripper, table.faults, (how,)


def paired_by_name(
    names: Sequence[str], poses: Float[ndarray, "n 4 4"]
) -> dict[bool, Float[ndarray, "n 4 4"]]:
    """Return the pose of each name, for two ways to sort `names`, if the k-th pose belongs to the k-th sorted name.

    The result maps the way to poses in the order of `names`. Key True: names sorted by the numbers in them (2 before
    10); key False: sorted as text. A key is left out if `names` are in this order already.
    """
    found = {}
    for by_number in (True, False):
        order = sorted(range(len(names)), key=lambda k: natural(names[k]) if by_number else names[k])
        if order != list(range(len(names))):
            found[by_number] = np.empty_like(poses)
            found[by_number][order] = poses
    return found


def natural(name: str) -> list[tuple[int, str]]:
    """Return a sort key that orders names by the numbers in them: img2 before img10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def image_names(folder: Path) -> list[str]:
    """Return the paths of the images in a folder, relative to it, in natural order ("2.png" before "10.png").

    If the folder has a subfolder images/, only the images in this subfolder are returned.
    """
    inside = folder / "images" if (folder / "images").is_dir() else folder
    files = [file for file in inside.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    return sorted((str(file.relative_to(folder)) for file in files), key=natural)


def stamp_ns(text: str, where: str) -> int:
    """Convert a time stamp from text to nanoseconds; its size tells whether it is in s, ms, µs or ns.

    Numbers below 1e11 are in s, below 1e14 in ms, below 1e17 in µs, others in ns. The result is exact; a float has 16
    of the 19 digits of nanoseconds since 1970. Raises InputError, begun with `where`, if the text is no time stamp.
    """
    with suppress(ArithmeticError, ValueError):  # errors of Decimal and int
        value = Decimal(text)
        if (size := abs(value)) < 10**20:
            unit_ns = 10**9 if size < 10**11 else 10**6 if size < 10**14 else 10**3 if size < 10**17 else 1
            if abs(stamp := int(value * unit_ns)) <= _LATEST_NS:
                return stamp
    raise InputError(f"{where}: {shown(text)} is not a time stamp; give seconds or nanoseconds")


def _paired_by_name(folder: Path, file: Path, table: PoseTable) -> Paired:
    """Pair the poses of a table with images by the image names in its rows; the result is that of `pair_with_images`.

    Folder, slashes, case and file ending of a name may differ from those of the image file.
    """
    assert table.images is not None
    own, located = dict[str, list[str]](), list[str]()
    for image in image_names(folder):
        own.setdefault(Path(image).stem.casefold(), []).append(image)
    for name in table.images:
        like = own.get(PureWindowsPath(name).stem.casefold(), [])  # splits at both kinds of slashes
        places = (name, f"images/{name}", *(like if len(like) == 1 else ()))
        # Unlike Path.is_file, isfile is False for a name that is too long.
        located.append(next((place for place in places if isfile(folder / place)), name))
    here = [name for name in image_names(folder) if name not in set(located)]
    left_out = f"{len(here)} images have no pose in {file.name} and are left out: {first_few(here)}"
    absent = [name for name in located if not isfile(folder / name)]
    if len(absent) > tolerated(len(located)):
        raise InputError(
            f"{file}: names {len(absent)} of {len(located)} images that are not in {folder}: {first_few(absent)}; add "
            f"them or drop their rows{' (' + left_out + ')' if here else ''}"
        )
    pairs = zip(table.images, located, strict=True)
    other = [f"{name} is {found}" for name, found in pairs if found not in (name, f"images/{name}")]
    notes = [f"{len(other)} names in {file.name} are not those of files: {other[0]} …"] if other else []
    return located, table.base_from_gripper, table.faults, (*notes, *([left_out] if here else []))


def _paired_by_time(
    folder: Path, file: Path, table: PoseTable, taken: list[str], options: ReadOptions
) -> Paired | None:
    """Pair the images `taken`, named by time stamps, with interpolated poses; the result is that of `pair_with_images`.

    An image whose surrounding poses are over `options.max_gap_ms` apart has a message. The result is None if the names
    are no time stamps, or none of the stamps is within the times of the table.
    """
    assert table.stamp_ns is not None
    try:
        stamps = np.array([stamp_ns(Path(name).stem, str(folder / name)) for name in taken])
    except InputError:
        return None
    if not ((stamps >= table.stamp_ns.min()) & (stamps <= table.stamp_ns.max())).any():
        return None
    sound = np.isfinite(table.base_from_gripper).all((1, 2))
    poses, gap_ns = interpolated_poses(table.stamp_ns[sound], table.base_from_gripper[sound], stamps)
    stale = np.flatnonzero(gap_ns > 1e6 * options.max_gap_ms).tolist()
    why = f"no pose within {options.max_gap_ms:.0f} ms around it; drop the image or raise --max-gap-ms"
    notes = (f"poses interpolated at the {len(taken)} images' time stamps",)
    return taken, poses, {k: f"{file}: {taken[k]}: {why}" for k in stale}, notes
