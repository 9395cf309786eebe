"""Correspondences between images from their pointmaps: reciprocal nearest neighbours, below a pixel."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from jcr.geometry import apply, inverse
from jcr.pointmaps.pairs import PairPredictions
from jcr.records import Tracks

COARSE_POINTS = 6000
"""Of a pointmap in the tree that is searched first; the pixels around its answer are searched next."""
PATCH_RADIUS = 3
"""Pixels around a match over which a quadratic is fitted to the pointmap, which averages its noise.

A plane was tried: foreshortening bends it, which moves all matches along the epipolar line (0.03 px of 128).
"""
DEPTH_WEIGHT = 0.05
"""Of the logarithm of distance beside direction (rad) when points are compared.

Networks err along the ray, by 1 % and more, where directions are good to a fraction of a pixel: matching by
Euclidean distance was tried and slides along slanted surfaces, by twice the error at 128x96 pixels. The
distance is still needed to tell surfaces apart that lie behind one another.
"""
LARGEST_MISFIT = 0.02
"""RMS distance of a patch's points from their quadratic, in the same unit: more is an occlusion boundary."""

KEYPOINTS = 6000
"""Of all images together, spread evenly, each the most confident pixel of its cell."""
LEAST_CONFIDENCE = 0.1
"""Quantile of a pointmap's confidence below which its pixels are not matched."""
LARGEST_GAP = 0.05
"""By how much the distances of matched points from the camera may differ, as a share."""
LARGEST_DISAGREEMENT = 0.01
"""Distance between there and back, and between the two orders of a pair, over the image's width."""

Pixels = Int[ndarray, "k 2"]
"""x, y."""
Pointmap = tuple[Float[ndarray, "h w 3"], Float[ndarray, "h w"]]
"""Points in some frame, and their confidence."""
OriginalPx = Callable[[Float[ndarray, "k 2"]], Float[ndarray, "k 2"]]


def tracks_from_pairs(
    predictions: PairPredictions, points_in_recon: Float[ndarray, "n h w 3"], original_px: OriginalPx
) -> Tracks:
    """One track per keypoint that another image sees, in pairs that each have a frame of their own.

    A pair (n, m) puts points of n and m into the frame of camera n, where keypoint p of n and pixel q of m
    match when each is the other's nearest neighbour as seen from there (Wang et al., DUSt3R, section 3.3, but
    distance along the ray counts little); q is then moved below a pixel. A track starts at one keypoint and
    takes at most one match from each image, so it cannot contradict itself as chains of pairwise matches do.
    `original_px` maps the pointmaps' pixels to the capture's images.
    """
    p = predictions
    confidence = np.zeros(points_in_recon.shape[:3], np.float32)
    for e, (n, m) in enumerate(p.edges):
        confidence[n] += p.conf[e]
        confidence[m] += p.conf2[e]

    def pairs() -> Iterator[tuple[int, int, Pointmap, Pointmap]]:
        for e, (n, m) in enumerate(p.edges.tolist()):
            yield n, m, (p.pts3d[e], p.conf[e]), (p.pts3d_in_other_view[e], p.conf2[e])

    return _tracks(pairs(), confidence, points_in_recon, original_px)


def tracks_from_pointmaps(
    recon_from_camera: Float[ndarray, "n 4 4"],
    points_in_recon: Float[ndarray, "n h w 3"],
    confidence: Float[ndarray, "n h w"],
    original_px: OriginalPx,
) -> Tracks:
    """One track per keypoint that another image sees, where all pointmaps are in one frame already."""
    confidence = confidence.astype(np.float32)

    def seen_from(n: int, image: int) -> Pointmap:
        x_in_camera = apply(inverse(recon_from_camera[n]), points_in_recon[image])
        return x_in_camera.astype(np.float32), confidence[image]

    pairs = ((n, m, seen_from(n, n), seen_from(n, m)) for n in range(len(confidence)) for m in range(n))
    return _tracks(pairs, confidence, points_in_recon, original_px)


def _tracks(
    pairs: Iterable[tuple[int, int, Pointmap, Pointmap]],
    confidence: Float[ndarray, "n h w"],
    points_in_recon: Float[ndarray, "n h w 3"],
    original_px: OriginalPx,
) -> Tracks:
    count, _, width = confidence.shape
    keypoints = [_keypoints(image, KEYPOINTS / count) for image in confidence]
    # By image, other image, and order of the pair.
    pixels = np.full((count, count, 2, len(keypoints[0]), 2), np.nan)
    good = np.ones(pixels.shape[:-1], bool)
    for n, m, *maps in pairs:
        first, second = (_surface(*pointmap) for pointmap in maps)
        pixels[n, m, 0], good[n, m, 0] = _match(first, second, keypoints[n])
        pixels[m, n, 1], good[m, n, 1] = _match(second, first, keypoints[m])
    predicted = ~np.isnan(pixels[..., 0])
    seen = predicted.any(2) & good.all(2)
    matched = np.where(predicted[..., None], pixels, 0).sum(2) / np.maximum(predicted.sum(2), 1)[..., None]
    apart = np.linalg.norm(pixels[:, :, 0] - pixels[:, :, 1], axis=-1)
    seen &= ~(apart > LARGEST_DISAGREEMENT * width)

    image, other, which = np.argwhere(seen).T
    start_image, start_which = np.argwhere(seen.any(1)).T
    point = np.full((count, len(keypoints[0])), -1)
    point[start_image, start_which] = np.arange(len(start_image))
    start_px = np.array(keypoints)[start_image, start_which]
    return Tracks(
        image=np.concatenate([start_image, other]),
        x_px=original_px(np.concatenate([start_px.astype(np.float64), matched[image, other, which]])),
        point=np.concatenate([point[start_image, start_which], point[image, which]]),
        points_in_recon=points_in_recon[start_image, start_px[:, 1], start_px[:, 0]].astype(np.float64),
        from_pointmaps=True,
    )


def _keypoints(confidence: Float[ndarray, "h w"], number: float) -> Pixels:
    """The most confident pixel of each of about `number` equal cells, away from the border."""
    height, width = confidence.shape
    rows, columns = height - 2 * PATCH_RADIUS, width - 2 * PATCH_RADIUS
    # Keypoints closer than this would share most of their patches.
    size = max(PATCH_RADIUS + 1, int(np.sqrt(rows * columns / number)))
    rows, columns = rows // size, columns // size
    top, left = (height - rows * size) // 2, (width - columns * size) // 2
    cells = confidence[top : top + rows * size, left : left + columns * size]
    cells = cells.reshape(rows, size, columns, size).swapaxes(1, 2).reshape(rows * columns, size * size)
    row, column = np.divmod(np.arange(rows * columns), columns)
    y, x = np.divmod(cells.argmax(1), size)
    return np.stack([left + column * size + x, top + row * size + y], -1)


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """A pointmap as seen from its origin, made ready for searching."""

    seen: Float[ndarray, "h w 4"]
    """Unit direction, and DEPTH_WEIGHT times the logarithm of the distance."""
    confidence: Float[ndarray, "h w"]
    least_confidence: float
    smooth: Float[ndarray, "h w 4"]
    """Means of `seen` over patches, by confidence, lest the nearest of noisy points be the noisiest."""
    stride: int
    tree: KDTree
    """Search tree of every `stride`-th pixel of `smooth`."""


def _surface(points: Float[ndarray, "h w 3"], confidence: Float[ndarray, "h w"]) -> _Surface:
    distance = np.maximum(np.sqrt(np.einsum("hwc,hwc->hw", points, points)), 1e-9)[..., None]
    seen = np.concatenate([points / distance, DEPTH_WEIGHT * np.log(distance)], axis=2)
    size = (2 * PATCH_RADIUS + 1,) * 2
    weighted = cv2.boxFilter(seen * confidence[..., None], -1, size)
    smooth = weighted / np.maximum(cv2.boxFilter(confidence, -1, size), 1e-9)[..., None]
    stride = max(1, int(np.sqrt(confidence.size / COARSE_POINTS)))
    tree = KDTree(smooth[::stride, ::stride].reshape(-1, 4), balanced_tree=False)
    # Every seventh pixel gives the quantile closely enough in a tenth of the time.
    least = float(np.quantile(confidence.ravel()[::7], LEAST_CONFIDENCE))
    return _Surface(
        seen=seen, confidence=confidence, least_confidence=least, smooth=smooth, stride=stride, tree=tree
    )


def _match(
    start: _Surface, end: _Surface, keypoints: Pixels
) -> tuple[Float[ndarray, "k 2"], Bool[ndarray, " k"]]:
    """Pixels of `end` that match keypoints of `start`, and which of them are good."""
    height, width = end.confidence.shape
    point, _, smooth = _local_shape(start, keypoints)
    nearest = _nearest_pixels(end, point)
    center, slope, smooth_there = _local_shape(end, nearest)
    # The step along the surface that comes closest: least squares in the two columns of the slope.
    normal = np.einsum("kci,kcj->kij", slope, slope)
    normal += (1e-9 * np.trace(normal, axis1=1, axis2=2) + 1e-30)[:, None, None] * np.eye(2)
    step = np.linalg.solve(normal, np.einsum("kci,kc->ki", slope, point - center)[..., None])[..., 0]
    pixels = nearest + step
    gap = np.abs(point - center - np.einsum("kci,ki->kc", slope, step))[:, 3] / DEPTH_WEIGHT
    back = np.linalg.norm(_nearest_pixels(start, center) - keypoints, axis=-1)
    good = smooth & smooth_there & (np.linalg.norm(step, axis=-1) <= PATCH_RADIUS)
    good &= gap <= LARGEST_GAP
    good &= back <= max(2.0, LARGEST_DISAGREEMENT * width)
    good &= start.confidence[keypoints[:, 1], keypoints[:, 0]] >= start.least_confidence
    good &= end.confidence[nearest[:, 1], nearest[:, 0]] >= end.least_confidence
    return pixels, good & (pixels >= 0).all(-1) & (pixels <= [width - 1, height - 1]).all(-1)


def _nearest_pixels(surface: _Surface, points: Float[ndarray, "k 4"]) -> Pixels:
    """The pixel nearest to each point: by the tree of every few pixels, then among those around it."""
    height, width = surface.confidence.shape
    _, flat = surface.tree.query(points)
    y, x = np.divmod(flat, -(-width // surface.stride))
    offset = np.arange(-surface.stride, surface.stride + 1)
    around_y = np.clip(y[:, None] * surface.stride + offset, 0, height - 1)
    around_x = np.clip(x[:, None] * surface.stride + offset, 0, width - 1)
    around = surface.smooth[around_y[:, :, None], around_x[:, None, :]]
    distance = ((around - points[:, None, None]) ** 2).sum(-1)
    row, column = np.divmod(distance.reshape(len(points), -1).argmin(1), len(offset))
    each = np.arange(len(points))
    return np.stack([around_x[each, column], around_y[each, row]], -1)


def _local_shape(
    surface: _Surface, pixels: Pixels
) -> tuple[Float[ndarray, "k 4"], Float[ndarray, "k 4 2"], Bool[ndarray, " k"]]:
    """At each pixel: what is seen, its derivative by the pixel, and whether a smooth surface lies around it.

    Least squares of a quadratic in x and y, weighted by confidence. The border is not smooth.
    """
    height, width = surface.confidence.shape
    r = PATCH_RADIUS
    v, u = np.mgrid[-r : r + 1, -r : r + 1].reshape(2, -1)
    design = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], -1)
    x, y = np.clip(pixels, r, [width - 1 - r, height - 1 - r]).T
    at = (y[:, None] + v, x[:, None] + u)
    patch = surface.seen[at].astype(np.float64)
    weight = surface.confidence[at].astype(np.float64) + 1e-9
    weight /= weight.sum(1, keepdims=True)
    normal = np.einsum("kp,pi,pj->kij", weight, design, design)
    shape = np.linalg.solve(normal, np.einsum("kp,pi,kpc->kic", weight, design, patch))
    misfit = np.sqrt(np.einsum("kp,kpc->k", weight, (patch - design @ shape) ** 2))
    inside = (pixels == np.stack([x, y], -1)).all(-1)
    return shape[:, 0], np.swapaxes(shape[:, 1:3], 1, 2), inside & (misfit <= LARGEST_MISFIT)
