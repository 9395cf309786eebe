"""The section on the features: where in the frame they lie, and how far their 3D points fall from them."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics, Reconstruction
from jcr.report.figures import bars_figure, grid_figure
from jcr.report.markup import filled
from jcr.results import RunResult
from jcr.rounding import significant

CELLS = 16
"""Of the frame's width."""
BINS = 24
FAR = 99.0
"""Percent of the errors that the histogram shows; the rest is in its last bar."""


def features_section(result: RunResult) -> str:
    """Coverage of the frame and reprojection errors; empty where the back end has no tracked features."""
    tracks = result.reconstruction.tracks
    if len(tracks.image) == 0:
        return ""
    count = coverage(tracks.x_px, result.lens)
    covered = 100 * float((count > 0).mean())
    errors = reprojection_errors_px(result.reconstruction)
    half = significant(float(np.median(errors)))
    low = (
        ""
        if covered > 60
        else " Features near the border tell most of the distortion: let the scene fill it."
    )
    return filled(
        "features.html",
        say=f"{len(tracks.image)} observations of {len(tracks.points_in_recon)} points lie in {covered:.0f} % of the "
        f"cells of the frame; half of the 3D points fall within {half} px of them.{low}",
        coverage=grid_figure("Features over the frame, all images", count, "features in a cell"),
        errors=bars_figure("Reprojection errors", *histogram(errors), "observations", "px"),
    )


def coverage(x_px: Float[ndarray, "k 2"], lens: Intrinsics) -> Int[ndarray, "rows columns"]:
    """How many features lie in each cell of the frame."""
    size = lens.width / CELLS
    rows = max(round(lens.height / size), 1)
    column, row = ((x_px + 0.5) / [size, lens.height / rows]).astype(int).T
    count = np.zeros((rows, CELLS), int)
    np.add.at(count, (row.clip(0, rows - 1), column.clip(0, CELLS - 1)), 1)
    return count


def reprojection_errors_px(reconstruction: Reconstruction) -> Float[ndarray, " k"]:
    """Distance of each feature from where its 3D point falls."""
    tracks = reconstruction.tracks
    errors = np.zeros(len(tracks.image))
    for k, pose in enumerate(reconstruction.recon_from_camera):
        seen = np.flatnonzero(tracks.image == k)
        x_in_camera = apply(inverse(pose), tracks.points_in_recon[tracks.point[seen]])
        miss = project(reconstruction.intrinsics, x_in_camera) - tracks.x_px[seen]
        errors[seen] = np.linalg.norm(miss, axis=1)
    return errors


def histogram(errors: Float[ndarray, " k"]) -> tuple[Int[ndarray, " b"], Float[ndarray, " c"]]:
    """Counts, and the edges of their bins; the last bin holds all that is beyond, too."""
    last = max(float(np.percentile(errors, FAR)), 1e-6)
    return np.histogram(errors.clip(0, last), BINS, (0.0, last))
