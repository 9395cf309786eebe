"""Numbers in brackets and numbers with names, in the notations of robot controllers and programming languages."""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from jcr.capture.documents.nested import is_container, leaves, require_short
from jcr.capture.documents.plain import MAX_DEPTH
from jcr.capture.documents.table import LONGEST_NAME, Cell, cell_of

NUMBER = r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?"
GLUED = re.compile(rf"({NUMBER})(mm|cm|m|deg|degrees|°|rad|s|ms)")
"""Number with its unit, such as 298.8mm."""
_TOKEN = re.compile(
    rf"""(?P<flat>[\[(][ \t]*{NUMBER}(?:[ \t,]+{NUMBER})+[ \t]*[\])])|"""
    r"""(?P<open>[\[({])|(?P<close>[\])}])|(?P<assign>:=|[:=])"""
    r"""|(?P<text>"(?![,;])[^"\n\[\](){}]*"|'(?![,;])[^'\n\[\](){}]*')"""
    r"""|(?P<mark>[;,\n])|(?P<call>[A-Za-z_][\w.]*(?=\())|(?P<word>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(?:\.\d+)?"""
    r"""|(?:[^\s,;=:\[\](){}"']|(?<=\d):(?=\d))+)"""
)
_VALUE = re.compile(r"\d.*|.*\.[A-Za-z]\w{2,4}")
"""Word that is a value: a time or another word that begins with a digit, or the name of a file."""
Entry = tuple[str | None, Any]
"""Name (None without one) and value of a number, a text or a bracket."""


@dataclass(kw_only=True)
class Statement:
    """Line of text, continued where a bracket is open, that has numbers in brackets or numbers with names.

    Attributes:
        file: Document with the line.
        lines: Index of the first line and of the line after the last one.
        key: Name of the only value, such as p10 in "CONST robtarget p10:=[…]"; None without one.
        words: Words that are no names, such as "movej p".
        entries: Values of the statement.
        names: Names of the values if all are numbers or texts with different names; otherwise empty.
    """

    file: Path
    lines: tuple[int, int]
    key: str | None
    words: str
    entries: list[Entry]
    names: set[str]

    def row(self, header: Sequence[str] | None = None) -> dict[str | int, Cell]:
        """Return the cells by column name; a cell that has no name is counted. `header` has a name for each entry.

        Raises InputError for a name that is too long.
        """
        several = sum(is_container(value) for _, value in self.entries) > 1
        row, place = dict[str | int, Cell](), 0
        for k, (name, value) in enumerate(self.entries):
            name = header[k] if header else name
            if not is_container(value):
                row[name or len(row)] = value
                continue
            start = name or (str(place) if several else "")
            require_short(self.file, start)
            place += 1
            flat = isinstance(value, list) and not any(map(is_container, value))
            for path, cell in leaves(self.file, value).items():
                row[f"{start}.{path}" if start else len(row) if flat else path] = cell
        return row


class _Bracket:
    """Open bracket, or the line outside of all brackets, whose content is being read."""

    __slots__ = "opening", "glued", "entries", "words", "breaks", "word", "assigned", "last", "units"

    def __init__(self, opening: str = "", glued: bool = False) -> None:
        self.opening, self.glued = opening, glued
        self.entries, self.words, self.breaks = list[Entry](), list[str](), list[tuple[int, str]]()
        self.word, self.assigned, self.last, self.units = "", False, "", set[str]()

    def add(self, value: Any, unit: str = "") -> None:
        """Append a value; a name before it with = or :, or without in braces, is the name of the value."""
        in_braces = self.opening == "{" and not is_container(value)
        if self.word and (self.assigned or in_braces or self.word.endswith("]")):
            self.entries.append((self.word + unit, value))
            self.word, self.assigned = "", False
        else:
            self.end_word()
            self.entries.append((None, value))
            self.words += [unit] if unit and unit not in self.units else []
            self.units.add(unit)

    def end_word(self) -> None:
        """End a word that names nothing: a file name or a word that begins with a digit is a value."""
        if self.word and not self.assigned and _VALUE.fullmatch(self.word):
            self.entries.append((None, self.word))
        elif self.word:
            self.words.append(self.word)
        self.word, self.assigned = "", False

    def take(self, kind: str, token: str) -> None:
        """Read a token that is no bracket."""
        if kind == "mark":
            self.end_word()
            self.breaks.append((len(self.entries), token))
        elif kind == "call":
            self.words.append(token)
        elif kind == "assign":
            if not self.word and self.entries and self.entries[-1] == (None, cell_of(self.last)):
                self.entries.pop()  # a number or a text before : or = is a name
                self.word = self.last
            self.assigned = bool(self.word)
        elif glued := GLUED.fullmatch(token):
            self.add(float(glued[1]), f" [{glued[2]}]")
        elif (
            kind == "text" or isinstance(cell_of(token), float) or (self.assigned and _VALUE.fullmatch(token))
        ):
            self.last = token.strip("\"'")
            self.add(cell_of(self.last))
        elif self.assigned:
            self.words.append(token)  # a function between the name and its value
        else:
            self.end_word()
            self.word = token

    def value(self) -> Any:
        """Return the content: a map if all values have names, a list otherwise; the inner one of a single bracket."""
        self.end_word()
        if self.entries and len({name for name, _ in self.entries} - {None}) == len(self.entries):
            return dict(self.entries)
        inner = any(is_container(value) for _, value in self.entries)
        parts = [value for name, value in self.entries if not (inner and name) or is_container(value)]
        if inner:
            return parts[0] if len(parts) == 1 else parts
        fewest = 2 if any(mark == ";" for _, mark in self.breaks) else 3
        ends = [0, *(at for at, mark in self.breaks if mark != ","), len(parts)]
        rows = [parts[a:b] for a, b in pairwise(ends) if b > a]  # as MATLAB writes a matrix
        if self.opening == "[" and len(rows) >= fewest and len(set(map(len, rows))) == 1 < len(rows[0]):
            return rows
        return parts


def read_statements(file: Path, lines: Sequence[str], across_lines: bool = True) -> list[Statement]:
    """Return the statements in lines of text; where a bracket is never closed, those that are within one line."""
    statements, stack, first, line, before = list[Statement](), [_Bracket()], 0, 0, -1
    for match in _TOKEN.finditer("\n".join(lines) + "\n"):
        kind, token = match.lastgroup or "", match[0]
        if kind == "flat":
            stack[-1].add(list(map(cell_of, token[1:-1].replace(",", " ").split())))
        elif kind == "open":
            stack.append(_Bracket(token, match.start() == before))
        elif kind == "close" and len(stack) > 1:
            _close(stack[-2], stack.pop())
        elif kind != "close":
            stack[-1].take(kind, token)
        before = match.end() if kind in ("word", "close") else -1
        if len(stack) > MAX_DEPTH:
            break
        if token == "\n":
            line += 1
            if len(stack) == 1 and (statement := _statement(file, stack[0], (first, line))):
                _append(statements, statement)
            if len(stack) == 1 or not across_lines:
                stack, first = [_Bracket()], line
    if len(stack) > 1:
        return read_statements(file, lines, False) if across_lines else []
    has_values = [
        len(one.entries) > 2 or any(is_container(value) for _, value in one.entries) for one in statements
    ]
    return [one for one, kept in zip(statements, has_values, strict=True) if kept]


def _close(outer: _Bracket, inner: _Bracket) -> None:
    """Add the content of a closed bracket to the outer one; an index such as [3] after a name belongs to the name."""
    value = inner.value()
    is_index = inner.glued and inner.opening == "[" and inner.last.isdigit() and not inner.entries[1:]
    if is_index and 0 < len(outer.word) < LONGEST_NAME:
        outer.word += f"[{inner.last}]"
    elif value:
        outer.add(value)
    outer.words += inner.words
    outer.units |= inner.units


def _statement(file: Path, line: _Bracket, lines: tuple[int, int]) -> Statement | None:
    """Return a line as a statement; None if it has neither two numbers in brackets nor only numbers with names."""
    line.end_word()
    entries, key = list[Entry](line.entries), None
    inside = [cell for _, value in entries if is_container(value) for cell in leaves(file, value).values()]
    named = bool(entries) and all(name and not is_container(value) for name, value in entries)
    if len(entries) == 1 and inside and entries[0][0]:
        key, entries[0] = entries[0][0], (None, entries[0][1])
    if sum(isinstance(cell, float) for cell in inside) < 2 and not named and not (key and len(inside) > 2):
        return None
    names = {name for name, _ in entries if name} if named else set[str]()
    names = names if len(names) == len(entries) else set()
    words = " ".join(line.words)
    return Statement(file=file, lines=lines, key=key, words=words, entries=entries, names=names)


def _append(statements: list[Statement], new: Statement) -> None:
    """Append a statement; numbers with names that follow others on the line before, with new names, continue these."""
    if statements and statements[-1].lines[1] == new.lines[0]:
        last = statements[-1]
        if last.names and new.names and last.names.isdisjoint(new.names):
            last.entries += new.entries
            last.names |= new.names
            last.lines = last.lines[0], new.lines[1]
            return
    statements.append(new)


def group_statements(statements: Sequence[Statement]) -> list[list[Statement]]:
    """Return the statements with the same columns and the same words, apart from numbers, as groups."""
    groups = defaultdict[object, list[Statement]](list)
    for one in statements:
        groups[tuple(one.row()), re.sub(r"\d+", "#", one.words.lower())].append(one)
    return list(groups.values())
