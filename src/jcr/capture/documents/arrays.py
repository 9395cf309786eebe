"""Tables in arrays of NumPy (.npy, .npz) and MATLAB (.mat), and the names of binary files that are refused."""

import io
import math
import struct
import sys
import warnings
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from jcr.capture.documents.nested import nested_tables, require_short
from jcr.capture.documents.plain import MAX_DEPTH
from jcr.capture.documents.table import MAX_BYTES, MAX_ITEMS, MAX_TABLES, Cell, Table, table_of
from jcr.errors import InputError, shown

_PICKLE = (
    "a Python pickle, which may run programs; save numbers, np.save('poses.npy', np.array(poses, float))"
)
_MATLAB_OBJECT = "a MATLAB object such as a table; save it with writetable(T,'poses.csv')"
_SHEET = "a spreadsheet; save it as CSV"
_REFUSED = {
    b"\x89HDF": "HDF5; save arrays, np.save('poses.npy', h5py.File(name)['poses'][:])",
    b"MATLAB 7.3": "a MATLAB 7.3 file; save it with save('poses.mat','A','-v7')",
    b"\xd0\xcf\x11\xe0": _SHEET,
    **{b"\x80" + bytes([protocol]): _PICKLE for protocol in range(2, 6)},
}
"""First bytes of the files that are refused by name, and their remedy."""
_COMPRESSED, _MATRIX = 15, 14
_KINDS = {
    1: "i1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
    17: "u2",
    18: "u4",
}
"""Kinds of elements of a .mat file, and types of their numbers; others are bytes (MathWorks, MAT-File Format)."""
_OBJECT = object()
_NPY, _ZIP, _MATLAB = b"\x93NUMPY", b"PK\x03\x04", b"MATLAB 5.0"


def array_tables(file: Path, data: bytes) -> list[Table] | None:
    """Return the tables in the bytes of a .npy, .npz or .mat file; None for a file that may be text.

    An array of n rows, or of n matrices along its first or last side, is a table of n rows. Raises InputError for
    pickles, HDF5, spreadsheets and MATLAB objects, with the line of code that saves what can be read.
    """
    for start, name in _REFUSED.items():
        if data.startswith(start):
            raise InputError(f"{file}: {name}")
    if file.suffix.lower() in (".pkl", ".pickle", ".joblib"):
        raise InputError(f"{file}: {_PICKLE}")
    try:
        if data.startswith(_NPY):
            arrays: dict[str, Any] = {"": _read_npy(file, data)}
        elif data.startswith(_ZIP):
            arrays = _read_npz(file, data)
        elif data.startswith(_MATLAB):
            arrays = _read_mat(file, data)
        else:
            return None
        return _tables_of(file, arrays)
    except InputError:
        raise
    except Exception as error:  # NumPy and SciPy parse headers with errors of many types
        raise InputError(f"{file}: not readable as arrays ({str(error)[:80]}); save it again") from None


def _read_npy(file: Path, data: bytes) -> ndarray:
    """Return the array in the bytes of a .npy file; raise InputError for objects and for missing bytes."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    read_header = (
        np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a header that Python 2 wrote
        shape, by_columns, dtype = read_header(stream)
    if dtype.hasobject:
        raise InputError(f"{file}: {_PICKLE}")
    if math.prod(shape) > MAX_ITEMS or math.prod(shape) * dtype.itemsize > len(data):
        raise InputError(
            f"{file}: an array of shape {shown(shape)}, too large or cut off; save the poses alone"
        )
    flat = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
    if dtype.kind == "U" and flat.size and flat.view(dtype.byteorder + "u4").max() > sys.maxunicode:
        raise ValueError("a text with numbers of no characters")  # with which Python fails later
    return flat.reshape(shape, order="F" if by_columns else "C")


def _read_npz(file: Path, data: bytes) -> dict[str, Any]:
    """Return the arrays in the bytes of a .npz file by name; raise InputError for other archives."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {member.filename: member for member in archive.infolist()}
        if "[Content_Types].xml" in members or "mimetype" in members:
            raise InputError(f"{file}: {_SHEET}")
        if any(name.endswith(".pkl") for name in members):
            raise InputError(f"{file}: {_PICKLE}")
        if not members or not all(name.endswith(".npy") for name in members):
            raise InputError(f"{file}: an archive; unpack it")
        if sum(member.file_size for member in members.values()) > MAX_BYTES:
            raise InputError(f"{file}: more than {MAX_BYTES // 1_000_000} MB; save the poses alone")
        if any(
            member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
            for member in members.values()
        ):
            raise InputError(f"{file}: a compression that NumPy does not write; save it with numpy.savez")
        arrays = dict[str, Any]()
        for name, member in members.items():
            with archive.open(member) as stream:  # its content may be longer than its stated size
                arrays[name.removesuffix(".npy")] = _read_npy(file, stream.read(member.file_size))
        return arrays


def _read_mat(file: Path, data: bytes) -> dict[str, Any]:
    """Return the variables in the bytes of a .mat file of version 5 by name, fields of a struct as "struct.field".

    The format is read here, because scipy.io.loadmat ends the process on damaged files.
    """
    if len(data) <= 128:
        raise ValueError("the file is cut off")
    order, found, left, objects = "<" if data[126:128] == b"IM" else ">", dict[str, Any](), MAX_BYTES, False
    items = 0
    for kind, content in _elements(data[128:], order):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(content, left + 1)
            left -= len(unpacked)
            if left < 0:
                raise InputError(f"{file}: more than {MAX_BYTES // 1_000_000} MB; save the poses alone")
            kind, content = next(_elements(unpacked, order))
        name, value = _variable(content, order, 0) if kind == _MATRIX else ("", None)
        objects = objects or value is _OBJECT
        queue = [(name, value)] if name and value is not _OBJECT else []
        while queue:
            name, value = queue.pop()
            if isinstance(value, dict):
                queue += [(f"{name}.{field}", part) for field, part in value.items()]
            else:
                items += _count(value)
                if items > MAX_ITEMS:
                    raise InputError(f"{file}: more than {MAX_ITEMS:,} values; save the poses alone")
                found[name] = value if isinstance(value, ndarray) else _plain(value)
    if objects and not found:
        raise InputError(f"{file}: {_MATLAB_OBJECT}")
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the elements of a .mat file, or of those inside an element."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:  # up to four bytes in the place of the size
            yield kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)]
            at += 8
            continue
        if at + 8 + size > len(data):
            raise ValueError("the file is cut off")
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size + (0 if kind == _COMPRESSED else -size % 8)


def _variable(content: bytes, order: str, depth: int) -> tuple[str, Any]:
    """Return name and value of a variable: array, list (cell array), dictionary (struct), text, or an object's mark."""
    parts = list(_elements(content, order))
    if len(parts) > MAX_ITEMS:
        raise ValueError(f"more than {MAX_ITEMS:,} values")
    if not parts or depth > MAX_DEPTH:
        return "", None
    numbers = [np.frombuffer(part, order + _KINDS.get(kind, "u1")) for kind, part in parts]
    kind = content[8] if order == "<" else content[11]
    if kind in (3, 16, 17):
        return "object", _OBJECT
    shape, name = [int(side) for side in numbers[1]], parts[2][1].decode("latin-1")
    inner = [_variable(part, order, depth + 1)[1] for at, part in parts[3:] if at == _MATRIX]
    if kind == 1:
        return name, inner
    if kind == 2:
        width = int(numbers[3][0])
        fields = [
            parts[4][1][k : k + width].split(b"\0")[0].decode("latin-1")
            for k in range(0, len(parts[4][1]), width)
        ]
        structs = [
            dict(zip(fields, inner[k : k + len(fields)], strict=True))
            for k in range(0, len(inner), len(fields))
        ]
        return name, structs[0] if len(structs) == 1 else structs
    array = numbers[3].reshape(shape, order="F")
    return name, [
        "".join(map(chr, row)).strip() for row in array.reshape(len(array), -1)
    ] if kind == 4 else array


def _count(value: Any) -> int:
    """Return the number of numbers and texts in what a variable of MATLAB holds."""
    if isinstance(value, dict | list):
        return len(value) + sum(map(_count, value.values() if isinstance(value, dict) else value))
    return value.size if isinstance(value, ndarray) else 1


def _plain(value: Any) -> Any:
    """Return what a cell array or a struct array of MATLAB holds as nested lists and dictionaries."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list):
        texts = len(value) == 1 and isinstance(value[0], str)
        return value[0] if texts else [_plain(part) for part in value]
    if isinstance(value, ndarray):
        return value.reshape([side for side in value.shape if side != 1]).astype(float).tolist()
    return None if value is _OBJECT else value


def _tables_of(file: Path, arrays: dict[str, Any]) -> list[Table]:
    """Return the tables of arrays and nested lists by name: each alone, and those of equal length joined."""
    tables, equal = list[Table | None](), defaultdict[int, dict[str, list[dict[str | int, Cell]]]](dict)
    if sum(value.size for value in arrays.values() if isinstance(value, ndarray)) > MAX_ITEMS:
        raise InputError(f"{file}: more than {MAX_ITEMS:,} values; save the poses alone")
    for name, value in arrays.items():
        require_short(file, name)
        if not isinstance(value, ndarray):
            tables += nested_tables(file, {name: value} if name else value)
            continue
        for array in _row_views(value):
            rows = _rows(array)
            tables.append(table_of(file, rows, place=name))
            equal[len(rows)].setdefault(name, rows)
    for named in equal.values():
        if len(named) > 1:
            rows = [dict[str | int, Cell]() for _ in next(iter(named.values()))]
            for name, parts in named.items():
                for row, part in zip(rows, parts, strict=True):
                    row.update({f"{name}.{column}": cell for column, cell in part.items()})
            tables.append(table_of(file, rows))
    return [table for table in tables if table][:MAX_TABLES]


def _row_views(array: ndarray) -> list[ndarray]:
    """Return an array with its rows first; twice if the last side may count the rows as well; numbers and texts only."""
    if array.dtype.kind not in "fiuUb" or array.size == 0:
        return []
    array = array.reshape(array.shape or (1,))
    views = [array]
    if array.ndim == 3 and max(array.shape[:2]) <= 4:
        views = (
            [array, np.moveaxis(array, -1, 0)] if max(array.shape[1:]) <= 4 else [np.moveaxis(array, -1, 0)]
        )
    elif array.ndim == 2 and array.shape[0] in (3, 4, 6, 7) and array.shape[1] > 4:
        views.append(array.T)
    return views


def _rows(array: ndarray) -> list[dict[str | int, Cell]]:
    """Return the cells of each row of an array, by their indices where a row has two or more sides."""
    flat = array.reshape(len(array), -1)
    columns = [".".join(map(str, place)) for place in np.ndindex(array.shape[1:])]
    names = columns if array.ndim > 2 else range(flat.shape[1])
    cells = flat.tolist() if array.dtype.kind == "U" else flat.astype(float).tolist()
    return [dict(zip(names, row, strict=True)) for row in cells]
