"""Global alignment: pairwise pointmaps of a set of images become one reconstruction."""

from jcr.extras import extra
from jcr.progress import Progress
from jcr.reconstruct.global_alignment.alignment import Alignment, AlignOptions, check_connected, check_options
from jcr.reconstruct.global_alignment.pairs import PairPredictions

__all__ = ["AlignOptions", "Alignment", "align"]


def align(
    predictions: PairPredictions, options: AlignOptions | None = None, progress: Progress | None = None
) -> Alignment:
    """Minimise eq. 1 of the paper's section III over cameras, depths, focal lengths and pair scales.

    Raises InputError for images that no chain of pairs joins, and for options the predictions cannot serve.
    """
    options = options or AlignOptions()
    check_options(options)
    check_connected(predictions)
    if options.method == "adam":
        # torch takes seconds to import and the default does without.
        extra("torch", "networks", "--method adam")
        from jcr.reconstruct.global_alignment.adam import align_adam

        return align_adam(predictions, options, progress)
    from jcr.reconstruct.global_alignment.gauss_newton import align_fast

    return align_fast(predictions, options, progress)
