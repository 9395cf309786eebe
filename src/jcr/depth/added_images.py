"""Pointmaps of new images of a calibrated camera, and removal of older depth that the new images contradict."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from jcr.camera import project
from jcr.depth.densify import choose_neighbours, dense_pointmaps, sweep_planes, undistorted
from jcr.errors import InputError
from jcr.geometry import Similarity, apply, inverse, scale_translation
from jcr.progress import Progress
from jcr.records import MATCHED, NO_DEPTH, Capture, Intrinsics, Pointmaps, Reconstruction, Tracks

NEIGHBOURS = 6
"""Largest number of images that a new image is compared with; at most half of these are new as well."""
RANGE_FACTOR = 1.5
"""Factor by which the searched range of inverse depth is widened: a new object may be taller than all others."""
NEARER_BY = 0.015
"""Relative difference of depth from which one surface counts as nearer than another, above depth and pose noise."""
LEAST_NEW_SHARE = 0.005
"""Least share of a new image's pixels that must get a depth; with less, the image is taken to show another scene."""


def extend(
    reconstruction: Reconstruction,
    gripper_from_camera: Float[ndarray, "4 4"],
    base_from_recon: Similarity,
    capture_size: int,
    added: Capture,
    report: Progress,
) -> Reconstruction:
    """Return the reconstruction with the images of `added` (oldest first), their depth, and camera poses by the robot.

    A camera pose is the added image's `base_from_gripper` times `gripper_from_camera`, converted to the recon frame.
    The added images are the last rows; their `image_index` counts from `capture_size`, the number of images of the
    capture. Pixels get confidence 0 if a later added image sees through their points, or shows a surface in front of
    them. Raises InputError for an added image that sees no point, or has depth at less than 0.5 % of its pixels.
    """
    dense, old, new = reconstruction.dense, len(reconstruction.recon_from_camera), len(added)
    pinhole = dense.intrinsics
    base_from_camera = added.base_from_gripper @ gripper_from_camera
    recon_from_new = scale_translation(
        inverse(base_from_recon.rigid) @ base_from_camera, 1 / base_from_recon.scale
    )
    cameras = np.concatenate([reconstruction.recon_from_camera, recon_from_new])
    images = undistorted(added.folder, added.images, reconstruction.intrinsics, pinhole)
    colors = np.concatenate([dense.colors, images])
    tracks = _with_projections(reconstruction.tracks, cameras, old, pinhole)
    for k, name in enumerate(added.images):
        if not (tracks.image == old + k).any():
            raise InputError(
                f"{added.folder / name}: sees no point of the reconstruction at its gripper pose; correct the pose, or "
                "take an image that shows what other images show"
            )
    neighbours = []
    for others in choose_neighbours(tracks, cameras, old + new - 1):
        latest = others[others >= old][: NEIGHBOURS // 2]
        neighbours.append(np.concatenate([latest, others[others < old][: NEIGHBOURS - len(latest)]]))
    planes = sweep_planes(tracks, cameras)
    middle = planes.mean(1, keepdims=True)
    planes = middle + RANGE_FACTOR * (planes - middle)
    found = dense_pointmaps(colors, cameras, pinhole, neighbours, planes, report, before=dense).of_rows(
        np.arange(old, old + new)
    )
    for name, confidence in zip(added.images, found.confidence, strict=True):
        if (confidence > 0).mean() < LEAST_NEW_SHARE:
            raise InputError(
                f"{added.folder / name}: no depth can be found in it; its pose may be wrong, or it shows nothing "
                "that other images show"
            )
    pointmaps = _joined(dense, found, colors)
    for later in range(old, old + new):
        for earlier in range(later):
            gone = _contradicted(
                pointmaps.points_in_recon, pointmaps.confidence > 0, cameras, earlier, later, pinhole
            )
            pointmaps.confidence[earlier][gone] = 0.0
    return replace(
        reconstruction,
        image_index=np.concatenate([reconstruction.image_index, capture_size + np.arange(new)]),
        recon_from_camera=cameras,
        pointmaps=pointmaps,
    )


def _joined(dense: Pointmaps, found: Pointmaps, colors: UInt8[ndarray, "m h w 3"]) -> Pointmaps:
    """Return the pointmaps `dense` followed by the pointmaps `found` of later images; `colors` are those of all images.

    The confidences of `found` are multiplied by one factor, so that their median over pixels with depth is that of
    `dense`. The result has no `depth_std` if `dense` has none.
    """
    assert found.reason is not None and found.depth_std is not None
    known, unit = dense.confidence > 0, 1.0
    if known.any():
        unit = np.median(dense.confidence[known]) / np.median(found.confidence[found.confidence > 0])
    reason = np.where(known, MATCHED, NO_DEPTH).astype(np.uint8) if dense.reason is None else dense.reason
    std = dense.depth_std
    return replace(
        dense,
        points_in_recon=np.concatenate([dense.points_in_recon, found.points_in_recon]),
        confidence=np.concatenate([dense.confidence, unit * found.confidence]),
        colors=colors,
        reason=np.concatenate([reason, found.reason]),
        depth_std=None if std is None else np.concatenate([std, found.depth_std]),
    )


def _contradicted(
    points_in_recon: Float[ndarray, "m h w 3"],
    known: Bool[ndarray, "m h w"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    earlier: int,
    later: int,
    pinhole: Intrinsics,
) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels of image `earlier` whose depth image `later` contradicts.

    `earlier` and `later` are image indices; all images are on the pixel grid of `pinhole`. `known` marks pixels with
    depth. The later image contradicts a point if its surface, within two pixels of the projection, is 1.5 % or more
    behind (depth z). The later image also contradicts a pixel if two of its points project within one pixel and are
    that much in front.
    """

    def before(row: int, other: int) -> tuple[ndarray, ndarray, Bool[ndarray, " n"]]:
        """Return pixels v, u in image `other` of the n points of image `row`, and which hide other's surface."""
        other_from_recon = inverse(recon_from_camera[other])
        depth = apply(other_from_recon, points_in_recon[other])[..., 2]
        nearest = np.where(known[other], depth, np.inf).astype(np.float32)
        nearest = np.where(known[other], cv2.erode(nearest, np.ones((5, 5), np.uint8)), 0.0)
        u, v, z, inside = _pixels(apply(other_from_recon, points_in_recon[row][known[row]]), pinhole)
        return v, u, inside & (z < (1 - NEARER_BY) * nearest[v, u])

    # The later view sees through the point: its surface lies behind the point, at all pixels around.
    gone = np.zeros(known[earlier].shape, bool)
    gone[known[earlier]] = before(earlier, later)[2]
    # Points of the later view lie in front of the earlier view's surface, at all pixels around.
    v, u, in_the_way = before(later, earlier)
    hits = np.zeros(gone.shape, np.float32)
    np.add.at(hits, (v[in_the_way], u[in_the_way]), 1.0)
    # Two such points among 3x3 pixels suffice: the later view may be coarser, but a single point may be noise.
    return (gone | (cv2.blur(hits, (3, 3), borderType=cv2.BORDER_CONSTANT) * 9 >= 2)) & known[earlier]


def _pixels(
    x_in_camera: Float[ndarray, "n 3"], pinhole: Intrinsics
) -> tuple[ndarray, ndarray, ndarray, Bool[ndarray, " n"]]:
    """Return for n points the nearest pixel's u and v, the depth z, and a mask of points that project into the image.

    The image is that of `pinhole`. All four arrays have shape (n,); u and v are integers, and 0 for points outside.
    """
    z = x_in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.round(project(pinhole, x_in_camera)).T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < pinhole.width) & (v < pinhole.height)
    return np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int), z, inside


def _with_projections(
    tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"], first: int, pinhole: Intrinsics
) -> Tracks:
    """Return the tracks with the projections of all points into the images from index `first` on as more observations.

    Each projection is the nearest pixel on the grid of `pinhole`. Points outside of an image are left out; points that
    are hidden by others are not.
    """
    image, x_px, point = [tracks.image], [tracks.x_px], [tracks.point]
    for row in range(first, len(recon_from_camera)):
        u, v, _, inside = _pixels(apply(inverse(recon_from_camera[row]), tracks.points_in_recon), pinhole)
        image.append(np.full(inside.sum(), row))
        x_px.append(np.stack([u, v], -1)[inside].astype(float))
        point.append(np.flatnonzero(inside))
    rows, pixels, points = (np.concatenate(parts) for parts in (image, x_px, point))
    return Tracks(image=rows, x_px=pixels, point=points, points_in_recon=tracks.points_in_recon)
