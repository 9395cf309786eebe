"""Compiled comparison of depths and colours between views."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.numba_compile import compiled, inlined

SEEN_THROUGH = 0.01
"""Relative difference of depth: a neighbour whose depth at a point is farther by more sees through this point. Beside
an object's outline, the plain table often gets the object's depth; neighbours that see the table there show the
error."""


def inverse_depth_evidence(
    inverse_depth: Float[ndarray, "m h w"], known: Bool[ndarray, "m h w"], sees: Bool[ndarray, "m h w"]
) -> Float[ndarray, "m h w"]:
    """Return inverse depth 1/z with a code in its sign: 0 where it is not `known`, negative where `sees` is false.

    Such maps are the input of `agreement`. A pixel of `sees` may contradict depths of other images.
    """
    return np.where(known, np.where(sees, inverse_depth, -inverse_depth), 0).astype(np.float32, copy=False)


@compiled
@no_type_check
def agreement(sums, i, compared, others, a, b, centre, k, tolerance):
    """Compare the depth of each pixel of image i with the depths of the images `others`; return four maps, `sums`.

    `sums` (4,h,w) is 0 before. Map 0 is the mean inverse depth over image i and the images that agree, converted to
    image i. Maps 1 and 2 are the numbers of images that agree, and that see a surface more than 1 % behind the point.
    Map 3 is the sum over the agreeing images of |∂x/∂(inverse depth)|², x being the point's pixel there. Their depth is
    interpolated bilinearly, or is that of the nearest pixel if one of the four has none.

    `compared` (m,h,w) comes from `inverse_depth_evidence`. `others` (n) are image indices. R and t transform points of
    camera i to another camera, and K are the intrinsics. `a` (n,3,3) is K R and `b` (n,3) is K t; `centre` (n) is the
    z coordinate of the other camera's centre in camera i. `k` is fx, fy, cx, cy; `tolerance` is the largest relative
    difference of inverse depths that agree.
    """
    _, h, w = compared.shape
    half, one, tolerance = np.float32(0.5), np.float32(1), np.float32(tolerance)
    nearer = np.float32(1 - SEEN_THROUGH)
    pixels = np.empty((3, w), np.float32)
    for v in range(h):
        for n in range(len(others)):
            row, there = _row(v, n, a, b, k, w, h), compared[others[n]]
            for u in range(w):
                pixels[0, u], pixels[1, u], pixels[2, u] = _pixel(u, abs(compared[i, v, u]), row)
            for u in range(w):
                here, x, y, z = abs(compared[i, v, u]), pixels[0, u], pixels[1, u], pixels[2, u]
                if x < 0:
                    continue
                # Inverse depth there, interpolated; that of the nearest pixel if one of the four around is unknown.
                left, top = int(x), int(y)
                fx, fy = x - np.float32(left), y - np.float32(top)
                nearest = there[top + (fy >= half), left + (fx >= half)]
                p, q = abs(there[top, left]), abs(there[top, left + 1])
                r, s = abs(there[top + 1, left]), abs(there[top + 1, left + 1])
                found = z * abs(nearest)
                if p > 0 and q > 0 and r > 0 and s > 0:
                    upper, lower = p + fx * (q - p), r + fx * (s - r)
                    found = z * (upper + fy * (lower - upper))
                if nearest > 0 and found < here * nearer:
                    sums[2, v, u] += one
                if found > 0 and abs(found - here) < tolerance * here:
                    dx, dy = (b[n, 0] - x * b[n, 2]) / z, (b[n, 1] - y * b[n, 2]) / z
                    # Inverse depth in image i of the point that has the other image's depth on the other image's ray.
                    sums[0, v, u] += found / (centre[n] * found - centre[n] * here + one)
                    sums[1, v, u] += one
                    sums[3, v, u] += dx * dx + dy * dy
        for u in range(w):
            sums[0, v, u] = (abs(compared[i, v, u]) + sums[0, v, u]) / (one + sums[1, v, u])
    return sums


@compiled
@no_type_check
def colours_agree(sums, i, asked, inverse_depth, colors, others, a, b, k, tolerance):
    """Count for each pixel of image i the images that show its point in the same colour, in another, or see through it.

    The result `sums` (3,h,w), 0 before, has the three counts in this order. `asked` (h,w) is the inverse depth 1/z to
    test at each pixel, 0 for none. `inverse_depth` (m,h,w) is the matched inverse depth of all images, 0 for none.
    `colors` (m,h,w,3) are their RGB colours (0 to 1). Both are read at the nearest pixel. An image sees through the
    point if its matched depth is more than 1 % behind. An image whose matched depth is more than 1 % in front is not
    counted; one without depth is taken to see the point. Colours are the same if their Euclidean distance is below
    `tolerance`. `others` are the indices of the images to compare; their projections `a`, `b` and `k` are as in
    `agreement`.
    """
    h, w = asked.shape
    half, most = np.float32(0.5), np.float32(tolerance * tolerance)
    nearer, farther = np.float32(1 - SEEN_THROUGH), np.float32(1 + SEEN_THROUGH)
    for n in range(len(others)):
        j = others[n]
        for v in range(h):
            row = _row(v, n, a, b, k, w, h)
            for u in range(w):
                here = asked[v, u]
                x, y, z = _pixel(u, here, row)
                if x < 0:
                    continue
                p, q = int(y + half), int(x + half)
                there = z * inverse_depth[j, p, q] if inverse_depth[j, p, q] > 0 else here
                if there < here * nearer:
                    sums[2, v, u] += 1
                elif there <= here * farther:
                    red = colors[i, v, u, 0] - colors[j, p, q, 0]
                    green = colors[i, v, u, 1] - colors[j, p, q, 1]
                    blue = colors[i, v, u, 2] - colors[j, p, q, 2]
                    sums[int(red * red + green * green + blue * blue >= most), v, u] += 1
    return sums


@inlined
@no_type_check
def _row(v, n, a, b, k, width, height):
    """Return the coefficients that project the pixels of row v into the n-th other image; a, b, k as in `agreement`.

    The first three elements are (f, g, h) for x, y and z of the homogeneous pixel f·r + g + h·(inverse depth). Here r
    is the x coordinate of the pixel's ray with z = 1. The last element is (largest x, largest y, cx, 1/fx).
    """
    ry = (np.float32(v) - k[3]) / k[1]
    x = a[n, 0, 0], a[n, 0, 1] * ry + a[n, 0, 2], b[n, 0]
    y = a[n, 1, 0], a[n, 1, 1] * ry + a[n, 1, 2], b[n, 1]
    z = a[n, 2, 0], a[n, 2, 1] * ry + a[n, 2, 2], b[n, 2]
    return x, y, z, (np.float32(width - 1), np.float32(height - 1), k[2], np.float32(1) / k[0])


@inlined
@no_type_check
def _pixel(u, inverse_depth, row):
    """Return the pixel x, y in the other image, and the depth there over that here, of pixel u of a row (`_row`).

    x is -1 if the inverse depth is 0, or if the point is behind the other camera or outside of its image.
    """
    (x0, x1, bx), (y0, y1, by), (z0, z1, bz), (right, bottom, cx, per_fx) = row
    ray = (np.float32(u) - cx) * per_fx
    z = z0 * ray + z1 + bz * inverse_depth
    ahead = (inverse_depth > 0) & (z > 0)
    divisor = z if ahead else np.float32(1)
    x, y = (x0 * ray + x1 + bx * inverse_depth) / divisor, (y0 * ray + y1 + by * inverse_depth) / divisor
    inside = ahead & (x >= 0) & (y >= 0) & (x < right) & (y < bottom)
    return x if inside else np.float32(-1), y, z
