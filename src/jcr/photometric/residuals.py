"""Colour residuals of pixels over posed images: depth search along rays, and Gauss-Newton with eliminated depths.

Points are pixels of one image (their host) with a depth of their own, as in Engel et al., "Direct Sparse Odometry"
(PAMI 2018), taken where colour changes most. Their colour is compared with all other images, in RGB, with a robust
weight that excludes occluded views and gloss.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray

from jcr.camera import project, resized, unproject, zoomed
from jcr.geometry import inverse, skew
from jcr.records import Intrinsics

BLUR_PX = 1.0
"""Standard deviation, px, of the blur of every level, which turns an edge into a slope for linear steps."""
SEEN_BY = 0.6
"""Share of the other images, those of least cost, that the cost of a depth counts; others may not see the point."""
LEAST_DEPTH = 0.05
"""Least depth of a point in front of a camera, m."""
LOCATED_FROM = 2.0 / 255
"""Change of colour (0 to 1) per pixel below which a pixel has too little contrast to be located."""
_BORDER_PX = 2
_KEEP_DEPTH = 1e-3
"""Information that is added to every log depth, so that a depth that the images do not determine keeps its value."""
_CHUNK = 500
"""Number of points whose equations are in memory at a time: less than 100 MB for 15 images."""


@dataclass(frozen=True)
class Level:
    """Blurred images of one height, stacked along the rows, with their derivatives by pixel coordinates u and v."""

    color: Float32[ndarray, "nh w 3"]
    by_u: Float32[ndarray, "nh w 3"]
    by_v: Float32[ndarray, "nh w 3"]
    grid: Intrinsics
    """Pinhole intrinsics of these images. The focal length is a guess if unknown; `Cameras.zoom` corrects it."""

    @property
    def count(self) -> int:
        """Number of images."""
        return len(self.color) // self.grid.height

    def rows(self, which: Int[ndarray, " m"]) -> "Level":
        """Return the level with only the m images whose numbers, counted from 0, are in `which`, in this order."""
        color, by_u, by_v = (
            x.reshape(self.count, self.grid.height, *x.shape[1:])[which].reshape(-1, *x.shape[1:])
            for x in (self.color, self.by_u, self.by_v)
        )
        return Level(color, by_u, by_v, self.grid)

    def times(self, factor: Float[ndarray, " n"]) -> "Level":
        """Return the level with the colours of each image multiplied by its factor."""
        of_row = np.repeat(factor, self.grid.height).astype(np.float32)[:, None, None]
        return Level(of_row * self.color, of_row * self.by_u, of_row * self.by_v, self.grid)


@dataclass(frozen=True)
class Cameras:
    """Camera poses in the base frame (m), and a factor `zoom` of the focal lengths, common to all cameras."""

    base_from_camera: Float[ndarray, "n 4 4"]
    zoom: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Points:
    """Scene points: each is a pixel in one image (its host, given by row), with colour (0 to 1) and depth (m) there."""

    host: Int[ndarray, " k"]
    x_px: Float[ndarray, "k 2"]
    color: Float32[ndarray, "k 3"]
    depth: Float[ndarray, " k"]
    agreed: Bool[ndarray, " k"]
    """True for points whose colour most of the images that should see them show."""

    def where(self, kept: Bool[ndarray, " k"] | slice) -> "Points":
        """Return the points that a mask or slice selects."""
        return Points(**{name: values[kept] for name, values in vars(self).items()})


@dataclass(frozen=True, kw_only=True)
class PhotometricEquations:
    """Normal equations of a Gauss-Newton step in p camera parameters; the log depths of k points are eliminated.

    The parameters are six per camera, or six for all cameras, and last the log focal length. The steps of the log
    depths follow from the step of the parameters (Schur complement).
    """

    normal: Float[ndarray, "p p"]
    gradient: Float[ndarray, "k p"]
    """Gradient of each point's cost; the sum over the points is the gradient of the whole cost."""
    by_depth: Float[ndarray, "k p"]
    depth_gradient: Float[ndarray, " k"]
    depth_information: Float[ndarray, " k"]

    def depth_step(self, step: Float[ndarray, " p"]) -> Float[ndarray, " k"]:
        """Return the step of each point's log depth, given the step of the p camera parameters."""
        return -(self.depth_gradient + self.by_depth @ step) / self.depth_information


def make_level(images: Float32[ndarray, "n h w 3"], grid: Intrinsics, height: int) -> Level:
    """Return a level: the images (RGB, 0 to 1) reduced to `height` pixels and blurred (BLUR_PX).

    `grid` are the intrinsics of the images before the reduction.
    """
    small = resized(grid, max(1, round(grid.width * height / grid.height)), height)
    blurred = []
    for image in images:
        reduced = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        blurred.append(cv2.GaussianBlur(reduced, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE))
    stack = np.stack(blurred)
    by_v, by_u = np.gradient(stack, axis=(1, 2))
    color, by_u, by_v = (x.reshape(-1, small.width, 3) for x in (stack, by_u, by_v))
    return Level(color, by_u, by_v, small)


def strong_edges(level: Level, per_image: int) -> tuple[Int[ndarray, " k"], Int[ndarray, "k 2"]]:
    """Return image row and pixel (u, v) of k strong edges, at most `per_image` in each image.

    Each is the pixel of the largest change of colour in a square block. The blocks with the largest changes are taken;
    changes below LOCATED_FROM per pixel are left out.
    """
    n, h, w = level.count, level.grid.height, level.grid.width
    block = max(2, int(np.sqrt(h * w / (3 * per_image))))
    change = (level.by_u**2 + level.by_v**2).sum(-1).reshape(n, h, w)
    b = _BORDER_PX
    change[:, :b] = change[:, -b:] = change[..., :b] = change[..., -b:] = 0
    rows, columns = h // block, w // block
    blocks = change[:, : rows * block, : columns * block].reshape(n, rows, block, columns, block)
    blocks = blocks.swapaxes(2, 3).reshape(n, rows * columns, block * block)
    inside, best = blocks.argmax(-1), blocks.max(-1)
    cell = np.argsort(-best, axis=1, kind="stable")[:, :per_image]
    host, rank = np.nonzero(np.take_along_axis(best, cell, 1) > LOCATED_FROM**2)
    cell = cell[host, rank]
    inside = inside[host, cell]
    u, v = cell % columns * block + inside % block, cell // columns * block + inside // block
    return host, np.column_stack([u, v])


def search_depths(
    level: Level,
    cameras: Cameras,
    host: Int[ndarray, " k"],
    x_px: Int[ndarray, "k 2"],
    depths: Float[ndarray, "d n"],
    sigma: float,
    least: float,
) -> tuple[Points, float]:
    """Return points at the given pixels with the best of the tried `depths`, and the mean of the points' costs.

    `host` is the image row of each pixel; `depths` (z in the host's camera frame, m) has one row per trial and one
    column per image. The cost of a point is the mean of r²/(r² + sigma²) over the share SEEN_BY of the images with the
    smallest colour difference r. It is 1 where fewer than two images see the point. Points with a cost below `least`
    are marked as agreed.
    """
    color = level.color[level.grid.height * host + x_px[:, 1], x_px[:, 0]]
    agreed = np.ones(len(host), bool)
    points = Points(host=host, x_px=x_px.astype(float), color=color, depth=depths[0, host], agreed=agreed)
    cost = np.empty((len(depths), len(host)))
    for trial, depth in enumerate(depths):
        _, u, v, seen = in_view(level, cameras, replace(points, depth=depth[host]))
        misfit = squared_misfit(level, points, u, v)
        misfit = np.sort(np.where(seen, misfit / (misfit + np.float32(sigma**2)), 2.0), axis=0)
        count = seen.sum(0)
        kept = np.maximum(np.ceil(SEEN_BY * count), 2)
        total = np.where(np.arange(len(misfit))[:, None] < kept, misfit, 0).sum(0)
        cost[trial] = np.where(count < 2, 1.0, total / kept)
    best = cost.argmin(0)
    found = cost[best, np.arange(len(host))]
    return replace(points, depth=depths[best, host], agreed=found < least), float(found.mean())


def squared_misfit(
    level: Level, points: Points, u: Float32[ndarray, "n k"], v: Float32[ndarray, "n k"]
) -> Float32[ndarray, "n k"]:
    """Return for each image and point the squared colour difference, summed over RGB (0 to 1).

    The colour of image n at the pixel u[n, k], v[n, k], by bilinear interpolation, is compared with that of point k.
    """
    difference = sample(level.color, level, u, v) - points.color
    return np.einsum("nkc,nkc->nk", difference, difference)


def _in_host(level: Level, cameras: Cameras, points: Points) -> Float[ndarray, "k 3"]:
    """Return the points in the camera frame of their host images, m."""
    return points.depth[:, None] * unproject(zoomed(level.grid, cameras.zoom), points.x_px)


def in_base(level: Level, cameras: Cameras, points: Points) -> Float[ndarray, "k 3"]:
    """Return the points in the base frame, m."""
    pose = cameras.base_from_camera[points.host]
    return np.einsum("kij,kj->ki", pose[:, :3, :3], _in_host(level, cameras, points)) + pose[:, :3, 3]


def in_view(
    level: Level, cameras: Cameras, points: Points
) -> tuple[Float32[ndarray, "n k 3"], Float32[ndarray, "n k"], Float32[ndarray, "n k"], Bool[ndarray, "n k"]]:
    """Return per image and point: the point in the camera frame (m), its pixel u and v, and whether the image shows it.

    The image shows a point in front of the camera and inside the image; occlusion is not tested. A host image does not
    count as seeing its own points.
    """
    camera_from_base = inverse(cameras.base_from_camera).astype(np.float32)
    x = in_base(level, cameras, points).astype(np.float32) @ camera_from_base[:, :3, :3].swapaxes(1, 2)
    x += camera_from_base[:, None, :3, 3]
    # Depths below LEAST_DEPTH are clipped before projection.
    ahead = np.concatenate([x[..., :2], np.maximum(x[..., 2:], np.float32(LEAST_DEPTH))], -1)
    u, v = np.moveaxis(project(zoomed(level.grid, cameras.zoom), ahead), -1, 0)
    seen = (x[..., 2] > LEAST_DEPTH) & (u >= 0) & (u <= level.grid.width - 1)
    seen &= (v >= 0) & (v <= level.grid.height - 1)
    seen[points.host, np.arange(len(points.host))] = False
    return x, u, v, seen


def sample(
    stack: Float32[ndarray, "nh w 3"], level: Level, u: ndarray, v: ndarray
) -> Float32[ndarray, "n k 3"]:
    """Return the colour of each of the n images of `stack` at its k pixels u, v (n,k), by bilinear interpolation.

    `stack` has the images of `level`, or their derivatives, one below the other. Pixels outside the image take the
    colour of the nearest border pixel.
    """
    u = np.clip(u, 0, level.grid.width - 1)
    v = np.clip(v, 0, level.grid.height - 1) + np.float32(level.grid.height) * np.arange(len(v))[:, None]
    return cv2.remap(stack, u, v.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def energy(level: Level, cameras: Cameras, points: Points, sigma: float) -> float:
    """Return the mean robust cost, 0 to 1, of the agreed points over all images that see them.

    The cost of a colour difference r (RGB, 0 to 1) is r²/(r² + sigma²).
    """
    _, u, v, seen = in_view(level, cameras, points)
    misfit = squared_misfit(level, points, u, v)
    weight = seen & points.agreed
    return float((weight * misfit / (misfit + np.float32(sigma**2))).sum() / max(weight.sum(), 1))


def equations(
    level: Level, cameras: Cameras, points: Points, sigma: float, tied: bool
) -> PhotometricEquations:
    """Return the normal equations for twists (translation, rotation in camera axes) and the log focal length.

    A twist ξ changes a pose T to T·exp(ξ). There is one twist for all cameras if `tied` (p = 7), otherwise one for each
    camera (p = 6n + 1). The cost is that of `energy`, with its scale `sigma`.
    """
    n, k = level.count, len(points.host)
    p = 7 if tied else 6 * n + 1
    normal = np.zeros((p, p))
    gradient, by_depth = np.zeros((k, p)), np.zeros((k, p))
    depth_gradient, information = np.zeros(k), np.zeros(k)
    for rows, residual, by_target, by_host, by_focal, by_log_depth in _linearised(
        level, cameras, points, sigma
    ):
        if tied:
            a = np.concatenate([by_target + by_host, by_focal[..., None]], -1)
        else:
            a = np.zeros((*residual.shape, p), np.float32)
            of_host = 6 * points.host[rows, None] + np.arange(6)
            at = np.arange(len(of_host))[:, None]
            for i in range(n):
                a[i, ..., 6 * i : 6 * i + 6] = by_target[i]
                a[i, at, :, of_host] += by_host[i].swapaxes(1, 2)
            a[..., -1] = by_focal
        # Reorder to one block of 3n rows per point.
        a, q, r = (x.swapaxes(0, 1).reshape(len(x[0]), 3 * n, -1) for x in (a, by_log_depth, residual))
        b = (a * q).sum(1).astype(np.float64)
        flat = a.reshape(-1, p)
        information[rows] = (q * q).sum((1, 2)) + _KEEP_DEPTH
        depth_gradient[rows] = (q * r).sum((1, 2))
        by_depth[rows] = b
        normal += (flat.T @ flat) - (b / information[rows, None]).T @ b
        gradient[rows] = (a * r).sum(1) - b * (depth_gradient[rows] / information[rows])[:, None]
    return PhotometricEquations(
        normal=normal,
        gradient=gradient,
        by_depth=by_depth,
        depth_gradient=depth_gradient,
        depth_information=information,
    )


def _linearised(
    level: Level, cameras: Cameras, points: Points, sigma: float
) -> Iterator[tuple[slice, ndarray, ndarray, ndarray, ndarray, ndarray]]:
    """Yield per chunk of points: their slice, the weighted residuals, and four arrays of weighted derivatives.

    The derivatives are by the twist of the viewing camera, the twist of the point's host camera, the log focal length
    and the log depth. Residuals and derivatives are arrays (images, points, 3 colours); those by a twist have a last
    axis of 6. The weight is the root of the Geman-McClure weight of scale `sigma`; it is 0 where an image does not show
    an agreed point.
    """
    poses = cameras.base_from_camera
    rotation = (poses[:, None, :3, :3].swapaxes(-1, -2) @ poses[None, :, :3, :3]).astype(np.float32)
    for start in range(0, len(points.host), _CHUNK):
        rows = slice(start, start + _CHUNK)
        some = points.where(rows)
        x, u, v, seen = in_view(level, cameras, some)
        residual, by_u, by_v = (sample(of, level, u, v) for of in (level.color, level.by_u, level.by_v))
        residual = residual - some.color
        # Weight of the Geman-McClure loss.
        squared = np.einsum("nkc,nkc->nk", residual, residual)
        weight = (seen & some.agreed) / (1 + squared / np.float32(sigma**2)) ** 2
        root = np.sqrt(weight, dtype=np.float32)[..., None]
        x_in_host = _in_host(level, cameras, some).astype(np.float32)
        other_from_host = rotation[:, some.host]
        moves = np.zeros((*x.shape, 14), np.float32)
        moves[..., 0:3] = -np.eye(3)
        moves[..., 3:6] = skew(x)
        moves[..., 6:9] = other_from_host
        moves[..., 9:12] = -other_from_host @ skew(x_in_host).astype(np.float32)
        arms = np.stack([x_in_host * np.array([-1, -1, 0], np.float32), x_in_host], -1)
        moves[..., 12:] = other_from_host @ arms
        # camera.by_point of a pinhole, times `moves`: 0.27 instead of 0.47 ms for 500 points in 15 images, without its
        # zeros and the many small products.
        z = np.maximum(x[..., 2:], np.float32(LEAST_DEPTH))
        shift_u = (moves[..., 0, :] - x[..., :1] / z * moves[..., 2, :]) / z
        shift_v = (moves[..., 1, :] - x[..., 1:2] / z * moves[..., 2, :]) / z
        shift_u *= np.float32(level.grid.fx * cameras.zoom)
        shift_v *= np.float32(level.grid.fy * cameras.zoom)
        shift_u[..., 12] += u - np.float32(level.grid.cx)
        shift_v[..., 12] += v - np.float32(level.grid.cy)
        j = (by_u * root)[..., None] * shift_u[..., None, :]
        j += (by_v * root)[..., None] * shift_v[..., None, :]
        yield rows, residual * root, j[..., :6], j[..., 6:12], j[..., 12], j[..., 13]
