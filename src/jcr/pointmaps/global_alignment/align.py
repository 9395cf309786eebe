"""Global alignment of pairwise pointmaps into one reconstruction (paper section III, eq. 1)."""

from pathlib import Path

import numpy as np

from jcr.errors import InputError
from jcr.pointmaps.global_alignment.alignment import Alignment
from jcr.pointmaps.global_alignment.gauss_newton import dense_alignment, solve
from jcr.pointmaps.global_alignment.observations import Problem
from jcr.pointmaps.pairs import PairPredictions, read_pairs
from jcr.progress import Progress

PIXELS = 2048
"""Pixels per image, the most confident of as many equal cells."""
LEAST_PIXELS = 50
"""Least number of pixels per image: several for each coarse cell of the correlation of residuals."""


def global_align(
    pairs: Path | str | PairPredictions, pixels: int = PIXELS, progress: Progress | None = None
) -> Alignment:
    """Estimate cameras, focal length, depths and pair scales from pairwise pointmaps, or from their npz file.

    `pixels` of each image are used. The principal point and the ratio fy / fx are those of the predictions' intrinsics;
    without these they are the image's middle and 1. The focal length is that of the pointmaps.

    Raises InputError for a file that cannot be used, for images that no chain of pairs joins, and for too few pixels;
    RejectedError where the pointmaps do not determine the cameras.
    """
    predictions = pairs if isinstance(pairs, PairPredictions) else read_pairs(Path(pairs))
    if pixels < LEAST_PIXELS:
        raise InputError(f"{pixels} pixels per image are too few; alignment needs {LEAST_PIXELS} or more")
    _check_connected(predictions)
    problem = Problem.of(predictions)
    return dense_alignment(problem, solve(problem, pixels), progress)


def _check_connected(predictions: PairPredictions) -> None:
    """Raise InputError naming the images that no chain of pairs joins to the first."""
    count = predictions.image_count
    if len(predictions.edges) == 0:
        raise InputError("the predictions have no pair; predict at least one")
    reached = np.zeros(count, dtype=bool)
    reached[predictions.edges[0, 0]] = True
    for _ in range(count):
        joined = reached[predictions.edges].any(axis=1)
        reached[predictions.edges[joined].ravel()] = True
    if not reached.all():
        names = ", ".join(predictions.names[k] for k in np.flatnonzero(~reached))
        raise InputError(
            f"no chain of pairs joins {names} to the other images; predict pairs between them, "
            "or leave these images out"
        )
