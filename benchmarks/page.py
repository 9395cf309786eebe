"""Tables, distances in mm and degrees, and captures that several benches share."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import step_between
from jcr.records import Capture


def table(head: str, rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a Markdown table; `head` names the columns, with bars between them."""
    lines = [f"| {head} |", "|---" * (head.count("|") + 1) + "|"]
    return lines + [f"| {' | '.join(map(str, row))} |" for row in rows]


def number(value: float | None, digits: int = 2) -> str:
    """Return a cell of a table, empty where there is no value."""
    return "" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def mm_deg(step: Float[ndarray, " p"]) -> tuple[float, float]:
    """Return length (mm) and angle (degrees) of a step: translation (m), rotation vector (rad)."""
    return 1e3 * float(np.linalg.norm(step[:3])), float(np.degrees(np.linalg.norm(step[3:6])))


def largest_std(covariance: Float[ndarray, "p p"]) -> tuple[float, float]:
    """Return the largest standard deviation on an axis of a transform, mm and degrees."""
    std = np.sqrt(np.diag(covariance)[:6])
    return 1e3 * float(std[:3].max()), float(np.degrees(std[3:].max()))


def squared_distance(
    off: Float[ndarray, "*k p"], covariance: Float[ndarray, "*k p p"]
) -> Float[ndarray, "*k"]:
    """Return squared Mahalanobis distances."""
    return (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(-1)


def apart(x: Float[ndarray, "4 4"], reference: Float[ndarray, "4 4"]) -> tuple[float, float]:
    """Return the distance of two hand-eye transforms in mm and degrees."""
    return mm_deg(step_between(x, reference))


def farthest(
    found: Float[ndarray, "4 4"], covariance: Float[ndarray, "6 6"], truths: Iterable[Float[ndarray, "4 4"]]
) -> tuple[Float[ndarray, "6"], float]:
    """Return the step to the truth that is farthest in standard deviations on an axis, and that number."""
    steps, std = [step_between(found, true) for true in truths], np.sqrt(np.diag(covariance))
    sigmas = [float(np.abs(step / std).max()) for step in steps]
    return steps[int(np.argmax(sigmas))], max(sigmas)


def of_rows(capture: Capture, rows: Sequence[int]) -> Capture:
    """Return a capture with some of its images, without their depth."""
    return replace(capture.of_rows(rows), depths=None)


def folders_with_captures(captures: Path, every: int = 1) -> list[Path]:
    """Return one in `every` of the folders below `captures` that hold a capture.json, at even steps.

    Raises InputError where there is none.
    """
    folders = sorted(path.parent for path in captures.glob("*/capture.json"))
    if not folders:
        raise InputError(
            f"{captures}: no folder below it holds a capture.json; name another one with --captures, or build captures "
            "with python -m benchmarks fetch-captures data"
        )
    return folders[::every]
