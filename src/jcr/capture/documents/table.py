"""Table of numbers and texts that a document holds, and limited reading of the document's bytes and text."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jcr.errors import InputError
from jcr.files import read_bytes

Cell = float | str | None
MAX_BYTES = 20_000_000
"""Largest size of a document in bytes; fifty poses, each with the corners of a board, need 1 % of it."""
MAX_TABLES = 64
"""Largest number of tables of a document; further ones, which are deeper inside, are left out."""
MAX_ITEMS = 1_000_000
"""Largest number of numbers and texts in a document; it bounds the memory that a hostile file takes."""
LONGEST_NAME = 500
"""Largest number of characters of the keys that lead to a value, joined by "."; those of poses have 50. It bounds the
memory that the names of MAX_ITEMS values take: half a GB."""
_LONGEST_WORDS = 4000
"""Largest length of `Table.words`; a title and a few comments need 1 % of it."""
_LONGEST_NUMBER = 64
_LATIN = {*map(chr, range(128)), *"äöüÄÖÜßéèêàâçñóòôíìúùåøæÅØÆ°µ²³·±§«»"}
"""Characters of Western European texts of numbers: ASCII, accented letters, and signs of units."""
_BINARY = re.compile(r"[\0-\x08\x0e-\x1f\x7f]")


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of numbers and texts with the names that the document gives to columns and rows.

    Attributes:
        file: Document, or the folder of one document for each image.
        place: Keys inside the document that lead to the table, joined by "."; "" for the whole document.
        columns: Name of each column; None for a column without name.
        rows: Cells of each row, as many as columns; a missing cell is None.
        keys: Name of each row (key of a map, stem of a file); None where rows only have an order.
        words: Text around the numbers in lower case: titles, comments, names of functions.
    """

    file: Path
    place: str = ""
    columns: tuple[str | None, ...]
    rows: tuple[tuple[Cell, ...], ...]
    keys: tuple[str, ...] | None = None
    words: str = ""


def table_of(
    file: Path,
    rows: Sequence[Mapping[str | int, Cell] | None],
    *,
    place: str = "",
    keys: Sequence[str] | None = None,
    words: str = "",
) -> Table | None:
    """Return the table of rows that map column name to cell; None if no column is in half of the rows.

    An integer instead of a name stands for a column without name. A row of None has no cells. A column that fewer than
    half of the rows have is left out, so that the number of cells is at most twice the number of numbers read.
    """
    counts = Counter[str | int]()
    for row in rows:
        counts.update((row or {}).keys())
    columns = [column for column, count in counts.items() if 2 * count >= len(rows)]
    if not columns:
        return None
    return Table(
        file=file,
        place=place,
        columns=tuple(column if isinstance(column, str) else None for column in columns),
        rows=tuple(tuple(map((row or {}).get, columns)) for row in rows),
        keys=None if keys is None else tuple(keys),
        words=tidy_words([words]),
    )


def tidy_words(texts: Iterable[str]) -> str:
    """Return texts as one line in lower case, cut after 4000 characters."""
    return " ".join(" ".join(texts).lower()[:_LONGEST_WORDS].split())


def cell_of(text: str) -> Cell:
    """Return a text as a number if it is one, None if it is empty, otherwise the text.

    An integer of more than 15 digits, such as nanoseconds, stays a text, because a float would lose digits of it.
    """
    text = text.strip()
    if len(text) > 15 and (len(text) > _LONGEST_NUMBER or text.lstrip("+-").isdigit()):
        return text
    try:
        return float(text) if "_" not in text else text
    except ValueError:
        return text or None


def read_limited(file: Path) -> bytes:
    """Return the bytes of a document; raise InputError if it cannot be read or has more than 20 MB."""
    try:
        if file.is_file() and file.stat().st_size > MAX_BYTES:
            raise InputError(f"{file}: more than {MAX_BYTES // 1_000_000} MB; name a file of poses")
        return read_bytes(file)
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}); name a file that is there") from None


def decode_text(file: Path, data: bytes) -> str:
    """Return bytes as text in UTF-8, UTF-16, GB18030 or Latin-1, the first that fits; raise InputError if none fits."""
    utf16 = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    if not utf16 and len(data) > 8 and 2 * data[1::2].count(0) > len(data) // 2:
        data, utf16 = b"\xff\xfe" + data, True  # UTF-16 without its mark, as PowerShell may leave it
    # cp1252 is Latin-1 with the printable characters that Windows has where Latin-1 has control characters.
    for encoding in ("utf-16",) if utf16 else ("utf-8-sig", "gb18030", "cp1252"):
        try:
            text = data.decode(encoding).rstrip("\0\x1a")
        except UnicodeDecodeError:
            continue
        # Few accented letters in a Latin-1 text may be valid pairs of bytes in GB18030.
        if encoding == "gb18030" and not set(data.decode("cp1252", "replace")) - _LATIN:
            continue
        if not _BINARY.search(text):
            return text
    raise InputError(f"{file}: a binary file; save its numbers as text (CSV) or with numpy.save")
