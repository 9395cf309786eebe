"""What other images say of a depth: compiled checks across views."""

from typing import no_type_check

import numpy as np

from jcr.compiled import compiled

SEEN_THROUGH = 0.01
"""A neighbour whose depth is farther by this share sees through the point. Beside an object's outline the plain
table often gets the object's depth; the neighbours that look past the object there know better."""


@compiled
@no_type_check
def agreement(i, inverse_depth, known, trusted, others, a, b, centre, k, tolerance):
    """Mean inverse depth (h,w) of image i with the images that agree at each pixel, how many do, how many see through.

    The fourth map is the information of those that agree: the sum of squares of how far (px) the point moves in them
    per inverse depth. An image sees through only where it is `trusted` (m,h,w). `a` (n,3,3) is K R and `b` (n,3) K t to
    each other image; `centre` (n) its camera's z in image i.
    """
    h, w = inverse_depth.shape[1:]
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
            rx, ry = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            total = here
            for n in range(len(others)):
                z = a[n, 2, 0] * rx + a[n, 2, 1] * ry + a[n, 2, 2] + b[n, 2] * here
                if z <= 0:
                    continue
                x = (a[n, 0, 0] * rx + a[n, 0, 1] * ry + a[n, 0, 2] + b[n, 0] * here) / z
                y = (a[n, 1, 0] * rx + a[n, 1, 1] * ry + a[n, 1, 2] + b[n, 1] * here) / z
                if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
                    continue
                ix, iy = int(x), int(y)
                j = others[n]
                nx, ny = int(x + np.float32(0.5)), int(y + np.float32(0.5))
                if not known[j, ny, nx]:
                    continue
                fx, fy = x - ix, y - iy
                if (
                    known[j, iy, ix]
                    and known[j, iy, ix + 1]
                    and known[j, iy + 1, ix]
                    and known[j, iy + 1, ix + 1]
                ):
                    top = inverse_depth[j, iy, ix] * (1 - fx) + inverse_depth[j, iy, ix + 1] * fx
                    low = inverse_depth[j, iy + 1, ix] * (1 - fx) + inverse_depth[j, iy + 1, ix + 1] * fx
                    there = top * (1 - fy) + low * fy
                else:
                    there = inverse_depth[j, ny, nx]
                ratio = z / here * there
                if abs(ratio - 1) < tolerance:
                    # The point moves along the other's ray until it has the other's depth; its z here follows.
                    total += 1 / (centre[n] + (1 / here - centre[n]) / ratio)
                    count[v, u] += 1
                    moves_x, moves_y = (b[n, 0] - x * b[n, 2]) / z, (b[n, 1] - y * b[n, 2]) / z
                    information[v, u] += moves_x * moves_x + moves_y * moves_y
                elif ratio < 1 - SEEN_THROUGH and trusted[j, ny, nx]:
                    through[v, u] += 1
            mean[v, u] = total / (1 + count[v, u])
    return mean, count, through, information


@compiled
@no_type_check
def colours_agree(i, inverse_depth, wanted, matched_depth, matched, colors, others, a, b, k, tolerance):
    """Of the pixels of image i that are wanted: how many others show the point in its colour, in another, see through.

    A point is hidden from an image whose matched depth there is nearer; such an image says nothing.
    """
    h, w = inverse_depth.shape
    same = np.zeros((h, w), np.uint8)
    other_colour = np.zeros((h, w), np.uint8)
    through = np.zeros((h, w), np.uint8)
    for v in range(h):
        for u in range(w):
            if not wanted[v, u]:
                continue
            here = inverse_depth[v, u]
            rx, ry = (np.float32(u) - k[2]) / k[0], (np.float32(v) - k[3]) / k[1]
            for n in range(len(others)):
                z = a[n, 2, 0] * rx + a[n, 2, 1] * ry + a[n, 2, 2] + b[n, 2] * here
                if z <= 0:
                    continue
                x = (a[n, 0, 0] * rx + a[n, 0, 1] * ry + a[n, 0, 2] + b[n, 0] * here) / z
                y = (a[n, 1, 0] * rx + a[n, 1, 1] * ry + a[n, 1, 2] + b[n, 1] * here) / z
                if x < 0 or y < 0 or x >= w - 1 or y >= h - 1:
                    continue
                j = others[n]
                nx, ny = int(x + np.float32(0.5)), int(y + np.float32(0.5))
                if matched[j, ny, nx]:
                    ratio = z / here * matched_depth[j, ny, nx]
                    if ratio > 1 + SEEN_THROUGH:
                        continue
                    if ratio < 1 - SEEN_THROUGH:
                        through[v, u] += 1
                        continue
                difference = np.float32(0)
                for c in range(3):
                    d = colors[i, v, u, c] - colors[j, ny, nx, c]
                    difference += d * d
                if difference < tolerance * tolerance:
                    same[v, u] += 1
                else:
                    other_colour[v, u] += 1
    return same, other_colour, through
