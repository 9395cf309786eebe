"""Images and a table of gripper poses: which image belongs to which row."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PureWindowsPath

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.camera_info import FILE, read_camera_info
from jcr.capture.checks import checked_capture
from jcr.capture.depth_images import depth_beside
from jcr.capture.names import natural
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained
from jcr.capture.pose_table import PoseTable, read_pose_table, stamp_ns
from jcr.capture.pose_track import pose_track
from jcr.capture.table_cells import SUFFIXES, is_number
from jcr.errors import InputError
from jcr.records import Capture

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
TABLES = tuple(f"{stem}{suffix}" for stem in ("poses", "gripper_poses", "robot_poses") for suffix in SUFFIXES)


def read(path: Path, options: ReadOptions) -> Capture:
    """The capture of a table, or of a folder that holds one; images in the same folder or in images/."""
    file = options.poses or find_table(path)
    if file is None:
        raise InputError(f"{path}: holds no table of poses ({', '.join(TABLES[:4])}); name it with --poses")
    folder = path if path.is_dir() else path.parent
    table = read_pose_table(file, options)
    images, poses, notes = _paired(folder, file, table, options)
    capture = checked_capture(folder, images, poses, str(file))
    depths = depth_beside(folder, images)
    capture = replace(with_camera_info(capture, options), source=file, notes=notes, depths=depths)
    return replace(capture, pose_convention=table.convention)


def find_table(path: Path) -> Path | None:
    """The table of poses that a path is or holds, if there is one."""
    if path.is_file():
        return path
    return next((path / name for name in TABLES if (path / name).is_file()), None)


def with_camera_info(capture: Capture, options: ReadOptions) -> Capture:
    """The capture with the intrinsics of a camera_info YAML, where there is one and it has none yet."""
    file = options.camera_info or capture.folder / FILE
    if options.camera_info is None and (capture.intrinsics is not None or not file.is_file()):
        return capture
    return replace(capture, intrinsics=read_camera_info(file, capture.image_size))


def gripper_poses(
    folder: Path, images: Sequence[str], options: ReadOptions
) -> tuple[list[int], Float[ndarray, "m 4 4"], tuple[str, ...]]:
    """Rows of `images` that a table of gripper poses knows, their poses, and a note of those it does not know.

    Raises InputError when there is no table or it does not belong to these images.
    """
    file = options.poses or find_table(folder)
    if file is None:
        raise InputError(f"{folder}: the cameras' poses are here, but no gripper poses; give --poses TABLE")
    table = read_pose_table(file, options)
    if table.images is None:
        if len(table.base_from_gripper) != len(images):
            raise InputError(
                f"{file}: {len(table.base_from_gripper)} poses for {len(images)} images; add a column with the "
                "images' names"
            )
        return list(range(len(images))), table.base_from_gripper, ()
    row_of = {_plain(name): row for row, name in enumerate(table.images)}
    if len(row_of) < len(table.images):
        raise InputError(f"{file}: names an image more than once; keep one row per image")
    known = [k for k, name in enumerate(images) if _plain(name) in row_of]
    if not known:
        raise InputError(
            f"{file}: lists none of the images; it lists {table.images[0]}, the images are called {images[0]}"
        )
    rows = [row_of[_plain(images[k])] for k in known]
    notes = ()
    if unknown := len(images) - len(known):
        notes = (f"{unknown} of {len(images)} images have no gripper pose in {file.name}: left out",)
    return known, table.base_from_gripper[rows], notes


def _plain(name: str) -> str:
    """An image's name without folder and ending: tools differ in both."""
    return Path(name).stem


def _paired(
    folder: Path, file: Path, table: PoseTable, options: ReadOptions
) -> tuple[list[str], Float[ndarray, "n 4 4"], tuple[str, ...]]:
    if table.images is not None:
        located = _located(folder, table.images, file)
        notes = _without_pose(folder, located, file)
        named = zip(table.images, located, strict=True)
        if other := [(name, found) for name, found in named if found not in (name, f"images/{name}")]:
            found = " is ".join(other[0])
            notes = (f"{len(other)} names in {file.name} are not those of files: {found}, and so on", *notes)
        return located, table.base_from_gripper, notes
    taken = image_names(folder)
    if not taken:
        raise InputError(f"{folder}: holds no images, nor does {folder / 'images'}; put them there")
    stems = [Path(name).stem for name in taken]
    if table.stamp_ns is not None and all(map(is_number, stems)):
        stamps = np.array(
            [stamp_ns(stem, str(folder / name)) for stem, name in zip(stems, taken, strict=True)]
        )
        if (stamps >= table.stamp_ns.min()).any() and (stamps <= table.stamp_ns.max()).any():
            poses, gap_ns = pose_track(table.stamp_ns, table.base_from_gripper).at(stamps)
            fresh = gap_ns <= 1e6 * options.max_gap_ms
            if not fresh.all():
                stale = int(gap_ns.argmax())
                raise InputError(
                    f"{file}: no pose within {options.max_gap_ms:.0f} ms around {taken[stale]}; drop that image "
                    "or raise --max-gap-ms"
                )
            return taken, poses, (f"poses interpolated at the {len(taken)} images' time stamps",)
    if len(taken) != len(table.base_from_gripper):
        raise InputError(
            f"{file}: {len(table.base_from_gripper)} poses for {len(taken)} images in {folder} "
            f"({taken[0]} … {taken[-1]}), and no column says which belongs to which; add a column image with "
            "their names"
        )
    how = f"rows paired with images in order of their names: {taken[0]} … {taken[-1]}"
    return taken, table.base_from_gripper, (how,)


def _without_pose(folder: Path, named: list[str], file: Path) -> tuple[str, ...]:
    """A note on images that the table does not name; InputError where it names images that are not there."""
    here = [name for name in image_names(folder) if name not in named]
    left_out = (
        f"{len(here)} images have no pose in {file.name} and are left out: {_listed(here)}" if here else ""
    )
    absent = [name for name in named if not (folder / name).is_file()]
    if absent:
        raise InputError(
            f"{file}: names {len(absent)} of {len(named)} images that are not in {folder}: {_listed(absent)}; add them "
            f"or drop their rows{' (' + left_out + ')' if here else ''}"
        )
    return (left_out,) if here else ()


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _located(folder: Path, names: Sequence[str], file: Path) -> list[str]:
    """The images' paths in the folder: as written, in images/, or by their own names whatever folder, case and ending.

    A name that more than one image has decides nothing.
    """
    own: dict[str, list[str]] = {}
    for image in image_names(folder):
        for key in {Path(image).name.casefold(), Path(image).stem.casefold()}:
            own.setdefault(key, []).append(image)
    found = []
    for name in names:
        plain = PureWindowsPath(name).name  # which takes both kinds of slashes
        like = own.get(plain.casefold()) or own.get(Path(plain).stem.casefold()) or []
        if (folder / "images" / name).is_file() and not (folder / name).is_file():
            found.append(f"images/{name}")
        elif len(like) == 1 and not (folder / name).is_file():
            found.append(like[0])
        else:
            contained(folder, name, str(file))
            found.append(name)
    return found


def image_names(folder: Path) -> list[str]:
    """Images of a folder, or of its images/, as people count: img2 before img10."""
    inside = folder / "images" if (folder / "images").is_dir() else folder
    files = [file for file in inside.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    names = [str(file.relative_to(folder)) for file in files]
    return sorted(names, key=natural)
