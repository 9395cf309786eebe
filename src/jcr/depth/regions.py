"""Regions of one colour in an image, and the planes that the matched depths in each of them lie on."""

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.compiled import compiled, inlined, random_state, uniform

SCALE = 0.35
"""k of Felzenszwalb and Huttenlocher 2004, eq. 4, for colours from 0 to 1: the larger, the larger the regions."""
SMALLEST = 12
"""Pixels of a region; smaller ones join the neighbour most like them."""
TRIALS = 60
"""Planes drawn for a region."""
FEWEST = 12
"""Matched pixels that a region's plane rests on at least."""
SAMPLED = 400
"""Matched pixels of a region that take part in the drawing."""
SPREAD = 0.08
"""Least share of a region's variance across that the pixels which support its plane have: pixels along one edge do not
determine the slope across it, and may belong to the next object."""


def colour_regions(color: Float[ndarray, "h w 3"]) -> tuple[Int[ndarray, "h w"], int]:
    """Return the label of each pixel's region and the number of regions (Felzenszwalb and Huttenlocher, IJCV 2004).

    The image is smoothed with its edges kept; noise and JPEG blocks would otherwise join regions.
    """
    smooth = cv2.bilateralFilter(color, 7, 0.07, 3)
    steps = (np.abs(np.diff(smooth, axis=axis)) for axis in (1, 0))
    weight = np.concatenate([np.maximum(np.maximum(*step.T[:2]), step.T[2]).T.ravel() for step in steps])
    h, w = color.shape[:2]
    index = np.arange(h * w, dtype=np.int32).reshape(h, w)
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    order = _ascending(weight)
    root = _joined(first[order], second[order], weight[order], h * w)
    is_root = root == np.arange(h * w)
    label = (np.cumsum(is_root, dtype=np.int32) - 1)[root].reshape(h, w)
    return label, int(is_root.sum())


def _ascending(weight: Float[ndarray, " e"]) -> Int[ndarray, " e"]:
    """Return the stable np.argsort of numbers that are not negative; sorting their bits takes a fifth of the time."""
    bits = weight.astype(np.float32, copy=False).view(np.uint32)
    by_low = np.argsort(bits.astype(np.uint16), kind="stable")
    return by_low[np.argsort((bits >> 16).astype(np.uint16)[by_low], kind="stable")]


@inlined
@no_type_check
def _root(parent, x):
    while parent[x] != x:
        parent[x] = parent[parent[x]]
        x = parent[x]
    return x


@compiled
@no_type_check
def _joined(first, second, weight, n):
    parent = np.arange(n)
    size = np.ones(n, np.int64)
    inner = np.zeros(n, np.float32)
    for small in range(2):
        for e in range(len(weight)):
            a, b = _root(parent, first[e]), _root(parent, second[e])
            if a == b:
                continue
            if small == 1:
                join = size[a] < SMALLEST or size[b] < SMALLEST
            else:
                join = weight[e] <= min(inner[a] + SCALE / size[a], inner[b] + SCALE / size[b])
            if join:
                parent[b] = a
                size[a] += size[b]
                inner[a] = max(weight[e], inner[a], inner[b])
    for x in range(n):
        parent[x] = _root(parent, x)
    return parent


@compiled
@no_type_check
def region_planes(label, count, inverse_depth, matched, support, k, tolerance, seed):
    """Return each region's plane (count,3), on which most of its matched pixels lie, and its support.

    Gives planes, whether each is the support's, inliers, matched pixels, root mean square of the inliers' relative
    residuals, and mean (count,2) and inverse covariance (count,3: xx, xy, yy) in the image of the pixels that carry it.
    A region without a plane has 0 inliers. `support` (3)
    is that plane in the camera's coordinates; it wins where it carries nearly as many pixels as the best. `tolerance`
    is relative, of inverse depth.
    """
    state = random_state(seed)
    whole, fixed, start, pixel = _by_region(label, count, matched)
    planes, on_support = np.zeros((count, 3)), np.zeros(count, np.bool_)
    inliers, rest = np.zeros(count, np.int64), np.zeros(count)
    middle, shape = np.zeros((count, 2)), np.zeros((count, 3))
    samples = np.empty((SAMPLED, 3))
    for r in range(count):
        if fixed[r] < FEWEST:
            continue
        of_region = pixel[start[r] : start[r + 1]]
        taken = _sample(samples, of_region, inverse_depth, k, state)
        plane, is_support = _best_plane(samples[:taken], support, tolerance, state)
        if not is_support:
            # Least squares over all that agree.
            plane, found = _fit(samples[:taken], plane, tolerance)
            if not found:
                continue
        carried = np.zeros(6, np.float64)
        squares = _carry(carried, of_region, inverse_depth, plane, k, tolerance)
        total = carried[0]
        if total < FEWEST or _narrow(carried) < SPREAD * _narrow(whole[r]):
            continue
        planes[r, 0], planes[r, 1], planes[r, 2] = plane
        on_support[r] = is_support
        inliers[r] = total
        rest[r] = np.sqrt(squares / total)
        x, y, xx, xy, yy = _covariance(carried)
        determinant = (xx + 1) * (yy + 1) - xy * xy
        middle[r, 0], middle[r, 1] = x, y
        shape[r, 0], shape[r, 1], shape[r, 2] = (
            (yy + 1) / determinant,
            -xy / determinant,
            (xx + 1) / determinant,
        )
    return planes, on_support, inliers, fixed, rest, middle, shape


@compiled
@no_type_check
def _by_region(label, count, matched):
    """Return each region's moments (count,6), number of matched pixels, and where these begin in the list of all."""
    h, w = label.shape
    whole = np.zeros((count, 6))
    fixed = np.zeros(count, np.int64)
    for v in range(h):
        for u in range(w):
            _add(whole[label[v, u]], u, v)
            fixed[label[v, u]] += matched[v, u]
    start, at = np.zeros(count + 1, np.int64), np.zeros(count, np.int64)
    for r in range(count):
        at[r] = start[r]
        start[r + 1] = start[r] + fixed[r]
    pixel = np.empty(start[count], np.int64)
    for v in range(h):
        for u in range(w):
            if matched[v, u]:
                pixel[at[label[v, u]]] = v * w + u
                at[label[v, u]] += 1
    return whole, fixed, start, pixel


@inlined
@no_type_check
def _add(moments, u, v):
    """Add a pixel to the number and the sums of u, v, uu, uv, vv."""
    moments[0] += 1
    moments[1] += u
    moments[2] += v
    moments[3] += u * u
    moments[4] += u * v
    moments[5] += v * v


@inlined
@no_type_check
def _covariance(moments):
    """Return mean x and y, and covariance xx, xy, yy."""
    n = moments[0]
    x, y = moments[1] / n, moments[2] / n
    return x, y, moments[3] / n - x * x, moments[4] / n - x * y, moments[5] / n - y * y


@inlined
@no_type_check
def _narrow(moments):
    """Return the smaller eigenvalue of the covariance."""
    _, _, xx, xy, yy = _covariance(moments)
    return 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)


@inlined
@no_type_check
def _sample(samples, of_region, inverse_depth, k, state):
    """Write x and y of the ray and the inverse depth of the matched pixels, or of some; gives how many."""
    w, n = inverse_depth.shape[1], len(of_region)
    taken = min(n, SAMPLED)
    for t in range(taken):
        q = of_region[t if n <= SAMPLED else int(n * uniform(state))]
        v, u = q // w, q % w
        samples[t, 0], samples[t, 1] = (u - k[2]) / k[0], (v - k[3]) / k[1]
        samples[t, 2] = inverse_depth[v, u]
    return taken


@inlined
@no_type_check
def _agrees(samples, t, p, tolerance):
    predicted = p[0] * samples[t, 0] + p[1] * samples[t, 1] + p[2]
    return abs(predicted - samples[t, 2]) < tolerance * samples[t, 2]


@inlined
@no_type_check
def _supporters(samples, p, tolerance):
    count = 0
    for t in range(len(samples)):
        count += _agrees(samples, t, p, tolerance)
    return count


@inlined
@no_type_check
def _best_plane(samples, support, tolerance, state):
    """Return the plane through three samples with which most agree, or the support plane, and which of the two it is."""
    of_support = (support[0], support[1], support[2])
    plane, most, n = of_support, 0, len(samples)
    for _ in range(TRIALS):
        first, second, third = int(n * uniform(state)), int(n * uniform(state)), int(n * uniform(state))
        a, b, c = _row(samples, first), _row(samples, second), _row(samples, third)
        right = (samples[first, 2], samples[second, 2], samples[third, 2])
        p, determinant = _solve(a, b, c, right)
        if abs(determinant) < 1e-6:
            continue
        agree = _supporters(samples, p, tolerance)
        if agree > most:
            most, plane = agree, p
    agree = _supporters(samples, of_support, tolerance)
    if agree > 0 and agree >= 0.8 * most:
        return of_support, True
    return plane, False


@inlined
@no_type_check
def _row(samples, t):
    return samples[t, 0], samples[t, 1], 1.0


@inlined
@no_type_check
def _fit(samples, plane, tolerance):
    """Return the least-squares plane of the samples that agree with one, and whether they determine it."""
    xx, xy, yy, x, y, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xd, yd, d = 0.0, 0.0, 0.0
    for t in range(len(samples)):
        if _agrees(samples, t, plane, tolerance):
            rx, ry, depth = samples[t, 0], samples[t, 1], samples[t, 2]
            xx, xy, yy = xx + rx * rx, xy + rx * ry, yy + ry * ry
            x, y, n = x + rx, y + ry, n + 1.0
            xd, yd, d = xd + rx * depth, yd + ry * depth, d + depth
    p, determinant = _solve((xx, xy, x), (xy, yy, y), (x, y, n), (xd, yd, d))
    return p, abs(determinant) >= 1e-12


@inlined
@no_type_check
def _solve(a, b, c, right):
    """Return p with a·p, b·p, c·p = right by Cramer's rule, and the determinant, without which p means nothing."""
    bc, ca, ab = _cross(b, c), _cross(c, a), _cross(a, b)
    determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2]
    p0 = (right[0] * bc[0] + right[1] * ca[0] + right[2] * ab[0]) / determinant
    p1 = (right[0] * bc[1] + right[1] * ca[1] + right[2] * ab[1]) / determinant
    p2 = (right[0] * bc[2] + right[1] * ca[2] + right[2] * ab[2]) / determinant
    return (p0, p1, p2), determinant


@inlined
@no_type_check
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
@no_type_check
def _carry(carried, of_region, inverse_depth, plane, k, tolerance):
    """Add the matched pixels on the plane to the moments; gives the sum of squares of their relative residuals."""
    w, squares = inverse_depth.shape[1], 0.0
    for s in range(len(of_region)):
        v, u = of_region[s] // w, of_region[s] % w
        predicted = plane[0] * (u - k[2]) / k[0] + plane[1] * (v - k[3]) / k[1] + plane[2]
        if abs(predicted - inverse_depth[v, u]) < tolerance * inverse_depth[v, u]:
            squares += (predicted / inverse_depth[v, u] - 1) ** 2
            _add(carried, u, v)
    return squares
