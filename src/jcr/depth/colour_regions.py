"""Segmentation of an image into regions of one colour, and planes fitted to the matched depth in each region."""

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.numba_compile import compiled, inlined

SCALE = 0.35
"""Constant k of Felzenszwalb and Huttenlocher 2004, eq. 4, for colours from 0 to 1; it grows with the regions' size."""
SMALLEST_REGION = 12
"""Least number of pixels of a region; smaller ones are merged with the neighbour of most similar colour."""
TRIALS = 60
"""Number of RANSAC trials for the plane of a region."""
FEWEST_OF_REGION = 12
"""Least number of matched pixels from which a region's plane is fitted."""
SAMPLED = 400
"""Approximate largest number of matched pixels of a region among which RANSAC counts inliers."""
SPREAD = 0.08
"""Least ratio of the smallest variance of the positions of the pixels that support a plane to that of all pixels of the
region. Pixels along one edge do not determine the slope across it, and may belong to the adjacent object."""


def colour_regions(color: Float[ndarray, "h w 3"]) -> tuple[Int[ndarray, "h w"], int]:
    """Return for each pixel the index of its region of one colour (from 0), and the number of regions.

    `color` is RGB, 0 to 1. The method is that of Felzenszwalb and Huttenlocher, IJCV 2004. The image is smoothed first,
    with its edges kept; otherwise noise and JPEG blocks would join regions.
    """
    smooth = cv2.bilateralFilter(color, 7, 0.07, 3)
    pairs = (smooth[:, 1:], smooth[:, :-1]), (smooth[1:], smooth[:-1])
    # Over three channels, NumPy's maximum of two arrays takes a tenth of the time of its maximum along an axis.
    changes = (np.moveaxis(cv2.absdiff(one, other), -1, 0) for one, other in pairs)
    weight = np.concatenate([np.maximum(np.maximum(*change[:2]), change[2]).ravel() for change in changes])
    h, w = color.shape[:2]
    index = np.arange(h * w, dtype=np.int32).reshape(h, w)
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    # Sorting 16-bit numbers takes a fifth of the time.
    order = np.argsort((65535 * weight.clip(0, 1)).astype(np.uint16), kind="stable")
    root = np.arange(h * w)
    _join(first[order], second[order], weight[order], root, np.ones(h * w, int), np.zeros(h * w, np.float32))
    is_root = root == np.arange(h * w)
    label = (np.cumsum(is_root, dtype=np.int32) - 1)[root].reshape(h, w)
    return label, int(is_root.sum())


@inlined
@no_type_check
def _root(parent, x):
    while parent[x] != x:
        parent[x] = parent[parent[x]]
        x = parent[x]
    return x


@compiled
@no_type_check
def _join(first, second, weight, parent, size, inner):
    for small in range(2):
        for e in range(len(weight)):
            a, b = _root(parent, first[e]), _root(parent, second[e])
            if a == b:
                continue
            if small == 1:
                join = size[a] < SMALLEST_REGION or size[b] < SMALLEST_REGION
            else:
                join = weight[e] <= min(inner[a] + SCALE / size[a], inner[b] + SCALE / size[b])
            if join:
                parent[b] = a
                size[a] += size[b]
                inner[a] = max(weight[e], inner[a], inner[b])
    for x in range(len(parent)):
        parent[x] = _root(parent, x)


@dataclass(frozen=True, kw_only=True)
class RegionPlanes:
    """Planes of the r regions of an image and the matched pixels that support them; 0 for regions without a plane."""

    plane: Float[ndarray, "r 3"]
    """Plane p with p·ray = inverse depth."""
    is_support: Bool[ndarray, " r"]
    """Whether the plane is the scene's main plane."""
    inliers: Int[ndarray, " r"]
    matched: Int[ndarray, " r"]
    """Number of matched pixels, on the plane or not."""
    std: Float[ndarray, " r"]
    """Root mean square of the inliers' residuals, relative to the inverse depth."""
    middle_px: Float[ndarray, "r 2"]
    """Mean of the inliers' pixels (u, v)."""
    information: Float[ndarray, "r 2 2"]
    """Inverse covariance of the inliers' pixels, px⁻²."""


def region_planes(
    label: Int[ndarray, "h w"],
    count: int,
    inverse_depth: Float[ndarray, "h w"],
    matched: Bool[ndarray, "h w"],
    rays: Float[ndarray, "h w 3"],
    support: Float[ndarray, "3"],
    tolerance: float,
    seed: int,
) -> RegionPlanes:
    """Fit to the matched pixels of each region a plane p with p·ray = inverse depth (RANSAC, then least squares).

    `label` is each pixel's region from 0 to `count` - 1; `rays` have z = 1. `support` is the scene's main plane, as p
    in the camera frame. It is preferred where it has 80 % of the best plane's inliers or more. `tolerance` is the
    largest residual of an inlier, relative to the inverse depth; `seed` is that of RANSAC.
    """
    pixel = np.stack(np.nonzero(label >= 0)[::-1], -1).astype(float)
    fixed = np.bincount(label[matched], minlength=count)
    chosen = np.flatnonzero(matched & (fixed >= FEWEST_OF_REGION)[label])
    chosen = chosen[np.argsort(label.ravel()[chosen], kind="stable")]
    regions = np.flatnonzero(fixed >= FEWEST_OF_REGION)
    size, n = fixed[regions], len(regions)
    start, of = np.cumsum(size) - size, np.repeat(np.arange(n), size)
    ray, depth = rays.reshape(-1, 3)[chosen], inverse_depth.ravel()[chosen].astype(float)
    found = RegionPlanes(
        plane=np.zeros((count, 3)),
        is_support=np.zeros(count, bool),
        inliers=np.zeros(count, int),
        matched=fixed,
        std=np.zeros(count),
        middle_px=np.zeros((count, 2)),
        information=np.zeros((count, 2, 2)),
    )
    if n == 0:
        return found

    best, on = _drawn_planes(ray, depth, (start, size), support, tolerance, seed)
    on_best = ray * (np.abs(np.einsum("ki,ki->k", ray, best[of]) - depth) < tolerance * depth)[:, None]
    normal = np.add.reduceat(on_best[:, :, None] * ray[:, None], start)
    fitted = ~on & (np.abs(np.linalg.det(normal)) >= 1e-12)
    right = np.add.reduceat(on_best * depth[:, None], start)
    best[fitted] = np.linalg.solve(normal[fitted], right[fitted][..., None])[..., 0]
    off = np.einsum("ki,ki->k", ray, best[of]) / depth - 1
    carries = np.abs(off) < tolerance
    number, mean, covariance = _moments(of[carries], pixel[chosen[carries]], n)
    whole = _moments(label.ravel(), pixel, count)[2][regions]
    narrow, wide = (np.linalg.eigvalsh(one)[:, 0] for one in (covariance, whole))
    good = (on | fitted) & (number >= FEWEST_OF_REGION) & (narrow >= SPREAD * wide)
    kept = regions[good]
    found.plane[kept], found.is_support[kept], found.inliers[kept] = best[good], on[good], number[good]
    found.std[kept] = np.sqrt(np.bincount(of[carries], off[carries] ** 2, n)[good] / number[good])
    found.middle_px[kept], found.information[kept] = mean[good], np.linalg.inv(covariance[good] + np.eye(2))
    return found


def _drawn_planes(
    ray: Float[ndarray, "k 3"],
    depth: Float[ndarray, " k"],
    of_region: tuple[Int[ndarray, " n"], Int[ndarray, " n"]],
    support: Float[ndarray, "3"],
    tolerance: float,
    seed: int,
) -> tuple[Float[ndarray, "n 3"], Bool[ndarray, " n"]]:
    """Return for each of n regions the plane p, p·ray = inverse depth, of most inliers, and whether it is `support`.

    The planes tried are random ones through three pixels, drawn with `seed`, and `support`, which needs only 80 % of
    the others' inliers. The k pixels are sorted by region; `of_region` are the index of the first pixel and the number
    of pixels of each region. `ray` has z = 1, and `depth` is inverse depth. `tolerance` is the largest relative
    residual of an inlier.
    """
    start, size = of_region
    share = np.random.default_rng(seed).random((len(start), TRIALS, 3))
    corner = start[:, None, None] + (share * size[:, None, None]).astype(int)
    (a, b, c), (ya, yb, yc) = np.moveaxis(ray[corner], 2, 0), np.moveaxis(depth[corner], 2, 0)[..., None]
    ab = np.cross(a, b)
    determinant = (ab * c).sum(-1, keepdims=True)
    determinant[np.abs(determinant) < 1e-6] = np.inf
    tried = (ya * np.cross(b, c) + yb * np.cross(c, a) + yc * ab) / determinant
    tried = np.concatenate([tried, np.broadcast_to(support, (len(start), 1, 3))], 1)
    relative = (ray / depth[:, None]).astype(np.float32)
    best, on = np.empty((len(start), 3)), np.zeros(len(start), bool)
    for r, (first, pixels) in enumerate(zip(start, size, strict=True)):
        some = slice(first, first + pixels, -(-pixels // SAMPLED))
        agree = np.count_nonzero(np.abs(relative[some] @ tried[r].T.astype(np.float32) - 1) < tolerance, 0)
        most = agree[:-1].argmax()
        on[r] = agree[-1] > 0 and agree[-1] >= 0.8 * agree[most]
        best[r] = support if on[r] else tried[r, most]
    return best, on


def _moments(
    label: Int[ndarray, " n"], pixel: Float[ndarray, "n 2"], count: int
) -> tuple[Int[ndarray, " r"], Float[ndarray, "r 2"], Float[ndarray, "r 2 2"]]:
    """Return number, mean (px) and covariance (px²) of the pixels of each label, for the r = `count` labels from 0 on.

    `label` and `pixel` (u, v) are those of n pixels. Mean and covariance of a label without pixels are 0.
    """
    number = np.bincount(label, minlength=count)

    def mean(values: Float[ndarray, " n"]) -> Float[ndarray, " r"]:
        return np.bincount(label, values, count) / np.maximum(number, 1)

    middle = np.stack([mean(axis) for axis in pixel.T], -1)
    u, v = (pixel - middle[label]).T
    xy = mean(u * v)
    return number, middle, np.stack([mean(u * u), xy, xy, mean(v * v)], -1).reshape(-1, 2, 2)
