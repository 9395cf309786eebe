"""Tables, distances in mm and degrees, and captures that several benches share."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import rotation_between_deg


def table(head: str, rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a Markdown table; `head` names the columns, with bars between them."""
    lines = [f"| {head} |", "|---" * (head.count("|") + 1) + "|"]
    return lines + [f"| {' | '.join(map(str, row))} |" for row in rows]


def number(value: float | None, digits: int) -> str:
    """Return a cell of a table, empty where there is no value."""
    return "" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def mm_deg(step: Float[ndarray, " p"]) -> tuple[float, float]:
    """Return length (mm) and angle (degrees) of a step: translation (m), rotation vector (rad)."""
    return 1e3 * float(np.linalg.norm(step[:3])), float(np.degrees(np.linalg.norm(step[3:6])))


def apart(x: Float[ndarray, "4 4"], reference: Float[ndarray, "4 4"]) -> tuple[float, float]:
    """Return the distance of two hand-eye transforms in mm and degrees."""
    mm = 1e3 * float(np.linalg.norm(x[:3, 3] - reference[:3, 3]))
    return mm, float(rotation_between_deg(x[:3, :3], reference[:3, :3]))


def folders_with(captures: Path, file: str) -> list[Path]:
    """Return the folders below `captures` that hold a file of this name; raise InputError where there is none."""
    folders = sorted(path.parent for path in captures.glob(f"*/{file}"))
    if not folders:
        raise InputError(f"{captures}: no folder below it holds a {file}")
    return folders


def boards_of(boards: Sequence[str], folders: Sequence[Path], captures: Path) -> dict[str, str]:
    """Return boards given as CAPTURE=BOARD by capture; raise InputError for a capture that is not there."""
    named = {name: board for name, _, board in (text.partition("=") for text in boards)}
    if unknown := named.keys() - {folder.name for folder in folders}:
        raise InputError(f"--boards {', '.join(sorted(unknown))}: no such capture in {captures}")
    return named
