"""Refinement of predicted cameras and depth by optical flow between the images and bundle adjustment.

Each other view is warped by the predicted geometry; the remaining flow is found by OpenCV's pyramid of Lucas and Kanade
(1981). The gripper poses are not used.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from jcr.camera import rays, unproject
from jcr.estimation.image_equations import adjust_images
from jcr.estimation.intrinsics_prior import ESTIMATED, FIXED, camera_with_prior
from jcr.estimation.problem import Observations, image_problem
from jcr.geometry import apply, inverse
from jcr.pointmaps.grid import ImageGrid, PreparedImages, read_colors
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
WINDOW = (21, 21)
LEVELS = 3
"""Levels of the pyramid above the image; the largest displacement is about 60 pixels."""
WIDEST_DEG = 70.0
"""Largest angle between two views that are compared."""
LARGEST_RETURN_PX = 0.5
"""Largest distance between a keypoint and its position after the flow there and back."""
LEAST_CORRELATION = 0.8
"""Least normalised correlation of the patches around both ends."""
PATCH_RADIUS = 5
STEP_RADIUS, LARGEST_STEP = 5, 0.04
"""Pixels around a keypoint within which depth must not change by more than this share."""
LARGEST_STD_PX = 0.1
"""Largest standard deviation of a match in the least determined direction of its window."""
LARGEST_GAP = 0.15
"""Largest difference of a point's depth from the other view's own depth, in logarithms."""


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
    width, height = maps.grid.original_size
    scale = min(1.0, LONG_EDGE / max(width, height))
    work = ImageGrid.uncropped((width, height), (round(width * scale), round(height * scale)))
    colors = read_colors(capture, work, images.intrinsics_of_capture, images.pinhole)
    gray = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in colors])
    camera, poses = work.grid_intrinsics(pinhole), maps.recon_from_camera
    depth = _depth_on(work, maps)
    factor = np.ones(maps.confidence.shape, np.float32)
    at_depth, at_map = (_basis(_pixels_on(grid, work), work.size) for grid in (work, maps.grid))
    tracks, error_px = None, np.inf
    for _ in range(ROUNDS):
        tracks = _match(gray, camera, poses, depth)
        if np.bincount(tracks.image, minlength=len(gray)).min() < LEAST_MATCHES:
            return None
        tracks, error_px, poses, camera = _adjust(tracks, camera, poses, fixed=images.pinhole is not None)
        if len(tracks.image) == 0:
            return None
        change = _depth_changes(tracks, poses, depth)
        depth = depth * np.exp(np.einsum("hwc,nc->nhw", at_depth, change)).astype(np.float32)
        factor = factor * np.exp(np.einsum("hwc,nc->nhw", at_map, change)).astype(np.float32)
    assert tracks is not None
    return Refinement(
        recon_from_camera=poses,
        depth_factor=factor,
        tracks=replace(tracks, x_px=replace(images, grid=work).original_px(tracks.x_px)),
        pinhole=pinhole if images.pinhole is not None else work.original_intrinsics(camera),
        error_px=error_px / float(work.scale.mean()),
    )


def _pixels_on(grid: ImageGrid, other: ImageGrid) -> Float[ndarray, "h w 2"]:
    """Return the pixels of a grid in another grid of the same images."""
    v, u = np.mgrid[: grid.size[1], : grid.size[0]]
    return other.grid_from_original(grid.original_from_grid(np.stack([u, v], -1).astype(np.float64)))


def _basis(x_px: Float[ndarray, "*k 2"], size: tuple[int, int]) -> Float[ndarray, "*k 6"]:
    """Return 1, x, y, x², xy, y² of pixels of an image (width, height), scaled to -1 … 1."""
    scaled = 2 * x_px / (np.array(size) - 1) - 1
    x, y = scaled[..., 0], scaled[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _depth_on(grid: ImageGrid, maps: PosedPointmaps) -> Float[ndarray, "n h w"]:
    """Return the predicted depth at the pixels of another grid of the same images; 0 where no depth is known."""
    there = _pixels_on(grid, maps.grid)
    # The grid's outermost half pixels are still inside the image.
    x, y = np.moveaxis(np.clip(there, 0, np.array(maps.grid.size) - 1).astype(np.float32), -1, 0)
    inside = (np.abs(np.stack([x, y], -1) - there) <= 0.5).all(-1)
    depths = []
    for points, confidence in zip(maps.x_in_camera, maps.confidence, strict=True):
        known = cv2.remap((confidence > 0).astype(np.float32), x, y, cv2.INTER_LINEAR) > 0.99
        depths.append(np.where(known & inside, cv2.remap(points[..., 2], x, y, cv2.INTER_LINEAR), 0))
    return np.stack(depths).astype(np.float32)


def _match(
    gray: UInt8[ndarray, "n h w"],
    camera: Intrinsics,
    poses: Float[ndarray, "n 4 4"],
    depth: Float[ndarray, "n h w"],
) -> Tracks:
    """Match corners of each view in the other views; the points are at the depth of their first view."""
    axis = poses[:, :3, 2]
    apart_deg = np.degrees(np.arccos(np.clip(axis @ axis.T, -1, 1)))
    image, x_px, point = [np.zeros(0, int)], [np.zeros((0, 2))], [np.zeros(0, int)]
    points, total = [np.zeros((0, 3))], 0
    for n, start in enumerate(gray):
        smooth = (_smooth_surface(depth[n]) & _textured_both_ways(start)).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(
            start, KEYPOINTS // len(gray), 0.005, camera.width / 80, mask=smooth
        )
        if corners is None:
            continue
        corners = corners[:, 0]
        x_in_recon = apply(poses[n], depth[n][..., None] * rays(camera))
        of_view, matched = [], np.zeros(len(corners), bool)
        for m, pose in enumerate(poses):
            if m != n and apart_deg[n, m] <= WIDEST_DEG:
                x_in_end = apply(inverse(pose), x_in_recon)
                z = np.where((depth[n] > 0) & (x_in_end[..., 2] > 1e-9), x_in_end[..., 2], np.nan)
                good, there = _locate_corners(start, gray[m], corners, x_in_end, z, camera, depth[m])
                of_view.append((m, good, there))
                matched |= good
        row = np.cumsum(matched) - 1 + total
        own_px = corners[matched].astype(np.float64)
        column, line = np.rint(own_px).astype(int).T
        points.append(apply(poses[n], depth[n, line, column, None] * unproject(camera, own_px)))
        for m, which, there in [(n, matched, corners), *of_view]:
            image.append(np.full(which.sum(), m))
            x_px.append(there[which])
            point.append(row[which])
        total += int(matched.sum())
    return Tracks(
        image=np.concatenate(image),
        x_px=np.concatenate(x_px).astype(np.float64),
        point=np.concatenate(point),
        points_in_recon=np.concatenate(points),
    )


def _smooth_surface(depth: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels with known depth and no depth step around them, which outlines have."""
    window = np.ones((2 * STEP_RADIUS + 1,) * 2, np.uint8)
    nearest, farthest = cv2.erode(depth, window), cv2.dilate(depth, window)
    return (nearest > 0) & (farthest < (1 + LARGEST_STEP) * nearest)


def _textured_both_ways(gray: UInt8[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the mask of pixels whose window determines the flow in all directions, unlike a straight edge.

    The variance of the flow is the noise's over the smaller eigenvalue of the gradients' summed products (the
    structure tensor), whose share of noise is taken off.
    """
    image = gray.astype(np.float32)
    # A Laplacian of white noise has 6 times its deviation (Immerkær, 1996).
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    noise = max(float(np.median(np.abs(cv2.filter2D(image, -1, kernel)))) / 0.6745 / 6, 0.5)
    # OpenCV divides Sobel's gradients by 4 and by the side of the window, where their weights add up to 8.
    least = cv2.cornerMinEigenVal(image, WINDOW[0], ksize=3) * (WINDOW[0] / 2) ** 2
    # Sobel's weights of white noise: 12 of the 64 parts.
    least -= noise**2 * 12 / 64 * WINDOW[0] * WINDOW[1]
    return least > 2 * (noise / LARGEST_STD_PX) ** 2


def _locate_corners(
    start: UInt8[ndarray, "h w"],
    end: UInt8[ndarray, "h w"],
    corners: Float[ndarray, "k 2"],
    x_in_end: Float[ndarray, "h w 3"],
    z: Float[ndarray, "h w"],
    camera: Intrinsics,
    end_depth: Float[ndarray, "h w"],
) -> tuple[Bool[ndarray, " k"], Float[ndarray, "k 2"]]:
    """Locate corners of `start` in `end`; return the mask of those found and all positions.

    `x_in_end` are the points of the pixels of `start` in the camera frame of `end`, and `z` their depth, NaN if unknown.
    """
    with np.errstate(invalid="ignore"):
        u, v = camera.fx * x_in_end[..., 0] / z + camera.cx, camera.fy * x_in_end[..., 1] / z + camera.cy
    inside = (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
    if inside.mean() < 0.02:
        return np.zeros(len(corners), bool), corners
    # Far outside, where nothing is, instead of NaN, which remap does not know.
    u, v = (np.where(np.isfinite(of), of, -1e4).astype(np.float32) for of in (u, v))
    drawn = cv2.remap(end, u, v, cv2.INTER_LINEAR)
    moved, found = _flow(start, drawn, corners)
    back, returned = _flow(drawn, start, moved)
    good = (found[:, 0] > 0) & (returned[:, 0] > 0)
    good &= np.linalg.norm(back - corners, axis=1) < LARGEST_RETURN_PX
    there = np.stack([_sampled(u, moved), _sampled(v, moved)], axis=-1)
    good &= (there >= 1).all(1) & (there <= [camera.width - 2, camera.height - 2]).all(1)
    good &= _sampled(inside, moved) > 0.99
    own = _sampled(end_depth, np.clip(there, 0, [camera.width - 1, camera.height - 1]))
    with np.errstate(divide="ignore", invalid="ignore"):
        good &= (own <= 0) | (np.abs(np.log(_sampled(np.nan_to_num(z), moved) / own)) < LARGEST_GAP)
    patches = []
    for image, at in ((start, corners), (drawn, moved)):
        y, x = np.mgrid[-PATCH_RADIUS : PATCH_RADIUS + 1, -PATCH_RADIUS : PATCH_RADIUS + 1].reshape(2, -1)
        patch = _sampled(image, at[:, None] + np.stack([x, y], -1))
        patch -= patch.mean(1, keepdims=True)
        patches.append(patch / np.maximum(np.linalg.norm(patch, axis=1, keepdims=True), 1e-5))
    return good & ((patches[0] * patches[1]).sum(1) > LEAST_CORRELATION), there


def _flow(
    one: UInt8[ndarray, "h w"], other: UInt8[ndarray, "h w"], at: Float[ndarray, "k 2"]
) -> tuple[Float[ndarray, "k 2"], UInt8[ndarray, "k 1"]]:
    """Track points of one image in another that looks nearly like it; return positions and status."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        one, other, at, at.copy(), winSize=WINDOW, maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    return moved, found


def _sampled(values: ndarray, x_px: Float[ndarray, "*k 2"]) -> Float[ndarray, "*k"]:
    """Sample an image between pixels, linearly."""
    x = x_px.astype(np.float32).reshape(len(x_px), -1, 2)
    out = cv2.remap(values.astype(np.float32), x[..., 0], x[..., 1], cv2.INTER_LINEAR)
    return out.reshape(x_px.shape[:-1])


def _adjust(
    tracks: Tracks, camera: Intrinsics, poses: Float[ndarray, "n 4 4"], fixed: bool
) -> tuple[Tracks, float, Float[ndarray, "n 4 4"], Intrinsics]:
    """Adjust cameras and points, and the focal length unless it is fixed.

    Returns the tracks, their median reprojection error (px), the camera poses and the camera. Matches far from their
    points are left out of the tracks, and points that then have fewer than two views; no track is left where most points
    lie behind their cameras.
    """
    prior = camera_with_prior(camera, FIXED if fixed else {"f": ESTIMATED["f"]})
    observations = Observations.of_one_camera(tracks, len(poses))
    shown = adjust_images(*image_problem(poses, prior, observations, tracks.points_in_recon))
    seen, points = shown.problem.observations, shown.state.points_in_world
    assert seen is not None
    error = np.linalg.norm(shown.view.residual_px, axis=1)
    error[shown.view.depth <= 0] = np.inf
    good = error < LARGEST_PX * max(float(np.median(error)), 0.1)
    good &= (np.bincount(seen.point[good], minlength=len(points)) >= 2)[seen.point]
    kept, point = np.unique(seen.point[good], return_inverse=True)
    inliers = Tracks(image=seen.image[good], x_px=seen.x_px[good], point=point, points_in_recon=points[kept])
    error_px = float(np.median(error[good])) if good.any() else np.inf
    return inliers, error_px, shown.state.world_from_rig, shown.view.cameras[0]


def _depth_changes(
    tracks: Tracks, recon_from_camera: Float[ndarray, "n 4 4"], depth: Float[ndarray, "n h w"]
) -> Float[ndarray, "n 6"]:
    """Fit per view a quadratic in the image's coordinates to the logarithm of the factor that corrects its depth.

    `depth` is on the grid of the pixels of `tracks`, 0 where no depth is known. The fit is robust, with a prior on all
    coefficients but the constant: five points in a corner do not bend the rest.
    """
    camera_from_recon = inverse(recon_from_camera)[tracks.image]
    z = np.einsum("kj,kj->k", camera_from_recon[:, 2, :3], tracks.points_in_recon[tracks.point])
    z += camera_from_recon[:, 2, 3]
    size = depth.shape[2], depth.shape[1]
    pixel = np.clip(np.rint(tracks.x_px), 0, np.array(size) - 1)
    column, row = pixel.astype(int).T
    own = depth[tracks.image, row, column]
    found = np.zeros((len(depth), 6))
    for view, coefficients in enumerate(found):
        mine = (tracks.image == view) & (own > 0) & (z > 0)
        if not mine.any():
            continue
        design, target = _basis(pixel[mine], size), np.log(z[mine] / own[mine])
        coefficients[0] = np.median(target)
        for _ in range(10):
            off = target - design @ coefficients
            sigma = 1.4826 * np.median(np.abs(off)) + 1e-4
            weight = 1 / (1 + (off / (2 * sigma)) ** 2) / sigma**2
            normal = design.T @ (weight[:, None] * design) + 1e-9 * np.eye(6)
            normal[1:, 1:] += np.eye(5) / BEND_STD**2
            coefficients[:] = np.linalg.solve(normal, design.T @ (weight * target))
    return found
