"""Tables of a document by its syntax, and tables of documents with one row for each image."""

import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from jcr.capture.documents.arrays import array_tables
from jcr.capture.documents.nested import leaves, nested_tables
from jcr.capture.documents.plain import parse_content, syntax_of
from jcr.capture.documents.table import MAX_TABLES, Cell, Table, decode_text, read_limited, table_of
from jcr.capture.documents.text import text_tables


def read_tables(file: Path) -> tuple[Table, ...]:
    """Read the tables of a document, at most 64; numbers may be in several tables of different shape.

    Raises InputError for a file that has no syntax of a document, or is too large.
    """
    data = read_limited(file)
    if (tables := array_tables(file, data)) is not None:
        return tuple(tables)
    text = decode_text(file, data)
    if (syntax := syntax_of(file, text)) is None:
        return tuple(text_tables(file, text))
    comments = (
        [line.partition("#")[2] for line in text.splitlines() if "#" in line] if syntax == "YAML" else []
    )
    return tuple(nested_tables(file, parse_content(file, text, syntax), " ".join(comments)))


def read_record_tables(files: Sequence[Path]) -> tuple[Table, ...]:
    """Read documents with one pose or record each; return tables whose rows are the documents, in the given order.

    A document of nested data is one row; of other documents, each table is one row. Rows with the same columns are
    joined to a table; its keys are the stems of the files, and its file is their common folder.
    """
    groups = defaultdict[tuple[object, ...], dict[Path, dict[str | int, Cell]]](dict)
    words = dict[tuple[object, ...], str]()
    for file in files:
        for group, row, around in _records(file):
            groups[group].setdefault(file, row)
            words.setdefault(group, around)
    folder = Path(os.path.commonpath([file.parent for file in files])) if files else Path()
    tables = list[Table | None]()
    for group, rows in groups.items():
        keys, place = [file.stem for file in rows], str(group[0])
        tables.append(table_of(folder, list(rows.values()), place=place, keys=keys, words=words[group]))
    return tuple(table for table in tables if table)[:MAX_TABLES]


def _records(file: Path) -> list[tuple[tuple[object, ...], dict[str | int, Cell], str]]:
    """Return the rows of a document, each with the place and columns that it shares with others, and its words."""
    data = read_limited(file)
    if array_tables(file, data) is None and (syntax := syntax_of(file, text := decode_text(file, data))):
        content = parse_content(file, text, syntax)
        return [(("", type(content)), leaves(file, content), "")]
    records = list[tuple[tuple[object, ...], dict[str | int, Cell], str]]()
    for table in read_tables(file):
        row = dict[str | int, Cell]()
        for i, cells in enumerate(table.rows):
            for j, cell in enumerate(cells):
                name, single = table.columns[j], len(table.columns) == 1
                row[name or j if len(table.rows) == 1 else i if single else f"{i}.{name or j}"] = cell
        records.append(((table.place, *row), row, table.words))
    return records
