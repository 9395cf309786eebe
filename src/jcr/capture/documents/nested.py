"""Tables inside nested data: maps and lists whose children have the same leaves."""

import re
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from os.path import commonprefix
from pathlib import Path
from typing import Any

from jcr.capture.documents.table import LONGEST_NAME, MAX_TABLES, Cell, Table, cell_of, table_of
from jcr.errors import InputError, shown

FEWEST_CHILDREN = 3
"""Smallest number of children of a table in nested data; two are rather a pair than a table."""
Family = tuple[str, Sequence[Any], Sequence[str] | None]
"""Name, children and keys of the rows of a possible table; keys are None for the children of a list."""


def nested_tables(file: Path, content: Any, words: str = "") -> list[Table]:
    """Return the tables in nested lists and maps, outer ones first; `words` is the text around the content.

    A table is a list, a map, a group of keys that differ by a number, or a map of lists of one length. Raises InputError
    for names that are too long.
    """
    tables, queue = list[Table](), deque([("", content, words)])
    while queue and len(tables) < MAX_TABLES:
        place, value, around = queue.popleft()
        require_short(file, place)
        for name, children, keys in _families(value):
            rows = [leaves(file, child) if is_container(child) else None for child in children]
            if table := table_of(file, rows, place=_joined(place, name), keys=keys, words=around):
                tables.append(table)
        if isinstance(value, dict):
            texts = [f"{key} {cell}" for key, cell in value.items() if isinstance(cell, str)]
            around = " ".join([around, *texts])[:1000] if texts else around
        parts = (
            value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        )
        queue.extend((_joined(place, str(k)), part, around) for k, part in parts if has_tables(part))
    return tables[:MAX_TABLES]


def leaves(file: Path, value: Any) -> dict[str | int, Cell]:
    """Return the cells of nested data by their path, such as "position.x" or "matrix.0.3".

    Raises InputError, begun with `file`, for a path that is too long.
    """
    found = dict[str | int, Cell]()

    def descend(part: Any, path: str) -> None:
        require_short(file, path)
        if isinstance(part, dict | list):
            parts = part.items() if isinstance(part, dict) else enumerate(part)
            start = f"{path}." if path else ""
            for key, child in parts:
                descend(child, f"{start}{key}")
        elif isinstance(part, bool):
            found[path] = str(part).lower()
        else:
            found[path] = cell_of(part) if isinstance(part, str) else part

    descend(value, "")
    return found


def require_short(file: Path, name: str) -> None:
    """Raise InputError if the keys that lead to a value are too long together, because each value has a copy."""
    if len(name) > LONGEST_NAME:
        raise InputError(f"{file}: a name of {len(name)} characters, {shown(name)}; give a shorter one")


def is_container(value: Any) -> bool:
    """Test whether a value is a list or a map."""
    return isinstance(value, list | dict)


def _joined(place: str, name: str) -> str:
    """Return the path of a name below a place."""
    return f"{place}.{name}" if place and name else place or name


def has_tables(value: Any) -> bool:
    """Test whether a value may hold tables; a list of numbers and a matrix of at most 4x4 are cells of a row."""
    if not isinstance(value, list):
        return isinstance(value, dict)
    inner = [part for part in value if is_container(part)]
    small = len(value) <= 4 and all(
        isinstance(part, list) and len(part) <= 4 and not any(map(is_container, part)) for part in inner
    )
    return bool(inner) and not small


def _families(value: Any) -> Iterator[Family]:
    """Yield the groups of children of a list or a map that may be the rows of a table."""
    if isinstance(value, list) and _are_alike(value):
        yield "", value, None
    if not isinstance(value, dict):
        return
    if _are_alike(list(value.values())):
        yield "", list(value.values()), list(value)
    numbered, parallel = defaultdict[str, list[str]](list), defaultdict[int, dict[str, list[Any]]](dict)
    for key, child in value.items():
        if is_container(child) and any(map(str.isdigit, key)):
            numbered[re.sub(r"\d+", "#", key)].append(key)
        if isinstance(child, list) and len(child) >= FEWEST_CHILDREN:
            parallel[len(child)][key] = child
    for keys in numbered.values():
        if len(keys) < len(value) and _are_alike([value[key] for key in keys]):
            yield commonprefix(keys) + "*", [value[key] for key in keys], keys
    for lists in parallel.values():
        if len(lists) > 1:
            rows = [dict(zip(lists, cells, strict=True)) for cells in zip(*lists.values(), strict=True)]
            yield "", rows, None


def _are_alike(children: Sequence[Any]) -> bool:
    """Test whether children may be rows of one table: containers, or None for a missing row, of one kind.

    Lists of numbers must have one length: those of different lengths are parts of one pose.
    """
    full = [child for child in children if child is not None]
    if len(children) < FEWEST_CHILDREN or 2 * len(full) < len(children) or not all(map(is_container, full)):
        return False
    flat = [len(child) for child in full if not any(map(is_container, child))]
    return not isinstance(full[0], list) or len(flat) < len(full) or len(set(flat)) == 1
