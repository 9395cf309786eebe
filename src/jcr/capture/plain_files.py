"""Reading of text, YAML, JSON and arrays from untrusted files: plain data, or an InputError."""

import csv
import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from pydantic import BaseModel, TypeAdapter, ValidationError

from jcr.errors import InputError, first_fault, shown
from jcr.files import read_bytes, require_file

LONGEST = 255
"""Largest length of a file name in bytes that file systems accept."""
MAX_YAML, MAX_JSON = 4_000_000, 32_000_000
"""Largest number of characters of a YAML and a JSON file; a capture needs fewer."""
NAMED = 10
"""Largest number of names that a message lists; the others are counted."""
_DECIMAL_COMMA = re.compile(r"^([+-]?\d+),(\d+(?:[eE][+-]?\d+)?)$")


def read_text(file: Path, most: int = MAX_JSON) -> str:
    """Read the text of a file; raise InputError if it is missing, over `most` characters, binary or not UTF-8."""
    try:
        data = read_bytes(file)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); name a file that is there") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    if "\0" in text:
        raise InputError(f"{file}: a binary file, not text; name another, or say what it is with --format")
    if len(text) > most:
        raise InputError(f"{file}: {len(text) / 1e6:.0f} MB; {most // 1_000_000} MB at most")
    return text


def read_lines(file: Path) -> tuple[list[str], list[str]]:
    """Read a text file; return its lines, and its comment lines without the leading #. Blank lines are left out."""
    lines = [line.strip() for line in read_text(file).splitlines() if line.strip()]
    comments = [line.lstrip("# ") for line in lines if line.startswith("#")]
    return [line for line in lines if not line.startswith("#")], comments


def split_cells(lines: Sequence[str], file: Path) -> tuple[list[str] | None, list[list[str]]]:
    """Split lines of a table into cells; return the header (None without one) and the rows of cells.

    The separator is the tab, semicolon or comma in the first line, else a space. A first row without any number is the
    header. Raises InputError, begun with `file`, if the lines are no table.
    """
    separator = next((mark for mark in "\t;," if lines and mark in lines[0]), " ")
    try:
        rows = [next(csv.reader([line], delimiter=separator, skipinitialspace=True)) for line in lines]
    except csv.Error as error:
        raise InputError(f"{file}: not a table ({error}); save it as CSV") from None
    rows = [[cell.strip().strip('"') for cell in row] for row in rows]
    if separator != ",":  # in some countries spreadsheets write a decimal comma
        rows = [[_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row] for row in rows]
    if rows and all(number_of(cell) is None for cell in rows[0]):
        return rows[0], rows[1:]
    return None, rows


def number_of(cell: Any) -> float | None:
    """Return a table's cell as a float; None if the cell is not a number in Python's notation."""
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return None


def read_yaml(file: Path) -> Any:
    """Read the plain data of a YAML file; several documents become a list. Raise InputError if it is not YAML."""
    import yaml

    text = read_text(file, MAX_YAML)
    try:
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        documents = [one for one in yaml.load_all(text, Loader=loader) if one is not None]
        return documents[0] if len(documents) == 1 else documents or None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # Invalid dates and characters, and thousands of digits or brackets, raise other errors than YAMLError.
        mark = getattr(error, "problem_mark", None)
        place = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or error
        raise InputError(f"{file}: not YAML{place}: {problem}; correct it there") from None


def read_json(file: Path) -> Any:
    """Read a JSON file; raise InputError if it is not UTF-8 JSON or has a key twice in one object."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        content = dict(pairs)
        if len(content) < len(pairs):
            key = Counter(key for key, _ in pairs).most_common(1)[0][0]
            raise InputError(f"{file}: the key {shown(key)} appears twice in one object; keep one")
        return content

    try:
        return json.loads(read_text(file), object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{file}: not JSON at line {error.lineno}, column {error.colno}: {error.msg}; correct it there"
        ) from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # a number of thousands of digits
        raise InputError(f"{file}: an invalid number, or nested too deeply ({error}); correct it") from None


def first_few(names: Sequence[str]) -> str:
    """Return the first ten names as text, separated by commas, and the number of the remaining ones."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(name[:LONGEST] for name in names[:NAMED]) + more


def chosen_name(names: Sequence[str], asked: str | None, usual: Sequence[str], what: str, option: str) -> str:
    """Return the topic, key or frame `asked` by the user; if that is None, the only entry of `usual`, the likely names.

    Raises InputError that lists all `names` if `asked` is not one of them, or if `usual` has not one entry. In the
    message, `what` describes the choice and `option` is its command-line option.
    """
    if asked in names:
        return str(asked)
    if asked is None and len(usual) == 1:
        return usual[0]
    wrong = "" if asked is None else f"{asked} is not there; "
    raise InputError(f"{what}: {wrong}choose one with {option}: {', '.join(names) or 'there are none'}")


def validated_content(schema: type[BaseModel] | TypeAdapter, content: Any, where: str) -> Any:
    """Return the content of a file, converted by the pydantic model or type adapter `schema`.

    Raises InputError, begun with `where`, if the content does not fit.
    """
    validate = schema.validate_python if isinstance(schema, TypeAdapter) else schema.model_validate
    try:
        return validate(content)
    except ValidationError as error:
        raise InputError(f"{where}: {first_fault(error)}; correct it there") from None


def read_npy(file: Path) -> ndarray:
    """Read an array that numpy.save wrote; raise InputError for other files and for arrays of Python objects."""
    try:
        require_file(file)
        with file.open("rb") as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)
    except InputError:
        raise
    except Exception as error:  # NumPy parses the header as Python, with errors of many types
        raise InputError(f"{file}: not a NumPy array of numbers ({error}); save it with numpy.save") from None
