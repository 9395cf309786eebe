"""Readings of tables: columns that hold a pose, the notations that names and numbers leave possible, and the poses."""

import re
import unicodedata
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os.path import commonprefix

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.documents import Table
from jcr.capture.notations import (
    EULERS,
    MAKERS,
    NUMBERS,
    angle_unit,
    in_words,
    length_unit,
    notation_of,
    poses_of,
    rotation_fault,
)
from jcr.capture.options import ReadOptions, tolerated
from jcr.errors import InputError, first_few
from jcr.geometry import inverse
from jcr.number_format import HUGE, significant
from jcr.records import Reading

Numbers = Float[ndarray, "n c"]
Candidate = tuple[Reading, Float[ndarray, "n 4 4"]]
"""A reading, and the gripper poses that it gives for the rows of a table; NaN where a row holds none."""

UNITS = {
    "mm": "mm", "millimeter": "mm", "millimeters": "mm", "cm": "cm", "m": "m", "meter": "m", "meters": "m",
    "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "rad": "rad", "radian": "rad", "radians": "rad",
}  # fmt: skip
"""Units by the words for them in column names."""
POSITION = {"position", "pos", "translation", "trans", "t", "p", "xyz", "tvec", "location", "point", "vec"}
ROTATION = {
    "orientation", "rotation", "rot", "quaternion", "quat", "q", "rpy", "euler", "angle", "angles", "rvec", "rotvec",
    "vector", "axis", "aa", "r", "xyzw", "wxyz", "matrix", "mat", "mtx",
}  # fmt: skip
"""Words of column names that stand for one half of a pose; the rest of the name is that of the whole pose."""
ROTATION_OF_12 = (0, 1, 2, 4, 5, 6, 8, 9, 10)
"""Places of the rotation, row by row, among the numbers of a transform's rows."""
MOST_UNNAMED = 100
"""Largest number of columns without names in which a pose is looked for; poses and joints of two arms have 30."""
VECTOR = {"rvec", "rotvec", "vector", "aa"}
ROBOT = {
    "robot", "tcp", "ee", "eef", "flange", "tool", "tool0", "gripper", "hand", "end", "end2base", "ee2base", "tcp2base",
    "gripper2base", "base", "arm", "effector", "fpe", "actual", "wrist", "bmg", "bte",
}  # fmt: skip
OTHERS = {
    "board", "chess", "chessboard", "target", "cam", "camera", "marker", "tag", "aruco", "charuco", "object", "checker",
    "checkerboard", "pattern", "cpo", "target2cam", "obj", "joint", "joints", "tracking", "grid",
}  # fmt: skip
"""Words that name the robot's pose, and those that name another one, such as a board's in the camera."""
DIRECT = re.compile(
    r"(gripper|ee|eef|end|tcp|tool|flange|hand|g|e)_?2_?(base|b|robot)|base_from_|b(ase)?_t_|fpe|o_t_ee"
)
INVERSE = re.compile(
    r"(base|robot)_?2_?(gripper|ee|eef|end|tcp|tool|flange|hand)|_from_base|base_in_(gripper|ee|tcp)"
)
"""Names that state the direction: base_from_gripper, and gripper_from_base."""
ROTATION_NAMES: dict[tuple[str, ...], tuple[str, ...]] = {
    ("qx", "qy", "qz", "qw"): ("quat:xyzw",),
    ("q0", "q1", "q2", "q3"): ("quat:wxyz", "quat:xyzw"),
    ("q1", "q2", "q3", "q4"): ("quat:wxyz", "quat:xyzw"),
    ("roll", "pitch", "yaw"): ("euler:xyz",),
    ("w", "p", "r"): ("euler:xyz",),
    ("o", "a", "t"): ("euler:ZYZ",),
    ("u", "v", "w"): ("euler:ZYX",),
    ("wx", "wy", "wz"): ("rotvec",),
    ("rx", "ry", "rz"): ("rotvec", *EULERS),
    ("a", "b", "c"): EULERS,
    ("alpha", "beta", "gamma"): EULERS,
    ("ax", "ay", "az"): ("rotvec", *EULERS),
    ("ex", "ey", "ez"): EULERS,
}
"""Names of a rotation's columns, and the notations that they may stand for; one notation is stated by the names."""


@dataclass(frozen=True, kw_only=True)
class PoseColumns:
    """Columns of a table that hold one pose: three positions and a rotation, with what their names state."""

    position: tuple[int, ...]
    rotation: tuple[int, ...]
    notations: tuple[str, ...]
    """Notations that the names leave possible."""
    name: str
    """First part of the names of the columns; empty without names."""
    is_named: bool
    """Whether names mark the columns, which then hold the gripper in the base unless a name states the inverse."""
    length: str | None = None
    angle: str | None = None
    """Units that the names state; None: the numbers show them."""


def words_of(text: str) -> list[str]:
    """Return the words of a name in lower case: parts between other characters, and before capitals in mixed case."""
    plain = unicodedata.normalize("NFC", text)
    return [
        part.lower()
        for part in re.findall(r"°|[A-Z]?[^\W\d_A-Z]+|[A-Z]+|\d+", re.sub(r"(\d)(?=[A-Za-z])", r"\1 ", plain))
    ]


def _split(name: str) -> tuple[tuple[str, ...], str, str | None]:
    """Return the words before the last part of a column's name, its last part, and its unit if the name states one.

    The last part is an axis ("x", "qx", "roll"), a number, or two numbers joined by a comma for a matrix.
    """
    plain = unicodedata.normalize("NFC", name).strip()
    parts = [one.lower() for one in re.findall(r"[^\W_]+|°", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", plain))]
    unit = next((UNITS[one] for one in parts[1:] if one in UNITS), None)
    parts = [parts[0], *(one for one in parts[1:] if one not in UNITS)] if parts else [""]
    if len(parts) > 1 and parts[-1].isdecimal() and parts[-2].isdecimal():
        return tuple(parts[:-2]), f"{parts[-2]},{parts[-1]}", unit
    if (entry := re.fullmatch(r"([a-z]*?)_?([0-4])([0-4])", parts[-1])) and entry[1]:
        return (*parts[:-1], *filter(None, [entry[1]])), f"{entry[2]},{entry[3]}", unit
    if (short := re.fullmatch(r"(?:pos|p|t)([xyz])", parts[-1])) is not None:
        return (*parts[:-1], "position"), short[1], unit
    if (short := re.fullmatch(r"(pose|tcp|ee)([xyz]|r[xyz])", parts[-1])) is not None:
        return (*parts[:-1], short[1]), short[2], unit
    if (glued := re.fullmatch(r"([a-z]{3,})(\d+)", parts[-1])) is not None:
        return (*parts[:-1], glued[1]), glued[2], unit
    return tuple(parts[:-1]), parts[-1], unit


def numbers_of_table(table: Table) -> Numbers:
    """Return the cells of a table as numbers (n,c); NaN for texts, missing cells, and numbers that no pose has."""
    made = [
        [cell if isinstance(cell, float) and abs(cell) < HUGE else np.nan for cell in row]
        for row in table.rows
    ]
    return np.array(made, dtype=np.float64).reshape(len(table.rows), len(table.columns))


def pose_columns(table: Table, skipped: frozenset[int] = frozenset()) -> list[PoseColumns]:
    """Return the sets of columns that may hold a pose, by the names of the columns, or by their order without names.

    `skipped` are columns that hold names of images, time stamps or numbers of rows.
    """
    numbers = numbers_of_table(table)
    enough = np.isfinite(numbers).sum(0) >= len(numbers) - tolerated(len(numbers))
    usable = [k for k in np.flatnonzero(enough).tolist() if k not in skipped]
    named = [k for k in usable if table.columns[k] is not None]
    if len(named) < 3:
        return _unnamed_poses(usable, numbers, "")
    groups, units = dict[tuple[str, str], tuple[dict[str, int], set[str]]](), dict[int, str | None]()
    for k in named:
        stem, last, units[k] = _split(table.columns[k] or "")
        pose = "_".join(one for one in stem if one not in POSITION | ROTATION)
        cells, words = groups.setdefault((pose, _half(stem, last)), ({}, set()))
        cells.setdefault(last, k)
        words.update(stem)
    return [replace(one, **_stated_units(one, units)) for one in _of_groups(groups, numbers)]


def _half(stem: Sequence[str], last: str) -> str:
    """Return the half of a pose that a column belongs to by its name: "position", "rotation", or "" for a whole pose."""
    if last in ("x", "y", "z") or last[:1].isdecimal():
        if set(stem) & ROTATION and not set(stem) & POSITION - {"t", "p", "vec"}:
            return "rotation"
        return "" if last[:1].isdecimal() and not set(stem) & POSITION else "position"
    return "rotation"


def _of_groups(
    groups: dict[tuple[str, str], tuple[dict[str, int], set[str]]], numbers: Numbers
) -> Iterator[PoseColumns]:
    """Yield poses from columns grouped by pose and half, each group with its last parts of names and its words.

    A lone position joins a lone rotation of another name.
    """
    positions = dict[str, tuple[int, ...]]()
    rotations = dict[str, list[tuple[tuple[int, ...], tuple[str, ...]]]]()
    for (pose, half), (cells, words) in groups.items():
        ordered = _numbered(cells) or []
        if half == "position" and {"x", "y", "z"} <= cells.keys():
            positions[pose] = tuple(cells[axis] for axis in "xyz")
        elif half == "position" and len(ordered) == 3:
            positions[pose] = tuple(ordered)
        elif half == "rotation" and len(ordered) not in (12, 16):
            rotations.setdefault(pose, []).extend(_rotations(cells, words))
        elif half == "rotation" and not numbers[:, ordered[3:12:4]].any():
            # A rotation that is stored as a whole transform without translation.
            rotations.setdefault(pose, []).append((tuple(ordered[k] for k in ROTATION_OF_12), ("matrix",)))
        elif ordered:
            yield from (
                replace(one, is_named=False, name=pose) for one in _unnamed_poses(ordered, numbers, pose)
            )
    lone = len(positions) == 1 and len(rotations) == 1
    for pose, position in positions.items():
        for rotation, notations in rotations.get(pose) or (next(iter(rotations.values())) if lone else []):
            is_named = not (len(position) == 3 and notations[0].startswith("matrix"))
            yield PoseColumns(
                position=position, rotation=rotation, notations=notations, name=pose, is_named=is_named
            )


def _numbered(cells: dict[str, int]) -> list[int] | None:
    """Return the columns 0, 1, 2, … or (0,0), (0,1), … in their order; None if the names are no such numbers."""
    is_matrix = all(re.fullmatch(r"[0-4]{2}", last) for last in cells)  # T_00, T_01, … T_33
    try:
        places = {tuple(map(int, last if is_matrix else last.split(","))): k for last, k in cells.items()}
    except ValueError:
        return None
    return [places[place] for place in sorted(places)]


def _rotations(cells: dict[str, int], words: set[str]) -> Iterator[tuple[tuple[int, ...], tuple[str, ...]]]:
    """Yield the columns of each rotation among columns of one half of a pose, and the notations that it may have."""
    three = ("rotvec",) if words & VECTOR else EULERS if "euler" in words else ("rotvec", *EULERS)
    three = ("euler:xyz",) if "rpy" in words else three
    if {"x", "y", "z", "w"} <= cells.keys():
        yield tuple(cells[axis] for axis in "xyzw"), ("quat:xyzw",)
    elif {"x", "y", "z"} <= cells.keys():
        yield tuple(cells[axis] for axis in "xyz"), three
    for names, notations in ROTATION_NAMES.items():
        if set(names) <= cells.keys():
            yield tuple(cells[name] for name in names), notations
    ordered = _numbered({last: k for last, k in cells.items() if last[:1].isdecimal()})
    if ordered and len(ordered) == 9:
        yield tuple(ordered), ("matrix",)
    elif ordered and len(ordered) == 4:
        stated = tuple(f"quat:{order}" for order in ("xyzw", "wxyz") if order in words)
        yield tuple(ordered), stated or ("quat:xyzw", "quat:wxyz")
    elif ordered and len(ordered) == 3:
        yield tuple(ordered), three


def _unnamed_poses(columns: Sequence[int], numbers: Numbers, name: str) -> list[PoseColumns]:
    """Return the poses that columns of numbers without names may hold, by their count and order.

    Six numbers are a position and three numbers of a rotation, in either order; seven a position and a quaternion;
    twelve or sixteen a matrix. A quaternion or a matrix is found among more numbers by its length or its axes. Sixteen
    numbers with the last row 0 0 0 1 are a matrix even if it has no rotation: that row is no quaternion.
    """
    for position, rotation, notations, zero in next(_layouts(16)) if len(columns) == 16 else ():
        last = numbers[:, [columns[k] for k in (*zero, 15)]]
        if (last == (0, 0, 0, 1)).all(1).sum() >= len(numbers) - tolerated(len(numbers)):
            at, of_rotation = (tuple(columns[k] for k in places) for places in (position, rotation))
            columns_of = {"position": at, "rotation": of_rotation, "notations": notations}
            return [PoseColumns(**columns_of, name=name, is_named=False)]
    for group in _layouts(len(columns)) if len(columns) <= MOST_UNNAMED else ():
        found = []
        for position, rotation, notations, zero in group:
            at, of_rotation, none = (
                tuple(columns[k] for k in places) for places in (position, rotation, zero)
            )
            made = poses_of(numbers[:, at], numbers[:, of_rotation], notations[0])
            is_rotation = int(np.isnan(made[:, 0, 0]).sum()) <= tolerated(len(numbers))
            if is_rotation and not numbers[:, none].any():
                columns_of = {"position": at, "rotation": of_rotation, "notations": notations}
                found.append(PoseColumns(**columns_of, name=name, is_named=False))
        if found:
            return found[:1] if len(columns) == 16 else _most_exact(found, numbers)
    return []


def _most_exact(found: list[PoseColumns], numbers: Numbers) -> list[PoseColumns]:
    """Return the poses whose quaternions have the most exact length; those of shifted columns are near 1 by chance.

    Four numbers that are 0 or 1 in all rows, such as the configuration of an arm, are no quaternion beside others.
    """
    if len(found[0].rotation) != 4:
        return found
    found = [one for one in found if not np.isin(np.abs(numbers[:, one.rotation]), (0.0, 1.0)).all()] or found
    off = [
        float(np.nanmax(np.abs(np.linalg.norm(numbers[:, one.rotation], axis=1) - 1), initial=0.0))
        for one in found
    ]
    largest = 10 * min(off) + 1e-5
    return [one for one, size in zip(found, off, strict=True) if size <= largest]


_Layout = tuple[Sequence[int], Sequence[int], tuple[str, ...], Sequence[int]]
"""Places of the position and of the rotation among n numbers, notations of the rotation, and places that hold zeros."""


def _layouts(n: int) -> Iterator[Sequence[_Layout]]:
    """Yield groups of the layouts that n numbers of a pose may have; a group counts if none before it fits."""
    by_rows, by_columns = ROTATION_OF_12, (0, 4, 8, 1, 5, 9, 2, 6, 10)
    if n == 16:
        yield [
            ((3, 7, 11), by_rows, ("matrix",), (12, 13, 14)),
            ((12, 13, 14), by_columns, ("matrix",), (3, 7, 11)),
        ]
    if n == 12:
        either = ("matrix", "matrix:columns")
        yield [((3, 7, 11), by_rows, ("matrix",), ())]
        yield [((9, 10, 11), range(9), either, ()), ((0, 1, 2), range(3, 12), either, ())]
    orders = ("quat:xyzw", "quat:wxyz")
    quaternion_last = [(range(k, k + 3), range(k + 3, k + 7), orders, ()) for k in range(n - 6)]
    yield quaternion_last + [(range(k + 4, k + 7), range(k, k + 4), orders, ()) for k in range(n - 6)]
    three = ("rotvec", *EULERS)
    starts = sorted({0, n - 6}) if n >= 6 else []
    six = [((k, k + 1, k + 2), (k + 3, k + 4, k + 5), three, ()) for k in starts]
    yield six + [(rotation, position, three, ()) for position, rotation, _, _ in six]


def _stated_units(columns: PoseColumns, units: dict[int, str | None]) -> dict[str, str | None]:
    """Return the units of length and angle that the names of the columns state, as fields of PoseColumns."""
    found = {}
    for field, places in (("length", columns.position), ("angle", columns.rotation)):
        stated = {units.get(k) for k in places} & ({"m", "mm", "cm"} if field == "length" else {"deg", "rad"})
        found[field] = stated.pop() if len(stated) == 1 else None
    return found


def relevance(table: Table, columns: PoseColumns) -> int:
    """Return 1 if words around a pose name the robot, -1 if they name a board or a camera, 0 without either.

    The names of the columns and the keys that lead to them come first; the name of the file and other words around the
    numbers count only where these say nothing.
    """
    keys = "" if table.keys is None else table.keys[0]
    for text in (columns.name, table.place, keys, table.file.stem, table.words):
        words = set(words_of(text)) | set(re.split(r"[^a-z0-9]+", text.lower()))
        robot, other = len(words & ROBOT), len(words & OTHERS)
        if robot != other:
            return 1 if robot > other else -1
    return 0


def source_of(table: Table) -> str:
    """Return the name of a table's file; for one file of each image, the folder and what the files' names share."""
    if table.keys is None or not table.file.is_dir():
        return table.file.name
    return f"{table.file.name}/{commonprefix(table.keys)}*"


def readings_of(
    table: Table, options: ReadOptions, where: str, skipped: frozenset[int] = frozenset()
) -> tuple[int, list[Candidate]]:
    """Return the readings of a table that names, numbers and options leave possible, each with its poses (m).

    The first result is the `relevance` of the columns that were read. The list is empty if no columns hold a pose.
    `skipped` are columns that are not part of a pose. Raises InputError if the numbers contradict the units that an
    option or a name states, or have no columns for the notation in `options.pose_convention`.
    """
    numbers, found, errors = numbers_of_table(table), list[Candidate](), list[InputError]()
    sets = pose_columns(table, skipped)
    if options.pose_columns is not None:
        sets = [one for one in sets if one.name == options.pose_columns.lower()]
    moving = [one for one in sets if np.ptp(numbers[:, one.position], axis=0).max(initial=0.0) > 0]
    # A position that never changes is something else, such as an arm's configuration.
    sets = moving if moving and len(numbers) > 1 else sets
    # All makers write the position first.
    if options.pose_convention != "auto" or _maker_in(table.words) is not None:
        sets = [one for one in sets if one.position < one.rotation or len(one.rotation) == 9] or sets
    best = max((relevance(table, one) for one in sets), default=0)
    for columns in sets:
        if relevance(table, columns) == best:
            try:
                found += _readings_of_columns(table, columns, numbers, options, where)
            except InputError as error:
                errors.append(error)
    if not found and errors:
        raise errors[0]
    if not found and sets and options.pose_convention != "auto":
        asked = notation_of(options.pose_convention)
        raise InputError(
            f"{where}: no columns hold the {NUMBERS[asked]} numbers of --pose-convention {options.pose_convention}; "
            f"they may hold {', '.join(sorted({one for columns in sets for one in columns.notations[:2]}))}"
        )
    return best, _distinct(found)


def _readings_of_columns(
    table: Table, columns: PoseColumns, numbers: Numbers, options: ReadOptions, where: str
) -> Iterator[Candidate]:
    """Yield the readings of one set of columns with the poses that each gives, as `readings_of`."""
    asked = None if options.pose_convention == "auto" else notation_of(options.pose_convention)
    notations = _allowed(columns, asked, table.words)
    units = (None, None) if options.pose_units == "auto" else options.pose_units.split("-")
    position, rotation = numbers[:, columns.position], numbers[:, columns.rotation]
    length = length_unit(position, units[0] or columns.length, where)
    direct, inverted = _directions(table, columns, options)
    is_read = False
    for notation in notations:
        angle = angle_unit(rotation, notation, units[1] or columns.angle, where)
        poses = poses_of(position, rotation, notation, f"{length}-{angle}")
        if int(np.isnan(poses[:, 0, 0]).sum()) > tolerated(len(poses)):
            continue
        is_read = True
        is_stated = columns.is_named or _maker_in(table.words) is not None
        decided_by = "option" if asked else "names" if is_stated and len(notations) == 1 else "numbers"
        reading = Reading(
            file=source_of(table),
            columns=columns.name,
            notation=notation,
            units=f"{length}-{angle}",
            decided_by=decided_by,
        )
        if direct:
            yield reading, poses
        if inverted:
            yield replace(reading, inverted=True), inverse(poses)
    if notations and not is_read and len(columns.rotation) != 3:
        kind = "quaternions" if len(columns.rotation) == 4 else "matrices"
        names = first_few([table.columns[k] or str(k + 1) for k in columns.rotation])
        fault = rotation_fault(rotation, notations[0])
        raise InputError(f"{where}: the {kind} in its columns {names} {fault}")


def untaken_readings(
    table: Table, taken: Reading, where: str, skipped: frozenset[int] = frozenset()
) -> list[Candidate]:
    """Return all other readings of the columns that a reading took: every notation of as many numbers, both directions.

    They show what a wrong name or option would have been. Arguments are those of `readings_of`.
    """
    numbers, found = numbers_of_table(table), list[Candidate]()
    for columns in pose_columns(table, skipped):
        count = len(columns.rotation)
        if columns.name != taken.columns or count != NUMBERS[taken.notation]:
            continue
        every = tuple(notation for notation, width in NUMBERS.items() if width == count)
        own = replace(columns, notations=every, is_named=False, length=taken.units.split("-")[0], angle=None)
        with suppress(InputError):
            found += _readings_of_columns(replace(table, words=""), own, numbers, ReadOptions(), where)
    own = taken.notation, taken.inverted
    return [one for one in _distinct(found) if (one[0].notation, one[0].inverted) != own]


def _allowed(columns: PoseColumns, asked: str | None, words: str) -> tuple[str, ...]:
    """Return the notations of columns that an option, or a maker's word beside the numbers, leaves possible.

    `p[…]` is UR's pose, and robtarget is ABB's. The option may name a notation of as many numbers with other names.
    """
    if asked is not None:
        is_matrix = asked.startswith("matrix") and columns.notations[0].startswith("matrix")
        # A whole 4x4 matrix shows by its last row whether it is written by rows or by columns.
        if is_matrix and len(columns.notations) == 1:
            return columns.notations
        return (asked,) if NUMBERS[asked] == len(columns.rotation) else ()
    maker = _maker_in(words)
    if maker is not None and MAKERS[maker] in columns.notations:
        return (MAKERS[maker],)
    return columns.notations


def _maker_in(words: str) -> str | None:
    """Return the maker whose word for a pose stands around the numbers: `p[…]` is UR's, robtarget is ABB's; or None."""
    names = set(words.split())
    return "abb" if "robtarget" in names else "ur" if "p" in names else None


def _directions(table: Table, columns: PoseColumns, options: ReadOptions) -> tuple[bool, bool]:
    """Return whether the poses may be base_from_gripper, and whether they may be its inverse."""
    key = "" if table.keys is None else table.keys[0]
    text = "_".join((table.file.stem, table.place, key, columns.name)).lower().replace(".", "_")
    if options.pose_inverted:
        return False, True
    if INVERSE.search(text):
        return False, True
    by_maker = options.pose_convention != "auto" or _maker_in(table.words) is not None
    is_stated = columns.is_named or DIRECT.search(text) is not None or by_maker
    return True, not is_stated


def _distinct(found: list[Candidate]) -> list[Candidate]:
    """Return the readings without those that give the same poses as an earlier one."""
    kept = dict[bytes, Candidate]()
    for one in found:
        # Adding zero makes -0.0 and 0.0 equal; all NaN have the same bytes here.
        kept.setdefault((np.round(one[1], 8) + 0.0).tobytes(), one)
    return list(kept.values())


def text_of(reading: Reading) -> str:
    """Return a reading in words, such as "x y z in mm, angles xyz in degrees, R = Rz·Ry·Rx"."""
    length, angle = reading.units.split("-")
    direction = ", the base in the gripper frame" if reading.inverted else ""
    name = f"{reading.columns}: " if reading.columns else ""
    return f"{name}x y z in {length}, {in_words(reading.notation, angle)}{direction}"


def options_of(reading: Reading, several_files: bool = False, several_columns: bool = False) -> str:
    """Return the command-line options that read a file by a reading, such as "--pose-convention euler:ZYX".

    The file and the columns are named where several are possible.
    """
    parts = [f"--poses {reading.file}"] if several_files else []
    parts += [f"--pose-columns {reading.columns}"] if several_columns else []
    parts += [f"--pose-convention {reading.notation}"]
    parts += ["--pose-inverted"] if reading.inverted else []
    return " ".join(parts)


def undecided(where: str, readings: Sequence[Reading]) -> InputError:
    """Return the error that several readings of poses are possible, with the option for each; it is not raised."""
    files = len({reading.file for reading in readings}) > 1
    columns = len({reading.columns for reading in readings}) > 1
    listed = [f"{options_of(one, files, columns)} ({text_of(one)})" for one in readings[:6]]
    more = f", and {len(readings) - 6} more" if len(readings) > 6 else ""
    return InputError(f"{where}: the poses may be read as {'; '.join(listed)}{more}: say which")


def decision_in_words(reading: Reading) -> str:
    """Return a sentence on how the poses were read and what decided it, for the terminal and the report."""
    by = {
        "names": "by names and the size of the numbers",
        "numbers": "by the numbers",
        "option": "by option",
        "images": "decided by the images",
    }
    text = f"{reading.file}: {text_of(reading)}; {by[reading.decided_by]}"
    if reading.misfit_mm is None:
        return text
    following = ""
    if reading.next_best is not None:
        size = "none of them fits"
        if reading.next_misfit_mm is not None:
            size = f"{significant(reading.next_misfit_mm)} mm"
        following = f"; next best: {reading.next_best}, {size}"
    return f"{text} ({significant(reading.misfit_mm)} mm{following})"
