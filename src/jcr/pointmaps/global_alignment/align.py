"""Global alignment of pairwise pointmaps into one reconstruction (paper section III, eq. 1)."""

from pathlib import Path

from jcr.pointmaps.global_alignment.alignment import Alignment, AlignOptions, check_connected, check_options
from jcr.pointmaps.global_alignment.gauss_newton import Problem, dense_alignment, solve
from jcr.pointmaps.pairs import PairPredictions, read_pairs
from jcr.progress import Progress


def global_align(
    pairs: Path | str | PairPredictions,
    options: AlignOptions | None = None,
    progress: Progress | None = None,
) -> Alignment:
    """Estimate cameras, depths, focal lengths and pair scales from pairwise pointmaps, or from their npz file.

    Raises InputError for a file that cannot be used, for images that no chain of pairs joins, and for options that the
    predictions cannot serve; RejectedError where the pointmaps do not determine the cameras.
    """
    options = options or AlignOptions()
    predictions = pairs if isinstance(pairs, PairPredictions) else read_pairs(Path(pairs))
    check_options(options)
    check_connected(predictions)
    problem = Problem.of(predictions, options)
    return dense_alignment(problem, solve(problem, options), progress)
