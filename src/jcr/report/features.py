"""The section on the features: where in the frame they lie, and how far their 3D points fall from them."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics, Reconstruction
from jcr.report.figures import bars_figure, grid_figure
from jcr.report.render import Section
from jcr.results import RunResult
from jcr.rounding import significant

CELLS = 16
"""Cells across the frame's width."""
BINS = 24
FAR = 99.0
"""Percent of the errors that the histogram shows; the rest is in its last bar."""
WELL_COVERED = 60.0
"""Percent of the cells."""


def features_section(result: RunResult) -> Section | None:
    """Coverage of the frame and reprojection errors; None where the back end has no tracked features."""
    tracks = result.reconstruction.tracks
    if len(tracks.image) == 0:
        return None
    count = coverage(tracks.x_px, result.intrinsics)
    covered = 100 * float((count > 0).mean())
    errors = reprojection_errors_px(result.reconstruction)
    content = {
        "observations": len(tracks.image),
        "points": len(tracks.points_in_recon),
        "covered": f"{covered:.0f}",
        "half_px": significant(float(np.median(errors))),
        "is_well_covered": covered > WELL_COVERED,
        "figures": [
            grid_figure("Features over the frame, all images", count, "features in a cell"),
            bars_figure("Reprojection errors", *histogram(errors), "observations", "px"),
        ],
    }
    return Section("features", content)


def coverage(x_px: Float[ndarray, "k 2"], intrinsics: Intrinsics) -> Int[ndarray, "rows columns"]:
    """How many features lie in each cell of the frame."""
    size = intrinsics.width / CELLS
    rows = max(round(intrinsics.height / size), 1)
    column, row = ((x_px + 0.5) / [size, intrinsics.height / rows]).astype(int).T
    count = np.zeros((rows, CELLS), int)
    np.add.at(count, (row.clip(0, rows - 1), column.clip(0, CELLS - 1)), 1)
    return count


def reprojection_errors_px(reconstruction: Reconstruction) -> Float[ndarray, " k"]:
    """Distance of each feature from where its 3D point falls."""
    return np.linalg.norm(reprojections_px(reconstruction), axis=1)


def reprojections_px(reconstruction: Reconstruction) -> Float[ndarray, "k 2"]:
    """From each feature to where its 3D point falls."""
    tracks = reconstruction.tracks
    errors = np.zeros_like(tracks.x_px)
    for k, camera_from_recon in enumerate(inverse(reconstruction.recon_from_camera)):
        seen = tracks.image == k
        x_in_camera = apply(camera_from_recon, tracks.points_in_recon[tracks.point[seen]])
        errors[seen] = project(reconstruction.intrinsics, x_in_camera) - tracks.x_px[seen]
    return errors


def histogram(errors: Float[ndarray, " k"]) -> tuple[Int[ndarray, " b"], Float[ndarray, " c"]]:
    """Counts, and the edges of their bins; the last bin holds all that is beyond, too."""
    last = max(float(np.percentile(errors, FAR)), 1e-6)
    return np.histogram(errors.clip(0, last), BINS, (0.0, last))
