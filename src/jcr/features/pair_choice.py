"""Choice of the image pairs to match: all pairs of a few images, else pairs of near viewpoints or of a common scene."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.features.pair_verification import Gate, Key, Motions
from jcr.geometry import apply, inverse, motion_length, nearest_to_lines, rotation_angle, skew, transform
from jcr.records import Intrinsics

FIRST_NEIGHBOURS, NEIGHBOURS = 4, 8
"""Numbers of near viewpoints that each image is paired with: in the first search, and where this does not find R_X."""
ALL_PAIRS_UP_TO = 16
"""Largest number of images whose pairs are all matched at once. This is cheap, and a pair that happens to match may
register a camera far from all others (doosan_bench: 12 mm from its gripper with near pairs alone, 7 mm with all)."""
PARTNERS = 8
"""Number of viewpoints that each image is paired with by the scene they share, once R_X is known."""
LARGEST_ANGLE = math.radians(60)
"""Largest angle (rad) between two viewing directions of a pair; beyond it nothing matches."""
LEAST_COMMON = 0.25
"""Least share of the scene points in an image that the other image must see, too."""
SAME_VIEWPOINT = 5e-3, math.radians(1)
"""Largest motion (m, rad) of the gripper between images of one viewpoint; such images show no parallax."""
PRIOR_STD_M = 0.2
"""Standard deviation, m, of the camera's position about the flange: a camera is mounted on the flange or near it."""
ROBOT_STD_M = 2e-3
LEAST_DIRECTION_STD = 0.01
"""Least standard deviation, rad, of a two-view translation's direction, which plane scenes determine weakly."""
TRANSLATION_ROUNDS = 15
"""Number of weighted least-squares estimates of t_X, each with new weights (Cauchy)."""
POINTS_OF_PAIR = 60
"""Approximate number of matches of a pair that are used with the pairs' poses."""


def near_pairs(motion: Motions, neighbours: int) -> list[Key]:
    """Return the pairs of each image with one image of each of its `neighbours` nearest viewpoints.

    The distance is the length of the gripper's motion (geometry.motion_length).
    """
    return _best(-np.asarray(motion_length(motion)), neighbours, viewpoints(motion))


def repeats(motion: Motions) -> Bool[ndarray, "n n"]:
    """Test for each pair of images whether the gripper's motion is below SAME_VIEWPOINT; `motion[i, j]` is i_from_j."""
    metres, radians = SAME_VIEWPOINT
    way = np.linalg.norm(motion[..., :3, 3], axis=-1)
    return (way < metres) & (np.asarray(rotation_angle(motion[..., :3, :3])) < radians)


def viewpoints(motion: Motions) -> Int[ndarray, " n"]:
    """Return for each image the row of the first image of the same viewpoint (SAME_VIEWPOINT)."""
    same, first = repeats(motion), np.arange(len(motion))
    for row in range(len(motion)):
        if first[row] == row:
            first[(first > row) & same[row]] = row
    return first


def pairs_of_common_scene(
    x_px: Sequence[Float[ndarray, "_ 2"]],
    intrinsics: Intrinsics,
    found: Gate,
    motion: Motions,
) -> list[Key]:
    """Return the pairs of every image with the viewpoints that share most of its scene; empty if this is not known yet.

    Each image has up to PARTNERS viewpoints. The shared scene is measured by the points of the pairs in `found` that
    the gripper confirms. It is unknown without a hand-eye rotation and with fewer than 20 points. `x_px` are the
    keypoints of every image (px), `intrinsics` those of the images.
    """
    if (gripper_from_camera := hand_eye_of_pairs(found, motion)) is None:
        return []
    first_from_camera = motion[0] @ gripper_from_camera
    kept = [np.zeros((0, 3))]  # points (m) of pairs with parallax, in the gripper frame of image 0
    for pair in found.confirmed:
        rows = pair.rows[:: max(1, len(pair.rows) // POINTS_OF_PAIR)]
        pose = first_from_camera[list(pair.key)]
        seen_px = np.stack([x_px[row][own] for row, own in zip(pair.key, rows.T, strict=True)], 1)
        direction = np.einsum("bij,mbj->mbi", pose[:, :3, :3], unproject(intrinsics, seen_px))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        x = nearest_to_lines(pose[:, :3, 3], direction)
        far = ((x[:, None] - pose[:, :3, 3]) * direction).sum(2)
        parallax = np.linalg.norm(np.cross(direction[:, 0], direction[:, 1]), axis=1)
        kept.append(x[(far > 0.02).all(1) & (parallax > np.sin(np.radians(1)))])
    points = np.concatenate(kept)
    if len(points) < 20:
        return []
    inside, size = [], [intrinsics.width - 0.5, intrinsics.height - 0.5]
    for camera_from_first in inverse(first_from_camera):
        x_in_camera = apply(camera_from_first, points)
        shown = x_in_camera[:, 2] > 0
        at_px = project(intrinsics, x_in_camera[shown])
        shown[shown] = ((at_px > -0.5) & (at_px < size)).all(1)
        inside.append(shown)
    counted = np.array(inside, np.float32)  # 10⁷ numbers for 200 images
    share = counted @ counted.T / np.maximum(counted.sum(1), 1)[:, None]
    toward = first_from_camera[:, :3, 2]
    between = np.arccos(np.clip(toward @ toward.T, -1, 1))
    score = np.where((between < LARGEST_ANGLE) & (share > LEAST_COMMON), share * np.cos(between), -np.inf)
    return _best(score, PARTNERS, viewpoints(motion))


def hand_eye_of_pairs(found: Gate, motion: Motions) -> Float[ndarray, "4 4"] | None:
    """Return gripper_from_camera = (R_X, t_X) from the confirmed image pairs; None while R_X is unknown.

    The gripper's motion of a pair is (R_A, t_A). The camera's translation is known up to its length; R_X rotates its
    direction to d. The equation d × ((R_A − I) t_X + t_A) = 0 is linear in t_X and needs neither the scale nor a map. A
    prior of standard deviation PRIOR_STD_M draws t_X to 0.
    """
    if found.of_x is None or not found.confirmed:
        return None
    best = [pair.motions[0] for pair in found.confirmed]
    gripper = np.stack([motion[pair.key] for pair in found.confirmed])
    turn, moved = gripper[:, :3, :3] - np.eye(3), gripper[:, :3, 3]
    cross = skew(np.stack([one.direction for one in best]) @ found.of_x.rotation.T)
    loose = np.sqrt([max(np.trace(r.covariance[3:, 3:]) / 2, LEAST_DIRECTION_STD**2) for r in best])
    a, b = cross @ turn, (cross @ moved[..., None])[..., 0]
    t = np.zeros(3)
    for _ in range(TRANSLATION_ROUNDS):
        std = np.hypot(ROBOT_STD_M, loose * np.linalg.norm(turn @ t + moved, axis=1))
        residual = np.linalg.norm(a @ t + b, axis=1) / std
        weight = 1 / (1 + (residual / 3) ** 2) / std**2
        information = np.einsum("p,pki,pkj->ij", weight, a, a) + np.eye(3) / PRIOR_STD_M**2
        t = -np.linalg.solve(information, np.einsum("p,pki,pk->i", weight, a, b))
    return transform(found.of_x.rotation, t)


def _best(score: Float[ndarray, "n n"], count: int, viewpoint: Int[ndarray, " n"]) -> list[Key]:
    """Return pairs of each image with one image of each of the `count` other viewpoints with the highest finite `score`.

    `viewpoint` is the viewpoint of each image (`viewpoints`), and `score[i, j]` belongs to images i and j. Images of
    one viewpoint are paired with different images of another one, so that their noise averages.
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
