"""Global alignment of pairwise pointmaps into one reconstruction (paper section III, eq. 1)."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jcr.camera import rays
from jcr.errors import InputError
from jcr.pointmaps.global_alignment.gauss_newton import ITERATIONS, AlignmentSolution, solve
from jcr.pointmaps.global_alignment.observations import AlignmentProblem, observe
from jcr.pointmaps.global_alignment.residuals import fitted_depth
from jcr.pointmaps.pairs import PairPredictions, read_pairs
from jcr.progress import Progress, silent
from jcr.records import Intrinsics

PIXELS = 2048
"""Pixels per image, the most confident of as many equal cells."""
LEAST_PIXELS = 50
"""Least number of pixels per image: several for each coarse cell of the correlation of residuals."""
DEPTH_CHUNK = 4096
"""Pixels at a time, so that the arrays of a chunk stay in the cache."""
CONTRADICTION = 4.0
"""A pair whose residual is this many times the median one is named to the user."""
USELESS = 0.2
"""Residual of the middle pair, relative to the distance, of pairs that do not belong together."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """One reconstruction from pairwise pointmaps: a camera and a depth map per image, a scale per pair.

    The recon frame is the camera frame of image 0; its unit is the geometric mean of the pairs' own units, so
    metric predictions give metres.
    """

    recon_from_camera: Float[ndarray, "n 4 4"]
    focal_px: tuple[float, float]
    """fx, fy, common to all images."""
    principal_point_px: tuple[float, float]
    depth: Float[ndarray, "n h w"]
    """Depth along the optical axis, recon units."""
    confidence: Float[ndarray, "n h w"]
    """Confidence of the network, averaged over the pairs, weighted by their agreement with this depth."""
    pair_scale: Float[ndarray, " e"]
    """σ_e: recon units per unit of the pair's pointmaps (paper eq. 1)."""
    pair_residual: Float[ndarray, " e"]
    """Typical distance of a pair's points from the reconstruction, relative to that from the camera."""
    covariance: Float[ndarray, "r r"]
    """Covariance of the steps of all cameras (translation, rotation), r = 6n; zero for image 0."""
    notes: tuple[str, ...] = ()
    """Pairs that contradict the others and count little."""
    warnings: tuple[str, ...] = ()
    """Faults of the alignment that the user must act on, such as pairs that agree on nothing."""

    def x_in_camera(self) -> Float[ndarray, "n h w 3"]:
        """Return the points of all pixels in their cameras' frames, float32."""
        _, height, width = self.depth.shape
        pinhole = Intrinsics(*self.focal_px, *self.principal_point_px, width, height)
        return rays(pinhole).astype(np.float32) * self.depth[..., None]


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
    problem = AlignmentProblem.of(predictions)
    return _dense_alignment(problem, solve(problem, pixels), progress or silent)


def _check_connected(predictions: PairPredictions) -> None:
    """Raise InputError naming the images that no chain of pairs joins to the first."""
    count, edges = predictions.image_count, predictions.edges
    if len(edges) == 0:
        raise InputError("the predictions have no pair; predict at least one")
    _, part = connected_components(csr_array((np.ones(len(edges)), edges.T), (count, count)), directed=False)
    if part.any():
        names = ", ".join(predictions.names[k] for k in np.flatnonzero(part != part[edges[0, 0]]))
        raise InputError(
            f"no chain of pairs joins {names} to the other images; predict pairs between them, "
            "or leave these images out"
        )


def _dense_alignment(problem: AlignmentProblem, solution: AlignmentSolution, progress: Progress) -> Alignment:
    """Return the alignment of a solution in its own recon frame, with the depth of every pixel."""
    predictions, state = problem.predictions, solution.state
    count, (height, width) = predictions.image_count, predictions.conf.shape[1:]
    depth = np.empty((count, height * width), np.float32)
    confidence = np.empty_like(depth)

    def settle(k: int) -> None:
        for start in range(0, height * width, DEPTH_CHUNK):
            chunk = slice(start, start + DEPTH_CHUNK)
            depth[k, chunk], confidence[k, chunk] = fitted_depth(
                observe(problem, k, chunk), state, solution.noise[k]
            )

    # numpy lets go of the interpreter during its loops, so threads share the cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, _ in enumerate(pool.map(settle, range(count)), start=1):
            progress("align pairs", done / count)
    focal = float(np.exp(state.log_focal))
    residual = np.zeros(len(predictions.edges))
    for o, noise in zip(solution.images, solution.noise, strict=True):
        np.maximum.at(residual, o.pair, np.sqrt(2 * noise.across**2 + noise.along**2))
    middle, notes, warnings = float(np.median(residual)), (), ()
    if len(bad := np.flatnonzero(residual > CONTRADICTION * middle)):
        names = predictions.names
        pairs = ", ".join(f"{names[n]}-{names[m]}" for n, m in predictions.edges[bad[:5]])
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        notes = (
            f"{len(bad)} of {len(residual)} pairs contradict the others and count little: {pairs}{more}",
        )
    if not solution.settled:
        warnings += (f"the alignment had not settled after {ITERATIONS} iterations and may be wrong",)
    if middle > USELESS:
        warnings += (
            f"the pairs disagree by {100 * middle:.0f} % of the distance; nothing can be built on them",
        )
    return Alignment(
        recon_from_camera=state.recon_from_camera,
        focal_px=(focal, focal * problem.aspect),
        principal_point_px=problem.principal_point_px,
        depth=depth.reshape(count, height, width),
        confidence=(np.exp(confidence) if problem.log_weight else confidence).reshape(count, height, width),
        pair_scale=np.exp(state.log_pair_scale),
        pair_residual=residual,
        covariance=solution.covariance,
        notes=notes,
        warnings=warnings,
    )
