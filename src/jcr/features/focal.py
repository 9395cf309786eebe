"""The focal length by which the angles between cameras become those between grippers, where no intrinsics are given."""

import math
from collections.abc import Iterable

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from jcr.features.gate import Key
from jcr.features.verify import View, matrices
from jcr.geometry import rotation_angle
from jcr.records import Intrinsics

LADDER = np.geomspace(0.35, 2.5, 40)
"""Focal lengths that are tried, in long sides."""
TOLERANCE = math.radians(1.5)
LEAST_SUPPORT = 3.0
"""Pairs that must agree at the best one; with fewer any focal length does."""
MATCHES = 200
"""Largest number of a pair's matches by which points in front of both cameras are counted."""


def focal_by_robot(
    x_px: list[Float[ndarray, "_ 2"]],
    size: tuple[int, int],
    geometries: Iterable[tuple[Key, pycolmap.TwoViewGeometry]],
    motion: Float[ndarray, "n n 4 4"],
) -> Intrinsics | None:
    """Undistorted intrinsics with square pixels and its centre in the middle; None where too few pairs agree on one."""
    width, height = size
    angle = np.asarray(rotation_angle(motion[..., :3, :3]))
    known = [item for item in geometries if angle[item[0]] > math.radians(8)]
    of_gripper = np.array([angle[key] for key, _ in known])
    best, support = None, LEAST_SUPPORT
    for factor in LADDER:
        focal = float(factor * max(size))
        intrinsics = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
        readings = [_rotations(x_px, intrinsics, key, geometry) for key, geometry in known]
        of_pair = np.repeat(np.arange(len(known)), np.array([len(one) for one in readings], int))
        rotations = np.array([rotation for one in readings for rotation in one]).reshape(-1, 3, 3)
        gap = np.full(len(known), np.inf)
        np.minimum.at(gap, of_pair, np.abs(rotation_angle(rotations) - of_gripper[of_pair]))
        agreeing = float(np.exp(-0.5 * (gap / TOLERANCE) ** 2).sum())
        if agreeing > support:
            best, support = intrinsics, agreeing
    return best


def _rotations(
    x_px: list[Float[ndarray, "_ 2"]],
    intrinsics: Intrinsics,
    key: Key,
    geometry: pycolmap.TwoViewGeometry,
) -> list[Float[ndarray, "3 3"]]:
    """Rotations that a geometry may mean."""
    rows = np.asarray(geometry.inlier_matches, dtype=int)[:MATCHES]
    essential, homography = matrices(geometry, intrinsics)
    view = View.of([x_px[key[0]][rows[:, 0]], x_px[key[1]][rows[:, 1]]], intrinsics)
    found = []
    if homography is not None:
        count, rotations, _, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
        rays = np.concatenate([view.rays[0], np.ones((len(rows), 1))], 1)
        found += [rotations[k] for k in range(count) if np.mean(rays @ normals[k][:, 0] > 0) > 0.9]
    elif essential is not None:
        found.append(cv2.recoverPose(essential, view.rays[0], view.rays[1], np.eye(3), distanceThresh=1e6)[1])
    return found
