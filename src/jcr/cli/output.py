"""Output of every command: the result on stdout, everything else on stderr."""

import io
import json
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from jcr.errors import printable
from jcr.number_format import INDENT

COLOURS = {"ACCEPTED, BUT NOT AS EXACT AS NEEDED": 33, "ACCEPTED": 32, "REJECTED": 31, "WARNING": 33}
"""ANSI codes of the words that state a verdict or a warning at the start of a line, the longest first: green where
the exit status is 0, red for a rejection, yellow otherwise."""
COLOURED = re.compile(rf"^({'|'.join(COLOURS)})\b")


@dataclass(frozen=True)
class Output:
    """Options of the output."""

    json: bool = False
    """Print the result as one JSON object."""
    quiet: bool = False
    """Print no progress and notes on stderr, only errors and warnings. The result is still printed on stdout."""

    def result(self, lines: Iterable[str], facts: Mapping[str, object]) -> None:
        """Print the result: with --json `facts` as one JSON object (arrays as lists), otherwise the `lines`."""
        if self.json:
            sys.stdout.write(json.dumps(facts, default=lambda array: array.tolist()) + "\n")
            sys.stdout.flush()
        else:
            write_lines(lines)


@dataclass(frozen=True)
class VerboseOutput(Output):
    """Options of the output, with the details on request."""

    verbose: bool = False
    """Also print the details: the uncertainty budget, the use of each image, notes and p-values."""


def write_lines(lines: Iterable[str]) -> None:
    """Write lines to stdout; on a terminal, those longer than a row are wrapped at words, below the text of a label.

    Commands to copy (the line Next, and lines in lower case) are not wrapped; in a file or pipe no line is.
    On a terminal a verdict or warning at the start of a line is coloured, unless NO_COLOR is set (no-color.org).
    """
    # While progress bars are drawn, stdout is a proxy of rich, which does not tell whether it is a terminal.
    stream = getattr(sys.stdout, "rich_proxied_file", sys.stdout)
    width = shutil.get_terminal_size().columns if stream.isatty() else 0
    for line in map(printable, lines):  # names in files must not command the terminal
        rows = [line]
        if 0 < width < len(line) and not (line.startswith("Next ") or line[:1].islower()):
            is_labelled = line[INDENT - 1 : INDENT] == " " != line[INDENT : INDENT + 1]
            indent = INDENT if is_labelled else len(line) - len(line.lstrip())
            rows = textwrap.wrap(
                line, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False
            )
        if stream.isatty() and not os.environ.get("NO_COLOR"):
            rows[0] = COLOURED.sub(lambda word: f"\033[1;{COLOURS[word[0]]}m{word[0]}\033[0m", rows[0])
        sys.stdout.writelines(f"{row}\n" for row in rows)
    sys.stdout.flush()


class Quiet(io.TextIOWrapper):
    """Stream that replaces stderr with --quiet and discards text; `warn` writes warnings to stderr (`before`)."""

    def __init__(self, nowhere: io.BufferedWriter, before: Any) -> None:
        super().__init__(nowhere, encoding="utf-8")
        self.before = before


def warn(text: str) -> None:
    """Print a warning that the user must act on, on stderr, also with --quiet."""
    stream = sys.stderr.before if isinstance(sys.stderr, Quiet) else sys.stderr
    stream.write(f"warning: {printable(text)}\n")


def numbers(values: Iterable[float], digits: int, sign: str = "") -> str:
    """Return numbers, separated by spaces, with `digits` decimals; `sign` "+" writes the sign of positive ones, too."""
    return " ".join(f"{value:{sign}.{digits}f}" for value in values)
