"""Compiled loops of PatchMatch stereo: a plane for every pixel, found by passing good ones on to the neighbours.

Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011, for several views as in Schönberger et al., ECCV 2016. A
plane p of camera coordinates holds p·x = 1, so that p·ray is the inverse depth of a pixel whose ray has z = 1, and the
homography to a neighbour is K (R + t pᵀ) K⁻¹. Numba, for measured reasons: the loops below take 12 images of 400x300
in 8.5 s on two cores; a sweep of fronto-parallel windows in torch took 11 s, and its windows do not lie on slopes.
"""

from typing import no_type_check

import numpy as np

from jcr.compiled import compiled, random_state, uniform

REACH, STRIDE = 2, 2
"""The window has (2·reach + 1)² pixels, every `stride`-th in a row and column."""
TAPS = (2 * REACH + 1) ** 2
NOISE = 1.0 / 255
"""Standard deviation of pixel noise: where the texture is no stronger, the correlation fades to 0."""
COLOR_SIGMA = 0.1
"""Distance of colours (RGB, each 0 to 1) at which a pixel of the window counts 0.6."""
MOST_SLANTED = 0.12
"""Cosine between a plane's normal and the ray, below which a surface shows too few pixels to be matched."""
PAD = 12
"""Pixels by which images are continued, so that windows at their borders need no question."""
BEST = 2
"""Neighbours whose correlations count at a pixel; the worse ones are taken to be occluded."""


@compiled
@no_type_check
def window_weights(color, grey):
    """Weights (h,w,taps) of each window, whose sum is 1, the same times its greys, and their mean and variance (h,w,2).

    Pixels count by likeness to the central colour (Schönberger et al., ECCV 2016, eq. 6).
    """
    h, w = grey.shape
    weight = np.empty((h, w, TAPS), np.float32)
    weighted = np.empty((h, w, TAPS), np.float32)
    moments = np.empty((h, w, 2), np.float32)
    inverse = np.float32(-0.5 / COLOR_SIGMA**2)
    for v in range(h):
        for u in range(w):
            total = np.float32(0)
            mean = np.float32(0)
            square = np.float32(0)
            tap = 0
            for dv in range(-REACH * STRIDE, REACH * STRIDE + 1, STRIDE):
                y = min(max(v + dv, 0), h - 1)
                for du in range(-REACH * STRIDE, REACH * STRIDE + 1, STRIDE):
                    x = min(max(u + du, 0), w - 1)
                    d = np.float32(0)
                    for c in range(3):
                        e = color[y, x, c] - color[v, u, c]
                        d += e * e
                    k = np.exp(d * inverse)
                    weight[v, u, tap] = k
                    total += k
                    mean += k * grey[y, x]
                    square += k * grey[y, x] * grey[y, x]
                    tap += 1
            mean /= total
            tap = 0
            for dv in range(-REACH * STRIDE, REACH * STRIDE + 1, STRIDE):
                y = min(max(v + dv, 0), h - 1)
                for du in range(-REACH * STRIDE, REACH * STRIDE + 1, STRIDE):
                    weight[v, u, tap] /= total
                    weighted[v, u, tap] = weight[v, u, tap] * grey[y, min(max(u + du, 0), w - 1)]
                    tap += 1
            moments[v, u, 0] = mean
            moments[v, u, 1] = max(square / total - mean * mean, np.float32(0))
    return weight, weighted, moments


@compiled
@no_type_check
def _correlation(v, u, p0, p1, p2, n, greys, others, weight, weighted, moments, a, b, k):
    """Correlation of the window at (v, u) on plane p with the n-th neighbour; -1 where that does not see its centre.

    The greys go on beyond their borders by `PAD` pixels.
    """
    height, stride = greys.shape[1], greys.shape[2]
    flat, width, one = greys.ravel(), np.uint32(stride), np.uint32(1)
    start = np.uint32(others[n] * height * stride)
    pad = np.float32(PAD)
    inverse_fx, inverse_fy = np.float32(1) / k[0], np.float32(1) / k[1]
    rx, ry = (np.float32(u) - k[2]) * inverse_fx, (np.float32(v) - k[3]) * inverse_fy
    # Columns of K (R + t pᵀ): along the ray's x, y and 1.
    b0, b1, b2 = b[n, 0], b[n, 1], b[n, 2]
    x0, x1, x2 = a[n, 0, 0] + b0 * p0, a[n, 0, 1] + b0 * p1, a[n, 0, 2] + b0 * p2
    y0, y1, y2 = a[n, 1, 0] + b1 * p0, a[n, 1, 1] + b1 * p1, a[n, 1, 2] + b1 * p2
    z0, z1, z2 = a[n, 2, 0] + b2 * p0, a[n, 2, 1] + b2 * p1, a[n, 2, 2] + b2 * p2
    x, y, z = x0 * rx + x1 * ry + x2, y0 * rx + y1 * ry + y2, z0 * rx + z1 * ry + z2
    if z <= 0:
        return np.float32(-1)
    iz = np.float32(1) / z
    cu, cv = x * iz, y * iz
    # The window is small: its homography is taken as affine about the centre, which spares the divisions.
    sx, sy = np.float32(STRIDE) * inverse_fx * iz, np.float32(STRIDE) * inverse_fy * iz
    uu, vu = (x0 - cu * z0) * sx, (y0 - cv * z0) * sx
    uv, vv = (x1 - cu * z1) * sy, (y1 - cv * z1) * sy
    ru, rv = np.float32(REACH) * (abs(uu) + abs(uv)), np.float32(REACH) * (abs(vu) + abs(vv))
    inside = (
        cu >= 0
        and cv >= 0
        and cu <= np.float32(stride - 2 * PAD - 1)
        and cv <= np.float32(height - 2 * PAD - 1)
    )
    if not inside or ru > pad - 2 or rv > pad - 2:
        return np.float32(-1)
    cu, cv = cu + pad, cv + pad
    mean = np.float32(0)
    square = np.float32(0)
    product = np.float32(0)
    tap = np.uint32(0)
    for i in range(-REACH, REACH + 1):
        # A row's sums of their own: one long chain of additions would wait for itself.
        row_mean = np.float32(0)
        row_square = np.float32(0)
        row_product = np.float32(0)
        for j in range(-REACH, REACH + 1):
            px = cu + np.float32(j) * uu + np.float32(i) * uv
            py = cv + np.float32(j) * vu + np.float32(i) * vv
            ix, iy = np.uint32(px), np.uint32(py)
            fx, fy = px - np.float32(ix), py - np.float32(iy)
            at = start + iy * width + ix
            g00, g01, g10, g11 = flat[at], flat[at + one], flat[at + width], flat[at + width + one]
            top = g00 + fx * (g01 - g00)
            low = g10 + fx * (g11 - g10)
            g = top + fy * (low - top)
            k_g = weight[v, u, tap] * g
            row_mean += k_g
            row_square += k_g * g
            row_product += weighted[v, u, tap] * g
            tap += one
        mean += row_mean
        square += row_square
        product += row_product
    variance = max(square - mean * mean, np.float32(0))
    noise = np.float32(NOISE * NOISE)
    spread = np.sqrt((moments[v, u, 1] + noise) * (variance + noise))
    return (product - mean * moments[v, u, 0]) / spread


@compiled
@no_type_check
def _score(v, u, p0, p1, p2, greys, others, asked, weight, weighted, moments, a, b, k, least):
    """Mean of the best correlations of the window at (v, u) on plane p with the neighbours that it asks.

    `a` (n,3,3) is K R and `b` (n,3) K t to each neighbour, in rows `others` of `greys`; k is fx, fy, cx, cy; bit n of
    `asked` (h,w) says whether a pixel asks the n-th. -1 where the last neighbour could not lift it above `least`.
    """
    first = np.float32(-1)
    second = np.float32(-1)
    left = 0
    for n in range(len(others)):
        left += (asked[v, u] >> n) & 1
    for n in range(len(others)):
        if not (asked[v, u] >> n) & 1:
            continue
        if left == 1 and len(others) >= BEST and first + 1 <= 2 * least:
            return np.float32(-1)
        left -= 1
        score = _correlation(v, u, p0, p1, p2, n, greys, others, weight, weighted, moments, a, b, k)
        if score > first:
            first, second = score, first
        elif score > second:
            second = score
    if len(others) < BEST:
        return first
    return np.float32(0.5) * (first + second)


@compiled
@no_type_check
def best_neighbours(planes, count, greys, others, weight, weighted, moments, a, b, k):
    """Bits (h,w) of the `count` neighbours with which each pixel's plane correlates best."""
    h, w = planes.shape[:2]
    asked = np.zeros((h, w), np.uint8)
    scores = np.empty(len(others), np.float32)
    for v in range(h):
        for u in range(w):
            p0, p1, p2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            for n in range(len(others)):
                scores[n] = _correlation(
                    v, u, p0, p1, p2, n, greys, others, weight, weighted, moments, a, b, k
                )
            for _ in range(min(count, len(others))):
                n = scores.argmax()
                asked[v, u] |= 1 << n
                scores[n] = -2
    return asked


@compiled
@no_type_check
def _faces(p0, p1, p2, rx, ry):
    """Whether the surface on the plane is seen from before, not too slanted."""
    inverse_depth = p0 * rx + p1 * ry + p2
    if inverse_depth <= 0:
        return False
    return inverse_depth > MOST_SLANTED * np.sqrt((p0 * p0 + p1 * p1 + p2 * p2) * (rx * rx + ry * ry + 1))


@compiled
@no_type_check
def random_planes(family, lowest, highest, k, h, w, seed):
    """A plane for each pixel: half of them parallel to the family's between its two, half with any normal.

    The inverse depth of these lies between `lowest` and `highest`.
    """
    state = random_state(seed)
    planes = np.empty((h, w, 3), np.float32)
    for v in range(h):
        for u in range(w):
            rx, ry = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            t = uniform(state)
            planes[v, u] = (1 - t) * family[0] + t * family[1]
            if (
                uniform(state) < 0.5
                or planes[v, u, 0] * rx + planes[v, u, 1] * ry + planes[v, u, 2] <= lowest
            ):
                inverse_depth = lowest + (highest - lowest) * uniform(state)
                n0, n1, n2 = 2 * uniform(state) - 1, 2 * uniform(state) - 1, 1.0
                facing = n0 * rx + n1 * ry + n2
                if facing < 0.3:
                    n0, n1, facing = 0.0, 0.0, 1.0
                scale = inverse_depth / facing
                planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = n0 * scale, n1 * scale, n2 * scale
    return planes


@compiled
@no_type_check
def score_all(planes, score, greys, others, asked, weight, weighted, moments, a, b, k):
    """Write the score of every pixel's plane."""
    h, w = score.shape
    for v in range(h):
        for u in range(w):
            p0, p1, p2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            score[v, u] = _score(
                v, u, p0, p1, p2, greys, others, asked, weight, weighted, moments, a, b, k, np.float32(-2)
            )


@compiled
@no_type_check
def spread_planes(
    planes,
    score,
    greys,
    others,
    asked,
    weight,
    weighted,
    moments,
    a,
    b,
    k,
    lowest,
    highest,
    size,
    tries,
    backward,
    seed,
):
    """One pass over the image: each pixel takes its neighbours' planes, or a changed one, where that scores better.

    Passes alternate in direction (Bleyer et al. 2011, section 3.2). `size` is the relative change of inverse depth
    that is tried, and of the normal; it halves from try to try.
    """
    state = random_state(seed)
    h, w = score.shape
    towards = 1 if backward else -1
    for row in range(h):
        v = h - 1 - row if backward else row
        for column in range(w):
            u = w - 1 - column if backward else column
            rx, ry = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            best = score[v, u]
            for side in range(2):
                y, x = (v, u + towards) if side == 0 else (v + towards, u)
                if y < 0 or x < 0 or y >= h or x >= w:
                    continue
                q0, q1, q2 = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2]
                if q0 == planes[v, u, 0] and q1 == planes[v, u, 1] and q2 == planes[v, u, 2]:
                    continue
                if not _faces(q0, q1, q2, rx, ry):
                    continue
                new = _score(v, u, q0, q1, q2, greys, others, asked, weight, weighted, moments, a, b, k, best)
                if new > best:
                    best = new
                    planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = q0, q1, q2
            for t in range(tries):
                p0, p1, p2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
                inverse_depth = p0 * rx + p1 * ry + p2
                scale = size * 0.5**t
                moved = inverse_depth * (1 + scale * (2 * uniform(state) - 1))
                moved = min(max(moved, lowest), highest)
                tilt = min(8 * scale, 0.5) * inverse_depth
                q0 = p0 + tilt * (2 * uniform(state) - 1)
                q1 = p1 + tilt * (2 * uniform(state) - 1)
                q2 = moved - q0 * rx - q1 * ry
                if not _faces(q0, q1, q2, rx, ry):
                    continue
                new = _score(
                    v,
                    u,
                    np.float32(q0),
                    np.float32(q1),
                    np.float32(q2),
                    greys,
                    others,
                    asked,
                    weight,
                    weighted,
                    moments,
                    a,
                    b,
                    k,
                    best,
                )
                if new > best:
                    best = new
                    planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = q0, q1, q2
            score[v, u] = best


@compiled
@no_type_check
def to_the_peak(planes, score, greys, others, asked, weight, weighted, moments, a, b, k, step):
    """Move each plane to the peak of the parabola through its score and those `step` (relative) off."""
    h, w = score.shape
    views = (greys, others, asked, weight, weighted, moments, a, b, k)
    for v in range(h):
        for u in range(w):
            p0, p1, p2 = planes[v, u, 0], planes[v, u, 1], planes[v, u, 2]
            rx, ry = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            delta = np.float32(step * (p0 * rx + p1 * ry + p2))
            left = _score(v, u, p0, p1, p2 - delta, *views, np.float32(-2))
            right = _score(v, u, p0, p1, p2 + delta, *views, np.float32(-2))
            curvature = left - 2 * score[v, u] + right
            if curvature < -1e-6:
                shift = (left - right) / (2 * curvature)
                planes[v, u, 2] += min(max(shift, np.float32(-1)), np.float32(1)) * delta


@compiled
@no_type_check
def inverse_depths(planes, k):
    """Inverse depth (h,w) of each pixel's plane at the pixel."""
    h, w = planes.shape[:2]
    out = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            out[v, u] = (
                planes[v, u, 0] * (u - k[2]) / k[0] + planes[v, u, 1] * (v - k[3]) / k[1] + planes[v, u, 2]
            )
    return out
