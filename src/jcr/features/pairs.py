"""Which pairs of images to match: all of a few images, of many those that are near or see the same."""

import math

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.camera import project
from jcr.features.epipolar import scene_points, translation_of_x
from jcr.features.gate import Gate, Key
from jcr.features.verify import View
from jcr.geometry import apply, inverse, motion_length
from jcr.records import Intrinsics

FIRST_NEIGHBOURS, NEIGHBOURS = 4, 8
"""Of an image, by the way between grippers: from which X is sought, and where these do not show it."""
FEW = 16
"""A capture of so few images has every pair matched at once: cheap, and a pair that only happens to match ties a camera
whose others are far (doosan_bench: one camera 12 mm from its gripper with the nearest alone, 7 mm with every pair)."""
PARTNERS = 8
"""Of an image, by what both see, once X is known."""
WIDEST = math.radians(60)
"""Between two viewing directions: nothing matches beyond."""
LEAST_COMMON = 0.25
"""Share of the scene in an image that the other must see, too."""


def all_pairs(n: int) -> list[Key]:
    """Every pair of n images."""
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def near_pairs(motion: Float[ndarray, "n n 4 4"], neighbours: int) -> list[Key]:
    """The nearest neighbours of every image by the gripper's way; in proportion to n."""
    return _best(-np.asarray(motion_length(motion)), neighbours)


def seen_in_common(view: View, found: Gate, motion: Float[ndarray, "n n 4 4"]) -> list[Key]:
    """The partners of every image with which it shares most of the scene, by X and the points seen so far."""
    x = translation_of_x(found, motion)
    if x is None:
        return []
    points = scene_points(view, found, motion, x)
    if len(points) < 20:
        return []
    first_from_camera = motion[0] @ x.gripper_from_camera
    camera_from_first = inverse(first_from_camera)
    inside = np.stack([_in_image(view.intrinsics, apply(pose, points)) for pose in camera_from_first])
    counted = inside.astype(np.float32)  # of 200 images 10⁷ numbers
    common = counted @ counted.T
    share = common / np.maximum(inside.sum(1), 1)[:, None]
    toward = first_from_camera[:, :3, 2]
    between = np.arccos(np.clip(toward @ toward.T, -1, 1))
    score = np.where((between < WIDEST) & (share > LEAST_COMMON), share * np.cos(between), -np.inf)
    return _best(score, PARTNERS)


def _in_image(intrinsics: Intrinsics, x_in_camera: Float[ndarray, "p 3"]) -> Bool[ndarray, " p"]:
    """Which points an image shows."""
    inside = x_in_camera[:, 2] > 0
    x_px = project(intrinsics, x_in_camera[inside])
    inside[inside] = ((x_px > -0.5) & (x_px < [intrinsics.width - 0.5, intrinsics.height - 0.5])).all(1)
    return inside


def _best(score: Float[ndarray, "n n"], count: int) -> list[Key]:
    """The `count` partners of every image with the highest finite scores, as pairs."""
    score = score.copy()
    np.fill_diagonal(score, -np.inf)
    order = np.argsort(-score, axis=1, kind="stable")[:, :count]
    return sorted(
        {
            (min(i, int(j)), max(i, int(j)))
            for i, partners in enumerate(order)
            for j in partners
            if np.isfinite(score[i, j])
        }
    )
