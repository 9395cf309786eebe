"""How large the errors of image observations are: one model for every adjustment.

The size comes from the median point, for wrong matches are many; what neighbours share of their errors from sums over
cells of the images.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.adjust.elimination import point_blocks
from jcr.adjust.scene import Observations
from jcr.distributions import chi2
from jcr.least_squares import loss_weight

LOSS_SCALE = 2.0
"""Cauchy loss: observations count half at this many sigma."""
CELLS = 8
"""Across the width of an image: so near each other features share errors, of a texture, a shadow or what the distortion
model leaves."""
MIN_SIGMA_PX = 0.02
RATIOS = (0.25, 100.0)
"""Of the variances of other cameras' observations to that of the first's: of few points that only one other sees, a
camera seems as good as its weight makes it."""
FAR_OFF = 6.0
"""Median residuals; seven sigma."""


@dataclass(frozen=True)
class PixelNoise:
    """Errors of image observations."""

    sigma_px: Float[ndarray, " c"]
    """Of one coordinate, by camera."""
    inflation: float = 1.0
    """Of the variance of what many observations say together, because neighbours share errors; one for all cameras, for
    where points follow the few observations of one its own residuals do not show it."""

    def change(self, before: "PixelNoise") -> float:
        """Of the sizes, relative; the largest."""
        return float(np.abs(np.log(self.sigma_px / before.sigma_px)).max())

    def weights(
        self, residual_px: Float[ndarray, "k 2"], depth: Float[ndarray, " k"], camera: Int[ndarray, " k"]
    ) -> Float[ndarray, " k"]:
        """Inverse variances of observations under the Cauchy loss; those of points behind a camera are 0."""
        variance = self.sigma_px[camera] ** 2
        squared = (residual_px**2).sum(1) / variance
        weight = loss_weight("cauchy", squared / LOSS_SCALE**2) / (variance * self.inflation)
        return (depth > 1e-9) * weight


@dataclass(frozen=True)
class Layout:
    """What of the observations the estimate needs and no adjustment changes."""

    camera: Int[ndarray, " k"]
    """Of each observation."""
    point: Int[ndarray, " k"]
    cell: Int[ndarray, " k"]
    """The images of a fixed camera show the same features with the same errors: their cells are one."""
    median_square: Float[ndarray, " p"]
    """Median of a point's sum of squared residuals where an image coordinate's variance is 1: of the 2n errors of n
    views its position takes up 3."""

    @staticmethod
    def of(observations: Observations, widths: Int[ndarray, " c"]) -> "Layout":
        """Of observations in images of these widths (px), by camera."""
        camera = observations.camera[observations.image]
        column, row = (CELLS * observations.x_px / widths[camera, None]).astype(int).T
        keys = np.stack([observations.rig[observations.image], camera, row, column])
        _, cell = np.unique(keys, axis=1, return_inverse=True)
        freedom = np.maximum(2 * np.bincount(observations.point) - 3, 1)
        return Layout(camera, observations.point, cell.ravel(), chi2.ppf(0.5, freedom))


def pixel_noise(
    layout: Layout,
    residual_px: Float[ndarray, "k 2"],
    depth: Float[ndarray, " k"],
    ratio: Float[ndarray, " c"],
) -> PixelNoise:
    """From the median point none of whose observations is far off, and from cells of the images.

    `ratio` is that of the variances of each camera's observations to those of the first. Were errors independent, the
    squared sum over a cell of what each observation pulls would be, on average, the sum of the squares; what it is times
    that is what the errors that neighbours share cost of the images' information (the variance inflation of cluster
    sampling; Liang and Zeger, Biometrika 73, 1986).
    """
    relative = (residual_px**2).sum(1) / ratio[layout.camera]
    far = relative > FAR_OFF**2 * np.median(relative)
    squares = np.bincount(layout.point, relative) / layout.median_square
    clean = np.bincount(layout.point, far) == 0
    factor = float(np.median(squares[clean] if clean.any() else squares))
    noise = PixelNoise(np.maximum(np.sqrt(factor * ratio), MIN_SIGMA_PX))
    pull = noise.weights(residual_px, depth, layout.camera)[:, None] * residual_px
    sums = sum(float((np.bincount(layout.cell, along) ** 2).sum()) for along in pull.T)
    # Of points that are all behind their cameras nothing pulls.
    return replace(noise, inflation=max(1.0, sums / max(float((pull**2).sum()), 1e-300)))


def variance_ratios(
    layout: Layout,
    before: PixelNoise,
    residual_px: Float[ndarray, "k 2"],
    depth: Float[ndarray, " k"],
    by_point: Float[ndarray, "k 2 3"],
    starts: Int[ndarray, " p"],
) -> Float[ndarray, " c"]:
    """Variances of each camera's observations over those of the first.

    From their sums of squares over what is left of them after the points took their part (their leverage), for a camera
    whose residuals are small because points follow it is not the better one. `by_point` are derivatives by the points,
    `starts` each point's first observation.
    """
    count = len(before.sigma_px)
    ratio = np.ones(count)
    if count == 1:
        return ratio
    weight = replace(before, inflation=1.0).weights(residual_px, depth, layout.camera)
    j = np.sqrt(weight)[:, None, None] * by_point
    inverse = np.linalg.inv(point_blocks(j, starts))[layout.point]
    left = 1 - np.minimum(np.einsum("kai,kij,kaj->k", j, inverse, j) / 2, 1.0)
    square = (residual_px**2).sum(1)
    for c in range(count):
        rows = layout.camera == c
        if rows.any():
            tame = weight[rows] * before.sigma_px[c] ** 2
            ratio[c] = (tame @ square[rows]) / max(2 * float(tame @ left[rows]), 1e-12)
    return np.clip(ratio / max(ratio[0], 1e-12), *RATIOS)
