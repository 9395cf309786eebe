"""Depth by matching: PatchMatch at half and at full resolution, image by image in threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays, resized
from jcr.depth.patch_match import (
    PAD,
    best_neighbours,
    inverse_depths,
    random_planes,
    score_all,
    spread_planes,
    to_the_peak,
    window_weights,
)
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


def match_depth(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m d 3"],
    threads: int,
    report: Callable[[float], None],
) -> tuple[Float[ndarray, "m h w"], Float[ndarray, "m h w"]]:
    """Inverse depth (per recon unit) and correlation (-1 to 1) of every pixel's best plane; no image asks another here.

    `planes`, evenly spaced as `views.sweep_planes` does, span what is searched, and half of the first guesses are
    parallel to them. The same whatever the number of threads.
    """
    half = resized(pinhole, pinhole.width // 2, pinhole.height // 2)
    coarse, fine = _shrunk(colors, half), colors.astype(np.float32) / 255
    greys = [level.mean(-1) - np.float32(0.5) for level in (coarse, fine)]
    continued = [np.pad(grey, ((0, 0), (PAD, PAD), (PAD, PAD)), "edge") for grey in greys]

    def one(i: int) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
        family = np.ascontiguousarray(planes[i][[0, -1]])
        reach = np.einsum("di,hwi->dhw", family, rays(half))
        highest = float(reach.max())
        lowest = max(float(reach.min()), LEAST * highest)
        others = neighbours[i][:COMPARED]
        found = asked = None
        k, score = grid(half), np.empty((half.height, half.width), np.float32)
        for level, color, grey, padded in zip((half, pinhole), (coarse, fine), greys, continued, strict=True):
            near, k = relative(i, others, recon_from_camera, level), grid(level)
            size = (level.width, level.height)
            window = window_weights(color[i], grey[i])
            if found is None or asked is None:
                found = random_planes(family, lowest, highest, k, level.height, level.width, i)
                asked = np.full(size[::-1], 255, np.uint8)
                passes, tries = _COARSE, _COARSE_TRIES
            else:
                found = cv2.resize(found, size, interpolation=cv2.INTER_NEAREST)
                asked = cv2.resize(asked, size, interpolation=cv2.INTER_NEAREST)
                passes, tries = _FINE, _FINE_TRIES
            score = np.empty(size[::-1], np.float32)
            views = (padded, near.others, asked, *window, near.a, near.b, k)
            score_all(found, score, *views)
            for n, step in enumerate(passes):
                bounds = (np.float32(lowest), np.float32(highest))
                spread_planes(found, score, *views, *bounds, step, tries, n % 2 == 1, 100 * i + n)
            if level is half:
                asked = best_neighbours(found, ASKED, padded, near.others, *window, near.a, near.b, k)
            else:
                to_the_peak(found, score, *views, _PEAK)
        return np.maximum(inverse_depths(found, k), np.float32(0.5 * lowest)), score

    depths, scores = [], []
    with ThreadPoolExecutor(threads) as pool:
        for n, (depth, score) in enumerate(pool.map(one, range(len(colors)))):
            depths.append(depth)
            scores.append(score)
            report((n + 1) / len(colors))
    return np.stack(depths), np.stack(scores)


def _shrunk(colors: UInt8[ndarray, "m h w 3"], pinhole: Intrinsics) -> Float[ndarray, "m y x 3"]:
    size = (pinhole.width, pinhole.height)
    small = [cv2.resize(color, size, interpolation=cv2.INTER_AREA) for color in colors]
    return np.stack(small).astype(np.float32) / 255
