"""Refinement of predicted cameras and depth: photometric matches between the images, then bundle adjustment.

The robot's poses are not used. Each view's depth is multiplied by a smooth factor that fits the adjusted points.
Matching and adjustment are repeated, for better cameras predict better where to match.
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
from jcr.pointmaps.grid import ImageGrid, PreparedImages, read_colors
from jcr.pointmaps.photometric_matches import Geometry, Matches, photometric_matches
from jcr.pointmaps.posed import PosedPointmaps
from jcr.records import Capture, Intrinsics, Tracks

LONG_EDGE = 960
"""Long edge of the images that are matched, in pixels; larger images are reduced."""
ROUNDS = 3
KEYPOINTS = 4000
"""Keypoints of all images together."""
LEAST_MATCHES = 70
"""Matches of an image in bundle adjustment; with fewer in any image nothing is refined. The calibration adjusts the
tracks of three images from 200 observations on."""
LARGEST_PX = 4.0
"""Reprojection error beyond which a match is left out, in units of the median."""
BEND_STD = 0.03
"""Prior standard deviation of the logarithm of a depth correction's uneven part."""


@dataclass(frozen=True, kw_only=True)
class Refinement:
    """Cameras, depth and tracks after adjustment to the matches."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    """Adjusted camera poses; the first camera keeps its predicted pose."""
    depth_factor: Float[ndarray, "n h w"]
    """Factor of the predicted points on the network's grid."""
    tracks: Tracks
    """Tracks in the pixels of the capture's own images."""
    pinhole: Intrinsics
    """Pinhole of the undistorted images: given, or with the adjusted focal length."""
    error_px: float
    """Median reprojection error in pixels of the capture's images."""


def refine(
    capture: Capture, images: PreparedImages, maps: PosedPointmaps, pinhole: Intrinsics
) -> Refinement | None:
    """Match the images of a capture and adjust cameras, depth and points; return None where too few matches are found.

    `pinhole` belongs to the undistorted images; it is fixed where `images` has it, else its focal length is adjusted.
    """
    work = ImageGrid.shrunk(maps.grid.original_size, LONG_EDGE)
    colors = read_colors(capture, work, images.intrinsics_of_capture, images.pinhole)
    gray = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in colors])
    camera, poses = work.grid_intrinsics(pinhole), maps.recon_from_camera
    depth = _depth_on(work, maps)
    factor = np.ones(maps.confidence.shape, np.float32)
    at_depth, at_map = _coordinates(work, work), _coordinates(maps.grid, work)
    adjusted = None
    for _ in range(ROUNDS):
        geometry = Geometry(camera, poses, depth)
        tracks = _tracks(photometric_matches(gray, geometry, KEYPOINTS // len(gray)), geometry)
        if np.bincount(tracks.image, minlength=len(gray)).min() < LEAST_MATCHES:
            return None
        adjusted = adjust_matches(tracks, geometry, fixed=images.pinhole is not None)
        if len(adjusted.tracks.image) == 0:
            return None
        poses, camera = adjusted.shown.state.world_from_rig, adjusted.shown.view.cameras[0]
        change = depth_changes(adjusted.tracks, poses, depth)
        depth = depth * np.stack([np.exp(at_depth @ c) for c in change]).astype(np.float32)
        factor = factor * np.stack([np.exp(at_map @ c) for c in change]).astype(np.float32)
    assert adjusted is not None
    original_px = replace(images, grid=work).original_px(adjusted.tracks.x_px)
    return Refinement(
        recon_from_camera=poses,
        depth_factor=factor,
        tracks=replace(adjusted.tracks, x_px=original_px),
        pinhole=pinhole if images.pinhole is not None else work.original_intrinsics(camera),
        error_px=adjusted.error_px / float(work.scale.mean()),
    )


@dataclass(frozen=True)
class _Adjustment:
    """Bundle adjustment of the matches, in pixels of the working grid."""

    shown: ImageEvidence
    tracks: Tracks
    """Tracks without outliers; empty where most points lie behind their cameras."""
    error_px: float
    """Median reprojection error of the tracks."""


def _depth_on(grid: ImageGrid, maps: PosedPointmaps) -> Float[ndarray, "n h w"]:
    """Return the predicted depth at the pixels of another grid of the same images; 0 where no depth is known."""
    v, u = np.mgrid[: grid.size[1], : grid.size[0]]
    there = maps.grid.grid_from_original(grid.original_from_grid(np.stack([u, v], -1).astype(np.float64)))
    x, y = (there[..., axis].astype(np.float32) for axis in range(2))
    # The grid's outermost half pixels are still inside the image.
    x, y = np.clip(x, 0, maps.grid.size[0] - 1), np.clip(y, 0, maps.grid.size[1] - 1)
    inside = (np.abs(x - there[..., 0]) <= 0.5) & (np.abs(y - there[..., 1]) <= 0.5)
    depths = []
    for points, confidence in zip(maps.x_in_camera, maps.confidence, strict=True):
        known = cv2.remap((confidence > 0).astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.99
        depths.append(np.where(known & inside, cv2.remap(points[..., 2], x, y, cv2.INTER_LINEAR), 0))
    return np.stack(depths).astype(np.float32)


def _coordinates(grid: ImageGrid, work: ImageGrid) -> Float[ndarray, "h w 6"]:
    """Return the quadratic basis of the working grid's coordinates at the pixels of a grid."""
    v, u = np.mgrid[: grid.size[1], : grid.size[0]]
    on_work = work.grid_from_original(grid.original_from_grid(np.stack([u, v], -1).astype(np.float64)))
    return _basis(on_work[..., 0] / (work.size[0] - 1), on_work[..., 1] / (work.size[1] - 1))


def _tracks(matches: Matches, geometry: Geometry) -> Tracks:
    """Return tracks of keypoints and their matches, the points at the depth of their first view."""
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


def adjust_matches(tracks: Tracks, geometry: Geometry, fixed: bool) -> _Adjustment:
    """Adjust cameras and points, and the focal length unless it is fixed.

    Matches far from their points are left out of the tracks, and points that then have fewer than two views.
    """
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
    return _Adjustment(shown, inliers, float(np.median(error[good])) if good.any() else np.inf)


def depth_changes(
    tracks: Tracks, recon_from_camera: Float[ndarray, "n 4 4"], depth: Float[ndarray, "n h w"]
) -> Sequence[Float[ndarray, "6"]]:
    """Fit per view a quadratic in the image's coordinates to the logarithm of the factor that corrects its depth.

    `depth` is on the grid of the pixels of `tracks`, 0 where no depth is known. The fit is robust, with a prior on all
    coefficients but the constant: five points in a corner do not bend the rest.
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
    """Return 1, x, y, x², xy, y² of coordinates 0 … 1, centred."""
    x, y = 2 * x - 1, 2 * y - 1
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
