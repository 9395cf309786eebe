"""Photometric matching between views, initialised from predicted pointmaps and cameras.

A pointmap predicts the position of each pixel of a view in another view to a few pixels. The other view is warped by
this prediction, which removes rotation, scale and slant; the remaining optical flow (Lucas and Kanade, 1981; OpenCV's
pyramid) is accurate to a fraction of a pixel of the camera's own images, independent of the network's resolution and
predictions.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from jcr.camera import rays
from jcr.geometry import apply, inverse
from jcr.records import Intrinsics

WINDOW = (21, 21)
LEVELS = 3
"""Levels of the pyramid above the image; the largest displacement is about 60 pixels."""
WIDEST_DEG = 70.0
"""Largest angle between two views that are compared."""
LARGEST_RETURN_PX = 0.5
"""Largest distance between a keypoint and its position after the flow there and back."""
LEAST_CORRELATION = 0.8
"""Least normalised correlation of the patches around both ends."""
PATCH_RADIUS = 5
STEP_RADIUS, LARGEST_STEP = 5, 0.04
"""Pixels around a keypoint within which depth must not change by more than this share."""
LARGEST_STD_PX = 0.1
"""Largest standard deviation of a match in the least determined direction of its window."""
LARGEST_GAP = 0.15
"""Largest difference of a point's depth from the other view's own depth, in logarithms."""


@dataclass(frozen=True)
class Geometry:
    """Estimated cameras and depth of each image."""

    pinhole: Intrinsics
    recon_from_camera: Float[ndarray, "n 4 4"]
    depth: Float[ndarray, "n h w"]
    """Depth along z; 0 where it is unknown."""


@dataclass(frozen=True)
class Matches:
    """Keypoints of views and their matches in other views."""

    start: Float[ndarray, "p 3"]
    """View, x, y of each keypoint."""
    point: ndarray
    """Row of `start` per match (k,)."""
    view: ndarray
    """View of each match (k,)."""
    x_px: Float[ndarray, "k 2"]


def photometric_matches(gray: UInt8[ndarray, "n h w"], geometry: Geometry, keypoints: int) -> Matches:
    """Match up to `keypoints` corners of each view in the other views."""
    count, height, width = gray.shape
    directions = rays(geometry.pinhole)
    axis = geometry.recon_from_camera[:, :3, 2]
    apart_deg = np.degrees(np.arccos(np.clip(axis @ axis.T, -1, 1)))
    starts, points, views, pixels = [], [], [], []
    total = 0
    for n in range(count):
        known = (_smooth_surface(geometry.depth[n]) & _textured_both_ways(gray[n])).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(gray[n], keypoints, 0.005, width / 80, mask=known)
        if corners is None:
            continue
        corners = corners[:, 0]
        x_in_recon = apply(geometry.recon_from_camera[n], geometry.depth[n][..., None] * directions)
        for m in range(count):
            if m == n or apart_deg[n, m] > WIDEST_DEG:
                continue
            good, there = _locate_corners(gray[n], gray[m], corners, x_in_recon, geometry, n, m)
            points.append(total + np.flatnonzero(good))
            views.append(np.full(good.sum(), m))
            pixels.append(there[good])
        starts.append(np.column_stack([np.full(len(corners), n), corners]))
        total += len(corners)
    if not points:
        return Matches(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    return Matches(
        np.concatenate(starts), np.concatenate(points), np.concatenate(views), np.concatenate(pixels)
    )


def _smooth_surface(depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels with known depth and no depth step around them, which outlines have."""
    window = np.ones((2 * STEP_RADIUS + 1,) * 2, np.uint8)
    nearest, farthest = cv2.erode(depth, window), cv2.dilate(depth, window)
    return (nearest > 0) & (farthest < (1 + LARGEST_STEP) * nearest)


def _textured_both_ways(gray: UInt8[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels whose window determines the flow in all directions, unlike a straight edge.

    The variance of the flow is the noise's over the smaller eigenvalue of the gradients' summed products (the
    structure tensor), whose share of noise is taken off.
    """
    image = gray.astype(np.float32)
    by_x, by_y = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    # A Laplacian of white noise has 6 times its deviation (Immerkær, 1996).
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    noise = max(float(np.median(np.abs(cv2.filter2D(image, -1, kernel)))) / 0.6745 / 6, 0.5)
    xx, xy, yy = (
        cv2.boxFilter(a * b, -1, WINDOW, normalize=False)
        for a, b in ((by_x, by_x), (by_x, by_y), (by_y, by_y))
    )
    least = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy**2)
    # Sobel's weights of white noise: 12 of the 64 parts.
    least -= noise**2 * 12 / 64 * WINDOW[0] * WINDOW[1]
    return least > 2 * (noise / LARGEST_STD_PX) ** 2


def _locate_corners(
    start: UInt8[ndarray, "h w"],
    end: UInt8[ndarray, "h w"],
    corners: Float[ndarray, "k 2"],
    x_in_recon: Float[ndarray, "h w 3"],
    geometry: Geometry,
    n: int,
    m: int,
) -> tuple[Bool[ndarray, " k"], Float[ndarray, "k 2"]]:
    """Locate corners of `start` in `end`, the image of view m; return the mask of those found and all positions."""
    k = geometry.pinhole
    x_in_end = apply(inverse(geometry.recon_from_camera[m]), x_in_recon)
    z = np.where((geometry.depth[n] > 0) & (x_in_end[..., 2] > 1e-9), x_in_end[..., 2], np.nan)
    with np.errstate(invalid="ignore"):
        u = (k.fx * x_in_end[..., 0] / z + k.cx).astype(np.float32)
        v = (k.fy * x_in_end[..., 1] / z + k.cy).astype(np.float32)
    inside = (u >= 0) & (u <= k.width - 1) & (v >= 0) & (v <= k.height - 1)
    if inside.mean() < 0.02:
        return np.zeros(len(corners), bool), corners
    # Far outside, where nothing is, instead of NaN, which remap does not know.
    u, v = (
        np.where(np.isfinite(u), u, -1e4).astype(np.float32),
        np.where(np.isfinite(v), v, -1e4).astype(np.float32),
    )
    drawn = cv2.remap(end, u, v, cv2.INTER_LINEAR)
    moved, found = _flow(start, drawn, corners)
    back, returned = _flow(drawn, start, moved)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0)
    good &= np.linalg.norm(back - corners, axis=1) < LARGEST_RETURN_PX
    there = np.stack([_sampled(u, moved), _sampled(v, moved)], axis=-1)
    good &= (there >= 1).all(1) & (there <= [k.width - 2, k.height - 2]).all(1)
    good &= _sampled(inside.astype(np.float32), moved) > 0.99
    own = _sampled(geometry.depth[m], np.clip(there, 0, [k.width - 1, k.height - 1]))
    seen = _sampled(np.nan_to_num(z).astype(np.float32), moved)
    with np.errstate(divide="ignore", invalid="ignore"):
        good &= (own <= 0) | (np.abs(np.log(seen / own)) < LARGEST_GAP)
    good[good] = _correlation(start, corners[good], drawn, moved[good]) > LEAST_CORRELATION
    return good, there


def _flow(
    one: UInt8[ndarray, "h w"], other: UInt8[ndarray, "h w"], at: Float[ndarray, "k 2"]
) -> tuple[Float[ndarray, "k 2"], UInt8[ndarray, "k 1"]]:
    """Track points of one image in another that looks nearly like it; return positions and status."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, at, at.copy(), winSize=WINDOW, maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return moved, found


def _sampled(values: Float[ndarray, "h w"], x_px: Float[ndarray, "k 2"]) -> Float[ndarray, " k"]:
    """Sample an image between pixels, linearly."""
    x = x_px.astype(np.float32)
    return cv2.remap(values.astype(np.float32), x[None, :, 0], x[None, :, 1], cv2.INTER_LINEAR)[0]


def _correlation(
    one: UInt8[ndarray, "h w"],
    at: Float[ndarray, "k 2"],
    other: UInt8[ndarray, "h w"],
    there: Float[ndarray, "k 2"],
) -> Float[ndarray, " k"]:
    """Return the normalised correlation of the patches around both ends."""
    if not len(at):
        return np.zeros(0)
    y, x = np.mgrid[-PATCH_RADIUS : PATCH_RADIUS + 1, -PATCH_RADIUS : PATCH_RADIUS + 1].reshape(2, 1, -1)
    patches = [
        cv2.remap(
            image,
            (ends[:, :1] + x).astype(np.float32),
            (ends[:, 1:] + y).astype(np.float32),
            cv2.INTER_LINEAR,
        ).astype(np.float64)
        for image, ends in ((one, at), (other, there))
    ]
    first, second = (patch - patch.mean(1, keepdims=True) for patch in patches)
    size = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return (first * second).sum(1) / np.maximum(size, 1e-9)
