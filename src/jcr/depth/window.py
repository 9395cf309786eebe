"""Sums over the window of a pixel in another image, all taps at once in the lanes of vector registers.

A loop over the taps is not vectorised by the compiler, which may not change the order of a sum. Here the order is
written down: lane k is added to lane k + 16, then k to k + 8, and so on, so that all machines and the compiler's cache
give the same bits. A window took 190 ns as a loop, and takes 21 ns.
"""

from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt16, UInt64
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import signature
from numba.extending import intrinsic
from numpy import ndarray

from jcr.compiled import compiled
from jcr.depth.lanes import INT, LONG, Lanes

REACH, STRIDE = 2, 2
"""The window has (2·reach + 1)² pixels, every `stride`-th in a row and column."""
TAPS = (2 * REACH + 1) ** 2
LANES = 32
"""Taps, and lanes of weight 0 to the next power of two."""

NOISE = 3.0
"""Standard deviation of pixel noise, in the sum of three colours (each 0 to 255): where the texture is no stronger,
the correlation fades to 0."""
COLOR_SIGMA = 25.5
"""Distance of colours (RGB, each 0 to 255) at which a pixel of the window counts 0.6."""
_STEP = 4
ALIKE = np.exp(-0.5 * _STEP / COLOR_SIGMA**2 * np.arange(4096)).astype(np.float32)
"""Weight of a pixel by its squared distance of colours, in steps of `_STEP`."""


def quads(grey: UInt16[ndarray, "h w"]) -> UInt64[ndarray, "h w"]:
    """Four greys in each pixel: its own in the lowest bits, then the one to the right, the one below, and its right one.

    A bilinear interpolation is then one read from memory.
    """
    own = np.pad(grey, (0, 1), "edge").astype(np.uint64)
    rows = own[:, :-1] | own[:, 1:] << 16
    return rows[:-1] | rows[1:] << 32


@compiled
@no_type_check
def windows(color, grey, alike):
    """Two rows of numbers (h,w,2,lanes) for the window of each pixel: weights whose sum is 1, and what a grey counts.

    A pixel's weight is its likeness to the central colour (Schönberger et al., ECCV 2016, eq. 6), `ALIKE`. The second
    row is the weight times the window's own grey less its mean, over its standard deviation with noise.
    """
    h, w = grey.shape
    rows = np.zeros((h, w, 2, LANES), np.float32)
    greys = np.empty(TAPS, np.float32)
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
                    distance = 0
                    for c in range(3):
                        difference = np.int64(color[y, x, c]) - np.int64(color[v, u, c])
                        distance += difference * difference
                    weight = alike[min(distance // _STEP, len(alike) - 1)]
                    g = np.float32(grey[y, x])
                    rows[v, u, 0, tap], greys[tap] = weight, g
                    total += weight
                    mean += weight * g
                    square += weight * g * g
                    tap += 1
            mean /= total
            variance = max(square / total - mean * mean, np.float32(0))
            spread = np.sqrt(variance + np.float32(NOISE * NOISE))
            for tap in range(TAPS):
                rows[v, u, 0, tap] /= total
                rows[v, u, 1, tap] = rows[v, u, 0, tap] * (greys[tap] - mean) / spread
    return rows


@intrinsic
@no_type_check
def window_sums(typing, packed, n, windows, pixel, x, y, xu, yu, xv, yv):
    """Σ w·g, Σ w·g² and Σ c·g over the window of pixel (v, u), with w and c its rows of `windows`.

    g is interpolated in the n-th image of `packed` (n,y,x; `quads`) about (x, y), at taps that lie (xu, yu) apart in a
    row of the window and (xv, yv) in a column. All of it must lie in that image.
    """
    sums = signature(
        types.UniTuple(types.float32, 3), packed, types.int64, windows, pixel, *[types.float32] * 6
    )

    def generate(context: Any, builder: Any, sums: Any, given: Any) -> Any:
        images, rows = (context.make_array(sums.args[k])(context, builder, given[k]) for k in (0, 2))
        _, height, width = cgutils.unpack_tuple(builder, images.shape, 3)
        image = builder.gep(images.data, [builder.mul(given[1], builder.mul(height, width))])
        grey = _interpolated(builder, image, builder.trunc(width, INT), given[4:])
        v, u = cgutils.unpack_tuple(builder, given[3], 2)
        of_row = cgutils.unpack_tuple(builder, rows.shape, 4)[1]
        first = builder.mul(builder.add(builder.mul(v, of_row), u), LONG(2 * LANES))
        weight, counts = (
            Lanes.read(builder, rows.data, builder.add(first, LONG(k)), LANES) for k in (0, LANES)
        )
        weighted = weight * grey
        terms = (weighted, weighted * grey, counts * grey)
        return context.make_tuple(builder, sums.return_type, [lanes.sum() for lanes in terms])

    return sums, generate


def _interpolated(builder: Any, image: Any, width: Any, window: Any) -> Lanes:
    """The grey at every tap."""
    x, y, xu, yu, xv, yv = (Lanes.repeated(builder, number, LANES) for number in window)
    steps, unused = range(-REACH, REACH + 1), [0.0] * (LANES - TAPS)
    column = Lanes.constant(builder, [j for _ in steps for j in steps] + unused)
    row = Lanes.constant(builder, [i for i in steps for _ in steps] + unused)
    px, py = x + column * xu + row * xv, y + column * yu + row * yv
    left, top = px.as_ints(), py.as_ints()
    packed = (top * Lanes.repeated(builder, width, LANES) + left).gathered(image, TAPS)
    here, right, below, both = ((packed >> 16 * k).as_ints() & 65535 for k in range(4))
    here, right, below, both = (grey.as_floats() for grey in (here, right, below, both))
    fx, fy = px - left.as_floats(), py - top.as_floats()
    upper, lower = here + fx * (right - here), below + fx * (both - below)
    return upper + fy * (lower - upper)
