"""Output of every command: the result on stdout, everything else on stderr."""

import io
import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from jcr.errors import printable


@dataclass(frozen=True)
class Output:
    """Options of a command's output."""

    json: bool = False
    """Print the result as one JSON object."""
    quiet: bool = False
    """Print no progress and notes on stderr, only errors and warnings. The result is still printed on stdout."""

    def result(self, lines: Iterable[str], facts: Mapping[str, object]) -> None:
        """Print the result: with --json `facts` as one JSON object (arrays as lists), otherwise the `lines`."""
        as_json = [json.dumps(facts, default=lambda array: array.tolist())] if self.json else []
        shown = as_json or map(printable, lines)  # names in files must not command the terminal
        sys.stdout.writelines(f"{line}\n" for line in shown)
        sys.stdout.flush()


@dataclass(frozen=True)
class VerboseOutput(Output):
    """Options of the output of a command that prints details only with --verbose."""

    verbose: bool = False
    """Also print the details: the uncertainty budget, the use of each image, notes and p-values."""


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
