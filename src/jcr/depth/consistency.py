"""Compiled comparison of depths and colours between views, 16 pixels of a row at once in vector registers."""

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic
from numpy import ndarray

from jcr.compiled import compiled, inlined
from jcr.depth.lanes import INT, LONG, Lanes

LANES = 16
SEEN_THROUGH = 0.01
"""Relative difference of depth: a neighbour whose depth at a point is farther by more sees through this point. Beside
an object's outline, the plain table often gets the object's depth; neighbours that see the table there show the
error."""


def inverse_depth_evidence(
    inverse_depth: Float[ndarray, "m h w"], known: Bool[ndarray, "m h w"], sees: Bool[ndarray, "m h w"]
) -> Float[ndarray, "m h _"]:
    """Return inverse depth 1/z with a code in its sign: 0 where it is not `known`, negative where `sees` is false.

    Such maps are the input of `agreement`. A pixel of `sees` may contradict depths of other images. The image width w
    is padded with zeros to a multiple of LANES (16).
    """
    maps = np.where(known, np.where(sees, inverse_depth, -inverse_depth), 0).astype(np.float32, copy=False)
    return np.pad(maps, [(0, 0), (0, 0), (0, -maps.shape[2] % LANES)])


@compiled
@no_type_check
def agreement(i, compared, others, a, b, centre, k, width, tolerance):
    """Compare the depth of each pixel of image i with the depths of the images `others`; return four maps (4,h,w).

    Map 0 is the mean inverse depth over image i and the images that agree, converted to image i. Maps 1 and 2 are the
    numbers of images that agree, and that see a surface more than 1 % behind the point. Map 3 is the sum over the
    agreeing images of |∂x/∂(inverse depth)|², x being the point's pixel there. Their depth is interpolated bilinearly,
    or is that of the nearest pixel if one of the four has none.

    `compared` (m,h,w padded) comes from `inverse_depth_evidence`; `width` is the images' width before padding. `others`
    (n) are image indices. R and t transform points of camera i to another camera, and K are the intrinsics. `a` (n,3,3)
    is K R and `b` (n,3) is K t; `centre` (n) is the z coordinate of the other camera's centre in camera i. `k` is fx,
    fy, cx, cy; `tolerance` is the largest relative difference of inverse depths that agree.
    """
    _, h, w = compared.shape
    one, tolerance = np.float32(1), np.float32(tolerance)
    sums = np.zeros((4, h, w), np.float32)
    for v in range(h):
        for n in range(len(others)):
            rays = _row(v, n, a, b, k, width, h)
            for u in range(0, w, LANES):
                _compare_depths(sums, compared, (i, others[n], v, u), rays, (centre[n], tolerance))
        for u in range(width):
            sums[0, v, u] = (abs(compared[i, v, u]) + sums[0, v, u]) / (one + sums[1, v, u])
    return sums[:, :, :width]


@compiled
@no_type_check
def colours_agree(i, asked, inverse_depth, colors, others, a, b, k, tolerance):
    """Count for each pixel of image i the images that show its point in the same colour, in another, or see through it.

    The result (3,h,w) has the three counts in this order. `asked` (h,w) is the inverse depth 1/z to test at each pixel,
    0 for none. `inverse_depth` (m,h,w) is the matched inverse depth of all images, 0 for none. `colors` (m,h,w,3) are
    their RGB colours (0 to 1). Both are read at the nearest pixel. An image sees through the point if its matched depth
    is more than 1 % behind. An image whose matched depth is more than 1 % in front is not counted; one without depth is
    taken to see the point. Colours are the same if their Euclidean distance is below `tolerance`. `others` are the
    indices of the images to compare; their projections `a`, `b` and `k` are as in `agreement`.
    """
    h, w = asked.shape
    half, most = np.float32(0.5), np.float32(tolerance * tolerance)
    nearer, farther = np.float32(1 - SEEN_THROUGH), np.float32(1 + SEEN_THROUGH)
    sums = np.zeros((3, h, w), np.float32)
    for n in range(len(others)):
        j = others[n]
        for v in range(h):
            (x0, x1, bx), (y0, y1, by), (z0, z1, bz), (right, bottom, cx, per_fx) = _row(v, n, a, b, k, w, h)
            for u in range(w):
                here, ray = asked[v, u], (np.float32(u) - cx) * per_fx
                z = z0 * ray + z1 + bz * here
                if here <= 0 or z <= 0:
                    continue
                x, y = (x0 * ray + x1 + bx * here) / z, (y0 * ray + y1 + by * here) / z
                if x < 0 or y < 0 or x >= right or y >= bottom:
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


@intrinsic
@no_type_check
def _compare_depths(typing, sums, compared, place, rays, rest):
    """Add to `sums`, the maps of `agreement`, the comparison of 16 pixels of image i with image j.

    `typing` is numba's typing context, which is not used; `compared` is that of `agreement`. `place` is (i, j, v, u):
    the two images, the row, and the first of the 16 columns. `rays` comes from `_row`; `rest` is (`centre` of image j,
    `tolerance`).
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        out, maps = (context.make_array(signature.args[n])(context, builder, given[n]) for n in range(2))
        _, height, width = cgutils.unpack_tuple(builder, maps.shape)
        i, j, v, u = cgutils.unpack_tuple(builder, given[2])
        size, own = builder.mul(height, width), builder.add(builder.mul(v, width), u)

        def numbers(row: Any) -> list[Any]:
            return [Lanes.repeated(builder, number, LANES) for number in cgutils.unpack_tuple(builder, row)]

        # Pixels x, y in the other image, inside of it, and their depth z there over the depth in image i.
        here: Any = abs(Lanes.read(builder, maps.data, builder.add(builder.mul(i, size), own), LANES))
        rows = [numbers(row) for row in cgutils.unpack_tuple(builder, given[3])]
        (x0, x1, bx), (y0, y1, by), (z0, z1, bz), (right, bottom, cx, per_fx) = rows
        columns: Any = Lanes.repeated(builder, builder.trunc(u, INT), LANES).as_floats()
        ray = (columns + Lanes.constant(builder, range(LANES)) - cx) * per_fx
        z = z0 * ray + z1 + bz * here
        ahead = z > 0.0
        z = ahead.choose(z, 1.0)
        x, y = (x0 * ray + x1 + bx * here) / z, (y0 * ray + y1 + by * here) / z
        inside = ahead & (here > 0.0) & (x >= 0.0) & (y >= 0.0) & (x < right) & (y < bottom)
        x, y = inside.choose(x, 0.0), inside.choose(y, 0.0)
        # Inverse depth there, interpolated; that of the nearest pixel if one of the four pixels around is unknown.
        left, top = x.as_ints(), y.as_ints()
        across = Lanes.repeated(builder, builder.trunc(width, INT), LANES)
        image, first = builder.gep(maps.data, [builder.mul(j, size)]), top * across + left
        (p, q), (r, s) = (at.gathered(image, LANES).as_pairs() for at in (first, first + across))
        fx, fy = x - left.as_floats(), y - top.as_floats()
        nearest = (fy >= 0.5).choose((fx >= 0.5).choose(s, r), (fx >= 0.5).choose(q, p))
        sees = nearest > 0.0
        p, q, r, s = abs(p), abs(q), abs(r), abs(s)
        whole = (p > 0.0) & (q > 0.0) & (r > 0.0) & (s > 0.0)
        upper, lower = p + fx * (q - p), r + fx * (s - r)
        depth = whole.choose(upper + fy * (lower - upper), abs(nearest))
        centre, tolerance = numbers(given[4])
        there = z * depth
        agrees = inside & (depth > 0.0) & (abs(there - here) < tolerance * here)
        # Inverse depth in image i of the point that has the other image's depth on the other image's ray.
        moved = there / (centre * there - centre * here + 1.0)
        through = inside & sees & (there < here * (1.0 - SEEN_THROUGH))
        dx, dy = (bx - x * bz) / z, (by - y * bz) / z
        found = (agrees, moved), (agrees, 1.0), (through, 1.0), (agrees, dx * dx + dy * dy)
        for n, (where, value) in enumerate(found):
            at = builder.add(builder.mul(size, LONG(n)), own)
            (where.choose(value, 0.0) + Lanes.read(builder, out.data, at, LANES)).write(out.data, at)
        return context.get_dummy_value()

    return signature(types.none, sums, compared, place, rays, rest), generate
