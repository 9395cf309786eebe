"""Compiled loops of PatchMatch stereo: a plane for every pixel, found by passing good ones on to the neighbours.

Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011, for several views as in Schönberger et al., ECCV 2016. A
plane p of camera coordinates holds p·x = 1, so that p·ray is the inverse depth of a pixel whose ray has z = 1, and the
homography to a neighbour is K (R + t pᵀ) K⁻¹.

What the loops share: `found` (h,w,4) is each pixel's plane and its score, `windows` what `window.windows` makes of the
image, `packed` (n,y,x) what `window.quads` makes of its neighbours, continued by `PAD` pixels, `motions` (n,12) the rows
of K R and K t to each, and k is fx, fy, cx, cy. They are plain arguments: an array that is taken out of a
tuple is counted by numba, which takes longer than a window.
"""

from typing import no_type_check

import numpy as np

from jcr.compiled import compiled, inlined, random_state, uniform
from jcr.depth.window import NOISE, REACH, STRIDE, window_sums

MOST_SLANTED = 0.12
"""Cosine between a plane's normal and the ray, below which a surface shows too few pixels to be matched."""
PAD = 12
"""Pixels by which images are continued, so that windows at their borders need no question."""
BEST = 2
"""Neighbours whose correlations count at a pixel; the worse ones are taken to be occluded."""


@inlined
@no_type_check
def _ray(v, u, k):
    return (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]


@inlined
@no_type_check
def _column(motions, n, row, p):
    """A row of K (R + t pᵀ)."""
    t = motions[n, 9 + row]
    return (
        motions[n, 3 * row] + t * p[0],
        motions[n, 3 * row + 1] + t * p[1],
        motions[n, 3 * row + 2] + t * p[2],
    )


@inlined
@no_type_check
def _correlation(pixel, p, n, packed, motions, windows, k):
    """Correlation of the window at a pixel (v, u) on plane p with the n-th neighbour; -1 where that is not seen."""
    v, u = pixel
    rx, ry = _ray(v, u, k)
    # Columns of K (R + t pᵀ): along the ray's x, y and 1.
    x0, x1, x2 = _column(motions, n, 0, p)
    y0, y1, y2 = _column(motions, n, 1, p)
    z0, z1, z2 = _column(motions, n, 2, p)
    x, y, z = x0 * rx + x1 * ry + x2, y0 * rx + y1 * ry + y2, z0 * rx + z1 * ry + z2
    if z <= 0:
        return np.float32(-1)
    iz = np.float32(1) / z
    cu, cv = x * iz, y * iz
    # The window is small: its homography is taken as affine about the centre, which spares the divisions.
    sx, sy = np.float32(STRIDE) / k[0] * iz, np.float32(STRIDE) / k[1] * iz
    uu, vu = (x0 - cu * z0) * sx, (y0 - cv * z0) * sx
    uv, vv = (x1 - cu * z1) * sy, (y1 - cv * z1) * sy
    ru, rv = np.float32(REACH) * (abs(uu) + abs(uv)), np.float32(REACH) * (abs(vu) + abs(vv))
    right, bottom = np.float32(packed.shape[2] - 2 * PAD - 1), np.float32(packed.shape[1] - 2 * PAD - 1)
    pad, most = np.float32(PAD), np.float32(PAD - 2)
    if not (cu >= 0 and cv >= 0 and cu <= right and cv <= bottom and ru <= most and rv <= most):
        return np.float32(-1)
    mean, square, product = window_sums(packed, n, windows, pixel, cu + pad, cv + pad, uu, vu, uv, vv)
    variance = max(square - mean * mean, np.float32(0))
    return product / np.sqrt(variance + np.float32(NOISE * NOISE))


@inlined
@no_type_check
def _score(pixel, p, packed, motions, windows, k, asked):
    """Mean of the best correlations of the window at a pixel on plane p with the neighbours `asked` (h,w,a) there.

    No neighbour is left out where it could change nothing: the branch, which chance would take, takes longer.
    """
    v, u = pixel
    first = np.float32(-1)
    second = np.float32(-1)
    for n in range(asked.shape[2]):
        score = _correlation(pixel, p, asked[v, u, n], packed, motions, windows, k)
        first, second = max(first, score), max(second, min(first, score))
    if asked.shape[2] < BEST:
        return first
    return np.float32(0.5) * (first + second)


@inlined
@no_type_check
def _faces(p, rx, ry):
    """Whether the surface on the plane is seen from before, not too slanted."""
    inverse_depth = p[0] * rx + p[1] * ry + p[2]
    if inverse_depth <= 0:
        return False
    normal, ray = p[0] * p[0] + p[1] * p[1] + p[2] * p[2], rx * rx + ry * ry + np.float32(1)
    return inverse_depth > np.float32(MOST_SLANTED) * np.sqrt(normal * ray)


@compiled
@no_type_check
def random_planes(family, span, k, h, w, seed):
    """A plane for each pixel: half of them parallel to the family's between its two, half with any normal.

    The inverse depth of these lies in the span. The scores are left at 0.
    """
    state = random_state(seed)
    lowest, highest = span
    found = np.zeros((h, w, 4), np.float32)
    for v in range(h):
        for u in range(w):
            rx, ry = _ray(v, u, k)
            t = uniform(state)
            for c in range(3):
                found[v, u, c] = (1 - t) * family[0, c] + t * family[1, c]
            own = found[v, u, 0] * rx + found[v, u, 1] * ry + found[v, u, 2]
            if uniform(state) < 0.5 or own <= lowest:
                inverse_depth = lowest + (highest - lowest) * uniform(state)
                n0, n1, n2 = 2 * uniform(state) - 1, 2 * uniform(state) - 1, 1.0
                facing = n0 * rx + n1 * ry + n2
                if facing < 0.3:
                    n0, n1, facing = 0.0, 0.0, 1.0
                scale = inverse_depth / facing
                found[v, u, 0], found[v, u, 1], found[v, u, 2] = n0 * scale, n1 * scale, n2 * scale
    return found


@compiled
@no_type_check
def scores(found, asked, packed, motions, windows, k):
    """The score (h,w) of every pixel's plane."""
    h, w = asked.shape[:2]
    out = np.empty((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            p = found[v, u, 0], found[v, u, 1], found[v, u, 2]
            out[v, u] = _score((v, u), p, packed, motions, windows, k, asked)
    return out


@compiled
@no_type_check
def spread_planes(found, asked, packed, motions, windows, k, search, seed):
    """One pass over the image: each pixel takes its neighbours' planes, or a changed one, where that scores better.

    Passes alternate in direction (Bleyer et al. 2011, section 3.2), with the lowest bit of the seed. `search` is the
    span of inverse depths, the relative change of it that is tried, and of the normal, and how often it is: the change
    halves from try to try.
    """
    state = random_state(seed)
    h, w = asked.shape[:2]
    tries = search[3]
    backward = seed % 2 == 1
    towards = 1 if backward else -1
    for row in range(h):
        v = h - 1 - row if backward else row
        for column in range(w):
            u = w - 1 - column if backward else column
            rx, ry = _ray(v, u, k)
            here = found[v, u, 0], found[v, u, 1], found[v, u, 2], found[v, u, 3]
            for option in range(2 + tries):
                if option < 2:
                    y, x = (v, u + towards) if option == 0 else (v + towards, u)
                    if y < 0 or x < 0 or y >= h or x >= w:
                        continue
                    q = found[y, x, 0], found[y, x, 1], found[y, x, 2]
                    if q[0] == here[0] and q[1] == here[1] and q[2] == here[2]:
                        continue
                else:
                    q = _changed(here, rx, ry, search, option - 2, state)
                if not _faces(q, rx, ry):
                    continue
                new = _score((v, u), q, packed, motions, windows, k, asked)
                if new > here[3]:
                    here = q[0], q[1], q[2], new
            found[v, u, 0], found[v, u, 1], found[v, u, 2], found[v, u, 3] = here


@inlined
@no_type_check
def _changed(p, rx, ry, search, halvings, state):
    """A plane like p by chance."""
    lowest, highest, size, _ = search
    inverse_depth = p[0] * rx + p[1] * ry + p[2]
    scale = size * 0.5**halvings
    moved = inverse_depth * (1 + scale * (2 * uniform(state) - 1))
    moved = min(max(moved, lowest), highest)
    tilt = min(8 * scale, 0.5) * inverse_depth
    q0 = p[0] + tilt * (2 * uniform(state) - 1)
    q1 = p[1] + tilt * (2 * uniform(state) - 1)
    return np.float32(q0), np.float32(q1), np.float32(moved - q0 * rx - q1 * ry)
