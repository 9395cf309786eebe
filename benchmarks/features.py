"""SIFT and XFeat on real captures, with the robot's gate and without it."""

import time
from contextlib import nullcontext
from itertools import combinations
from pathlib import Path
from unittest.mock import patch

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import folders_with_captures, largest_std, number, table
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.features.matchers import FeatureName, Matcher
from jcr.features.pair_search import MatchedPairs
from jcr.records import Intrinsics
from jcr.sfm import colmap
from jcr.sfm.colmap import reconstruct_colmap

WAYS: tuple[tuple[FeatureName, bool], ...] = (("sift", True), ("sift", False), ("xfeat", True))
"""Features, and whether the robot checks the pairs."""


def run(captures: Path, every: int = 1) -> str:
    """Return the page in Markdown: one in `every` of the captures below `captures`, matched in each way."""
    folders = folders_with_captures(captures, every)
    counts, rows = [], []
    for features, gate in WAYS:
        way = features + ("" if gate else " without the gate")
        found = [_row(folder, features, gate, way) for folder in folders]
        counts.append(f"{sum(accepted for accepted, _ in found)} of {len(found)} with {way}")
        rows += [cells for _, cells in found]
    lines = [
        f"> Calibrations from images alone that are accepted: {', '.join(counts)}.",
        "",
        "Leave-one-out error of the gripper poses. Seconds: reconstruction without dense depth and calibration.",
        "",
        *table(
            "capture | features | images registered | leave-one-out, mm | ±σ: mm | ° | accepted | s",
            sorted(rows),
        ),
    ]
    return "\n".join(lines) + "\n"


def _row(folder: Path, features: FeatureName, gate: bool, way: str) -> tuple[bool, list[str]]:
    """Reconstruct and calibrate one capture; return whether it is accepted, and the row of the table."""
    capture, count, hand_eye = read_capture(folder), 0, None
    begun = time.perf_counter()
    try:
        with nullcontext() if gate else patch.object(colmap, "match_with_robot", _match_all):
            made = reconstruct_colmap(capture, features)
        count = len(made.image_index)
        hand_eye = calibrate_reconstruction(capture, made)
    except RejectedError:
        pass
    seconds, numbers = time.perf_counter() - begun, ["", "", ""]
    if hand_eye is not None:
        left_out = np.nan if hand_eye.held_out is None else 1e3 * hand_eye.held_out.length_m
        numbers = [*map(number, (left_out, *largest_std(hand_eye.covariance)))]
    accepted = hand_eye is not None and hand_eye.converged
    verdict = "yes" if accepted else "no"
    return accepted, [folder.name, way, f"{count} of {len(capture)}", *numbers, verdict, f"{seconds:.0f}"]


def _match_all(
    matcher: Matcher, gripper: Float[ndarray, "n 4 4"], working: Intrinsics, *_: object
) -> MatchedPairs:
    """Match without gripper poses: all pairs, none judged, as if the gripper moved between all images."""
    pairs = list(combinations(range(len(matcher.features.x_px)), 2))
    moving = np.zeros((len(gripper), len(gripper)), bool)
    geometries = matcher.geometries(pairs, np.zeros((len(pairs), 2)), moving)
    return MatchedPairs(geometries=geometries, intrinsics=working)
