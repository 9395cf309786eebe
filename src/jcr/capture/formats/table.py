"""Images with a file of gripper poses: CSV and other tables, NumPy arrays, UR's p[…], YAML and JSON lists."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jcr.capture.checks import checked_capture, require_frames
from jcr.capture.controllers import CONVENTIONS, checked_rows, tolerated
from jcr.capture.formats import pose_lists
from jcr.capture.formats.pose_lists import usual_name
from jcr.capture.options import ConventionName, ReadOptions
from jcr.capture.pairing import PoseTable, pair_with_images, stamp_ns
from jcr.capture.plain_files import number_of, read_lines, read_npy, shown, split_cells
from jcr.capture.ros import CAMERA_INFO, read_camera_info
from jcr.errors import InputError
from jcr.records import Capture

TEXTS = (".csv", ".tsv", ".txt")
SUFFIXES = (*TEXTS, ".npy", *pose_lists.SUFFIXES)
TABLES = tuple(f"poses{suffix}" for suffix in SUFFIXES)
_IMAGE = (
    "image", "image_name", "image_path", "file", "filename", "file_name", "file_path", "name", "picture",
)  # fmt: skip
_STAMP = ("timestamp", "timestamp_ns", "stamp", "time", "time_s", "t")
_SHOWN: tuple[ConventionName, ...] = ("quat-xyzw", "rpy", "kuka", "fanuc", "abb", "matrix")
"""Conventions that column names identify; rx, ry, rz, which may be a rotation vector or angles, identify none."""
_LAST_ROW = {"m30": "0", "m31": "0", "m32": "0", "m33": "1"}
_EXPLICIT: dict[str, ConventionName] = {
    "ur_x": "ur", "rvec_x": "rotation-vector", "rotvec_x": "rotation-vector",
    "rotation_vector_x": "rotation-vector", "axis_angle_x": "rotation-vector",
}  # fmt: skip
"""Conventions that the first rotation column identifies; `ur_x` is that of UR's p[…]."""
_UR_POSE = re.compile(r"\bp\s*\[([^\]]*)\]")


def recognises(path: Path) -> bool:
    """Test whether a path is a file of gripper poses or a folder with one."""
    return (file := find_table(path)) is not None and file.suffix.lower() in SUFFIXES


def read(path: Path, options: ReadOptions) -> Capture:
    """Read a capture from a file of gripper poses, or a folder with such a file, and the images in the same folder.

    The images may also be in its subfolder images/. Intrinsics (camera_info.yaml) in the folder are read if they exist.
    Raises InputError if there is no such file or no image for it.
    """
    file = options.poses or find_table(path)
    if file is None:
        raise InputError(f"{path}: holds no table of poses ({', '.join(TABLES[:4])}); name it with --poses")
    folder = path if path.is_dir() else path.parent
    table = read_pose_table(file, options)
    images, poses, faults, notes = pair_with_images(folder, file, table, options)
    capture, _ = checked_capture(folder, images, poses, str(file), faults)
    info = options.camera_info or folder / CAMERA_INFO
    known = options.camera_info is not None or info.is_file()
    return replace(
        capture,
        source=file,
        notes=(*notes, *capture.notes),
        intrinsics=read_camera_info(info, capture.image_size) if known else None,
    )


def find_table(path: Path) -> Path | None:
    """Return the pose file at a path, or the one in the folder at the path; None if there is none."""
    if path.is_file():
        return path
    return next((path / name for name in TABLES if (path / name).is_file()), None)


def read_pose_table(file: Path, options: ReadOptions) -> PoseTable:
    """Read the poses of a file; raise InputError that names the faulty column or the option to add."""
    return pose_table(*_read_rows(file), options, str(file))


def pose_table(
    header: Sequence[str] | None, rows: Sequence[Sequence[Any]], options: ReadOptions, where: str
) -> PoseTable:
    """Convert rows of cells to poses, NaN for rows without one; raise InputError if more are than `tolerated` permits.

    `header` has the names of the columns; None if the table has no header. The convention follows from `options` or, if
    "auto", from the header. Messages begin with `where`.
    """
    if not rows or not rows[0]:
        raise InputError(f"{where}: holds no poses; expected one row per image")
    width = len(header or rows[0])
    for number, row in enumerate(rows, start=1):
        if len(row) != width:
            raise InputError(f"{where}: row {number} has {len(row)} columns, not {width}; correct it")
    cells, convention = _named_columns(header, rows, options, where)
    image, stamp = (next((cells[one] for one in names if one in cells), None) for names in (_IMAGE, _STAMP))
    require_frames(0 if image is None else len(image), where, 0)
    wanted = CONVENTIONS[convention].columns
    if set(_LAST_ROW) <= set(wanted) and not set(_LAST_ROW) & set(cells):
        cells = cells | {name: (cell,) * len(rows) for name, cell in _LAST_ROW.items()}
    if missing := [name for name in wanted if name not in cells]:
        raise InputError(
            f"{where}: no column {', '.join(missing)}, which --pose-convention {convention} needs; "
            f"it has {', '.join(cells)}"
        )
    numbers, texts = np.full((len(rows), len(wanted)), np.nan), dict[int, str]()
    for k, name in enumerate(wanted):
        for row, cell in enumerate(cells[name]):
            if (number := number_of(cell)) is not None:
                numbers[row, k] = number
            else:
                text = f"{shown(cell)} is not a number; correct or drop the row"
                texts.setdefault(row, f"{where}: row {row + 1}, column {name}: {text}")
    poses, faults = checked_rows(numbers, convention, options.pose_units, where)
    faults |= texts
    if len(faults) > tolerated(len(rows)):
        raise InputError(faults[min(faults)])
    return PoseTable(
        base_from_gripper=poses,
        images=None if image is None else tuple(map(str, image)),
        stamp_ns=None if stamp is None else np.array([stamp_ns(str(cell), where) for cell in stamp]),
        faults=faults,
    )


def _convention_of(names: Collection[str], where: str) -> ConventionName:
    """Return the pose convention that column names identify; raise InputError, begun with `where`, if they do not."""
    for convention in _SHOWN:
        if set(CONVENTIONS[convention].columns) - set(_LAST_ROW) <= set(names):
            return convention
    if {"rx", "ry", "rz"} <= set(names):
        raise InputError(
            f"{where}: columns rx, ry, rz may be a rotation vector (--pose-convention ur) or angles about fixed axes "
            "(--pose-convention yaskawa); say which"
        )
    raise InputError(
        f"{where}: its columns ({', '.join(names)}) contain no pose; name them x, y, z and qx, qy, qz, qw or "
        "roll, pitch, yaw, or give --pose-convention"
    )


def _named_columns(
    header: Sequence[str] | None, rows: Sequence[Sequence[Any]], options: ReadOptions, where: str
) -> tuple[dict[str, tuple[Any, ...]], ConventionName]:
    """Return the columns of a table of poses, and the convention of its poses, by the options or the header.

    The columns are a dictionary from name ("x", "qx", "image", …) to cells. Without a header, an image name or time
    stamp is expected first, then the columns of the convention. Messages of InputError begin with `where`.
    """
    columns, convention = [tuple(column) for column in zip(*rows, strict=True)], options.pose_convention
    if header is not None:
        names = [usual_name(cell) for cell in header]
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            raise InputError(f"{where}: two columns are named {', '.join(sorted(twice))}; keep one")
        for cell in header if convention == "auto" else ():
            convention = _EXPLICIT.get(cell, convention)
        if convention == "auto":
            convention = _convention_of(names, where)
        return dict(zip(names, columns, strict=True)), convention
    named = dict[str, tuple[Any, ...]]()
    if number_of(columns[0][0]) is None:
        named["image"] = columns.pop(0)
    if convention == "auto":
        # Eight numbers are TUM's: timestamp tx ty tz qx qy qz qw.
        guesses: dict[int, ConventionName] = {8: "quat-xyzw", 12: "matrix", 16: "matrix"}
        convention = guesses.get(len(columns), convention)
    if convention == "auto":
        raise InputError(
            f"{where}: {len(columns)} columns of numbers without names; add a header (x,y,z,qx,qy,qz,qw) or say how "
            f"a pose is written with --pose-convention ({', '.join(CONVENTIONS)})"
        )
    wanted = CONVENTIONS[convention].columns
    if len(wanted) == 16 and len(columns) in (12, 13):
        wanted = tuple(name for name in wanted if name not in _LAST_ROW)
    if len(columns) == len(wanted) + 1:
        named["timestamp"] = columns.pop(0)
    if len(columns) != len(wanted):
        raise InputError(
            f"{where}: {len(columns)} columns of numbers; --pose-convention {convention} has {len(wanted)}: "
            f"{', '.join(wanted)}"
        )
    return named | dict(zip(wanted, columns, strict=True)), convention


def _read_rows(file: Path) -> tuple[Sequence[str] | None, Sequence[Sequence[Any]]]:
    """Read the header of a pose file (None without one) and the cells of every row.

    The file is a text table, UR's p[…], YAML, JSON or .npy. Matrices of a .npy file become rows of numbers, matrix row
    by matrix row.
    """
    if file.suffix in pose_lists.SUFFIXES:
        return pose_lists.read_rows(pose_lists.read_yaml_or_json(file), str(file))
    if file.suffix == ".npy":
        array = read_npy(file)
        if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or not array.size:
            text = "no table of numbers; save (n,4,4) matrices or (n,k) rows with numpy.save"
            raise InputError(f"{file}: {text}")
        return None, array.reshape(len(array), -1).tolist()
    lines, comments = read_lines(file)
    if any(map(_UR_POSE.search, lines)):
        return _rows_of_ur(file, lines)
    header, rows = split_cells(lines, file)
    if header is not None:
        return header, rows
    # TUM and ethz-asl write the names of their columns as a comment.
    for comment in reversed(comments):
        cells = [cell for cell in re.split(r"[,;\s]+", comment) if cell]
        if rows and len(cells) == len(rows[0]) and set("xyz") <= {usual_name(cell) for cell in cells}:
            return cells, rows
    return None, rows


def _rows_of_ur(file: Path, lines: list[str]) -> tuple[Sequence[str], list[list[str]]]:
    """Return header and cells of lines with UR's p[x, y, z, rx, ry, rz], after an optional image name or time stamp.

    The header has "image" or "timestamp" if present, then x, y, z, ur_x, ur_y, ur_z. Raises InputError for a line that
    differs.
    """
    rows = list[list[str]]()
    for number, line in enumerate(lines, start=1):
        match = _UR_POSE.search(line)
        if match is None and not rows:
            continue  # a header
        before = re.findall(r"[^,;\t\s\"'=]+", line[: match.start()])[:1] if match else []
        rows.append([*before, *(cell.strip() for cell in match[1].split(","))] if match else [])
        if len(rows[-1]) not in (6, 7) or len(rows[-1]) != len(rows[0]):
            raise InputError(
                f"{file}: line {number} holds no p[x, y, z, rx, ry, rz] as the others: {shown(line)}; correct or drop it"
            )
    first = () if len(rows[0]) == 6 else ("image",) if number_of(rows[0][0]) is None else ("timestamp",)
    return (*first, "x", "y", "z", "ur_x", "ur_y", "ur_z"), rows
