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
from jcr.pointmaps.global_alignment.gauss_newton import WEIGHT_ROUNDS, AlignmentSolution, solve
from jcr.pointmaps.global_alignment.observations import AlignmentProblem, observe
from jcr.pointmaps.global_alignment.residuals import fitted_depth
from jcr.pointmaps.pair_predictions import PairPredictions, read_pairs
from jcr.progress import Progress, silent
from jcr.records import Intrinsics

PIXELS = 2048
"""Number of pixels used per image: the most confident one of each of as many equal cells."""
DEPTH_CHUNK = 4096
"""Number of pixels processed at a time, so that their arrays stay in the cache."""
REPORTED_RATIO = 4.0
"""Ratio of a pair's residual to the median residual above which the user is told of the pair."""
USELESS = 0.2
"""Median residual of the pairs, relative to the distance, above which the pairs do not belong together."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Camera pose and depth map of each image, and scale of each pair, from pairwise pointmaps.

    The recon frame is the camera frame of image 0. Its unit is the geometric mean of the pairs' own units, so metric
    predictions give metres.
    """

    recon_from_camera: Float[ndarray, "n 4 4"]
    focal_px: tuple[float, float]
    """Focal lengths fx, fy, common to all images."""
    principal_point_px: tuple[float, float]
    depth: Float[ndarray, "n h w"]
    """Depth along the optical axis, recon units."""
    confidence: Float[ndarray, "n h w"]
    """Network's confidence, averaged over the pairs and weighted by their agreement with this depth."""
    pair_scale: Float[ndarray, " e"]
    """Scale σ_e of each pair: recon units per unit of the pair's pointmaps (paper eq. 1)."""
    pair_residual: Float[ndarray, " e"]
    """Typical distance of a pair's points from the reconstruction, relative to their distance from the camera."""
    covariance: Float[ndarray, "r r"]
    """Covariance of the steps of all camera poses (translation, rotation), r = 6n; zero for image 0."""
    notes: tuple[str, ...] = ()
    """Messages about pairs that contradict the others and have little weight."""
    warnings: tuple[str, ...] = ()
    """Faults of the alignment that the user must act on, such as pairs that do not agree at all."""

    def x_in_camera(self) -> Float[ndarray, "n h w 3"]:
        """Return the point of every pixel in its own camera's frame, recon units, float32."""
        _, height, width = self.depth.shape
        pinhole = Intrinsics(*self.focal_px, *self.principal_point_px, width, height)
        return rays(pinhole).astype(np.float32) * self.depth[..., None]


def global_align(pairs: Path | str | PairPredictions, progress: Progress = silent) -> Alignment:
    """Estimate camera poses, focal length, depths and pair scales from pairwise pointmaps, or from their npz file.

    The focal length is estimated from the pointmaps. The principal point and the ratio fy / fx are those of the
    predictions' intrinsics; without intrinsics they are the image's middle and 1. Raises InputError for a file that
    cannot be used, and for images that no chain of pairs connects. Raises RejectedError where the pointmaps do not
    determine the cameras.
    """
    predictions = pairs if isinstance(pairs, PairPredictions) else read_pairs(Path(pairs))
    count, edges = predictions.image_count, predictions.edges
    if len(edges) == 0:
        raise InputError("the predictions have no pair; predict at least one")
    _, part = connected_components(csr_array((np.ones(len(edges)), edges.T), (count, count)), directed=False)
    if part.any():
        names = ", ".join(predictions.names[k] for k in np.flatnonzero(part != part[edges[0, 0]]))
        raise InputError(
            f"no chain of pairs joins {names} to the other images; predict pairs between them, or leave these out"
        )
    problem = AlignmentProblem.of(predictions)
    return _dense_alignment(problem, solve(problem, PIXELS), progress)


def _dense_alignment(problem: AlignmentProblem, solution: AlignmentSolution, progress: Progress) -> Alignment:
    """Return the result of the alignment with depth and confidence of every pixel, not only of those that solved it."""
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

    # numpy releases the interpreter lock during its loops, so that threads use all cores.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, _ in enumerate(pool.map(settle, range(count)), start=1):
            progress("align pairs", done / count)
    focal = float(np.exp(state.log_focal))
    residual = np.zeros(len(predictions.edges))
    for o, noise in zip(solution.images, solution.noise, strict=True):
        np.maximum.at(residual, o.pair, np.sqrt(2 * noise.across**2 + noise.along**2))
    middle, notes, warnings = float(np.median(residual)), (), ()
    if len(bad := np.flatnonzero(residual > REPORTED_RATIO * middle)):
        names = predictions.names
        pairs = ", ".join(f"{names[n]}-{names[m]}" for n, m in predictions.edges[bad[:5]])
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        notes = (
            f"{len(bad)} of {len(residual)} pairs contradict the others and count little: {pairs}{more}",
        )
    if not solution.settled:
        warnings += (f"the alignment had not settled after {WEIGHT_ROUNDS} rounds and may be wrong",)
    if middle > USELESS:
        warnings += (f"the pairs disagree by {100 * middle:.0f} % of distance; nothing can be built on them",)
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
