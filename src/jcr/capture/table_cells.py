"""The cells of a table on disk, csv, tsv, txt or npy, with the names and units that its header gives."""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from jcr.capture.options import ConventionName
from jcr.capture.plain_files import read_npy, read_text
from jcr.errors import InputError

SUFFIXES = (".csv", ".tsv", ".txt", ".npy")
_ALIASES = {
    f"{prefix}{axis}": axis for axis in "xyz" for prefix in ("t", "t_", "p", "p_", "pos_", "position_")
}
_ALIASES |= {
    f"{prefix}{axis}": f"q{axis}"
    for axis in "xyzw"
    for prefix in ("q_", "quat_", "quaternion_", "orientation_", "rotation_")
}
_ALIASES |= {f"{prefix}{axis}": f"r{axis}" for axis in "xyz" for prefix in ("rvec_", "rotvec_", "r_")}
_UR_POSE = re.compile(r"\bp\s*\[([^\]]*)\]")
_UNIT = re.compile(r"^(.+?)(?:_|_?[\[(])(mm|cm|m|deg|rad|s|ns)[\])]?$")
_DECIMAL_COMMA = re.compile(r"^([+-]?\d+),(\d+(?:[eE][+-]?\d+)?)$")


@dataclass(frozen=True)
class Cells:
    """A table as text, rectangular."""

    names: tuple[str, ...] | None
    """Lower case, without units; tx, pos_x, q_x … as x and qx."""
    units: frozenset[str]
    """That the names give: of mm, cm, m, deg, rad."""
    rows: list[list[str]]
    convention: ConventionName = "auto"
    """That the notation gives away: UR's p[…]."""

    def columns(self) -> list[tuple[str, ...]]:
        """The cells of each column."""
        return list(zip(*self.rows, strict=True))


def read_cells(file: Path) -> Cells:
    """The table in a file; InputError when it is none, is empty, or a row has too many or too few cells."""
    if file.suffix != ".npy" and (written := _ur_poses(file)) is not None:
        return written
    header, rows = _array(file) if file.suffix == ".npy" else _text(file)
    if not rows:
        raise InputError(f"{file}: holds no poses; expected one row per image")
    width = len(header or rows[0])
    for number, row in enumerate(rows, start=1):
        if len(row) != width:
            raise InputError(f"{file}: row {number} has {len(row)} columns, not {width}; complete or drop it")
    if header is None:
        return Cells(None, frozenset(), rows)
    names, units = zip(*(_name_and_unit(cell) for cell in header), strict=True)
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{file}: two columns are named {', '.join(sorted(twice))}; keep one")
    return Cells(names, frozenset(units) - {"", "s", "ns"}, rows)


def is_number(cell: str) -> bool:
    """Whether a cell is a number, as Python's own floats are written."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _ur_poses(file: Path) -> Cells | None:
    """A table whose lines hold poses as URScript writes them, p[x, y, z, rx, ry, rz], and what stands before them."""
    text = read_text(file)
    if _UR_POSE.search(text) is None:
        return None
    lines = [line.strip() for line in text.splitlines()]
    matches = [(number, line, _UR_POSE.search(line)) for number, line in enumerate(lines, 1)]
    rows: list[list[str]] = []
    for number, line, match in matches:
        if match is not None:
            before = [
                cell for cell in re.split(r"[,;\t\s]+", line[: match.start()].strip(" \t,;\"'=:")) if cell
            ]
            numbers = [cell.strip() for cell in match[1].split(",")]
            if len(numbers) != 6 or (rows and len(before) + 6 != len(rows[0])):
                raise InputError(
                    f"{file}: line {number}: write {line!r} as the others, with p[x, y, z, rx, ry, rz]"
                )
            rows.append(before[:1] + numbers if before else numbers)
        elif rows and line and not line.startswith("#"):
            raise InputError(
                f"{file}: line {number} holds no p[x, y, z, rx, ry, rz]: {line!r}; complete or drop it"
            )
    first = len(rows[0]) - 6
    names = (("timestamp" if is_number(rows[0][0]) else "image"),) * first + ("x", "y", "z", "rx", "ry", "rz")
    return Cells(names, frozenset(), rows, "ur")


def _text(file: Path) -> tuple[list[str] | None, list[list[str]]]:
    """Header, if there is one, and the cells of every row."""
    lines = [line.strip() for line in read_text(file).splitlines() if line.strip()]
    comments = [line.lstrip("# ") for line in lines if line.startswith("#")]
    lines = [line for line in lines if not line.startswith("#")]
    if not lines:
        return None, []
    separator = next((mark for mark in "\t;," if mark in lines[0]), None)
    rows = [[cell.strip().strip('"') for cell in line.split(separator)] for line in lines]
    if separator != ",":  # as spreadsheets write numbers where the comma is the decimal mark
        rows = [[_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in rows]
    if not any(is_number(cell) for cell in rows[0]):
        return rows[0], rows[1:]
    # TUM and ethz-asl write the names of their columns as a comment.
    for comment in reversed(comments):
        cells = [cell for cell in re.split(r"[,;\s]+", comment) if cell]
        if len(cells) == len(rows[0]) and {"x", "y", "z"} <= {_name_and_unit(cell)[0] for cell in cells}:
            return cells, rows
    return None, rows


def _array(file: Path) -> tuple[list[str] | None, list[list[str]]]:
    """The same of a NumPy array: a structured one has a header, matrices are rows of their numbers."""
    array = read_npy(file)
    if array.dtype.names is not None and array.ndim == 1:
        return list(array.dtype.names), [[str(value) for value in row] for row in array.tolist()]
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or not array.size:
        raise InputError(f"{file}: no table of numbers; save (n,4,4) matrices or (n,k) rows with numpy.save")
    return None, [[repr(value) for value in row] for row in array.reshape(len(array), -1).tolist()]


def _name_and_unit(cell: str) -> tuple[str, str]:
    plain = re.sub(r"[\s.]+", "_", cell.strip().strip('"').lower()).strip("_")
    match = _UNIT.match(plain)
    name, unit = match.groups() if match else (plain, "")
    return _ALIASES.get(name, name), unit
