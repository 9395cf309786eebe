"""Compiled loops of PatchMatch stereo: a plane for every pixel, propagated between pixels and varied at random.

Bleyer, Rhemann and Rother, "PatchMatch stereo", BMVC 2011, for several views as in Schönberger et al., ECCV 2016. A
plane is a vector p in the camera frame with p·x = 1 for its points x. So p·ray is the inverse depth of a pixel whose
ray has z = 1, and the homography to a neighbour is K (R + t pᵀ) K⁻¹. Planes propagate from row to row, for 16 pixels
of a row at once.

Arguments of the loops: `found` (4,h,w) is each pixel's plane and score, with whole blocks of `window.LANES` columns.
`windows` is the result of `window.windows` for the image, and `packed` (n,y,x) that of `window.quads` for its
neighbours, padded by `PAD` pixels. `motions` (n,12) are the rows of K R and K t to each neighbour; k is fx, fy, cx, cy.
For one block of pixels, `near` (n,12,lanes) describes the neighbours, as `window.correlate` reads them, and `each`
(n,lanes) are the correlations with them. `tried` (7,lanes) holds a plane in rows 0 to 2, input of `correlate` in rows 3
to 5, and the score. Arrays are plain arguments, because numba counts references of an array taken out of a tuple, which
takes longer than a window.
"""

from typing import no_type_check

import numpy as np

from jcr.depth.window_correlation import LANES, STRIDE, correlate
from jcr.numba_compile import compiled, inlined, uniform

MOST_SLANTED = 0.12
"""Least cosine between a plane's normal and the ray; a more slanted surface shows too few pixels to be matched."""
BEST = 2
"""Number of neighbours, the best ones, whose correlations are averaged at a pixel; others are taken to be occluded."""
NOT_COMPARED = -2.0
"""Score of a plane that has not been compared yet."""
_PASSED = 3
"""Number of planes that a pixel tries from the row before: that of its own column, and the best one to either side."""
_BESIDE = 3
"""Number of columns to either side in which the best plane is searched."""


@inlined
@no_type_check
def _ray(v, u, k):
    return (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]


@inlined
@no_type_check
def _look(v, u, motions, k, near):
    """Write the projections of 16 pixels of row v, from column u on, into the neighbour images to `near`.

    `motions` (n,12) has the rows of K R, and K t, for each neighbour; `k` is fx, fy, cx, cy. K are the intrinsics, and R
    and t transform points of this camera to the neighbour's. `near` (n,12,16) holds four vectors of three numbers. The
    first two are K R times the change of a ray by one window sample in u, and in v. The others are K R times the ray,
    and K t.
    """
    su, sv = np.float32(STRIDE) / k[0], np.float32(STRIDE) / k[1]
    for n in range(len(motions)):
        for lane in range(LANES):
            rx, ry = _ray(v, u + lane, k)
            for row in range(3):
                a, b, c = motions[n, 3 * row], motions[n, 3 * row + 1], motions[n, 3 * row + 2]
                near[n, row, lane] = a * su
                near[n, 3 + row, lane] = b * sv
                near[n, 6 + row, lane] = a * rx + b * ry + c
                near[n, 9 + row, lane] = motions[n, 9 + row]


@inlined
@no_type_check
def _score(v, u, tried, packed, windows, k, near, each):
    """Write to row 6 of `tried` the scores of 16 planes: the mean of the BEST highest correlations with neighbours.

    The pixels are those of row v from column u on. Rows 0 to 2 of `tried` (7,16) are their planes p, with p·x = 1 in
    the camera frame. Rows 3 to 5 are overwritten with the input of `correlate`. The correlations are written to `each`
    (n,16), one row per neighbour. `packed` (n,y,x) are the neighbours' greys from `quads`, and `near` comes from
    `_look`. `windows` is the result of `window_correlation.windows` for this image; `k` is fx, fy, cx, cy.
    """
    su, sv = np.float32(STRIDE) / k[0], np.float32(STRIDE) / k[1]
    for lane in range(LANES):
        rx, ry = _ray(v, u + lane, k)
        tried[3, lane], tried[4, lane] = tried[0, lane] * su, tried[1, lane] * sv
        tried[5, lane] = tried[0, lane] * rx + tried[1, lane] * ry + tried[2, lane]
    slots = len(each)
    for slot in range(slots):
        correlate(each, slot, packed, near, windows, (v, u // LANES), tried)
    for lane in range(LANES):
        first, second = each[0, lane], np.float32(-1)
        for slot in range(1, slots):
            one = each[slot, lane]
            first, second = max(first, one), max(second, min(first, one))
        tried[6, lane] = first if slots < BEST else np.float32(0.5) * (first + second)


@inlined
@no_type_check
def _keep_better(found, v, u, k, tried):
    """Replace the planes of 16 pixels in `found` by those in `tried` with a higher score that face the camera.

    The pixels are those of row v from column u on. A plane faces the camera if the cosine between its normal and the
    ray is above MOST_SLANTED. Rows 0 to 2 of `found` (4,h,w) and `tried` (7,16) are the plane p, with p·x = 1 for
    its points x in the camera frame. The score is row 3 of `found` and row 6 of `tried`. Row 5 of `tried` is the inverse
    depth; its rows 3 and 4 are not read. `k` is fx, fy, cx, cy.
    """
    for lane in range(LANES):
        rx, ry = _ray(v, u + lane, k)
        p0, p1, p2, here = tried[0, lane], tried[1, lane], tried[2, lane], tried[5, lane]
        normal, ray = p0 * p0 + p1 * p1 + p2 * p2, rx * rx + ry * ry + np.float32(1)
        faces = here > 0 and here > np.float32(MOST_SLANTED) * np.sqrt(normal * ray)
        if faces and tried[6, lane] > found[3, v, u + lane]:
            found[0, v, u + lane], found[1, v, u + lane], found[2, v, u + lane] = p0, p1, p2
            found[3, v, u + lane] = tried[6, lane]


@inlined
@no_type_check
def _try_passed(found, row, u, side, tried):
    """Write to rows 0 to 2 of `tried` (7,16) the planes that `found` (4,h,w) has in image row `row`, for 16 pixels.

    The pixels are those from column u on. For `side` 0 the planes are those of the same columns. For `side` -1 (1) they
    are those of highest score (row 3 of `found`) among the _BESIDE columns to the left (right).
    """
    last = found.shape[2] - 1
    for lane in range(LANES):
        best = min(max(u + lane + side, 0), last)
        for far in range(2, _BESIDE + 1 if side != 0 else 2):
            column = min(max(u + lane + side * far, 0), last)
            if found[3, row, column] > found[3, row, best]:
                best = column
        for c in range(3):
            tried[c, lane] = found[c, row, best]


@inlined
@no_type_check
def _try_changed(found, v, u, k, search, halvings, state, tried):
    """Write to rows 0 to 2 of `tried` the planes of 16 pixels with random changes of depth and normal.

    The planes are those in `found` (4,h,w) of row v, from column u on; `k` is fx, fy, cx, cy. The first three elements
    of `search` are lowest inverse depth, highest one, and its largest relative change, which is halved `halvings`
    times. `state` is the state of the random generator `uniform`, which is updated.
    """
    lowest, highest, size = search[:3]
    scale = size * 0.5**halvings
    for lane in range(LANES):
        rx, ry = _ray(v, u + lane, k)
        p0, p1, p2 = found[0, v, u + lane], found[1, v, u + lane], found[2, v, u + lane]
        inverse_depth = p0 * rx + p1 * ry + p2
        changed = inverse_depth * (1 + scale * (2 * uniform(state) - 1))
        changed = min(max(changed, lowest), highest)
        tilt = min(8 * scale, 0.5) * inverse_depth
        q0 = p0 + tilt * (2 * uniform(state) - 1)
        q1 = p1 + tilt * (2 * uniform(state) - 1)
        tried[0, lane], tried[1, lane], tried[2, lane] = q0, q1, changed - q0 * rx - q1 * ry


@compiled
@no_type_check
def random_planes(found, family, span, k, state):
    """Write a random plane for each pixel to rows 0 to 2 of `found` (4,h,w).

    Planes are vectors p in the camera frame with p·x = 1; `k` is fx, fy, cx, cy. About half of the planes are random
    mixtures of the two planes in `family` (2,3). The others have random normals and an inverse depth in `span`. `state`
    is the state of the random generator `uniform`, which is updated.
    """
    lowest, highest = span
    for v in range(found.shape[1]):
        for u in range(found.shape[2]):
            rx, ry = _ray(v, u, k)
            t = uniform(state)
            for c in range(3):
                found[c, v, u] = (1 - t) * family[0, c] + t * family[1, c]
            own = found[0, v, u] * rx + found[1, v, u] * ry + found[2, v, u]
            if uniform(state) < 0.5 or own <= lowest:
                inverse_depth = lowest + (highest - lowest) * uniform(state)
                n0, n1, n2 = 2 * uniform(state) - 1, 2 * uniform(state) - 1, 1.0
                facing = n0 * rx + n1 * ry + n2
                if facing < 0.3:
                    n0, n1, facing = 0.0, 0.0, 1.0
                scale = inverse_depth / facing
                found[0, v, u], found[1, v, u], found[2, v, u] = n0 * scale, n1 * scale, n2 * scale


@compiled
@no_type_check
def spread_planes(found, packed, motions, windows, k, search, number, state):
    """Update the planes of all pixels in `found` once by planes of the row before or random changes that score higher.

    `found` (4,h,w), plane and score, is changed in place.
    `packed` (n,y,x) are the neighbours' greys from `quads`, and `motions` (n,12) the rows of K R, and K t, to them.
    `windows` is the result of `window_correlation.windows` for this image; `k` is fx, fy, cx, cy. `number` counts the
    passes at one resolution. Rows are visited downwards for even and upwards for odd numbers (Bleyer et al. 2011,
    section 3.2); in pass 0 the planes have no score yet. `search` is (lowest inverse depth, highest one, relative
    change to try,
    number of tries). The change of inverse depth and normal halves from try to try. `state` is the state of the random
    generator `uniform`, which is updated.
    """
    _, h, w = found.shape
    near, each = np.empty((len(motions), 12, LANES), np.float32), np.empty((len(motions), LANES), np.float32)
    tried = np.empty((7, LANES), np.float32)
    tries = search[3]
    for row in range(h):
        v, before = (row, row - 1) if number % 2 == 0 else (h - 1 - row, h - row)
        for u in range(0, w, LANES):
            _look(v, u, motions, k, near)
            for option in range(-1 if number == 0 else 0, _PASSED + tries):
                if option < 0:
                    _try_passed(found, v, u, 0, tried)
                elif option >= _PASSED:
                    _try_changed(found, v, u, k, search, option - _PASSED, state, tried)
                elif row > 0:
                    _try_passed(found, before, u, option - 1, tried)
                else:
                    continue
                _score(v, u, tried, packed, windows, k, near, each)
                _keep_better(found, v, u, k, tried)
