"""Output of every command: its result on stdout, all else on stderr."""

import io
import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Output:
    """Options of the output."""

    json: bool = False
    """Print the result as one JSON object."""
    quiet: bool = False
    """Print only errors and warnings on stderr: no progress, no notes."""

    def result(self, lines: Iterable[str], facts: Mapping[str, object]) -> None:
        """Print the result at once: `facts`, arrays as lists, with --json, else the lines for people."""
        shown = [json.dumps(facts, default=lambda array: array.tolist())] if self.json else lines
        sys.stdout.writelines(f"{line}\n" for line in shown)
        sys.stdout.flush()


@dataclass(frozen=True)
class VerboseOutput(Output):
    """Output of a command that leaves out details."""

    verbose: bool = False
    """Print the details as well: what uncertainty comes from, images left out, notes, p-values."""


class Quiet(io.TextIOWrapper):
    """Stderr with --quiet: what is written to it is not seen, but for warnings, which go where all went before."""

    def __init__(self, nowhere: io.BufferedWriter, before: Any) -> None:
        super().__init__(nowhere, encoding="utf-8")
        self.before = before


def warn(text: str) -> None:
    """Print what asks the user to act on stderr, with --quiet too."""
    stream = sys.stderr.before if isinstance(sys.stderr, Quiet) else sys.stderr
    stream.write(f"warning: {text}\n")


def numbers(values: Iterable[float], digits: int, sign: str = "") -> str:
    """Return numbers with so many decimals in one line; `sign` "+": positive ones have a sign."""
    return " ".join(f"{value:{sign}.{digits}f}" for value in values)
