"""Depth by PatchMatch stereo at half and then at full resolution, one image per thread."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays, resized
from jcr.depth.patch_match_loops import NOT_COMPARED, random_planes, spread_planes
from jcr.depth.window_correlation import LANES, MARGIN, PAD, blocks_of, quads, windows
from jcr.geometry import inverse
from jcr.numba_compile import random_state
from jcr.records import Intrinsics

COMPARED = 5
"""Number of neighbours that an image is matched with: the first ones of its list."""
_COARSE = ((0.2, 2), (0.1, 2), (0.05, 2), (0.025, 2))
_FINE = ((0.01, 2), (0.003, 1))
"""Passes of PatchMatch at half (`_COARSE`) and full resolution: relative change of inverse depth, and trials."""
LEAST_INVERSE_DEPTH = 0.25
"""Least inverse depth of the search, as a share of the largest inverse depth of the search planes."""


Relative = tuple[Int[ndarray, " _"], Float[ndarray, "_ 3 3"], Float[ndarray, "_ 3"], Float[ndarray, " _"]]
"""Projection of pixels of an image into its neighbours, u ~ a·ray + b·(inverse depth): rows of the neighbours, a = K R,
b = K t, and the z coordinate of each neighbour's camera centre in the image's camera frame."""


def relative(
    i: int, others: Int[ndarray, " n"], recon_from_camera: Float[ndarray, "m 4 4"], pinhole: Intrinsics
) -> Relative:
    """Return the motion from image i to the n images `others` in the form that the compiled loops read (`Relative`).

    The result is (`others`, K R (n,3,3), K t (n,3), z (n)). R and t (recon units) transform points of camera i to
    another camera, and K is the matrix of `pinhole`. The last array is the z coordinate of the other camera's centre in
    camera i. All images are on the pixel grid of `pinhole`.
    """
    motion = inverse(recon_from_camera[others]) @ recon_from_camera[i]
    a, b = pinhole.matrix @ motion[:, :3, :3], motion[:, :3, 3] @ pinhole.matrix.T
    a, b, centre = (np.ascontiguousarray(part, np.float32) for part in (a, b, inverse(motion)[:, 2, 3]))
    return others.astype(np.int64), a, b, centre


def grid(pinhole: Intrinsics) -> Float[ndarray, "4"]:
    """Return fx, fy, cx, cy of a pinhole camera as a float32 array, which the compiled loops take as `k`."""
    return np.array([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], np.float32)


class _Level:
    """All images at one resolution: RGB colours, greys (sum of the three colours), greys packed for interpolation."""

    def __init__(self, colors: UInt8[ndarray, "m _ _ 3"], pinhole: Intrinsics) -> None:
        size, self.pinhole = (pinhole.width, pinhole.height), pinhole
        self.colors = [cv2.resize(color, size, interpolation=cv2.INTER_AREA) for color in colors]
        self.greys = [cv2.transform(color.astype(np.uint16), np.ones((1, 3))) for color in self.colors]
        self.packed = np.stack([quads(np.pad(grey, PAD, "edge")) for grey in self.greys])

    def views(
        self, i: int, others: Int[ndarray, " n"], recon_from_camera: Float[ndarray, "m 4 4"]
    ) -> tuple[ndarray, ndarray, ndarray, tuple[np.float32, ...]]:
        """Return the arguments `packed`, `motions`, `windows` and `k` of the loops that match image i with `others`.

        `others` are n image indices. `packed` are their greys, packed by `quads`; `motions` (n,12) are the rows of K R,
        and K t, to each of them. `windows` are those of image i; `k` is (fx, fy, cx, cy).
        """
        _, a, b, _ = relative(i, others, recon_from_camera, self.pinhole)
        motions = np.concatenate([a.reshape(-1, 9), b], 1)
        around = ((MARGIN, MARGIN), (MARGIN, MARGIN + -self.pinhole.width % LANES))
        channels = *np.moveaxis(self.colors[i], -1, 0), self.greys[i]
        image = np.stack([np.pad(channel.astype(np.float32), around, "edge") for channel in channels])
        k = tuple(grid(self.pinhole))  # a tuple, which the loops keep in registers
        return self.packed[others], motions, windows(image), k

    def enlarged(self, map_of_half: ndarray) -> ndarray:
        """Return a map (c,h,w) from one (c,h/2,w/2) of half the resolution; each pixel is repeated at 2 x 2 pixels.

        The width of the result is rounded up to a multiple of LANES.
        """
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
    rows: Sequence[int],
    threads: int,
    report: Callable[[float], None],
) -> tuple[Float[ndarray, "k h w"], Float[ndarray, "k h w"]]:
    """Estimate the depth of the k images of indices `rows` by PatchMatch stereo, `threads` images at once.

    Returns for each pixel the inverse depth (1/z, per recon unit) and the mean correlation with its two best neighbours
    (-1 to 1). `colors` and poses are of all m undistorted images, on the pixel grid of `pinhole`. `neighbours` and
    `planes` come from `choose_neighbours` and `sweep_planes`. The search covers the inverse depths between an image's
    two planes, from a quarter of the largest on. `report` is called with the finished fraction.
    """
    half = _Level(colors, resized(pinhole, pinhole.width // 2, pinhole.height // 2))
    full = _Level(colors, pinhole)
    (h, w), ray, full_ray = half.greys[0].shape, rays(half.pinhole), rays(pinhole).astype(np.float32)

    def match(i: int) -> Float[ndarray, "2 h w"]:
        others, seed = neighbours[i][:COMPARED], 100 * i
        family = np.ascontiguousarray(planes[i])
        reach = np.einsum("di,hwi->dhw", family, ray)
        span = max(float(reach.min()), LEAST_INVERSE_DEPTH * float(reach.max())), float(reach.max())

        views = half.views(i, others, recon_from_camera)
        found = np.full((4, h, blocks_of(w)), NOT_COMPARED, np.float32)
        random_planes(found, family, span, views[-1], random_state(i))
        for n, (size, tries) in enumerate(_COARSE):
            spread_planes(found, *views, (*span, size, tries), n, random_state(seed + n))
        found = full.enlarged(found)
        views = full.views(i, others, recon_from_camera)
        found[3] = NOT_COMPARED
        for n, (size, tries) in enumerate(_FINE):
            spread_planes(found, *views, (*span, size, tries), n, random_state(seed + n))
        found = found[..., : pinhole.width]
        depth = np.einsum("chw,hwc->hw", found[:3], full_ray)
        return np.stack([np.maximum(depth, np.float32(0.5 * span[0])), found[3]])

    results = []
    with ThreadPoolExecutor(threads) as pool:
        for found in pool.map(match, rows):
            results.append(found)
            report(len(results) / len(rows))
    inverse_depth, score = np.stack(results, 1)
    return inverse_depth, score
