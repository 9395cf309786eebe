"""Estimate of the errors of image observations, one model for every adjustment.

The size comes from the median point, for wrong matches are many; what neighbours share of their errors from sums over
cells of the images.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.elimination import point_blocks
from jcr.least_squares import loss_weight

LOSS_SCALE = 2.0
"""Cauchy loss: observations count half at this many sigma."""
MIN_SIGMA_PX = 0.02
RATIOS = (0.25, 100.0)
"""Bounds of the ratio of the variances of other groups' observations to those of the first camera."""
FAR_OFF = 6.0
"""Median residuals; seven sigma."""
COMMON = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
"""Shares of the variance of the median observation that are tried as what all observations have in common."""
SCALE_STEPS = 10
NEAREST = 0.05
"""Least depth of an observation as a share of the median depth: no camera focuses on nearer points."""
LEAST_LEFT = 0.1
"""Least share of an observation's variance after its point took its part; below, the residual shows nothing of it."""


@dataclass(frozen=True)
class PixelNoise:
    """Errors of image observations."""

    sigma_px: Float[ndarray, " g"]
    """Standard deviation of one coordinate by group of observations: the features of each camera, then the corners of
    boards, which another detector finds."""
    inflation: float = 1.0
    """Factor on the variance of sums of many observations, because neighbours share errors. It is one for all cameras:
    where points follow the few observations of a camera, its own residuals do not show it."""
    common: float = 1.0
    """Share of the variance of a median observation that all have alike; the rest is as its match states it."""

    def change(self, before: "PixelNoise") -> float:
        """Return the largest relative change of the sizes."""
        return float(np.abs(np.log(self.sigma_px / before.sigma_px)).max())

    def variance_px2(self, layout: "Layout") -> Float[ndarray, " k"]:
        """Return the variance of each observation's coordinates, px², shape (n,)."""
        return self.sigma_px[layout.group] ** 2 * layout.relative_variance(self.common)

    def weights(
        self, residual_px: Float[ndarray, "k 2"], depth: Float[ndarray, " k"], layout: "Layout"
    ) -> Float[ndarray, " k"]:
        """Return the inverse variances of observations under the Cauchy loss.

        They are 0 for points behind a camera, or so near that no camera is in focus there.
        """
        variance = self.variance_px2(layout)
        squared = (residual_px**2).sum(1) / variance
        weight = loss_weight("cauchy", squared / LOSS_SCALE**2) / (variance * self.inflation)
        nearest = NEAREST * max(float(np.median(depth)), 0.0) if len(depth) else 0.0
        return (depth > max(nearest, 1e-9)) * weight


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Values of the observations that the estimate needs and no adjustment changes."""

    camera: Int[ndarray, " k"]
    """Camera of each observation."""
    group: Int[ndarray, " k"]
    """Group of each observation, as PixelNoise counts them."""
    groups: int
    point: Int[ndarray, " k"]
    cell: Int[ndarray, " k"]
    """Cell of each observation. The images of a fixed camera show the same features with the same errors: their cells
    are one."""
    stated_variance: Float[ndarray, " k"]
    """Variance that matching states, over that of the median observation."""
    median_square: Float[ndarray, " p"]
    """Median of a point's sum of squared residuals where an image coordinate's variance is 1: of the 2n errors of n
    views its position takes up 3, but for a corner of a board, whose place is known."""

    @property
    def states_variances(self) -> bool:
        """Whether matching distinguishes the observations."""
        return bool(np.ptp(self.stated_variance) > 0) if len(self.stated_variance) else False

    def relative_variance(self, common: float) -> Float[ndarray, " k"]:
        """Return the variance of each observation over the median one, all having this share in common."""
        return common + (1 - common) * self.stated_variance

    def squares_of_cells(self, pull: Float[ndarray, "k 2"]) -> float:
        """Return the sum of the squared sums of weighted residuals over cells."""
        return sum(float((np.bincount(self.cell, along) ** 2).sum()) for along in pull.T)


def pixel_noise(
    layout: Layout,
    residual_px: Float[ndarray, "k 2"],
    depth: Float[ndarray, " k"],
    ratio: Float[ndarray, " g"],
    common: float = 1.0,
) -> PixelNoise:
    """Return the pixel noise from the median point without outliers and from cells of the images.

    `ratio` is that of the variances of each group's observations to those of the first. With independent errors the
    squared sum of the weighted residuals over a cell is, on average, the sum of their squares. The factor beyond that
    is the information that errors shared by neighbours cost the images (variance inflation of cluster sampling; Liang
    and Zeger, Biometrika 73, 1986).
    """
    relative = (residual_px**2).sum(1) / (ratio[layout.group] * layout.relative_variance(common))
    far = relative > FAR_OFF**2 * np.median(relative)
    squares = np.bincount(layout.point, relative) / layout.median_square
    clean = np.bincount(layout.point, far) == 0
    factor = float(np.median(squares[clean] if clean.any() else squares))
    noise = PixelNoise(np.maximum(np.sqrt(factor * ratio), MIN_SIGMA_PX), common=common)
    pull = noise.weights(residual_px, depth, layout)[:, None] * residual_px
    # Of points that are all behind their cameras nothing pulls.
    inflation = layout.squares_of_cells(pull) / max(float((pull**2).sum()), 1e-300)
    return replace(noise, inflation=max(1.0, inflation))


def refined_noise(
    layout: Layout,
    before: PixelNoise,
    residual_px: Float[ndarray, "k 2"],
    depth: Float[ndarray, " k"],
    by_point: Float[ndarray, "k 2 3"],
    starts: Int[ndarray, " p"],
    known: Float[ndarray, "p 3 3"] | None = None,
) -> PixelNoise:
    """Return the pixel noise with the variances of each group over those of the first, and of matches as stated.

    Sums of squares are divided by the share of each variance that the leverage of the points left in the residuals: a
    group whose residuals are small because points follow it is not the better one. `by_point` are derivatives by the
    points, `starts` each point's first observation, `known` the information that each point has beside its observations.
    """
    weight = replace(before, inflation=1.0).weights(residual_px, depth, layout)
    j = np.sqrt(weight)[:, None, None] * by_point
    blocks = point_blocks(j, starts)
    inverse = np.linalg.inv(blocks if known is None else blocks + known)[layout.point]
    left = 1 - np.minimum(np.einsum("kai,kij,kaj->k", j, inverse, j) / 2, 1.0)
    ratio, tame = np.ones(layout.groups), weight * before.variance_px2(layout)
    square = (residual_px**2).sum(1) / layout.relative_variance(before.common)
    for group in range(layout.groups):
        rows = layout.group == group
        if rows.any() and layout.groups > 1:
            ratio[group] = (tame[rows] @ square[rows]) / max(2 * float(tame[rows] @ left[rows]), 1e-12)
    ratio = np.clip(ratio / max(ratio[0], 1e-12), *RATIOS)
    return pixel_noise(layout, residual_px, depth, ratio, _common_share(layout, residual_px, left, ratio))


def _common_share(
    layout: Layout,
    residual_px: Float[ndarray, "k 2"],
    left: Float[ndarray, " k"],
    ratio: Float[ndarray, " g"],
) -> float:
    """Return the most likely share of variance that all observations have alike.

    Each share has its most likely size, under the Student's t distribution whose negative logarithm is the loss.
    """
    if not layout.states_variances:
        return 1.0
    shown = left > LEAST_LEFT
    square = (residual_px[shown] ** 2).sum(1) / (ratio[layout.group] * left)[shown]

    def cost(common: float) -> float:
        relative = layout.relative_variance(common)[shown]
        variance = float(np.median(square / relative))
        for _ in range(SCALE_STEPS):
            weight = loss_weight("cauchy", square / (relative * variance) / LOSS_SCALE**2)
            variance = max(float((weight * square / relative).mean()) / 2, MIN_SIGMA_PX**2)
        heavy = LOSS_SCALE**2 / 2 * np.log1p(square / (relative * variance) / LOSS_SCALE**2)
        return float((heavy + np.log(relative * variance)).sum())

    return min(COMMON, key=cost)
