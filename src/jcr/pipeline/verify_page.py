"""Page verify.html: drift of camera and scene over all captures that were verified against a run."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.drift import Step
from jcr.distributions import chi2
from jcr.files import write_text
from jcr.number_format import significant
from jcr.pipeline.verify import Verification
from jcr.pipeline.verify_history import Verified
from jcr.report.render import render

PAGE = "verify.html"
WIDTH, HEIGHT = 640, 150
"""Size of a chart in units of its drawing."""
WITHIN = 0.95
"""Probability with which a drift lies in the band if nothing has moved."""


class Chart(NamedTuple):
    """Chart of the length of a drift over the captures, in units of the drawing."""

    title: str
    unit: str
    points: list[tuple[float, float, str, bool]]
    """x, y, text, and whether the length is outside of the band."""
    band: str
    tolerance: float | None
    """y of the tolerance; None outside of the chart."""
    top: str


def write_page(out: Path, found: Verification, tolerance: tuple[float, float]) -> Path:
    """Write verify.html into a run folder and return its path; `tolerance` is in mm and degrees."""
    steps = (
        ("Camera on the gripper", lambda row: row.camera),
        ("Scene in the base frame", lambda row: row.scene),
    )
    charts = [
        _chart(found.history, title, unit, own, part, limit)
        for title, own in steps
        for unit, part, limit in (("mm", slice(0, 3), tolerance[0]), ("°", slice(3, 6), tolerance[1]))
    ]  # fmt: skip
    names = [row.name for row in found.history]
    content = {
        "name": out.resolve().name,
        "found": found,
        "charts": charts,
        "size": (WIDTH, HEIGHT),
        "changes": [(_x(move.first, len(names)), move.since) for move in found.moves],
        "rows": [_cells(row) for row in reversed(found.history)],
        "ends": names if len(names) < 2 else [names[0], names[-1]],
        "tolerance": tolerance,
    }
    write_text(out / PAGE, render("verify.html", content))
    return out / PAGE


def _x(k: int, count: int) -> float:
    """Return the place of capture k of `count` along a chart."""
    return WIDTH * (k + 0.5) / count


def _chart(
    rows: Sequence[Verified],
    title: str,
    unit: str,
    own: Callable[[Verified], Step],
    part: slice,
    tolerance: float,
) -> Chart:
    """Return the chart of the translation (unit mm) or rotation (°), a part of the step `own`, over the captures."""
    factor = 1e3 if unit == "mm" else float(np.degrees(1.0))
    lengths = [factor * float(np.linalg.norm(own(row).step[part])) for row in rows]
    limits = [factor * length_within(own(row).covariance[part, part]) for row in rows]
    top = 1.1 * max(*lengths, *limits, 1e-9)

    def y(value: float) -> float:
        return HEIGHT * (1 - value / top)

    xs = [_x(k, len(rows)) for k in range(len(rows))]
    ends = [(0.0, limits[0]), *zip(xs, limits, strict=True), (float(WIDTH), limits[-1])]
    corners = [*((x, y(limit)) for x, limit in ends), (WIDTH, HEIGHT), (0, HEIGHT)]
    return Chart(
        title=title,
        unit=unit,
        points=[
            (x, y(length), f"{row.name}: {significant(length)} {unit}; 95 % below {significant(limit)}", length > limit)
            for x, length, limit, row in zip(xs, lengths, limits, rows, strict=True)
        ],
        band=" ".join(f"{x:.1f},{at:.1f}" for x, at in corners),
        tolerance=y(tolerance) if tolerance < top else None,
        top=f"{significant(top)}{unit if unit == '°' else f' {unit}'}",
    )  # fmt: skip


def length_within(covariance: Float[ndarray, "3 3"]) -> float:
    """Return the length below which 95 % of the vectors with this covariance lie, by Satterthwaite's approximation."""
    trace, squares = float(np.trace(covariance)), float((covariance**2).sum())
    freedom = trace**2 / squares
    return float(np.sqrt(trace / freedom * chi2.ppf(WITHIN, freedom)))


def _cells(row: Verified) -> dict[str, Any]:
    """Return the cells of a capture in the table."""
    mm_deg = [
        (1e3 * np.linalg.norm(step[:3]), np.degrees(np.linalg.norm(step[3:])))
        for step in (row.camera.step, row.scene.step)
    ]
    noticed = 1e3 * row.detectable[0], np.degrees(row.detectable[1])
    numbers = [significant(float(value)) for pair in (*mm_deg, noticed) for value in pair]
    left = "" if row.scene_left is None else f"{100 * row.scene_left:.0f} %"
    return {
        "name": row.name,
        "numbers": [*numbers, left],
        "images": len(row.images),
        "notes": "; ".join(row.notes),
    }
