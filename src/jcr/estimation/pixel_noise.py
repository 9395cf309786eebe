"""Estimate of the pixel noise: size of the errors of image observations, and correlation between neighbours.

The size comes from the median point, because many matches are wrong. The correlation comes from sums over image cells.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.elimination import point_blocks
from jcr.least_squares import loss_weight

LOSS_SCALE = 2.0
"""Scale of the Cauchy loss: residual in standard deviations at which an observation has half its weight."""
MIN_SIGMA_PX = 0.02
"""Lower bound of the estimated standard deviation, px."""
RATIOS = (0.25, 100.0)
"""Bounds of a group's variance over that of the first camera's features."""
FAR_OFF = 6.0
"""Multiple of the median residual above which an observation is an outlier, about seven standard deviations."""
COMMON = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
"""Candidate values of `PixelNoise.common`."""
SCALE_STEPS = 10
"""Number of reweighted estimates of the variance for each candidate in COMMON."""
NEAREST = 0.05
"""Smallest depth of an observation over the median depth; a camera does not focus on nearer points."""
LEAST_LEFT = 0.1
"""Smallest share of an observation's variance in its residual (one minus leverage of its point) that is used."""


@dataclass(frozen=True)
class PixelNoise:
    """Sizes of the errors of image observations, and their correlation."""

    sigma_px: Float[ndarray, " g"]
    """Standard deviation of one pixel coordinate for each of g groups: features of each camera, then board corners."""
    inflation: float = 1.0
    """Factor on all variances for correlated errors of neighbouring observations. One factor serves all cameras: the
    residuals of a camera with few observations do not show it."""
    common: float = 1.0
    """Share c of the variance that is equal for all observations; the share 1 − c varies as the matching states."""

    def variance_px2(self, layout: "Layout") -> Float[ndarray, " k"]:
        """Return the variance (px²) of one pixel coordinate of each of k observations, without `inflation`."""
        return self.sigma_px[layout.group] ** 2 * layout.relative_variance(self.common)

    def weights(
        self, residual_px: Float[ndarray, "k 2"], depth: Float[ndarray, " k"], layout: "Layout"
    ) -> Float[ndarray, " k"]:
        """Return the weight (1/px²) of each of k observations: Cauchy weight of its residual over its variance.

        The variance includes the inflation. `depth` is z of each observed point in the camera frame; points behind a
        camera, or nearer than NEAREST of the median depth, have weight 0.
        """
        variance = self.variance_px2(layout)
        squared = (residual_px**2).sum(1) / variance
        weight = loss_weight("cauchy", squared / LOSS_SCALE**2) / (variance * self.inflation)
        nearest = NEAREST * max(float(np.median(depth)), 0.0) if len(depth) else 0.0
        return (depth > max(nearest, 1e-9)) * weight


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Constant data of k observations for the estimate of pixel noise: groups, points, image cells, stated variances.

    A group is the observations of one camera, or of all board corners.
    """

    camera: Int[ndarray, " k"]
    """Camera of each observation."""
    group: Int[ndarray, " k"]
    """Group of each observation, a row of PixelNoise.sigma_px."""
    groups: int
    """Number of groups of observations."""
    point: Int[ndarray, " k"]
    """Point of each observation."""
    cell: Int[ndarray, " k"]
    """Image cell of each observation. All images of a fixed camera share their cells, since the same features have the
    same errors in each."""
    stated_variance: Float[ndarray, " k"]
    """Variance stated by the matching, over that of the median observation."""
    median_square: Float[ndarray, " p"]
    """Median of each point's sum of squared residuals for unit variance: χ² with 2n − 3 degrees of freedom for n views,
    or 2n for a board corner, whose position is known."""

    @property
    def states_variances(self) -> bool:
        """Whether `stated_variance` differs between observations; if not, all pixels have the same variance."""
        return bool(np.ptp(self.stated_variance) > 0) if len(self.stated_variance) else False

    def relative_variance(self, common: float) -> Float[ndarray, " k"]:
        """Return each observation's variance over that of the median one: common + (1 − common) · stated variance.

        `common` is the share of the variance that all observations have alike.
        """
        return common + (1 - common) * self.stated_variance

    def squares_of_cells(self, pull: Float[ndarray, "k 2"]) -> float:
        """Return the sum over image cells and both pixel axes of (sum of the weighted residuals `pull` in the cell)²."""
        return sum(float((np.bincount(self.cell, along) ** 2).sum()) for along in pull.T)


def pixel_noise(
    layout: Layout,
    residual_px: Float[ndarray, "k 2"],
    depth: Float[ndarray, " k"],
    ratio: Float[ndarray, " g"],
    common: float = 1.0,
) -> PixelNoise:
    """Return the pixel noise: standard deviation of each of g groups, and inflation by correlation in image cells.

    `ratio` (g,) is each group's variance over that of the first. The standard deviations fit the median over points
    without outliers of the sum of squared residuals. `depth` is z in the camera frame; `common` is `PixelNoise.common`.
    For independent errors, the squared sum of weighted residuals over a cell equals on average the sum of squares; the
    inflation is the factor by which it exceeds this (variance inflation of cluster sampling; Liang and Zeger,
    Biometrika 73, 1986).
    """
    relative = (residual_px**2).sum(1) / (ratio[layout.group] * layout.relative_variance(common))
    far = relative > FAR_OFF**2 * np.median(relative)
    squares = np.bincount(layout.point, relative) / layout.median_square
    clean = np.bincount(layout.point, far) == 0
    factor = float(np.median(squares[clean] if clean.any() else squares))
    noise = PixelNoise(np.maximum(np.sqrt(factor * ratio), MIN_SIGMA_PX), common=common)
    pull = noise.weights(residual_px, depth, layout)[:, None] * residual_px
    # All weights are 0 if all points are behind their cameras.
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
    """Return the pixel noise with new estimates of the variance of each group and of the common share.

    Squared residuals are corrected for the leverage of the points, since a fitted point reduces its own residuals.
    `before` is the previous estimate, which gives the weights; `depth` is z in the camera frame. `by_point` are
    derivatives by the points, `starts` each point's first observation, and `known` is the information matrix of each
    point from other sources than its observations; None: there is none.
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
    """Return the likeliest value of `PixelNoise.common` among COMMON, under the t distribution of the Cauchy loss.

    `left` is the share of each observation's variance that the fit leaves in its residual; `ratio` as in `pixel_noise`.
    """
    if not layout.states_variances:
        return 1.0
    shown = left > LEAST_LEFT
    square = (residual_px[shown] ** 2).sum(1) / (ratio[layout.group] * left)[shown]

    def cost(common: float) -> float:
        """Return twice the negative log likelihood of a common share, at its likeliest variance."""
        relative = layout.relative_variance(common)[shown]
        variance = float(np.median(square / relative))
        for _ in range(SCALE_STEPS):
            weight = loss_weight("cauchy", square / (relative * variance) / LOSS_SCALE**2)
            variance = max(float((weight * square / relative).mean()) / 2, MIN_SIGMA_PX**2)
        heavy = LOSS_SCALE**2 / 2 * np.log1p(square / (relative * variance) / LOSS_SCALE**2)
        return float((heavy + np.log(relative * variance)).sum())

    return min(COMMON, key=cost)
