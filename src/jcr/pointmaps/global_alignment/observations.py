"""Pointmaps of all pairs at chosen pixels of one image, as arrays."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import InputError
from jcr.pointmaps.pair_predictions import PairPredictions

CELL_SIDE = 4
"""Number of cells along each side of the image, whose mean residuals measure the correlation of residuals."""
POOR = 0.2
"""Least weight of a cell's best pixel, relative to the 90 % quantile over the cells; a cell below it is left out."""


@dataclass(frozen=True)
class AlignmentProblem:
    """Pairwise predictions to align, the fixed principal point and fy / fx, and the rule for weights by confidence."""

    predictions: PairPredictions
    principal_point_px: tuple[float, float]
    """Principal point x, y on the pointmaps' grid; pixel (0, 0) is the centre of the top-left pixel."""
    aspect: float
    """Ratio fy / fx."""
    log_weight: bool
    """True if confidences C are at least 1 as in DUSt3R, with weight log C; otherwise they are weights."""

    @classmethod
    def of(cls, predictions: PairPredictions) -> "AlignmentProblem":
        """Return the problem of aligning these predictions.

        If the predictions have no intrinsics, the principal point is the middle of the grid, and fy / fx is 1.
        Confidences are treated as those of DUSt3R (`weigh`) if any is above 1.
        """
        given = predictions.intrinsics
        height, width = predictions.conf.shape[1:]
        middle = ((width - 1) / 2, (height - 1) / 2) if given is None else (given.cx, given.cy)
        largest = max(float(conf.max()) for conf in predictions.conf)
        return cls(predictions, middle, given.fy / given.fx if given else 1.0, largest > 1.0)

    def weigh(self, confidence: Float[ndarray, "*k"]) -> Float[ndarray, "*k"]:
        """Return the weights of confidences C: log C, at least 0, if `log_weight` (DUSt3R), otherwise C itself."""
        return np.log(np.maximum(confidence, 1.0)) if self.log_weight else confidence

    def observe_all(self, count: int) -> "list[ImageObservations]":
        """Return for each image the pointmaps of all its pairs at the most confident pixels.

        One pixel is taken from each of about `count` equal cells of the image. Equal cells cover the whole field of
        view, which a ranking by confidence alone would not. Cells without a confident pixel (sky) are left out (POOR).
        Raises InputError for an image without any confidence.
        """
        predictions = self.predictions
        height, width = predictions.conf.shape[1:]
        side = np.sqrt(max(1.0, height * width / count))
        rows, columns = max(1, round(height / side)), max(1, round(width / side))
        y, x = np.indices((height, width)).reshape(2, -1)
        cell = y * rows // height * columns + x * columns // width
        by_cell = np.argsort(cell, kind="stable")
        starts = np.searchsorted(cell[by_cell], np.arange(rows * columns))

        total = np.zeros((predictions.image_count, height * width), np.float32)
        for edge, *confidences in zip(predictions.edges, predictions.conf, predictions.conf2, strict=True):
            for image, confidence in zip(edge, confidences, strict=True):
                total[image] += confidence.ravel()
        shown = np.bincount(predictions.edges.ravel(), minlength=len(total)).astype(np.float32)
        chosen = []
        for k, weight in enumerate(self.weigh(total / shown[:, None])):
            best = np.maximum.reduceat(weight[by_cell], starts)
            if best.max() <= 0:
                raise InputError(f"image {predictions.names[k]} has no confident pixel; leave it out")
            winners = by_cell[weight[by_cell] == best[cell[by_cell]]]
            winners = winners[np.unique(cell[winners], return_index=True)[1]]
            chosen.append(observe(self, k, winners[best > POOR * np.quantile(best, 0.9)]))
        return chosen


@dataclass(frozen=True, kw_only=True)
class ImageObservations:
    """Pointmaps of one image at m chosen pixels, from k pairs, as float32 arrays with pixels as the last axis.

    The first of the k are second views: pointmaps in the frame of another camera. The others are in the image's own
    camera frame.
    """

    image: int
    second_count: int
    pixel_offset: Float[ndarray, "2 m"]
    """Pixel x, y minus the principal point, with y divided by fy/fx; divided by fx it is the ray at unit depth."""
    cell: Float[ndarray, "m c"]
    """Indicator: 1 where pixel m lies in coarse cell c, else 0."""
    pair: Int[ndarray, " k"]
    observer: Int[ndarray, " k"]
    """Image in whose camera frame each pointmap is."""
    direction: Float[ndarray, "k 3 m"]
    """Unit vectors from the observer to the predicted points, in the observer's camera frame."""
    log_range: Float[ndarray, "k m"]
    """Log of the points' distance from the observer, in the pair's unit."""
    weight: Float[ndarray, "k m"]


def observe(problem: AlignmentProblem, image: int, pixels: Int[ndarray, " m"] | slice) -> ImageObservations:
    """Return the pointmaps of all pairs that contain `image`, at its `pixels`.

    A pixel is given by its index row · width + column on the pointmaps' grid.
    """
    predictions = problem.predictions
    height, width = predictions.conf.shape[1:]
    as_first, as_second = (np.flatnonzero(predictions.edges[:, side] == image) for side in (0, 1))
    sources = (
        (as_second, predictions.pts3d_in_other_view, predictions.conf2),
        (as_first, predictions.pts3d, predictions.conf),
    )
    points = np.stack([view[e].reshape(-1, 3)[pixels].T for edges, view, _ in sources for e in edges])
    confidence = np.stack([conf[e].ravel()[pixels] for edges, _, conf in sources for e in edges])
    distance = np.sqrt(np.einsum("kcm,kcm->km", points, points))
    usable = distance > 1e-12
    distance[~usable] = 1.0
    y, x = np.divmod(np.arange(height * width)[pixels], width)
    cx, cy = problem.principal_point_px
    coarse = (y * CELL_SIDE // height) * CELL_SIDE + x * CELL_SIDE // width
    pair = np.concatenate([as_second, as_first])
    return ImageObservations(
        image=image,
        second_count=len(as_second),
        pixel_offset=np.stack([x - cx, (y - cy) / problem.aspect]).astype(np.float32),
        cell=(coarse[:, None] == np.arange(CELL_SIDE**2)).astype(np.float32),
        pair=pair,
        observer=predictions.edges[pair, 0],
        direction=points / distance[:, None],
        log_range=np.log(distance),
        weight=np.where(usable, problem.weigh(confidence), np.float32(0.0)),
    )
