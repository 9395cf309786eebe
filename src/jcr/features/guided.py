"""Guided matching: along the epipolar lines that X and the robot predict, for pairs that did not match by themselves."""

import math

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.features.gate import Key
from jcr.features.matchers import Matcher
from jcr.features.verify import View, matched, pair_of
from jcr.geometry import rotation_angle, skew

RATIO = 0.85
"""Of the angles between a descriptor and its best and second best on the line; repeated patterns fail it."""
LARGEST_ANGLE = math.radians(50)
"""Between descriptors that match."""
LEAST_RIGHT = 0.5
"""Share of guided matches that one geometry must explain: chance fills the whole band."""
NARROWEST_PX, WIDEST_PX = 4.0, 25.0
"""Of the band around the line."""
TWICE_PX = 3.0
"""Between two places at which one keypoint may have been found."""


def band_px(focal_px: float, std_rad: float) -> float:
    """Half width of the band in which a match may lie, from the uncertainty (rad) of the predicted directions."""
    return float(np.clip(3 * focal_px * std_rad, NARROWEST_PX, WIDEST_PX))


def guided(
    matcher: Matcher,
    view: View,
    camera: pycolmap.Camera,
    key: Key,
    i_from_j: Float[ndarray, "4 4"],
    upright: Float[ndarray, " n"],
    std_rad: float,
) -> pycolmap.TwoViewGeometry | None:
    """The verified geometry of what matches along predicted epipolar lines; None where that is too little.

    `std_rad` is the uncertainty of the predicted directions.
    """
    i, j = key
    (start_i, of_i), (start_j, of_j) = (matcher.descriptors(k, float(upright[k])) for k in key)
    at = [slice(start, start + len(of)) for start, of in ((start_i, of_i), (start_j, of_j))]
    some = View.of([view.x_px[k][rows] for k, rows in zip(key, at, strict=True)], view.intrinsics)
    rows = guided_rows(some, 0, 1, of_i, of_j, i_from_j, band_px(view.intrinsics.fx, std_rad)) + [
        start_i,
        start_j,
    ]
    found = matched(view.x_px, camera, i, j, rows, matcher.seed, matcher.known)
    if found is None or len(found.inlier_matches) < LEAST_RIGHT * len(rows):
        return None
    pair = pair_of(view, i, j, found)
    wanted = i_from_j[:3, :3]
    near = any(
        rotation_angle(r.rotation.T @ wanted) < 3 * (std_rad + np.sqrt(np.trace(r.covariance[:3, :3])))
        for r in pair.readings
    )
    return found if near else None


def guided_rows(
    view: View,
    i: int,
    j: int,
    descriptor_i: Float[ndarray, "k d"],
    descriptor_j: Float[ndarray, "l d"],
    i_from_j: Float[ndarray, "4 4"],
    band: float,
) -> Int[ndarray, "m 2"]:
    """Keypoints of two images that are each other's best within `band` pixels of their epipolar lines.

    Descriptors are of unit length.
    """
    h_i, h_j = (np.concatenate([view.rays[k], np.ones((len(view.rays[k]), 1))], 1) for k in (i, j))
    if min(len(h_i), len(h_j)) < 2:
        return np.zeros((0, 2), dtype=int)
    length = max(float(np.linalg.norm(i_from_j[:3, 3])), 1e-9)
    essential = skew(i_from_j[:3, 3] / length) @ i_from_j[:3, :3]
    line_i, line_j = h_j @ essential.T, h_i @ essential
    off = np.abs(h_i @ line_i.T)
    # Of its distances from the two lines a match has the larger: that whose line has the smaller norm.
    norm_i, norm_j = (np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12) for line in (line_i, line_j))
    cosine = descriptor_i @ descriptor_j.T
    cosine[off >= band / view.intrinsics.fx * np.minimum(norm_i, norm_j[:, None])] = -1.0
    best = cosine.argmax(1)
    nearest = np.arccos(np.clip(cosine[np.arange(len(best)), best], -1, 1))
    row = np.flatnonzero((cosine.argmax(0)[best] == np.arange(len(best))) & (nearest < LARGEST_ANGLE))
    others, x_px, at = cosine[row], view.x_px[j], view.x_px[j][best[row]]
    # A keypoint found twice is no rival of itself.
    others[(at[:, :1] - x_px[:, 0]) ** 2 + (at[:, 1:] - x_px[:, 1]) ** 2 < TWICE_PX**2] = -1.0
    good = row[nearest[row] < RATIO * np.arccos(np.clip(others.max(1), -1, 1))]
    return np.stack([good, best[good]], 1)
