"""What other images say of a depth: compiled checks across views."""

from typing import no_type_check

import numpy as np

from jcr.compiled import compiled, inlined

SEEN_THROUGH = 0.01
"""A neighbour whose depth is farther by this share sees through the point. Beside an object's outline the plain
table often gets the object's depth; the neighbours that look past the object there know better."""
_ONE, _HALF, _FAR = np.float32(1), np.float32(0.5), np.float32(SEEN_THROUGH)
# A number of Python among these makes a sum of double precision.


@inlined
@no_type_check
def _in_other(n, ray, inverse_depth, a, b):
    """Pixel x, y of a point in the n-th other image, and its depth there by that here."""
    rx, ry = ray
    z = a[n, 2, 0] * rx + a[n, 2, 1] * ry + a[n, 2, 2] + b[n, 2] * inverse_depth
    iz = _ONE / z
    x = (a[n, 0, 0] * rx + a[n, 0, 1] * ry + a[n, 0, 2] + b[n, 0] * inverse_depth) * iz
    y = (a[n, 1, 0] * rx + a[n, 1, 1] * ry + a[n, 1, 2] + b[n, 1] * inverse_depth) * iz
    return x, y, z


@inlined
@no_type_check
def _interpolated(inverse_depth, known, j, x, y):
    """Inverse depth of image j between its pixels, where all four are known, or else of the nearest."""
    left, top = np.uint32(x), np.uint32(y)
    right, low = left + np.uint32(1), top + np.uint32(1)
    if known[j, top, left] and known[j, top, right] and known[j, low, left] and known[j, low, right]:
        fx, fy = x - np.float32(left), y - np.float32(top)
        upper = inverse_depth[j, top, left] * (_ONE - fx) + inverse_depth[j, top, right] * fx
        lower = inverse_depth[j, low, left] * (_ONE - fx) + inverse_depth[j, low, right] * fx
        return upper * (_ONE - fy) + lower * fy
    return inverse_depth[j, np.uint32(y + _HALF), np.uint32(x + _HALF)]


@compiled
@no_type_check
def agreement(i, inverse_depth, known, trusted, others, a, b, centre, k, tolerance):
    """Mean inverse depth (h,w) of image i with the images that agree at each pixel, how many do, how many see through.

    The fourth map is the information of those that agree: the sum of squares of how far (px) the point moves in them
    per inverse depth. An image sees through only where it is `trusted` (m,h,w). `a` (n,3,3) is K R and `b` (n,3) K t to
    each other image; `centre` (n) its camera's z in image i.
    """
    h, w = inverse_depth.shape[1:]
    right, bottom, tolerance = np.float32(w - 1), np.float32(h - 1), np.float32(tolerance)
    mean = np.zeros((h, w), np.float32)
    count = np.zeros((h, w), np.uint8)
    through = np.zeros((h, w), np.uint8)
    information = np.zeros((h, w), np.float32)
    for v in range(h):
        for u in range(w):
            here = inverse_depth[i, v, u]
            mean[v, u] = here
            if not known[i, v, u]:
                continue
            ray = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            total, moved, agreeing, seeing = here, np.float32(0), 0, 0
            for n in range(len(others)):
                x, y, z = _in_other(n, ray, here, a, b)
                if not (z > 0 and x >= 0 and y >= 0 and x < right and y < bottom):
                    continue
                j, nx, ny = others[n], np.uint32(x + _HALF), np.uint32(y + _HALF)
                if not known[j, ny, nx]:
                    continue
                ratio = z / here * _interpolated(inverse_depth, known, j, x, y)
                if abs(ratio - _ONE) < tolerance:
                    # The point moves along the other's ray until it has the other's depth; its z here follows.
                    total += _ONE / (centre[n] + (_ONE / here - centre[n]) / ratio)
                    agreeing += 1
                    moves_x, moves_y = (b[n, 0] - x * b[n, 2]) / z, (b[n, 1] - y * b[n, 2]) / z
                    moved += moves_x * moves_x + moves_y * moves_y
                elif ratio < _ONE - _FAR and trusted[j, ny, nx]:
                    seeing += 1
            mean[v, u] = total / np.float32(1 + agreeing)
            count[v, u], through[v, u], information[v, u] = agreeing, seeing, moved
    return mean, count, through, information


@compiled
@no_type_check
def colours_agree(i, inverse_depth, wanted, matched_depth, matched, colors, others, a, b, k, tolerance):
    """Of the pixels of image i that are wanted: how many others show the point in its colour, in another, see through.

    A point is hidden from an image whose matched depth there is nearer; such an image says nothing.
    """
    h, w = inverse_depth.shape
    right, bottom, most = np.float32(w - 1), np.float32(h - 1), np.float32(tolerance * tolerance)
    same = np.zeros((h, w), np.uint8)
    other_colour = np.zeros((h, w), np.uint8)
    through = np.zeros((h, w), np.uint8)
    for v in range(h):
        for u in range(w):
            if not wanted[v, u]:
                continue
            here = inverse_depth[v, u]
            ray = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            for n in range(len(others)):
                x, y, z = _in_other(n, ray, here, a, b)
                if not (z > 0 and x >= 0 and y >= 0 and x < right and y < bottom):
                    continue
                j, nx, ny = others[n], np.uint32(x + _HALF), np.uint32(y + _HALF)
                if matched[j, ny, nx]:
                    ratio = z / here * matched_depth[j, ny, nx]
                    if ratio > _ONE + _FAR:
                        continue
                    if ratio < _ONE - _FAR:
                        through[v, u] += 1
                        continue
                difference = np.float32(0)
                for c in range(3):
                    d = colors[i, v, u, c] - colors[j, ny, nx, c]
                    difference += d * d
                if difference < most:
                    same[v, u] += 1
                else:
                    other_colour[v, u] += 1
    return same, other_colour, through
