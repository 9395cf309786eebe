"""New images of a calibrated camera: their pointmaps, and what they contradict in the older ones.

The camera's place follows from the gripper's, so that nothing is calibrated again. Depth is matched, whichever back end
made the reconstruction, and no plane is assumed. A scene changes between images; what a later one sees through, or sees
in the way of an older ray, is taken from the older pointmaps.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.camera import project, undistortion
from jcr.capture.images import read_image
from jcr.depth.dense import dense_pointmaps
from jcr.depth.views import choose_neighbours, sweep_planes
from jcr.errors import InputError
from jcr.geometry import apply, inverse, scale_translation
from jcr.progress import Progress
from jcr.records import MATCHED, NO_DEPTH, Capture, HandEye, Intrinsics, Pointmaps, Reconstruction, Tracks

NEIGHBOURS = 6
"""Images that a new one is compared with; at most half of them are other new ones."""
REACH = 1.5
"""The planes that span the search reach so much farther than known points: a new thing may be taller than all others."""
CONTRADICTION = 0.015
"""Relative difference of depths by which one surface lies before another, beyond noise of depth and poses."""
LEAST_SHARE = 0.005
"""Least share of a new image's pixels with depth; with less it shows nothing of the scene."""


def extend(
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    capture_size: int,
    added: Capture,
    report: Progress,
) -> Reconstruction:
    """Return the reconstruction with further images, oldest first, whose gripper poses are known.

    Their rows come last, numbered from `capture_size`, the images of the capture; where a later image contradicts
    an earlier one, the earlier's confidence is 0. Raises InputError for an image that shares no view with the
    others.
    """
    dense = reconstruction.dense
    pinhole = dense.intrinsics
    base_from_camera = added.base_from_gripper @ hand_eye.gripper_from_camera
    recon_from_new = scale_translation(
        inverse(hand_eye.base_from_recon) @ base_from_camera, 1 / hand_eye.scale
    )
    old, new = len(reconstruction.recon_from_camera), len(added)
    recon_from_camera = np.concatenate([reconstruction.recon_from_camera, recon_from_new])
    undistort = undistortion(reconstruction.intrinsics, pinhole)
    images = [undistort(read_image(added.folder / name)) for name in added.images]
    colors = np.concatenate([dense.colors, np.stack(images)])
    tracks = _with_projections(reconstruction.tracks, recon_from_new, pinhole, old)

    neighbours = _neighbours(tracks, recon_from_camera, old)
    taken = np.array(sorted(neighbours))
    planes = sweep_planes(tracks, recon_from_camera)
    middle = planes.mean(1, keepdims=True)
    found = dense_pointmaps(
        colors[taken],
        recon_from_camera[taken],
        pinhole,
        [np.searchsorted(taken, neighbours[row]) for row in taken],
        (middle + REACH * (planes - middle))[taken],
        report,
        changing=True,
    )
    for name, of_image in zip(added.images, found.confidence[-new:], strict=True):
        if (of_image > 0).mean() < LEAST_SHARE:
            raise InputError(
                f"{added.folder / name}: no depth can be found in it; its pose may be wrong, or it shows nothing "
                "that other images show"
            )
    pointmaps = _joined(dense, found, colors, new)
    _forget_contradicted(pointmaps.points_in_recon, pointmaps.confidence, recon_from_camera, old, pinhole)
    return replace(
        reconstruction,
        image_index=np.concatenate([reconstruction.image_index, capture_size + np.arange(new)]),
        recon_from_camera=recon_from_camera,
        pointmaps=pointmaps,
    )


def _joined(dense: Pointmaps, found: Pointmaps, colors: UInt8[ndarray, "m h w 3"], new: int) -> Pointmaps:
    """Return the pointmaps of a reconstruction and of its last `new` images; `colors` are of all.

    The confidence is in the unit of the back end's own, so that one threshold serves both.
    """
    assert found.reason is not None and found.depth_std is not None
    confidence, known = found.confidence[-new:], dense.confidence[dense.confidence > 0]
    if len(known):
        confidence = confidence * (np.median(known) / np.median(confidence[confidence > 0]))
    reason, std = dense.reason, dense.depth_std
    if reason is None:
        reason = np.where(dense.confidence > 0, MATCHED, NO_DEPTH).astype(np.uint8)
    return Pointmaps(
        intrinsics=dense.intrinsics,
        points_in_recon=np.concatenate([dense.points_in_recon, found.points_in_recon[-new:]]),
        confidence=np.concatenate([dense.confidence, confidence]),
        colors=colors,
        reason=np.concatenate([reason, found.reason[-new:]]),
        depth_std=None if std is None else np.concatenate([std, found.depth_std[-new:]]),
    )


def _neighbours(
    tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"], old: int
) -> dict[int, Int[ndarray, " _"]]:
    """Return the rows that each new image, and each old one that takes part, is compared with.

    Old images take part with a depth of their own, so that depths can be cross-checked.
    """
    count = len(recon_from_camera)
    near = choose_neighbours(tracks, recon_from_camera, count - 1)
    neighbours = {}
    for row in range(old, count):
        others = near[row]
        latest = others[others >= old][: NEIGHBOURS // 2]
        neighbours[row] = np.concatenate([latest, others[others < old][: NEIGHBOURS - len(latest)]])
    taken = np.unique(np.concatenate([*neighbours.values(), np.arange(old, count)]))
    for row in taken[taken < old].tolist():
        neighbours[row] = near[row][np.isin(near[row], taken)][:NEIGHBOURS]
    return neighbours


View = tuple[Float[ndarray, "h w 3"], Bool[ndarray, "h w"], Float[ndarray, "4 4"]]
"""Points in the recon frame, where they are known, and camera_from_recon."""


def _forget_contradicted(
    points: Float[ndarray, "m h w 3"],
    confidence: Float[ndarray, "m h w"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    old: int,
    pinhole: Intrinsics,
) -> None:
    """Write 0 as the confidence of what an image from row `old` on contradicts in an earlier one."""
    camera_from_recon = inverse(recon_from_camera)
    for later in range(old, len(points)):
        for earlier in range(later):
            gone = contradicted(
                (points[earlier], confidence[earlier] > 0, camera_from_recon[earlier]),
                (points[later], confidence[later] > 0, camera_from_recon[later]),
                pinhole,
            )
            confidence[earlier][gone] = 0.0


def contradicted(earlier: View, later: View, pinhole: Intrinsics) -> Bool[ndarray, "h w"]:
    """Return the pixels of an earlier view that the later one sees through, or whose ray meets the later's surface."""
    x_earlier, known, earlier_from_recon = earlier
    x_later, known_later, later_from_recon = later
    gone = np.zeros(known.shape, bool)

    # Seen through: the later view's surface lies behind the point, all around its pixel.
    surface = _nearest_around(apply(later_from_recon, x_later)[..., 2], known_later)
    u, v, depth, inside = _pixels(later_from_recon, x_earlier[known], pinhole)
    gone[known] = inside & (depth < (1 - CONTRADICTION) * np.where(inside, surface[v, u], 0.0))

    # In the way: points of the later view lie before the earlier one's surface, all around their pixel.
    surface = _nearest_around(apply(earlier_from_recon, x_earlier)[..., 2], known)
    u, v, depth, inside = _pixels(earlier_from_recon, x_later[known_later], pinhole)
    before = inside & (depth < (1 - CONTRADICTION) * np.where(inside, surface[v, u], 0.0))
    hits = np.zeros(known.shape, np.float32)
    np.add.at(hits, (v[before], u[before]), 1.0)
    # The later view's points may be sparser than the earlier's pixels, but one alone proves nothing.
    return (gone | (cv2.blur(hits, (3, 3), borderType=cv2.BORDER_CONSTANT) * 9 >= 2)) & known


def _pixels(
    camera_from_recon: Float[ndarray, "4 4"], x_in_recon: Float[ndarray, "n 3"], pinhole: Intrinsics
) -> tuple[ndarray, ndarray, ndarray, Bool[ndarray, " n"]]:
    """Return the nearest pixel u, v (n,), depth (n,), and whether it lies in the image (else the pixel is 0, 0)."""
    x_in_camera = apply(camera_from_recon, x_in_recon)
    z = x_in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = np.round(project(pinhole, x_in_camera)).T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < pinhole.width) & (v < pinhole.height)
    return np.where(inside, u, 0).astype(int), np.where(inside, v, 0).astype(int), z, inside


def _nearest_around(depth: Float[ndarray, "h w"], known: Bool[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Return the smallest known depth in 5x5 pixels; 0 where the pixel itself has none."""
    nearest = cv2.erode(np.where(known, depth, np.inf).astype(np.float32), np.ones((5, 5), np.uint8))
    return np.where(known, nearest, 0.0)


def _with_projections(
    tracks: Tracks, recon_from_new: Float[ndarray, "k 4 4"], pinhole: Intrinsics, first: int
) -> Tracks:
    """Return the tracks with the projections of their points in new images, for the choice of views."""
    image, x_px, point = [tracks.image], [tracks.x_px], [tracks.point]
    for row, new_from_recon in enumerate(inverse(recon_from_new), start=first):
        u, v, _, inside = _pixels(new_from_recon, tracks.points_in_recon, pinhole)
        image.append(np.full(inside.sum(), row))
        x_px.append(np.stack([u, v], -1)[inside].astype(float))
        point.append(np.flatnonzero(inside))
    return Tracks(
        image=np.concatenate(image),
        x_px=np.concatenate(x_px),
        point=np.concatenate(point),
        points_in_recon=tracks.points_in_recon,
    )
