"""A table of gripper poses: columns by their names, TUM and ethz-asl trajectories, or a controller's rows."""

from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.checks import require_frames
from jcr.capture.options import ConventionName, ReadOptions, UnitsName
from jcr.capture.plain_files import shown
from jcr.capture.robot_poses import CONVENTIONS, poses_from_numbers
from jcr.capture.table_cells import Cells, is_number, read_cells
from jcr.errors import InputError

_IMAGE = (
    "image", "image_name", "image_path", "file", "filename", "file_name", "file_path", "name", "picture",
)  # fmt: skip
_STAMP = ("timestamp", "stamp", "time", "t")
_SHOWN: tuple[ConventionName, ...] = ("quat-xyzw", "rpy", "kuka", "fanuc", "abb", "matrix")
"""Conventions that the names of columns give away; rx, ry, rz may be a rotation vector or angles."""
_LAST_ROW = {"m30": "0", "m31": "0", "m32": "0", "m33": "1"}

_LATEST_NS = np.iinfo(np.int64).max
"""The last nanosecond that fits 64 bits, in the year 2262."""


@dataclass(frozen=True)
class PoseTable:
    """The rows of a table."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    images: tuple[str, ...] | None
    """Names as they stand in the table."""
    stamp_ns: Int[ndarray, " n"] | None
    convention: str
    """A name of CONVENTIONS."""


def read_pose_table(file: Path, options: ReadOptions) -> PoseTable:
    """The poses of a table; InputError naming the row or column at fault, or the option that it needs."""
    cells = read_cells(file)
    if options.pose_convention == "auto":
        options = replace(options, pose_convention=cells.convention)
    if cells.names is None:
        columns = _unnamed(file, cells, options)
    else:
        columns = dict(zip(cells.names, cells.columns(), strict=True))
    image = next((columns[name] for name in _IMAGE if name in columns), None)
    if image is not None:
        require_frames(len(image), str(file), 0)  # a row a frame: before a million numbers are read
    stamp = next((columns[name] for name in _STAMP if name in columns), None)
    options = replace(options, pose_convention=convention_of(columns, options, str(file)))
    base_from_gripper = poses_of_columns(columns, cells.units, options, str(file))
    stamp_numbers = None if stamp is None else np.array([stamp_ns(text, str(file)) for text in stamp])
    return PoseTable(base_from_gripper, image, stamp_numbers, options.pose_convention)


def convention_of(columns: dict[str, tuple[str, ...]], options: ReadOptions, where: str) -> ConventionName:
    """The convention of named columns: that was asked for, or that they show."""
    return options.pose_convention if options.pose_convention != "auto" else _shown(columns, where)


def poses_of_columns(
    columns: dict[str, tuple[str, ...]], units: frozenset[str], options: ReadOptions, where: str
) -> Float[ndarray, "n 4 4"]:
    """base_from_gripper (n,4,4) from named columns of text, in the convention that they show or was asked for."""
    convention = convention_of(columns, options, where)
    wanted = CONVENTIONS[convention].columns
    rows = len(next(iter(columns.values())))
    if set(_LAST_ROW) <= set(wanted) and not set(_LAST_ROW) & set(columns):
        columns = columns | {name: (cell,) * rows for name, cell in _LAST_ROW.items()}
    missing = [name for name in wanted if name not in columns]
    if missing:
        raise InputError(
            f"{where}: no column {', '.join(missing)}, which --pose-convention {convention} needs; "
            f"it has {', '.join(columns)}"
        )
    numbers = np.array([_numbers(columns[name], name, where) for name in wanted]).T
    return poses_from_numbers(numbers, convention, _units(convention, units, options), where)


def stamp_ns(text: str, where: str) -> int:
    """A time stamp in nanoseconds; seconds, milli-, micro- and nanoseconds are distinguished by their size.

    Exact: a float holds 16 of the 19 digits that nanoseconds since 1970 have.
    """
    try:
        value = Decimal(text)
        size = abs(value)
        if not size < 10**20:
            raise ValueError
        unit_ns = 10**9 if size < 10**11 else 10**6 if size < 10**14 else 10**3 if size < 10**17 else 1
        if not -_LATEST_NS <= (stamp := int(value * unit_ns)) <= _LATEST_NS:
            raise ValueError
        return stamp
    except (ArithmeticError, ValueError):  # of Decimal each has its own name
        raise InputError(f"{where}: {shown(text)} is not a time stamp; give seconds or nanoseconds") from None


def _unnamed(file: Path, cells: Cells, options: ReadOptions) -> dict[str, tuple[str, ...]]:
    """Columns without a header: an image's name in front, or a stamp, and then the convention's own."""
    columns = cells.columns()
    named: dict[str, tuple[str, ...]] = {}
    if not is_number(columns[0][0]):
        named["image"] = columns.pop(0)
    convention = options.pose_convention
    if convention == "auto":
        # Eight are TUM's: timestamp tx ty tz qx qy qz qw.
        convention = {8: "quat-xyzw", 12: "matrix", 16: "matrix"}.get(len(columns))
    if convention is None:
        raise InputError(
            f"{file}: {len(columns)} columns of numbers without names; add a header (x,y,z,qx,qy,qz,qw) or say how "
            f"a pose is written with --pose-convention ({', '.join(CONVENTIONS)})"
        )
    wanted = CONVENTIONS[convention].columns
    if len(wanted) == 16 and len(columns) in (12, 13):
        wanted = tuple(name for name in wanted if name not in _LAST_ROW)
    if len(columns) == len(wanted) + 1:
        named["timestamp"] = columns.pop(0)
    if len(columns) != len(wanted):
        raise InputError(
            f"{file}: {len(columns)} columns of numbers; --pose-convention {convention} has {len(wanted)}: "
            f"{', '.join(wanted)}"
        )
    return named | dict(zip(wanted, columns, strict=True))


def _shown(columns: dict[str, tuple[str, ...]], where: str) -> ConventionName:
    """The convention that the names of the columns show."""
    for name in _SHOWN:
        if set(CONVENTIONS[name].columns) - set(_LAST_ROW) <= columns.keys():
            return name
    if {"rx", "ry", "rz"} <= columns.keys():
        raise InputError(
            f"{where}: columns rx, ry, rz may be a rotation vector (--pose-convention ur) or angles about fixed axes "
            "(--pose-convention yaskawa); say which"
        )
    raise InputError(
        f"{where}: its columns ({', '.join(columns)}) contain no pose; name them x, y, z and qx, qy, qz, qw or roll, "
        "pitch, yaw, or give --pose-convention"
    )


def _units(convention: str, named: frozenset[str], options: ReadOptions) -> UnitsName:
    """Units that were asked for, or else those that the names of the columns give, and for the rest the convention."""
    if options.pose_units != "auto" or not named:
        return options.pose_units
    length, angle = CONVENTIONS[convention].units()
    length = next((unit for unit in ("mm", "cm", "m") if unit in named), length)
    angle = next((unit for unit in ("deg", "rad") if unit in named), angle)
    return next(units for units in get_args(UnitsName) if units == f"{length}-{angle}")


def _numbers(cells: tuple[str, ...], name: str, where: str) -> list[float]:
    for row, cell in enumerate(cells, start=1):
        if not is_number(cell):
            raise InputError(
                f"{where}: row {row}, column {name}: {shown(cell)} is not a number; correct or drop the row"
            )
    return [float(cell) for cell in cells]
