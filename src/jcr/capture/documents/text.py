"""Tables in text: lines of numbers with any separator, matrices over several lines, and numbers in brackets."""

import csv
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from jcr.capture.documents.brackets import GLUED, Statement, group_statements, read_statements
from jcr.capture.documents.nested import has_tables, nested_tables
from jcr.capture.documents.table import MAX_ITEMS, MAX_TABLES, Cell, Table, cell_of, table_of, tidy_words
from jcr.errors import InputError

_FEWEST_ROWS = 5
"""Smallest number of rows of a section that is a table of its own beside that of all sections; a capture has five."""
_LONGEST_HEADER = 10_000
"""Largest length of a line with names of columns, in characters."""
_SECTIONS = 16
"""Largest number of lengths of rows, and of sections of each, that are tried."""
_HEADER = re.compile(r"\"[^\"]*\"|[^\s,;]+(?:\s*[\[(][^\[\]()]*[\])])?")
_BOUNDS = ",;:=\"'[](){}\n"
"""Characters between which values may be, besides spaces."""
_BRACKET = 10
"""Number of values that are read in the time of a pair of brackets: 36 µs for a line of its own, 4 µs for a value. The
largest text of such lines, 60,000, is read in 2 s."""
_MARKS = str.maketrans("，：；−", ",:;-")
_GAP = re.compile(r"(?<=\d)[ \t]+(?=(?:mm|cm|deg|rad|°)(?!\w))")
_COMMENT = re.compile(r"^\s*(?:#|%|//|;|\(\*|!)+(.*)|\s(?:#|//)(.*)")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
_SPACED = re.compile(r"\"[^\"]*\"|'[^']*'|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?|\S+")
# A name is looked for where a word begins: from each character of a long word, it would take hours.
_NAME = re.compile(r"(?<![^\s,;:=\"'])[^\s,;:=\"']+\.[A-Za-z]\w{1,4}\b")
Row = tuple[int, list[Cell]]
"""Index of the line and cells of a row."""


def text_tables(file: Path, text: str) -> list[Table]:
    """Return the tables of a text: those in brackets first, then those of lines; a comment is text around a table."""
    values = len(text.split()) + sum(map(text.count, _BOUNDS))
    if values + _BRACKET * sum(map(text.count, "[({")) > MAX_ITEMS:
        raise InputError(f"{file}: more than {MAX_ITEMS:,} values; give the poses alone")
    lines, comments = _GAP.sub("", text.translate(_MARKS)).splitlines(), dict[int, str]()
    for k, line in enumerate(lines):
        if comment := _COMMENT.search(line) if any(mark in line for mark in "#%/;(!") else None:
            comments[k], lines[k] = (comment[1] or comment[2] or "").strip(), line[: comment.start()]
    tables = _bracket_tables(file, lines, comments)
    return [*tables, *_line_tables(file, lines, comments)][:MAX_TABLES]


def _bracket_tables(file: Path, lines: list[str], comments: dict[int, str]) -> list[Table]:
    """Return the tables of numbers in brackets or with names, and blank their lines."""
    if not any(mark in line for line in lines for mark in "[({=:"):
        return []
    texts = {k: line.strip() for k, line in enumerate(lines) if line.strip()} | comments
    rows, lists, inner = list[Statement](), dict[str, Any](), list[Table]()
    for one in read_statements(file, lines):
        for k in range(*one.lines):
            texts.pop(k, None)
            lines[k] = ""
        value = one.entries[0][1]
        found = nested_tables(file, value, one.words) if len(one.entries) == 1 and has_tables(value) else []
        is_texts = isinstance(value, list) and len(value) > 2 and all(isinstance(part, str) for part in value)
        if one.key and (found or is_texts):
            lists[one.key] = value
        elif found:
            inner += found
        else:
            rows.append(one)
    around = " ".join(texts.values())
    tables = [_without_counts(one) for one in (*nested_tables(file, lists, around), *inner)]
    for group in group_statements(rows):
        names = [one.key for one in group if one.key]
        keys = names if len(set(names)) == len(group) else _keys(texts, [one.lines[0] for one in group])
        entries = len(group[0].entries)
        header = _header(texts, group[0].lines[0], entries, None) if entries > 1 else None
        words = " ".join([group[0].words, *dict.fromkeys(names[:3]), around])
        if table := table_of(file, [one.row(header) for one in group], keys=keys, words=words):
            tables.append(table)
    return tables


def _without_counts(table: Table) -> Table:
    """Return a table without the names of its columns if they only count the columns."""
    counted = table.columns == tuple(map(str, range(len(table.columns))))
    return replace(table, columns=(None,) * len(table.columns)) if counted else table


def _header(texts: dict[int, str], line: int, width: int, separator: str | None) -> list[str] | None:
    """Return the names of columns in the text above a line; None if it does not hold one name for each column."""
    text = next((texts[k] for k in range(line - 1, max(line - 3, -1), -1) if k in texts), "")[
        :_LONGEST_HEADER
    ]
    for mark in (separator, ";", ",", "\t", None):
        cells = [cell.strip().strip("\"'") for cell in (text.split(mark) if mark else _HEADER.findall(text))]
        if len(cells) == width and any(cells) and not any(isinstance(cell_of(cell), float) for cell in cells):
            return cells
    return None


def _keys(texts: dict[int, str], firsts: Sequence[int]) -> list[str] | None:
    """Return a name for each row from lines that differ by numbers, one before or after each row; None without them.

    `firsts` has the index of each row's first line. A name is the file name in the line, otherwise the line.
    """
    patterns = defaultdict[str, list[int]](list)
    for k in sorted(texts):
        patterns[re.sub(r"\d+", "#", texts[k])].append(k)
    for places in patterns.values():
        if len(places) == len(firsts) > 1 and any(
            all(a < b for a, b in pairwise(one for pair in zip(first, second, strict=True) for one in pair))
            for first, second in ((places, firsts), (firsts, places))
        ):
            names = [match[0] if (match := _NAME.search(texts[k])) else texts[k].strip(" :=") for k in places]
            return names if len(set(names)) == len(names) else None
    return None


def _separator(lines: Sequence[str]) -> tuple[str | None, bool]:
    """Return the mark between cells (None for spaces), and whether a comma is the mark of decimals."""
    sample = [line.strip().rstrip(";") for line in lines if re.search(r"\d", line)][:300]
    mark = next((mark for mark in "\t;," if 2 * sum(mark in line for line in sample) > len(sample)), None)
    parts = [part for line in sample for part in (re.split(r"[\t; ]+", line) if "," in line else ())]
    commas = [part for part in parts if "," in part]
    decimal = len(parts) > len(commas[:1]) and bool(commas) and all(map(_DECIMAL_COMMA.fullmatch, commas))
    return (None if decimal and mark == "," else mark), decimal


def _cells(line: str, separator: str | None, decimal: bool) -> list[Cell]:
    """Return the cells of a line; numbers in one cell that another mark separates are cells of their own."""
    line = line.strip(" ").rstrip(";") if separator != "\t" else line.rstrip("\r\n")
    if separator is None:
        texts = _SPACED.findall(line)
    elif '"' in line and len(line) < 10_000:
        texts = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    else:
        texts = line.split(separator)
    cells = list[Cell]()
    for text in texts:
        text = text.replace(",", ".") if decimal and _DECIMAL_COMMA.fullmatch(text.strip()) else text
        cell = cell_of(text.strip("\"'"))
        if isinstance(cell, str) and (" " in cell or "," in cell):
            marks = r",?\s+" if decimal else r"[,\s]+"
            parts = [cell_of(part.replace(",", ".")) for part in re.split(marks, cell) if part]
            if _NAME.fullmatch(str((parts or [""])[0])) or (
                parts and all(isinstance(one, float) for one in parts)
            ):
                cells += parts
                continue
        cells.append(cell.rstrip(":") if isinstance(cell, str) else cell)
    return cells


def _line_tables(file: Path, lines: Sequence[str], comments: dict[int, str]) -> list[Table]:
    """Return the tables of lines: rows of equal length, matrices of 3 or 4 such rows, and sections of the rows."""
    given = next((line.strip()[4:5] for line in lines[:2] if line.strip().lower().startswith("sep=")), None)
    separator, decimal = _separator(lines)
    separator = given or separator
    parsed = {k: _cells(line, separator, decimal) for k, line in enumerate(lines) if line.strip()}
    widths = defaultdict[int, list[Row]](list)
    for k, cells in parsed.items():
        if 2 * sum(map(_is_number, cells)) >= len(cells) - cells.count(None) > 0:
            widths[len(cells)].append((k, cells))
    texts, tables = {k: lines[k].strip() for k in parsed} | comments, list[Table]()
    for width in sorted(widths, key=lambda width: -width * len(widths[width]))[:_SECTIONS]:
        rows = widths[width]
        header = _header(texts, rows[0][0], width, separator) if rows else None
        if header and separator and not tables:  # rows with missing or wrong cells stay rows
            first = rows[0][0]
            below = [
                (k, cells)
                for k, cells in parsed.items()
                if k >= first and any(cell is not None for cell in cells)
            ]
            fitting = [(k, cells) for k, cells in below if 1 < len(cells) <= width and cells != header]
            rows = [(k, cells + [None] * (width - len(cells))) for k, cells in fitting]
            widths = {other: [row for row in widths[other] if row[0] < first] for other in widths}
        if not rows:
            continue
        numbered = {k for k, _ in rows}
        others = {k: texts[k] for k in texts if k not in numbered}
        tables.append(_table_of_rows(file, rows, others, separator))
        tables += _matrices(file, rows, others) if header is None else []
        breaks = [
            i for i, (a, b) in enumerate(pairwise(rows), 1) if any(k in others for k in range(a[0], b[0]))
        ]
        after = -1
        for first, end in pairwise([0, *breaks[:_SECTIONS], len(rows)]) if breaks else ():
            section = rows[first:end]
            around = {k: text for k, text in others.items() if after < k < section[-1][0]}
            after = section[-1][0]
            if len(section) >= _FEWEST_ROWS:
                table = _table_of_rows(file, section, around, separator)
                tables.append(replace(table, place=f"line {section[0][0] + 1}"))
    return tables


def _is_number(cell: Cell) -> bool:
    """Test whether a cell is a number, or a number with its unit."""
    return isinstance(cell, float) or (isinstance(cell, str) and GLUED.fullmatch(cell) is not None)


def _table_of_rows(file: Path, rows: Sequence[Row], texts: dict[int, str], separator: str | None) -> Table:
    """Return the table of rows of equal length among the other lines `texts`."""
    header = _header(texts, rows[0][0], len(rows[0][1]), separator)
    keys = _keys(texts, [k for k, _ in rows])
    counted = [cell for cell in rows[0][1] if cell is not None]
    if header is None and len(rows) > 1 and len(counted) > 2 and counted == list(range(len(counted))):
        rows, keys = rows[1:], None  # pandas numbers columns without names
    names, columns = list[str | None](), list[tuple[Cell, ...]]()
    for name, column in zip(
        header or [None] * len(rows[0][1]), zip(*(cells for _, cells in rows), strict=True), strict=True
    ):
        units = [GLUED.fullmatch(cell) if isinstance(cell, str) else None for cell in column]
        unit = {match[2] for match in units if match}
        if len(unit) == 1 and not any(
            isinstance(cell, str) and not match for cell, match in zip(column, units, strict=True)
        ):
            column = [float(match[1]) if match else cell for cell, match in zip(column, units, strict=True)]
            name = f"{name or ''} [{unit.pop()}]".strip()
        if name or any(cell is not None for cell in column):
            names.append(name or None)
            columns.append(tuple(column))
    return Table(
        file=file, columns=tuple(names), rows=tuple(zip(*columns, strict=True)),
        keys=None if keys is None else tuple(keys), words=tidy_words(texts.values()),
    )  # fmt: skip


def _matrices(file: Path, rows: Sequence[Row], texts: dict[int, str]) -> list[Table]:
    """Return tables with a row for every 3 or 4 lines of 3 or 4 numbers, where gaps between lines repeat so."""
    width, tables = len(rows[0][1]), list[Table]()
    gaps = {i for i, (a, b) in enumerate(pairwise(rows), 1) if b[0] != a[0] + 1}
    if width not in (3, 4) or not all(isinstance(cell, float) for _, cells in rows for cell in cells):
        return []
    for height in (4, 3):
        blocks = [rows[k : k + height] for k in range(0, len(rows), height)]
        expected = {k + gap % height for gap in gaps for k in range(0, len(rows), height)} - {0}
        if len(rows) % height or gaps != expected:
            continue
        keys, made = _keys(texts, [block[0][0] for block in blocks]), list[dict[str | int, Cell]]()
        for block in blocks:
            made.append(
                {f"{i}.{j}": cell for i, (_, cells) in enumerate(block) for j, cell in enumerate(cells)}
            )
        table = table_of(file, made, keys=keys, words=tidy_words(texts.values()))
        tables += [table] if table else []
    return tables
