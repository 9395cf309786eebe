"""Observations of points in images."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.records import Tracks


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Rig and camera of each image, and image, point and pixel of each observation."""

    rig: Int[ndarray, " n"]
    """Rig of each image."""
    camera: Int[ndarray, " n"]
    """Camera of each image."""
    image: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    """Pixels of the original, distorted image."""
    point: Int[ndarray, " k"]
    std_px: Float[ndarray, " k"]
    """Stated standard deviation of one coordinate, up to a common factor."""
    point_rows: Int[ndarray, " p"] | None = None
    """Row of each point among those that were given; None: all points."""

    @staticmethod
    def of_one_camera(tracks: Tracks, images: int) -> "Observations":
        """Return the observations of one camera, each of whose images is a rig."""
        each = np.arange(images)
        return Observations(
            rig=each,
            camera=np.zeros_like(each),
            image=tracks.image,
            x_px=tracks.x_px,
            point=tracks.point,
            std_px=np.ones(len(tracks.image)) if tracks.std_px is None else tracks.std_px,
        )


def sorted_by_point(observations: Observations, points: int) -> Observations:
    """Return the observations sorted by point and rig, without points that fewer than two show.

    The first of several observations of one point in one image is kept; the points are counted again.
    """
    rig = observations.rig[observations.image]
    order = np.lexsort((observations.image, rig, observations.point))
    point, image = observations.point[order], observations.image[order]
    order = order[np.r_[True, (np.diff(point) != 0) | (np.diff(image) != 0)][: len(order)]]
    count = np.bincount(observations.point[order], minlength=points)
    order = order[count[observations.point[order]] >= 2]
    kept, point = np.unique(observations.point[order], return_inverse=True)
    return replace(
        observations,
        image=observations.image[order],
        x_px=observations.x_px[order],
        point=point,
        std_px=observations.std_px[order],
        point_rows=kept,
    )
