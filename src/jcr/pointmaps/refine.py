"""Predicted cameras and depth refined by what the images show: colour matches, then bundle adjustment without the robot.

Predictions are rough at the pixel. Matches by colour (colour_matches.py) are not, and go where COLMAP's go: first into
an adjustment of cameras and points alone, here, which also corrects each view's depth by a smooth factor; then as tracks
into the calibration's. Matching and adjusting are repeated, for better cameras predict better where to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import unproject
from jcr.estimation.image_equations import ImageEvidence, adjust_images
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, camera_with_prior
from jcr.estimation.observations import Observations
from jcr.estimation.wrist import image_problem
from jcr.geometry import inverse
from jcr.pointmaps.grid import ImageGrid, PreparedImages
from jcr.pointmaps.interface import Predicted
from jcr.pointmaps.photometric_matches import Geometry, Matches, colour_matches
from jcr.records import CameraEvidence, Intrinsics, Tracks

LONG_EDGE = 960
"""Longest side of the images that are compared; larger ones are made smaller."""
ROUNDS = 3
KEYPOINTS = 4000
"""Keypoints of all images together."""
LEAST_MATCHES = 25
"""Of an image, in bundle adjustment: with fewer it is left where it was predicted, and nothing is refined."""
LARGEST_PX = 4.0
"""Reprojection error beyond which a match is none, in units of the median."""
BEND_STD = 0.03
"""Prior of the logarithm of a depth correction's uneven part, which is zero where no match is near."""


@dataclass(frozen=True, kw_only=True)
class Refined:
    """A prediction after adjustment to the images' matches."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    """The first camera is where it was."""
    depth_factor: Float[ndarray, "n h w"]
    """Factor of the predicted points, on the model's grid."""
    tracks: Tracks
    """Tracks in the capture's own images."""
    pinhole: Intrinsics
    """Of the undistorted images, as given, or with the focal length that the images show."""
    evidence: CameraEvidence
    error_px: float
    """Median reprojection error, in pixels of the camera's images."""


def refine(predicted: Predicted, images: PreparedImages, pinhole: Intrinsics) -> Refined | None:
    """Cameras, depth and tracks; None where too few matches are found.

    `images` are those of the capture without distortion, in full size; `pinhole` is theirs, fixed where `images` has
    it, else a first value of the focal length.
    """
    poses = predicted.recon_from_camera
    work = ImageGrid.shrunk(images.grid.size, LONG_EDGE)
    smaller = [cv2.resize(image, work.size, interpolation=cv2.INTER_AREA) for image in images.colors]
    gray = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in smaller])
    camera = work.grid_intrinsics(pinhole)
    depth = _depth_on(work, predicted)
    factor = np.ones(predicted.confidence.shape, np.float32)
    adjusted = None
    for _ in range(ROUNDS):
        geometry = Geometry(camera, poses, depth)
        tracks = _tracks(colour_matches(gray, geometry, KEYPOINTS // len(gray)), geometry)
        if np.bincount(tracks.image, minlength=len(gray)).min() < LEAST_MATCHES:
            return None
        adjusted = adjust_matches(tracks, geometry, fixed=images.pinhole is not None)
        if len(adjusted.tracks.image) == 0:
            return None
        poses, camera = adjusted.shown.state.world_from_rig, adjusted.shown.view.cameras[0]
        change = depth_changes(adjusted.tracks, poses, depth)
        depth = depth * np.stack([smooth_factor(c, work.size[1], work.size[0]) for c in change])
        factor = factor * np.stack([smooth_factor(c, *predicted.grid.size[::-1]) for c in change])
    assert adjusted is not None
    tracks = adjusted.tracks
    seen_px = images.grid.grid_from_original(work.original_from_grid(tracks.x_px))
    return Refined(
        recon_from_camera=poses,
        depth_factor=factor,
        tracks=replace(tracks, x_px=images.original_px(seen_px)),
        pinhole=pinhole if images.pinhole is not None else work.original_intrinsics(camera),
        evidence=CameraEvidence(poses, adjusted.shown.rig_covariance()),
        error_px=adjusted.error_px / float(work.scale.mean()),
    )


@dataclass(frozen=True)
class _Adjusted:
    """On the working grid."""

    shown: ImageEvidence
    tracks: Tracks
    """Without outliers; none where most points came to lie behind their cameras."""
    error_px: float
    """Median, of these."""


def _depth_on(grid: ImageGrid, predicted: Predicted) -> Float[ndarray, "n h w"]:
    """Predicted depth at the pixels of another grid of the same images; 0 outside, and beside what is unknown."""
    v, u = np.mgrid[: grid.size[1], : grid.size[0]]
    there = predicted.grid.grid_from_original(
        grid.original_from_grid(np.stack([u, v], -1).astype(np.float64))
    )
    x, y = (there[..., axis].astype(np.float32) for axis in range(2))
    # The grid's outermost half pixels are still inside the image.
    x, y = np.clip(x, 0, predicted.grid.size[0] - 1), np.clip(y, 0, predicted.grid.size[1] - 1)
    inside = (np.abs(x - there[..., 0]) <= 0.5) & (np.abs(y - there[..., 1]) <= 0.5)
    depths = []
    for points, confidence in zip(predicted.x_in_camera, predicted.confidence, strict=True):
        known = cv2.remap((confidence > 0).astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.99
        depths.append(np.where(known & inside, cv2.remap(points[..., 2], x, y, cv2.INTER_LINEAR), 0))
    return np.stack(depths).astype(np.float32)


def _tracks(matches: Matches, geometry: Geometry) -> Tracks:
    """Keypoints and where others show them; the points are where the depth of their first view puts them."""
    used, row = np.unique(matches.point, return_inverse=True)
    first, x_px = matches.start[used, 0].astype(int), matches.start[used, 1:].astype(np.float64)
    column, line = np.rint(x_px).astype(int).T
    x_in_camera = geometry.depth[first, line, column, None] * unproject(geometry.pinhole, x_px)
    rotation, center = geometry.recon_from_camera[first, :3, :3], geometry.recon_from_camera[first, :3, 3]
    return Tracks(
        image=np.concatenate([first, matches.view]),
        x_px=np.concatenate([x_px, matches.x_px]),
        point=np.concatenate([np.arange(len(used)), row]),
        points_in_recon=np.einsum("kij,kj->ki", rotation, x_in_camera) + center,
    )


def adjust_matches(tracks: Tracks, geometry: Geometry, fixed: bool) -> _Adjusted:
    """Cameras and points adjusted, and the focal length unless it is fixed; matches far from their points left out, and
    points that fewer than two views are left to see."""
    images, camera = len(geometry.recon_from_camera), geometry.pinhole
    prior = camera_with_prior(camera, FIXED if fixed else {"f": ESTIMATED["f"]})
    observations = Observations.of_one_camera(tracks, images)
    shown = adjust_images(
        *image_problem(geometry.recon_from_camera, prior, observations, tracks.points_in_recon)
    )
    seen, points = shown.problem.observations, shown.state.points_in_world
    assert seen is not None
    error = np.linalg.norm(shown.view.residual_px, axis=1)
    error[shown.view.depth <= 0] = np.inf
    good = error < LARGEST_PX * max(float(np.median(error)), 0.1)
    good &= (np.bincount(seen.point[good], minlength=len(points)) >= 2)[seen.point]
    kept, point = np.unique(seen.point[good], return_inverse=True)
    inliers = Tracks(image=seen.image[good], x_px=seen.x_px[good], point=point, points_in_recon=points[kept])
    return _Adjusted(shown, inliers, float(np.median(error[good])) if good.any() else np.inf)


def depth_changes(
    tracks: Tracks, recon_from_camera: Float[ndarray, "n 4 4"], depth: Float[ndarray, "n h w"]
) -> Sequence[Float[ndarray, "6"]]:
    """Per view a quadratic in the image's coordinates, for the logarithm by which its depth is too small.

    `depth` is on the grid in whose pixels `tracks` counts, 0 where nothing is known. Robust least squares on the tracks'
    points, with a prior on all but its constant: five points in a corner do not bend the rest.
    """
    camera_from_recon = inverse(recon_from_camera)[tracks.image]
    z = np.einsum("kj,kj->k", camera_from_recon[:, 2, :3], tracks.points_in_recon[tracks.point])
    z += camera_from_recon[:, 2, 3]
    column, row = np.clip(np.rint(tracks.x_px).astype(int), 0, [depth.shape[2] - 1, depth.shape[1] - 1]).T
    own = depth[tracks.image, row, column]
    found = []
    for view in range(len(depth)):
        mine = (tracks.image == view) & (own > 0) & (z > 0)
        design = _basis(column[mine] / (depth.shape[2] - 1), row[mine] / (depth.shape[1] - 1))
        target = np.log(z[mine] / own[mine])
        coefficients = np.array([np.median(target) if mine.any() else 0.0, *np.zeros(5)])
        for _ in range(10 if mine.any() else 0):
            off = target - design @ coefficients
            sigma = 1.4826 * np.median(np.abs(off)) + 1e-4
            weight = 1 / (1 + (off / (2 * sigma)) ** 2) / sigma**2
            normal = design.T @ (weight[:, None] * design)
            normal[1:, 1:] += np.eye(5) / BEND_STD**2
            coefficients = np.linalg.solve(normal + 1e-9 * np.eye(6), design.T @ (weight * target))
        found.append(coefficients)
    return found


def _basis(x: ndarray, y: ndarray) -> ndarray:
    """1, x, y, x², xy, y² of coordinates 0 … 1, centred."""
    x, y = 2 * x - 1, 2 * y - 1
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def smooth_factor(coefficients: Float[ndarray, "6"], height: int, width: int) -> Float[ndarray, "h w"]:
    """The factor at every pixel of an image of that size."""
    y, x = np.meshgrid(np.linspace(0, 1, height), np.linspace(0, 1, width), indexing="ij")
    return np.exp(_basis(x, y) @ coefficients).astype(np.float32)
