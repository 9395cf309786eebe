"""Regions of one colour in an image, and the planes that the matched depths in each of them lie on."""

from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.compiled import compiled, random_state, uniform

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
"""Of a region's variance across, that of the pixels which carry its plane has at least: those along one edge say nothing
of the slope across it, and they may be the next thing's."""


def colour_regions(color: Float[ndarray, "h w 3"]) -> tuple[Int[ndarray, "h w"], int]:
    """Label of each pixel's region, and how many there are (Felzenszwalb and Huttenlocher, IJCV 2004).

    The image is smoothed with its edges kept; noise and JPEG blocks would otherwise join regions.
    """
    smooth = cv2.bilateralFilter(color, 7, 0.07, 3)
    right = np.abs(np.diff(smooth, axis=1)).max(-1)
    down = np.abs(np.diff(smooth, axis=0)).max(-1)
    h, w = color.shape[:2]
    index = np.arange(h * w, dtype=np.int32).reshape(h, w)
    weight = np.concatenate([right.ravel(), down.ravel()])
    first = np.concatenate([index[:, :-1].ravel(), index[:-1].ravel()])
    second = np.concatenate([index[:, 1:].ravel(), index[1:].ravel()])
    order = np.argsort(weight, kind="stable")
    root = _joined(first[order], second[order], weight[order], h * w)
    label, count = np.unique(root, return_inverse=True)[1].reshape(h, w), len(np.unique(root))
    return label.astype(np.int32), count


@compiled
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
    """For each region the plane (count,3) that most of its matched pixels lie on, and what speaks for it.

    Gives planes, whether each is the support's, inliers, matched pixels, root mean square of the inliers' relative
    residuals, and mean (count,2) and inverse covariance (count,3: xx, xy, yy) in the image of the pixels that carry it.
    A region without a plane has 0 inliers. `support` (3)
    is that plane in the camera's coordinates; it wins where it carries nearly as many pixels as the best. `tolerance`
    is relative, of inverse depth.
    """
    state = random_state(seed)
    h, w = label.shape
    size = np.zeros(count, np.int64)
    held = np.zeros(count, np.int64)
    for v in range(h):
        for u in range(w):
            size[label[v, u]] += 1
            held[label[v, u]] += matched[v, u]
    start = np.zeros(count + 1, np.int64)
    for r in range(count):
        start[r + 1] = start[r] + held[r]
    at = start[:-1].copy()
    pixel = np.empty(start[-1], np.int64)
    for v in range(h):
        for u in range(w):
            if matched[v, u]:
                r = label[v, u]
                pixel[at[r]] = v * w + u
                at[r] += 1
    planes = np.zeros((count, 3))
    on_support = np.zeros(count, np.bool_)
    inliers = np.zeros(count, np.int64)
    rest = np.zeros(count)
    middle = np.zeros((count, 2))
    shape = np.zeros((count, 3))
    region_moments = np.zeros((count, 5))
    for v in range(h):
        for u in range(w):
            m = region_moments[label[v, u]]
            m[0] += u
            m[1] += v
            m[2] += u * u
            m[3] += u * v
            m[4] += v * v
    rays = np.empty((SAMPLED, 3))
    depths = np.empty(SAMPLED)
    for r in range(count):
        n = held[r]
        if n < FEWEST:
            continue
        taken = min(n, SAMPLED)
        for t in range(taken):
            q = pixel[start[r] + (t if n <= SAMPLED else int(n * uniform(state)))]
            v, u = q // w, q % w
            rays[t, 0], rays[t, 1], rays[t, 2] = (u - k[2]) / k[0], (v - k[3]) / k[1], 1.0
            depths[t] = inverse_depth[v, u]
        best, of_support = 0, 0
        plane = np.zeros(3)
        for trial in range(-1, TRIALS):
            if trial < 0:
                p = support.copy()
            else:
                first, second = int(taken * uniform(state)), int(taken * uniform(state))
                third = int(taken * uniform(state))
                a = np.stack((rays[first], rays[second], rays[third]))
                if abs(np.linalg.det(a)) < 1e-6:
                    continue
                p = np.linalg.solve(a, np.array([depths[first], depths[second], depths[third]]))
            agree = 0
            for t in range(taken):
                predicted = p[0] * rays[t, 0] + p[1] * rays[t, 1] + p[2]
                agree += abs(predicted - depths[t]) < tolerance * depths[t]
            if trial < 0:
                of_support = agree
            if agree > best:
                best = agree
                plane = p
        is_support = of_support >= 0.8 * best and of_support > 0
        if is_support:
            plane = support.copy()
        else:
            # Least squares over all that agree.
            normal = np.zeros((3, 3))
            right = np.zeros(3)
            for t in range(taken):
                predicted = plane[0] * rays[t, 0] + plane[1] * rays[t, 1] + plane[2]
                if abs(predicted - depths[t]) < tolerance * depths[t]:
                    for x in range(3):
                        right[x] += rays[t, x] * depths[t]
                        for y in range(3):
                            normal[x, y] += rays[t, x] * rays[t, y]
            if abs(np.linalg.det(normal)) < 1e-12:
                continue
            plane = np.linalg.solve(normal, right)
        total, squares = 0, 0.0
        m = np.zeros(5)
        for s in range(start[r], start[r + 1]):
            v, u = pixel[s] // w, pixel[s] % w
            predicted = plane[0] * (u - k[2]) / k[0] + plane[1] * (v - k[3]) / k[1] + plane[2]
            if abs(predicted - inverse_depth[v, u]) < tolerance * inverse_depth[v, u]:
                total += 1
                squares += (predicted / inverse_depth[v, u] - 1) ** 2
                m[0] += u
                m[1] += v
                m[2] += u * u
                m[3] += u * v
                m[4] += v * v
        if total < FEWEST:
            continue
        least = _narrow(region_moments[r], size[r])
        if _narrow(m, total) < SPREAD * least:
            continue
        planes[r] = plane
        on_support[r] = is_support
        inliers[r] = total
        rest[r] = np.sqrt(squares / total)
        middle[r, 0], middle[r, 1] = m[0] / total, m[1] / total
        xx = m[2] / total - middle[r, 0] ** 2 + 1
        xy = m[3] / total - middle[r, 0] * middle[r, 1]
        yy = m[4] / total - middle[r, 1] ** 2 + 1
        determinant = xx * yy - xy * xy
        shape[r, 0], shape[r, 1], shape[r, 2] = yy / determinant, -xy / determinant, xx / determinant
    return planes, on_support, inliers, held, rest, middle, shape


@compiled
@no_type_check
def _narrow(moments, n):
    """The smaller eigenvalue of the covariance of pixels, from the sums of u, v, uu, uv, vv."""
    x, y = moments[0] / n, moments[1] / n
    xx, xy, yy = moments[2] / n - x * x, moments[3] / n - x * y, moments[4] / n - y * y
    return 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
