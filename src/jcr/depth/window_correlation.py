"""Weighted correlation of the windows of 16 pixels of a row with another image, in vector registers.

A correlation takes 20 to 30 ns; the reads of its 25 taps (pixels of the window) alone take 17 ns.
"""

import functools
import itertools
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt16, UInt64
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic
from numpy import ndarray

from jcr.depth.vector_registers import INT, LONG, Lanes
from jcr.numba_compile import compiled

LANES = 16
"""Number of pixels of a row that are correlated at once; the rows of all maps are padded to a multiple of it."""
REACH, STRIDE = 2, 2
"""Size of the window: it has (2·REACH + 1)² pixels (taps), every STRIDE-th in a row and column."""
TAPS = (2 * REACH + 1) ** 2
MARGIN = REACH * STRIDE
PAD = 12
"""Pixels by which images are padded, so that windows at their borders need no check."""

PIXEL_NOISE = 3.0
"""Standard deviation of pixel noise, in the sum of three colours (each 0 to 255): where the texture is no stronger, the
correlation tends to 0."""
COLOR_SIGMA = 25.5
"""Distance of colours (RGB, each 0 to 255) from the central pixel at which a pixel of the window has the weight 0.6."""


def quads(grey: UInt16[ndarray, "h w"]) -> UInt64[ndarray, "h w"]:
    """Return for each pixel four 16-bit greys in 64 bits, from the lowest: its own, right, below, below right.

    Border pixels are repeated beyond the border. A bilinear interpolation then reads memory once.
    """
    own = np.pad(grey, (0, 1), "edge").astype(np.uint64)
    rows = own[:, :-1] | own[:, 1:] << 16
    return rows[:-1] | rows[1:] << 32


@compiled
@no_type_check
def windows(image):
    """Return weight and weighted grey of each tap (sampled pixel) of each pixel's window.

    The shape is (rows, blocks of 16 pixels, taps, 2, 16), the weight first in the axis of 2. `image` (4,h,w) are the
    three colours and grey of an image, padded by MARGIN on all sides and to whole blocks. The weights of a window have
    the sum 1. A tap's weight grows with the similarity of its colour to the central one (Schönberger et al., ECCV 2016,
    eq. 6). The function 1 / (1 + x/16)^16 replaces exp(-x), where x is the squared distance of the colours over 2
    COLOR_SIGMA². The weighted grey is weight · (grey - mean) / sqrt(variance + NOISE²), with weighted mean and variance
    of the window.
    """
    h, blocks = image.shape[1] - 2 * MARGIN, (image.shape[2] - 2 * MARGIN) // LANES
    rows = np.empty((h, blocks, TAPS, 2, LANES), np.float32)
    for v in range(h):
        for block in range(blocks):
            _write_windows(rows, image, v, block)
    return rows


def blocks_of(columns: int) -> int:
    """Return the number of columns rounded up to a multiple of LANES."""
    return -(-columns // LANES) * LANES


@intrinsic
@no_type_check
def _write_windows(typing, rows, image, v, block):
    """Write to `rows`, the result of `windows`, the weights and weighted greys of the 16 pixels of a block of row v.

    numba's `typing` context is not used. `image` is that of `windows`; `block` counts the blocks of 16 columns.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        out, channels = (context.make_array(signature.args[k])(context, builder, given[k]) for k in range(2))
        _, height, width = cgutils.unpack_tuple(builder, channels.shape, 3)
        corner = builder.add(builder.mul(given[2], width), builder.mul(given[3], LONG(LANES)))

        def read(channel: int, y: int, x: int) -> Lanes:
            at = builder.mul(builder.add(builder.mul(LONG(channel), height), LONG(y)), width)
            return Lanes.read(builder, channels.data, builder.add(builder.add(at, LONG(x)), corner), LANES)

        centre = [read(c, MARGIN, MARGIN) for c in range(3)]
        taps = []
        for y, x in itertools.product(range(0, 2 * MARGIN + 1, STRIDE), repeat=2):
            red, green, blue = (read(c, y, x) - centre[c] for c in range(3))
            far = red * red + green * green + blue * blue
            alike = (far * (0.5 / 16 / COLOR_SIGMA**2) + 1.0).inverted()
            for _ in range(4):
                alike = alike * alike
            taps.append((alike, read(3, y, x)))
        per_total = functools.reduce(Lanes.__add__, (weight for weight, _ in taps)).inverted()
        taps = [(weight * per_total, grey) for weight, grey in taps]
        mean = functools.reduce(Lanes.__add__, (weight * grey for weight, grey in taps))
        variance = functools.reduce(Lanes.__add__, (w * (g - mean) * (g - mean) for w, g in taps))
        per_spread = (variance + PIXEL_NOISE * PIXEL_NOISE).root().inverted()
        blocks = cgutils.unpack_tuple(builder, out.shape, 5)[1]
        first = builder.mul(builder.add(builder.mul(given[2], blocks), given[3]), LONG(2 * TAPS * LANES))
        numbers = [n for weight, grey in taps for n in (weight, weight * (grey - mean) * per_spread)]
        for n, lanes in enumerate(numbers):
            lanes.write(out.data, builder.add(first, LONG(n * LANES)))
        return context.get_dummy_value()

    return signature(types.void, rows, image, v, block), generate


@intrinsic
@no_type_check
def correlate(typing, out, slot, packed, motions, windows, place, tried):
    """Write to out[slot] the correlation of each of 16 pixels' windows with another image; -1 where it lies outside.

    `out` is (n,16) for n other images, of which the one with index `slot` is compared; `typing` is numba's typing
    context, which is not used. `windows` is the result of `windows` for this image; `place` is the row v and the block
    of 16 columns in it. `packed` (n,y,x) are the other images (made by `quads`, padded by `PAD`). Rows 3 and 4 of
    `tried` (7,16) are the changes of inverse depth from one window sample to the next, in u and v. Row 5 is the inverse
    depth. The array motions[slot] (12,16) has the projections into the other images (`near` in patch_match_loops).
    """
    sums = signature(types.void, out, types.int64, packed, motions, windows, place, tried)

    def generate(context: Any, builder: Any, sums: Any, given: Any) -> Any:
        def array(k: int) -> Any:
            return context.make_array(sums.args[k])(context, builder, given[k])

        def lanes(k: int, first: Any, count: int) -> list[Lanes]:
            places = (builder.add(first, LONG(n * LANES)) for n in range(count))
            return [Lanes.read(builder, array(k).data, at, LANES) for at in places]

        _, height, width = cgutils.unpack_tuple(builder, array(2).shape, 3)
        slot = given[1]
        image = builder.gep(array(2).data, [builder.mul(slot, builder.mul(height, width))])
        motion = lanes(3, builder.mul(slot, LONG(12 * LANES)), 12)
        size = [Lanes.repeated(builder, builder.trunc(n, INT), LANES) for n in (width, height)]
        window, inside = _window_there(motion, lanes(6, LONG(3 * LANES), 3), size)
        v, block = cgutils.unpack_tuple(builder, given[5], 2)
        blocks = cgutils.unpack_tuple(builder, array(4).shape, 5)[1]
        first = builder.mul(builder.add(builder.mul(v, blocks), block), LONG(TAPS * 2 * LANES))
        weights = lanes(4, first, 2 * TAPS)
        score = inside.choose(_correlation(image, size[0], window, weights), -1.0)
        score.write(array(0).data, builder.mul(slot, LONG(LANES)))
        return context.get_dummy_value()

    return sums, generate


def _window_there(motion: list[Lanes], plane: list[Lanes], size: list[Lanes]) -> tuple[list[Lanes], Lanes]:
    """Project the windows of 16 pixels into the padded other images; return places, and whether they lie inside.

    The places are six vectors (px). They are the centre x, y, and the steps x, y from one window sample to the next in
    a row, and in a column. A window lies inside if its centre is in the image without padding and no sample leaves the
    padding. `motion` are the 12 numbers of the projection (`near` in patch_match_loops). `plane` is the change of
    inverse depth from one sample to the next in a row, in a column, and the inverse depth. `size` is width and height of
    the padded images. The homography of a window is approximated as affine about its centre, which saves divisions.
    """
    (x0, y0, z0, x1, y1, z1, x, y, z, tx, ty, tz), (du, dv, here) = motion, plane
    z = z + tz * here
    ahead = z > 0.0
    iz = ahead.choose(z, 1.0).inverted()
    x, y = (x + tx * here) * iz, (y + ty * here) * iz
    z0, z1 = z0 + tz * du, z1 + tz * dv
    xu, yu = (x0 + tx * du - x * z0) * iz, (y0 + ty * du - y * z0) * iz
    xv, yv = (x1 + tx * dv - x * z1) * iz, (y1 + ty * dv - y * z1) * iz
    right, bottom = (n.as_floats() - (2.0 * PAD + 1.0) for n in size)
    most = (PAD - 2) / REACH
    inside = ahead & (x >= 0.0) & (y >= 0.0) & (right >= x) & (bottom >= y)
    inside = inside & (abs(xu) + abs(xv) < most) & (abs(yu) + abs(yv) < most)
    centre = [inside.choose(n + float(PAD), float(PAD)) for n in (x, y)]
    return centre + [inside.choose(n, 0.0) for n in (xu, yu, xv, yv)], inside


def _correlation(image: Any, width: Lanes, window: list[Lanes], weights: list[Lanes]) -> Lanes:
    """Return Σ c·g / std(g) per lane: g are the greys at a window's sampled pixels in `image`, c those of this image.

    `image` is the LLVM pointer to the packed other image, with `width` columns. The greys g are interpolated bilinearly
    at the places `window` (px), the result of `_window_there`. `weights` has weight and weighted grey c of each sample,
    by turns, from `windows`. The standard deviation std(g) is weighted and includes the pixel noise.
    """
    center_x, center_y, xu, yu, xv, yv = window
    steps = [float(n) for n in range(-REACH, REACH + 1)]
    along = [(xu * n, yu * n) for n in steps]
    mean = square = product = center_x * 0.0
    for i, down in enumerate((xv * n, yv * n) for n in steps):
        px, py = center_x + down[0], center_y + down[1]
        for j, (dx, dy) in enumerate(along):
            tap, x, y = weights[2 * (i * len(steps) + j) :], px + dx, py + dy
            left, top = x.as_ints(), y.as_ints()
            upper, lower = (top * width + left).gathered(image).as_pairs()
            fx, fy = x - left.as_floats(), y - top.as_floats()
            here, right = (upper & 65535).as_floats(), (upper >> 16).as_floats()
            below, both = (lower & 65535).as_floats(), (lower >> 16).as_floats()
            above, beneath = here + fx * (right - here), below + fx * (both - below)
            grey = above + fy * (beneath - above)
            weighted = tap[0] * grey
            mean, square, product = mean + weighted, square + weighted * grey, product + tap[1] * grey
    variance = square - mean * mean
    return product / ((variance > 0.0).choose(variance, 0.0) + PIXEL_NOISE * PIXEL_NOISE).root()
