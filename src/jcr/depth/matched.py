"""Depth by matching: PatchMatch at half and at full resolution, image by image in threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16, UInt64
from numpy import ndarray

from jcr.camera import rays, resized
from jcr.depth.patch_match import PAD, random_planes, scores, spread_planes
from jcr.depth.window import ALIKE, quads, windows
from jcr.geometry import inverse
from jcr.records import Intrinsics

COMPARED = 5
"""Neighbours that an image is matched with, the first that are given."""
ASKED = 3
"""Of them, those that a pixel is matched with at full resolution: the ones it correlated best with at half."""
_COARSE = (0.2, 0.1, 0.05, 0.025)
_FINE = (0.01, 0.003)
"""Per pass at half and at full resolution: relative change of inverse depth that is tried."""
_COARSE_TRIES, _FINE_TRIES = 3, 2
_PEAK = 0.003
"""Relative change of inverse depth, to either side, by which the peak is found in the end."""
LEAST = 0.25
"""Of the nearest inverse depth that tracks tell, the least that is searched."""


@dataclass(frozen=True)
class Relative:
    """How the pixels of one image move to its neighbours': u ~ a·ray + b·(inverse depth), z of the neighbour last."""

    others: Int[ndarray, " n"]
    """Rows of the neighbours."""
    a: Float[ndarray, "n 3 3"]
    b: Float[ndarray, "n 3"]
    centre: Float[ndarray, " n"]
    """z of the neighbour's camera in this image's."""


def relative(
    i: int, others: Int[ndarray, " n"], recon_from_camera: Float[ndarray, "m 4 4"], pinhole: Intrinsics
) -> Relative:
    """Image i beside others, in the grid of `pinhole`."""
    motion = inverse(recon_from_camera[others]) @ recon_from_camera[i]
    a = pinhole.matrix @ motion[:, :3, :3]
    b = motion[:, :3, 3] @ pinhole.matrix.T
    centre = inverse(motion)[:, 2, 3]
    return Relative(
        others.astype(np.int64),
        np.ascontiguousarray(a, np.float32),
        np.ascontiguousarray(b, np.float32),
        centre.astype(np.float32),
    )


def grid(pinhole: Intrinsics) -> Float[ndarray, "4"]:
    """fx, fy, cx, cy, as the compiled loops take them."""
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)


@dataclass(frozen=True)
class _Level:
    """All images at one resolution."""

    pinhole: Intrinsics
    colors: UInt8[ndarray, "m h w 3"]
    greys: UInt16[ndarray, "m h w"]
    """The sums of the three colours."""
    packed: UInt64[ndarray, "m y x"]
    """The greys as the windows of other images read them."""

    @classmethod
    def of(cls, colors: UInt8[ndarray, "m _ _ 3"], pinhole: Intrinsics) -> "_Level":
        size = (pinhole.width, pinhole.height)
        fitting = [cv2.resize(color, size, interpolation=cv2.INTER_AREA) for color in colors]
        greys = [cv2.transform(color.astype(np.uint16), np.ones((1, 3))) for color in fitting]
        packed = [quads(np.pad(grey, PAD, "edge")) for grey in greys]
        return cls(pinhole, np.stack(fitting), np.stack(greys), np.stack(packed))

    def views(
        self, i: int, others: Int[ndarray, " n"], recon_from_camera: Float[ndarray, "m 4 4"]
    ) -> tuple[ndarray, ndarray, ndarray, tuple[np.float32, ...]]:
        """`packed`, `motions`, `windows` and k of image i, as the loops take them."""
        near = relative(i, others, recon_from_camera, self.pinhole)
        motions = np.concatenate([near.a.reshape(-1, 9), near.b], 1)
        k = tuple(grid(self.pinhole))  # of numbers, that the loops keep in registers
        return self.packed[others], motions, windows(self.colors[i], self.greys[i], ALIKE), k

    def enlarged(self, map_of_half: ndarray) -> ndarray:
        """A map of the level below, each number for the pixels that it covers here."""
        h, w = self.pinhole.height, self.pinhole.width
        row, column = (np.arange(n) * half // n for n, half in zip((h, w), map_of_half.shape, strict=False))
        return map_of_half[row[:, None], column]


def match_depth(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m 2 3"],
    threads: int,
    report: Callable[[float], None],
) -> tuple[Float[ndarray, "m h w"], Float[ndarray, "m h w"]]:
    """Inverse depth (per recon unit) and correlation (-1 to 1) of every pixel's best plane; images are independent here.

    `planes` of `views.sweep_planes` span what is searched, and half of the first guesses are parallel to them. The
    result is the same whatever the number of threads.
    """
    half = _Level.of(colors, resized(pinhole, pinhole.width // 2, pinhole.height // 2))
    full = _Level.of(colors, pinhole)
    h, w = half.greys.shape[1:]

    def one(i: int) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
        others, seed = neighbours[i][:COMPARED], 100 * i
        family = np.ascontiguousarray(planes[i])
        reach = np.einsum("di,hwi->dhw", family, rays(half.pinhole))
        span = max(float(reach.min()), LEAST * float(reach.max())), float(reach.max())

        views = half.views(i, others, recon_from_camera)
        found = random_planes(family, span, views[-1], h, w, i)
        everyone = np.tile(np.arange(len(others), dtype=np.uint8), (h, w, 1))
        found[..., 3] = scores(found, everyone, *views)
        for n, size in enumerate(_COARSE):
            spread_planes(found, everyone, *views, (*span, size, _COARSE_TRIES), seed + n)
        each = [
            scores(found, np.ascontiguousarray(everyone[..., n : n + 1]), *views) for n in range(len(others))
        ]
        asked = np.argsort(-np.stack(each, -1), axis=-1, kind="stable")[..., :ASKED].astype(np.uint8)
        found, asked = full.enlarged(found), full.enlarged(asked)

        views = full.views(i, others, recon_from_camera)
        found[..., 3] = scores(found, asked, *views)
        for n, size in enumerate(_FINE):
            spread_planes(found, asked, *views, (*span, size, _FINE_TRIES), seed + n)
        peak = _inverse_depth_of_peak(found, asked, views, rays(pinhole))
        return np.maximum(peak, np.float32(0.5 * span[0])), found[..., 3]

    depths, correlations = [], []
    with ThreadPoolExecutor(threads) as pool:
        for n, (depth, score) in enumerate(pool.map(one, range(len(colors)))):
            depths.append(depth)
            correlations.append(score)
            report((n + 1) / len(colors))
    return np.stack(depths), np.stack(correlations)


def _inverse_depth_of_peak(
    found: Float[ndarray, "h w 4"],
    asked: UInt8[ndarray, "h w a"],
    views: tuple,
    direction: Float[ndarray, "h w 3"],
) -> Float[ndarray, "h w"]:
    """Inverse depth at the peak of the parabola through each plane's score and those `_PEAK` (relative) off."""
    inverse_depth = np.einsum("hwi,hwi->hw", found[..., :3], direction.astype(np.float32))
    step, beside = _PEAK * inverse_depth, []
    for side in (-step, step):
        plane = found.copy()
        plane[..., 2] += side
        beside.append(scores(plane, asked, *views))
    low, high = beside
    curvature = low - 2 * found[..., 3] + high
    shift = np.where(curvature < -1e-6, (low - high) / np.minimum(2 * curvature, -1e-6), 0)
    return inverse_depth + np.clip(shift, -1, 1) * step
