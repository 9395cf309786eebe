"""Findings of the image order on real captures, and on the same captures with their images in a random order.

A finding of order (slip, drift, moved base, delay) is true only of the true order. After a shuffle each one is false.
The bench needs no truth: what is found in random orders is the frequency of false findings.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from benchmarks.page import folders_with_captures, of_rows, table
from jcr.backends import ReconstructOptions, reconstruct
from jcr.calibration.calibrate import calibrate_reconstruction
from jcr.calibration.checks.effects import EXAMINED_FROM
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.findings import FindingKind, kinds_of
from jcr.records import Capture, Reconstruction

SHUFFLES = 3
"""Number of random orders of each capture."""
OF_ORDER = kinds_of("order")


def run(captures: Path, seed: int = 0) -> str:
    """Return a page: findings of order of the captures below a folder in their own order, and in random orders."""
    rows, shuffled, false = list[tuple[object, ...]](), 0, 0
    for folder in folders_with_captures(captures):
        capture = of_rows(read_capture(folder), range(len(read_capture(folder))))
        if len(capture) < EXAMINED_FROM or capture.mount == "base":
            continue
        try:
            made = reconstruct(capture, ReconstructOptions(backend="colmap"))
            own = found_in(capture, made)
        except RejectedError:
            rows.append((folder.name, len(capture), "not reconstructed", ""))
            continue
        rng, others = np.random.default_rng([seed, len(rows)]), Counter[FindingKind]()
        for _ in range(SHUFFLES):
            order = rng.permutation(len(capture))
            found = found_in(of_rows(capture, order.tolist()), in_order(made, order))
            others.update(found)
            shuffled, false = shuffled + 1, false + bool(found)
        named = ", ".join(f"{kind} ({count} of {SHUFFLES})" for kind, count in others.items())
        rows.append((folder.name, len(capture), ", ".join(own), named))
    lines = [
        f"> In {false} of {shuffled} random orders of {len(rows)} real captures, an effect of the order is found.",
        "",
        "A camera that slips or drifts, a moved base and late poses are effects of the order of the images. In a random",
        "order each such finding is false, whatever the truth of the capture is.",
        "",
        *table("capture | images | found in its own order | found in random orders", rows),
    ]
    return "\n".join(lines)


def found_in(capture: Capture, made: Reconstruction) -> list[FindingKind]:
    """Return the kinds of order that the calibration of a capture from its reconstruction finds."""
    return [one.kind for one in calibrate_reconstruction(capture, made).findings if one.kind in OF_ORDER]


def in_order(made: Reconstruction, order: Int[ndarray, " n"]) -> Reconstruction:
    """Return the reconstruction of the capture in another order: its image k is the image `order[k]` of before."""
    image_index = np.argsort(order)[made.image_index]
    rows = np.argsort(image_index)
    return replace(
        made,
        image_index=image_index[rows],
        recon_from_camera=made.recon_from_camera[rows],
        tracks=replace(made.tracks, image=np.argsort(rows)[made.tracks.image]),
        pointmaps=None,
    )
