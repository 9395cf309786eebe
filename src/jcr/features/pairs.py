"""Choice of the pairs of images to match: all of a few images, of many those that are near or see the same points."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.features.epipolar import scene_points, translation_of_x
from jcr.features.gate import Gate, Key
from jcr.features.verify import View
from jcr.geometry import apply, inverse, motion_length, rotation_angle
from jcr.records import Intrinsics

FIRST_NEIGHBOURS, NEIGHBOURS = 4, 8
"""Numbers of partners of an image by the gripper's motion: to find X, and where these do not show it."""
FEW = 16
"""Largest number of images of which every pair is matched at once. It is cheap, and a pair that happens to match may
tie a camera that is far from all others (doosan_bench: 12 mm from its gripper with the nearest alone, 7 mm with all)."""
PARTNERS = 8
"""Number of partners of an image by the points that both see, once X is known."""
WIDEST = math.radians(60)
"""Largest angle between two viewing directions; nothing matches beyond."""
LEAST_COMMON = 0.25
"""Least share of the scene in an image that the other must see, too."""
SAME_VIEWPOINT = 5e-3, math.radians(1)
"""m, rad: images between which the gripper moved by less repeat one viewpoint, and show no parallax."""


def all_pairs(n: int) -> list[Key]:
    """Return every pair of n images."""
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def near_pairs(motion: Float[ndarray, "n n 4 4"], neighbours: int) -> list[Key]:
    """Return the pairs of every image with its nearest viewpoints by the gripper's motion, in proportion to n."""
    return _best(-np.asarray(motion_length(motion)), neighbours, viewpoints(motion))


def viewpoints(motion: Float[ndarray, "n n 4 4"]) -> Int[ndarray, " n"]:
    """Return the row of the first image of each image's viewpoint."""
    metres, radians = SAME_VIEWPOINT
    way = np.linalg.norm(motion[..., :3, 3], axis=-1)
    same = (way < metres) & (np.asarray(rotation_angle(motion[..., :3, :3])) < radians)
    first = np.arange(len(motion))
    for row in range(len(motion)):
        if first[row] == row:
            first[(first > row) & same[row]] = row
    return first


def seen_in_common(view: View, found: Gate, motion: Float[ndarray, "n n 4 4"]) -> list[Key]:
    """Return the pairs of every image with the viewpoints that share most of its scene, by X and the points so far."""
    x = translation_of_x(found, motion)
    if x is None:
        return []
    points = scene_points(view, found, motion, x)
    if len(points) < 20:
        return []
    first_from_camera = motion[0] @ x
    camera_from_first = inverse(first_from_camera)
    inside = np.stack([_in_image(view.intrinsics, apply(pose, points)) for pose in camera_from_first])
    counted = inside.astype(np.float32)  # of 200 images 10⁷ numbers
    common = counted @ counted.T
    share = common / np.maximum(inside.sum(1), 1)[:, None]
    toward = first_from_camera[:, :3, 2]
    between = np.arccos(np.clip(toward @ toward.T, -1, 1))
    score = np.where((between < WIDEST) & (share > LEAST_COMMON), share * np.cos(between), -np.inf)
    return _best(score, PARTNERS, viewpoints(motion))


def _in_image(intrinsics: Intrinsics, x_in_camera: Float[ndarray, "p 3"]) -> Bool[ndarray, " p"]:
    """Test which points an image shows."""
    inside = x_in_camera[:, 2] > 0
    x_px = project(intrinsics, x_in_camera[inside])
    inside[inside] = ((x_px > -0.5) & (x_px < [intrinsics.width - 0.5, intrinsics.height - 0.5])).all(1)
    return inside


def _best(score: Float[ndarray, "n n"], count: int, viewpoint: Int[ndarray, " n"]) -> list[Key]:
    """Return pairs of every image with the `count` other viewpoints of highest finite score, one image of each.

    Repeats of a viewpoint take different images of another one, so that all are tied together and average their noise.
    """
    repeat = np.array([(viewpoint[:row] == of).sum() for row, of in enumerate(viewpoint)])
    pairs = set()
    for i, of_image in enumerate(score):
        order = np.argsort(-of_image, kind="stable")
        order = order[np.isfinite(of_image[order]) & (viewpoint[order] != viewpoint[i])]
        best = viewpoint[order][np.sort(np.unique(viewpoint[order], return_index=True)[1])]
        for rank, other in enumerate(best[:count]):
            images = np.flatnonzero(viewpoint == other)
            j = int(images[(repeat[i] + rank) % len(images)])
            pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)
