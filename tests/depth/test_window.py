"""A window's correlation beside the same computed by NumPy."""

import numpy as np
import pytest

from jcr.depth.patch_match import UNKNOWN, spread_planes
from jcr.depth.window import (
    COLOR_SIGMA,
    LANES,
    MARGIN,
    NOISE,
    PAD,
    STRIDE,
    continued,
    floats_of_windows,
    quads,
    windows,
)

pytestmark = pytest.mark.slow  # it compiles

H, W = 40, 48
SHIFT_PX = 3.4


def test_scores_are_weighted_correlations_at_interpolated_greys() -> None:
    """Of one plane parallel to two cameras side by side: a shift along the rows, between pixels."""
    draw = np.random.default_rng(0)
    color = draw.integers(0, 256, (H, W, 3), dtype=np.uint8)
    other = draw.integers(0, 3 * 256, (H, W), dtype=np.uint16)
    k = tuple(np.array([50.0, 50.0, 23.5, 19.5], np.float32))
    found = np.zeros((4, H, W), np.float32)
    found[2], found[3] = 1.0, UNKNOWN
    motions = np.array([[50.0, 0, 23.5, 0, 50, 19.5, 0, 0, 1, SHIFT_PX, 0, 0]], np.float32)
    grey = color.astype(np.uint16).sum(-1, dtype=np.uint16)
    views = (
        quads(np.pad(other, PAD, "edge"))[None],
        motions,
        windows(continued(color, grey), np.empty(floats_of_windows(H, W), np.float32)),
        k,
    )
    span, tries, fresh = (1.0, 1.0), 0, True
    spread_planes(found, np.zeros((1, H, W), np.uint8), *views, (*span, 0.1, tries, fresh), 0)

    v, u = 20, LANES + 5
    steps = np.arange(-MARGIN, MARGIN + 1, STRIDE)
    y, x = (grid.ravel() for grid in np.meshgrid(v + steps, u + steps, indexing="ij"))
    far = ((color[y, x].astype(float) - color[v, u]) ** 2).sum(-1)
    weight = (1 + far / (2 * 16 * COLOR_SIGMA**2)) ** -16
    weight /= weight.sum()
    left, share = np.floor(x + SHIFT_PX).astype(int), SHIFT_PX % 1
    there = (1 - share) * other[y, left] + share * other[y, left + 1]
    own = grey[y, x] - weight @ grey[y, x]
    noise = NOISE**2
    variance = weight @ there**2 - (weight @ there) ** 2
    expected = (weight * own) @ there / np.sqrt((weight @ own**2 + noise) * (variance + noise))
    assert found[3, v, u] == pytest.approx(expected, abs=2e-4)
    assert (found[3, :, W - 3 :] == -1).all(), "what lies beyond the other image is not seen"
