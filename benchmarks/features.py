"""`benchmarks features DIR`: SIFT and XFeat on real captures, with the robot's gate and without it."""

import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import folders_with, number, table
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.features.matchers import FeatureName, Matcher
from jcr.features.pairs import all_pairs
from jcr.features.stage import Matched
from jcr.records import Intrinsics
from jcr.sfm import mapping
from jcr.sfm.colmap import reconstruct_colmap
from jcr.sfm.options import ColmapOptions

WAYS: tuple[tuple[FeatureName, bool], ...] = (("sift", True), ("sift", False), ("xfeat", True))
"""Features, and whether the robot checks the pairs."""
EVERY = 4
"""One capture in this many is measured."""


@dataclass(frozen=True)
class Row:
    """One way of matching one capture."""

    capture: str
    features: str
    gate: bool
    images: str
    seconds: float
    accepted: bool = False
    leave_one_out_mm: float | None = None
    std: tuple[float, float] | None = None
    """Largest stated standard deviation, mm and degrees."""

    @property
    def way(self) -> str:
        """Features and gate in words."""
        return self.features + ("" if self.gate else " without the gate")

    def cells(self) -> list[str]:
        """Return the row of the table."""
        numbers = [number(value, 2) for value in (self.leave_one_out_mm, *(self.std or (None, None)))]
        accepted = "yes" if self.accepted else "no"
        return [self.capture, self.way, self.images, *numbers, accepted, f"{self.seconds:.0f}"]


def run(captures: Path) -> str:
    """Return the page in Markdown: some of the captures below `captures`, matched in each way."""
    folders = folders_with(captures, "capture.json")[::EVERY]
    return page([_row(folder, features, gate) for folder in folders for features, gate in WAYS])


def page(rows: Sequence[Row]) -> str:
    """Return the page of measured rows in Markdown."""
    ways = {way: [row for row in rows if row.way == way] for way in dict.fromkeys(row.way for row in rows)}
    counts = [f"{sum(row.accepted for row in some)} of {len(some)} with {way}" for way, some in ways.items()]
    lines = [
        f"> Calibrations from images alone that are accepted: {', '.join(counts)}.",
        "",
        "Leave-one-out error of the gripper poses. Seconds: reconstruction without dense depth and calibration.",
        "",
        *table(
            "capture | features | images registered | leave-one-out, mm | ±σ: mm | ° | accepted | s",
            (row.cells() for row in rows),
        ),
    ]
    return "\n".join(lines) + "\n"


def _row(folder: Path, features: FeatureName, gate: bool) -> Row:
    """Reconstruct and calibrate one capture."""
    capture, count = read_capture(folder), 0
    begun = time.perf_counter()
    try:
        with nullcontext() if gate else _without_gate():
            made = reconstruct_colmap(capture, ColmapOptions(features=features))
        count = len(made.image_index)
        hand_eye = calibrate(capture, made)
    except RejectedError:
        return Row(folder.name, features, gate, f"{count} of {len(capture)}", time.perf_counter() - begun)
    seconds, std = time.perf_counter() - begun, np.sqrt(np.diag(hand_eye.covariance))
    return Row(
        folder.name,
        features,
        gate,
        f"{count} of {len(capture)}",
        seconds,
        hand_eye.converged,
        None if hand_eye.leave_one_out is None else 1e3 * hand_eye.leave_one_out.length_m,
        (1e3 * float(std[:3].max()), float(np.degrees(std[3:6].max()))),
    )


def _without_gate():
    """Replace the matching by one without gripper poses: all pairs, none judged."""

    def match_all(
        matcher: Matcher, gripper: Float[ndarray, "n 4 4"], working: Intrinsics, *_: object
    ) -> Matched:
        pairs = all_pairs(len(matcher.x_px))
        geometries = matcher.geometries(pairs, np.zeros((len(pairs), 2)))
        return Matched(geometries=geometries, gate=None, intrinsics=working)

    return patch.object(mapping, "match_with_robot", match_all)
