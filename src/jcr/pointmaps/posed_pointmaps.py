"""Pointmaps of images with a camera pose each, in one frame: the common form of every network's prediction."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import guessed_intrinsics, rays
from jcr.pointmaps.image_grid import ImageGrid
from jcr.records import Intrinsics

SAMPLES = 20_000
"""Approximate number of pixels, over all images, that the pinhole is fitted to."""
PREDICTED_STD = (0.02, np.radians(1.5))
"""Standard deviations of a predicted camera pose without matches: position per axis, relative to the distance of the
scene, and rotation per axis (rad). They hold for Depth Anything 3's largest model on 7-Scenes (27 % of pairs within
an average threshold of 3°, its benchmark page)."""
FOCAL_STD = 0.05
"""Relative standard deviation of a network's focal length without matches, common to all images."""


@dataclass(frozen=True, kw_only=True)
class PosedPointmaps:
    """Camera pose and pointmap (3D point of each pixel, with confidence) of each image, in one recon frame."""

    grid: ImageGrid
    """Position of the pointmaps' pixels in the undistorted images."""
    recon_from_camera: Float[ndarray, "n 4 4"]
    """Rigid camera poses."""
    x_in_camera: Float[ndarray, "n h w 3"]
    """Point of each pixel in its own camera's frame; finite where the confidence is above 0."""
    confidence: Float[ndarray, "n h w"]
    """Confidence, at least 0; 0 means no estimate. It is comparable only within an image, and no probability."""
    is_metric: bool
    covariance: Float[ndarray, "r r"] | None = None
    """Covariance of the steps of all camera poses (translation, rotation), r = 6n; None: unknown."""
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def on_rays(self, pinhole: Intrinsics) -> "PosedPointmaps":
        """Return the pointmaps with each point moved, at constant z, to its pixel's ray by the grid's `pinhole`.

        Points with confidence 0 become 0.
        """
        points = self.x_in_camera[..., 2:] * rays(pinhole).astype(np.float32)
        return replace(self, x_in_camera=np.where((self.confidence > 0)[..., None], points, 0))


def fit_pinhole(maps: PosedPointmaps) -> tuple[Intrinsics, float]:
    """Fit pinhole intrinsics of the grid to about SAMPLES pixels and their points; return them with the median residual.

    The residual is in px. The model u = fx · x/z + cx is linear in the unknowns, and residuals are weighted robustly
    (Geman-McClure). The residual is infinite where half of the points lie behind their camera, or fewer than 100 lie in
    front, or for a focal length that is not positive; the intrinsics are then a guess.
    """
    confidence = maps.confidence
    height, width = confidence.shape[1:]
    stride = max(1, int(np.sqrt(confidence.size / SAMPLES)))
    points, prior = maps.x_in_camera[:, ::stride, ::stride], confidence[:, ::stride, ::stride]
    v, u = np.mgrid[:height:stride, :width:stride]
    pixel = np.broadcast_to(np.stack([u, v], -1), (*prior.shape, 2))
    ahead = (prior > 0) & (points[..., 2] > 0)
    if ahead.sum() < max(100, 0.5 * (prior > 0).sum()):
        return guessed_intrinsics((width, height)), float("inf")
    ray, pixel, prior = points[ahead, :2] / points[ahead, 2:], pixel[ahead], prior[ahead]
    focal, center = np.empty(2), np.empty(2)
    misfit = np.zeros_like(ray)
    for _ in range(5):
        scale = np.median(np.linalg.norm(misfit, axis=1)) + 1e-6
        weight = prior / (1 + (misfit**2).sum(1) / (2 * scale) ** 2) ** 2
        for axis in range(2):
            mean_ray, mean_px = (np.average(values[:, axis], weights=weight) for values in (ray, pixel))
            centred = ray[:, axis] - mean_ray
            focal[axis] = (weight * centred) @ pixel[:, axis] / ((weight * centred) @ centred)
            center[axis] = mean_px - focal[axis] * mean_ray
        misfit = ray * focal + center - pixel
    (fx, fy), (cx, cy) = focal.tolist(), center.tolist()
    if min(fx, fy) <= 0:
        return guessed_intrinsics((width, height)), float("inf")
    return Intrinsics(fx, fy, cx, cy, width, height), float(np.median(np.linalg.norm(misfit, axis=1)))


def published_covariance(maps: PosedPointmaps) -> Float[ndarray, "r r"]:
    """Return the covariance (6n,6n) of n camera poses relative to the first, from errors published for a network.

    Each camera has six rows: translation (recon units) and rotation (rad) in recon axes; those of the first are 0.
    Every camera has an independent error (PREDICTED_STD); the first camera's error also moves all others relative to
    it.
    """
    poses = maps.recon_from_camera
    count = len(poses)
    distance = float(np.median(maps.x_in_camera[..., 2][maps.confidence > 0]))
    single = np.diag(np.repeat([(PREDICTED_STD[0] * distance) ** 2, PREDICTED_STD[1] ** 2], 3))
    by_first = np.tile(np.eye(6), (count, 1, 1))
    for axis in range(3):
        by_first[:, :3, 3 + axis] = np.cross(np.eye(3)[axis], poses[:, :3, 3] - poses[0, :3, 3])
    covariance = np.einsum("nij,jk,mlk->niml", by_first, single, by_first)
    covariance[np.arange(count), :, np.arange(count), :] += single
    covariance[0], covariance[:, :, 0] = 0, 0
    return covariance.reshape(6 * count, 6 * count)
