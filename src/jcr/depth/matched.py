"""Depth by matching: PatchMatch at half and at full resolution, image by image in threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16, UInt64
from numpy import ndarray

from jcr.camera import rays, resized
from jcr.depth.patch_match import UNKNOWN, best_neighbours, peaks, random_planes, spread_planes
from jcr.depth.window import PAD, blocks_of, continued, floats_of_windows, quads, windows
from jcr.geometry import inverse
from jcr.records import Intrinsics

COMPARED = 5
"""Neighbours that an image is matched with, the first that are given."""
ASKED = 3
"""Number of neighbours that a pixel is matched with at full resolution, the best ones at half resolution."""
_COARSE = ((0.2, 2), (0.1, 2), (0.05, 2), (0.025, 2))
_FINE = ((0.01, 2), (0.003, 1))
"""Per pass at half and at full resolution: relative change of inverse depth that is tried, and how often."""
_PEAK = 0.003
"""Relative change of inverse depth, to either side, by which the peak is found in the end."""
LEAST = 0.25
"""Least inverse depth of the search, as a share of the largest one of the tracks."""


@dataclass(frozen=True)
class Relative:
    """Projection of an image's pixels into its neighbours: u ~ a·ray + b·(inverse depth)."""

    others: Int[ndarray, " n"]
    """Rows of the neighbours."""
    a: Float[ndarray, "n 3 3"]
    b: Float[ndarray, "n 3"]
    centre: Float[ndarray, " n"]
    """z of the neighbour's camera in this image's."""


def relative(
    i: int, others: Int[ndarray, " n"], recon_from_camera: Float[ndarray, "m 4 4"], pinhole: Intrinsics
) -> Relative:
    """Return the projection of image i into others, in the grid of `pinhole`."""
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
    """Return fx, fy, cx, cy for the compiled loops."""
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
        self,
        i: int,
        others: Int[ndarray, " n"],
        recon_from_camera: Float[ndarray, "m 4 4"],
        space: Float[ndarray, " _"],
    ) -> tuple[ndarray, ndarray, ndarray, tuple[np.float32, ...]]:
        """Return `packed`, `motions`, `windows` (written to `space`) and k of image i for the compiled loops."""
        near = relative(i, others, recon_from_camera, self.pinhole)
        motions = np.concatenate([near.a.reshape(-1, 9), near.b], 1)
        k = tuple(grid(self.pinhole))  # of numbers, that the loops keep in registers
        return self.packed[others], motions, windows(continued(self.colors[i], self.greys[i]), space), k

    def enlarged(self, map_of_half: ndarray) -> ndarray:
        """Return a map of the level below at this resolution, each number for the pixels that it covers."""
        h, w = self.pinhole.height, self.pinhole.width
        row = np.minimum(np.arange(h) // 2, map_of_half.shape[1] - 1)
        column = np.minimum(np.arange(blocks_of(w)) // 2, map_of_half.shape[2] - 1)
        return np.ascontiguousarray(map_of_half[:, row[:, None], column])


def match_depth(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m 2 3"],
    threads: int,
    report: Callable[[float], None],
) -> tuple[Float[ndarray, "m h w"], Float[ndarray, "m h w"]]:
    """Return inverse depth (per recon unit) and correlation (-1 to 1) of every pixel's best plane, image by image.

    `planes` of `views.sweep_planes` span what is searched, and half of the first guesses are parallel to them. The
    result is the same whatever the number of threads.
    """
    half = _Level.of(colors, resized(pinhole, pinhole.width // 2, pinhole.height // 2))
    full = _Level.of(colors, pinhole)
    h, w = half.greys.shape[1:]
    spaces = SimpleQueue[ndarray]()
    for _ in range(threads):
        spaces.put(np.empty(floats_of_windows(*full.greys.shape[1:]), np.float32))

    def match(i: int, space: Float[ndarray, " _"]) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
        others, seed = neighbours[i][:COMPARED], 100 * i
        family = np.ascontiguousarray(planes[i])
        reach = np.einsum("di,hwi->dhw", family, rays(half.pinhole))
        span = max(float(reach.min()), LEAST * float(reach.max())), float(reach.max())

        views = half.views(i, others, recon_from_camera, space)
        found = random_planes(family, span, views[-1], h, blocks_of(w), i)
        asked = np.empty((len(others), *found.shape[1:]), np.uint8)
        asked[:] = np.arange(len(others))[:, None, None]
        for n, (size, tries) in enumerate(_COARSE):
            spread_planes(found, asked, *views, (*span, size, tries, n == 0), seed + n)
        asked = best_neighbours(found, asked, *views, ASKED)
        found, asked = full.enlarged(found), full.enlarged(asked)

        views = full.views(i, others, recon_from_camera, space)
        found[3] = UNKNOWN
        for n, (size, tries) in enumerate(_FINE):
            spread_planes(found, asked, *views, (*span, size, tries, n == 0), seed + n)
        depth = peaks(found, asked, *views, np.float32(_PEAK))
        return np.maximum(depth, np.float32(0.5 * span[0]))[:, : pinhole.width], found[3, :, : pinhole.width]

    def one(i: int) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
        space = spaces.get()
        try:
            return match(i, space)
        finally:
            spaces.put(space)  # after an error too, or the other threads wait for the buffer without end

    depths, correlations = [], []
    with ThreadPoolExecutor(threads) as pool:
        for n, (depth, score) in enumerate(pool.map(one, range(len(colors)))):
            depths.append(depth)
            correlations.append(score)
            report((n + 1) / len(colors))
    return np.stack(depths), np.stack(correlations)
