"""Localisation of another camera's image in the reconstruction of the capture's own camera.

Features that it shares with two or more images of known pose become points; the image's place follows from those that
agree (P3P in RANSAC, with a focal length where none is given). Points and all their observations are kept, for the
bundle adjustment of all images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.estimation.absolute_pose import absolute_pose
from jcr.features.sift import matches
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics
from jcr.sfm.register import GATE_PX, MIN_POINTS, Features, features, triangulated

FOCAL_OF_WIDTH = 0.9
"""Initial focal length of a camera without known intrinsics, as a share of the width."""
LEAST_SPREAD = 0.05
"""Least share of the image's area that the points span; crowded points determine the pose badly."""
CLEARLY_MORE = 1.1
"""Times the points that agree with given intrinsics: more are no chance of RANSAC."""


@dataclass(frozen=True)
class Known:
    """The images of known pose and what is found in them."""

    intrinsics: Intrinsics
    recon_from_camera: Float[ndarray, "m 4 4"]
    found: tuple[Features, ...]


@dataclass(frozen=True, kw_only=True)
class Shared:
    """The points that an image shares with images of known pose, and where it was taken from."""

    recon_from_camera: Float[ndarray, "4 4"]
    intrinsics: Intrinsics
    points_in_recon: Float[ndarray, "p 3"]
    x_px: Float[ndarray, "p 2"]
    """Pixels of the image."""
    row: Int[ndarray, " k"]
    """Image of known pose of each further observation."""
    row_x_px: Float[ndarray, "k 2"]
    row_point: Int[ndarray, " k"]


def known_images(
    images: Sequence[UInt8[ndarray, "h w 3"]],
    intrinsics: Intrinsics,
    recon_from_camera: Float[ndarray, "m 4 4"],
) -> Known:
    """Return images of known poses of one camera with their features."""
    found = tuple(features(image, intrinsics) for image in images)
    return Known(intrinsics, recon_from_camera, found)


def guessed_intrinsics(size: tuple[int, int]) -> Intrinsics:
    """Return initial intrinsics for an image size."""
    width, height = size
    focal = FOCAL_OF_WIDTH * max(size)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def localised(
    known: Known, image: UInt8[ndarray, "h w 3"], intrinsics: Intrinsics, is_given: bool
) -> Shared | int:
    """Return the pose of an image, or the number of points that it shares where these are too few."""
    found = features(image, intrinsics)
    of_image = [matches(found.descriptors, other.descriptors) for other in known.found]
    seen = _Matched(
        found.x_px,
        np.concatenate([mine for mine, _ in of_image]),
        np.repeat(np.arange(len(of_image)), [len(mine) for mine, _ in of_image]),
        np.concatenate([known.found[k].x_px[theirs] for k, (_, theirs) in enumerate(of_image)]),
    )
    return _located(known, seen, intrinsics, is_given)


@dataclass(frozen=True)
class _Matched:
    """Keypoints of an image, and which image of known pose shows which of them where."""

    x_px: Float[ndarray, "n 2"]
    feature: Int[ndarray, " c"]
    row: Int[ndarray, " c"]
    row_x_px: Float[ndarray, "c 2"]


def _located(known: Known, seen: _Matched, intrinsics: Intrinsics, is_given: bool) -> Shared | int:
    """Return the pose of an image from its matches, as `localised`."""
    feature, row, count = seen.feature, seen.row, len(seen.x_px)
    rays = unproject(known.intrinsics, seen.row_x_px)[:, :2]
    gate = GATE_PX / known.intrinsics.fx
    points, _, good = triangulated(feature, row, rays, known.recon_from_camera, gate, count)
    if good.sum() < MIN_POINTS:
        return int(good.sum())
    candidate = np.flatnonzero(good)
    x_px, points_seen = seen.x_px[candidate], points[candidate]
    gate_px = 2 * GATE_PX * max(1.0, intrinsics.width / 1600)
    placed = absolute_pose(
        x_px, points_seen, intrinsics, gate_px=gate_px, focal="given" if is_given else "free"
    )
    if is_given:
        # Wrong intrinsics leave those points that agree with a wrong pose: another focal length explains more.
        free = absolute_pose(x_px, points_seen, intrinsics, gate_px=gate_px, focal="free")
        given, more = (0 if pose is None else int(pose.inlier.sum()) for pose in (placed, free))
        placed = free if more > CLEARLY_MORE * given else placed
    if placed is None or placed.inlier.sum() < MIN_POINTS:
        return 0 if placed is None else int(placed.inlier.sum())
    recon_from_camera, intrinsics, inlier = placed.a_from_camera, placed.camera, placed.inlier
    agreed = candidate[inlier]
    # Of the known images' observations those that the point meets.
    rotation, centre = known.recon_from_camera[row, :3, :3], known.recon_from_camera[row, :3, 3]
    in_camera = np.einsum("cji,cj->ci", rotation, points[feature] - centre)
    ahead = in_camera[:, 2] > 1e-6
    miss = np.full(len(row), np.inf)
    miss[ahead] = np.linalg.norm(project(known.intrinsics, in_camera[ahead]) - seen.row_x_px[ahead], axis=1)
    kept = (miss < GATE_PX) & np.isin(feature, agreed)
    number = np.zeros(count, int)
    number[agreed] = np.arange(len(agreed))
    return Shared(
        recon_from_camera=recon_from_camera,
        intrinsics=intrinsics,
        points_in_recon=points[agreed],
        x_px=seen.x_px[agreed],
        row=row[kept],
        row_x_px=seen.row_x_px[kept],
        row_point=number[feature[kept]],
    )


def spread(shared: Shared) -> float:
    """Return the share of the image's area that the standard deviations of its points span."""
    sides = 4 * np.sqrt(np.linalg.eigvalsh(np.cov(shared.x_px.T)))
    return float(sides.prod() / (shared.intrinsics.width * shared.intrinsics.height))


def distance(shared: Shared) -> float:
    """Return the median depth of the points, in the reconstruction's unit."""
    return float(np.median(apply(inverse(shared.recon_from_camera), shared.points_in_recon)[:, 2]))
