"""Guided matching: along the epipolar lines that X and the robot predict, for pairs that did not match by themselves."""

import math

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.geometry import rotation_angle, skew
from jcr.match.gate import Key
from jcr.match.matchers import Matcher
from jcr.match.verify import View, matched, pair_of

RATIO = 0.85
"""Of the angles between a descriptor and its best and second best on the line; repeated patterns fail it."""
LARGEST_ANGLE = math.radians(50)
"""Between descriptors that match."""
LEAST_RIGHT = 0.5
"""Share of guided matches that one geometry must explain: chance fills the whole band."""
NARROWEST_PX, WIDEST_PX = 4.0, 25.0
"""Of the band around the line."""


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
    length = max(float(np.linalg.norm(i_from_j[:3, 3])), 1e-9)
    essential = skew(i_from_j[:3, 3] / length) @ i_from_j[:3, :3]
    line_i, line_j = h_j @ essential.T, h_i @ essential
    off = np.abs(h_i @ line_i.T)
    off_i = off / np.maximum(np.linalg.norm(line_i[:, :2], axis=1), 1e-12)
    off_j = off / np.maximum(np.linalg.norm(line_j[:, :2], axis=1), 1e-12)[:, None]
    near = np.maximum(off_i, off_j) < band / view.intrinsics.fx
    alike = np.where(near, descriptor_i @ descriptor_j.T, -1.0)
    if min(alike.shape) < 2:
        return np.zeros((0, 2), dtype=int)
    best = alike.argmax(1)
    row = np.arange(len(alike))
    first = alike[row, best]
    others = alike.copy()
    # A keypoint found twice is no rival of itself.
    twice = np.linalg.norm(view.x_px[j][best][:, None] - view.x_px[j][None], axis=2) < 3.0
    others[twice] = -1.0
    angle, next_angle = (np.arccos(np.clip(of, -1, 1)) for of in (first, others.max(1)))
    good = (alike.argmax(0)[best] == row) & (angle < LARGEST_ANGLE) & (angle < RATIO * next_angle)
    return np.stack([row[good], best[good]], 1)
