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

import numpy as np
from numpy import ndarray

from jcr.capture.documents.nested import require_short
from jcr.capture.documents.table import MAX_BYTES, MAX_ITEMS, MAX_TABLES, Cell, Table, table_of
from jcr.errors import InputError, shown

_PICKLE = "a Python pickle may run programs; save numbers, np.save('poses.npy', np.array(poses, float))"
_MATLAB_OBJECT = (
    "a MATLAB object such as a table, a cell array or a struct; save a table with writetable(T,'poses.csv'), numbers "
    "with A = cat(3,T{:}); save('poses.mat','A')"
)
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
    1: "i1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8", 17: "u2", 18: "u4",
}  # fmt: skip
"""Kinds of elements of a .mat file, and types of their numbers; others are bytes (MathWorks, MAT-File Format)."""
_NUMERIC = range(6, 16)
"""Classes of arrays of numbers in a .mat file: double to uint64."""
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
            arrays: dict[str, ndarray] = {"": _read_npy(file, data)}
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
        raise InputError(f"{file}: array of shape {shown(shape)}, too large or cut off; save the poses alone")
    flat = np.frombuffer(data, dtype, math.prod(shape), stream.tell())
    if dtype.kind == "U" and flat.size and flat.view(dtype.byteorder + "u4").max() > sys.maxunicode:
        raise ValueError("a text with numbers of no characters")  # with which Python fails later
    return flat.reshape(shape, order="F" if by_columns else "C")


def _read_npz(file: Path, data: bytes) -> dict[str, ndarray]:
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
        methods = {member.compress_type for member in members.values()}
        if not methods <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise InputError(f"{file}: a compression that NumPy does not write; save it with numpy.savez")
        arrays = dict[str, ndarray]()
        for name, member in members.items():
            with archive.open(member) as stream:  # its content may be longer than its stated size
                arrays[name.removesuffix(".npy")] = _read_npy(file, stream.read(member.file_size))
        return arrays


def _read_mat(file: Path, data: bytes) -> dict[str, ndarray]:
    """Return the arrays of numbers in the bytes of a .mat file of version 5 by name; raise InputError without one.

    The format is read here, because scipy.io.loadmat ends the process on damaged files, also behind a whole header.
    """
    if len(data) <= 128:
        raise ValueError("the file is cut off")
    order, found, left = "<" if data[126:128] == b"IM" else ">", dict[str, ndarray | None](), MAX_BYTES
    for kind, content in _elements(data[128:], order):
        if kind == _COMPRESSED:
            unpacked = zlib.decompressobj().decompress(content, left + 1)
            left -= len(unpacked)
            if left < 0:
                raise InputError(f"{file}: more than {MAX_BYTES // 1_000_000} MB; save the poses alone")
            kind, content = next(_elements(unpacked, order))
        if kind == _MATRIX:
            name, array = _variable(content, order)
            found[name] = array
    # An object has its content in an array without a name.
    numeric = {name: array for name, array in found.items() if name and array is not None}
    if found and not numeric:
        raise InputError(f"{file}: {_MATLAB_OBJECT}")
    return numeric


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


def _variable(content: bytes, order: str) -> tuple[str, ndarray | None]:
    """Return the name of a variable and its array of numbers; None for a cell array, a struct, a text or an object."""
    parts = list(_elements(content, order))
    if len(parts) < 3:
        return "", None
    kind = content[8] if order == "<" else content[11]
    name = parts[2][1].decode("latin-1")
    if kind not in _NUMERIC or len(parts) < 4:
        return name, None
    shape, numbers = (np.frombuffer(parts[k][1], order + _KINDS.get(parts[k][0], "u1")) for k in (1, 3))
    return name, numbers.reshape([int(side) for side in shape], order="F")


def _tables_of(file: Path, arrays: dict[str, ndarray]) -> list[Table]:
    """Return the tables of arrays by name: each alone, and those of equal length joined."""
    tables, equal = list[Table | None](), defaultdict[int, dict[str, list[dict[str | int, Cell]]]](dict)
    if sum(value.size for value in arrays.values()) > MAX_ITEMS:
        raise InputError(f"{file}: more than {MAX_ITEMS:,} values; save the poses alone")
    for name, value in arrays.items():
        require_short(file, name)
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
