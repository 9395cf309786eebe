"""Predicted cameras and depth refined by what the images show: colour matches, then bundle adjustment without the robot.

Predictions are rough at the pixel. Matches by colour (colour_matches.py) are not, and go where COLMAP's go: first into
an adjustment of cameras and points alone, here, which also corrects each view's depth by a smooth factor; then as tracks
into the calibration's. Matching and adjusting are repeated, for better cameras predict better where to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from jcr.camera import by_parameters, by_point, project, unproject, zoomed
from jcr.geometry import inverse, skew
from jcr.reconstruct.preprocess import ImageGrid, PreparedImages
from jcr.reconstruct.sfm import log_level
from jcr.reconstruct.views_at_once.colour_matches import Geometry, Matches, colour_matches
from jcr.reconstruct.views_at_once.interface import Predicted
from jcr.records import CameraEvidence, Intrinsics, Tracks

LONG_EDGE = 960
"""Of the images that are compared; larger ones are made smaller."""
ROUNDS = 3
KEYPOINTS = 4000
"""Of all images together."""
LEAST_MATCHES = 25
"""Of an image, in bundle adjustment: with fewer it is left where it was predicted, and nothing is refined."""
LOSS_PX = (3.0, 1.0, 0.5)
"""Scale of the Cauchy loss in each round."""
LARGEST_PX = 4.0
"""Reprojection error beyond which a match is none, in units of the median."""
REGION = 0.1
"""Of the distance to the scene: matches within it share their errors."""
BEND_STD = 0.03
"""Prior of the logarithm of a depth correction's uneven part, which is zero where no match says otherwise."""


@dataclass(frozen=True)
class Refined:
    """What became of a prediction."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    """The first camera is where it was."""
    depth_factor: Float[ndarray, "n h w"]
    """By which to multiply the predicted points, on the model's grid."""
    tracks: Tracks
    """In the capture's own images."""
    pinhole: Intrinsics
    """Of the undistorted images, as given, or with the focal length that the images show."""
    evidence: CameraEvidence
    error_px: float
    """Median reprojection error, in pixels of the camera's images."""


def refine(predicted: Predicted, images: PreparedImages, pinhole: Intrinsics) -> Refined | None:
    """Cameras, depth and tracks; None where too few matches are found.

    `images` are those of the capture without distortion, in full size; `pinhole` is theirs, held where `images` knows
    it, else a first value of the focal length.
    """
    poses = predicted.recon_from_camera
    assert poses is not None
    work = _working_grid(images.grid.size)
    gray = np.stack([cv2.cvtColor(_shrunk(image, work), cv2.COLOR_RGB2GRAY) for image in images.colors])
    camera = work.grid_intrinsics(pinhole)
    depth = _depth_on(work, predicted)
    factor = np.ones(predicted.confidence.shape, np.float32)
    adjusted = None
    for loss in LOSS_PX:
        matches = colour_matches(gray, Geometry(camera, poses, depth), KEYPOINTS // len(gray))
        found = _observations(matches, len(gray))
        if np.bincount(found.image, minlength=len(gray)).min() < LEAST_MATCHES:
            return None
        start = _started(found, matches, Geometry(camera, poses, depth))
        adjusted = _adjusted(start, poses, camera, loss, hold=images.pinhole is not None)
        if adjusted is None:
            return None
        poses, camera = adjusted.recon_from_camera, adjusted.pinhole
        change = depth_changes(adjusted.tracks, poses, depth)
        depth = depth * np.stack([smooth_factor(c, work.size[1], work.size[0]) for c in change])
        factor = factor * np.stack([smooth_factor(c, *predicted.grid.size[::-1]) for c in change])
    assert adjusted is not None
    tracks, work_px = adjusted.tracks, adjusted.tracks.x_px
    evidence = CameraEvidence(poses, _covariance(adjusted, images.pinhole is None))
    return Refined(
        poses,
        factor,
        replace(tracks, x_px=_capture_px(images, work.original_from_grid(work_px))),
        pinhole if images.pinhole is not None else work.original_intrinsics(camera),
        evidence,
        float(np.median(np.linalg.norm(_residuals(adjusted), axis=1)) / work.scale.mean()),
    )


@dataclass(frozen=True)
class _Adjusted:
    """Cameras, and observations of points, on the working grid."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    pinhole: Intrinsics
    tracks: Tracks


def _working_grid(size: tuple[int, int]) -> ImageGrid:
    scale = min(1.0, LONG_EDGE / max(size))
    shown = round(size[0] * scale), round(size[1] * scale)
    return ImageGrid(size, shown, (0, 0), shown)


def _shrunk(image: UInt8[ndarray, "h w 3"], grid: ImageGrid) -> UInt8[ndarray, "h2 w2 3"]:
    return (
        image
        if grid.size == grid.original_size
        else cv2.resize(image, grid.size, interpolation=cv2.INTER_AREA)
    )


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


def _observations(matches: Matches, count: int) -> Tracks:
    """Matches as tracks: a keypoint and where others show it; points are not known yet."""
    used, row = np.unique(matches.point, return_inverse=True)
    return Tracks(
        image=np.concatenate([matches.start[used, 0].astype(int), matches.view]),
        x_px=np.concatenate([matches.start[used, 1:], matches.x_px]).astype(np.float64),
        point=np.concatenate([np.arange(len(used)), row]),
        points_in_recon=np.zeros((len(used), 3)),
    )


def _started(tracks: Tracks, matches: Matches, geometry: Geometry) -> Tracks:
    """With points where the depth of their first view puts them."""
    first = len(tracks.points_in_recon)
    image, x_px = tracks.image[:first], tracks.x_px[:first]
    column, row = np.rint(x_px).astype(int).T
    z = geometry.depth[image, row, column]
    x_in_camera = z[:, None] * unproject(geometry.pinhole, x_px)
    points = np.einsum("kij,kj->ki", geometry.recon_from_camera[image, :3, :3], x_in_camera)
    points += geometry.recon_from_camera[image, :3, 3]
    kept = z > 0
    renumbered = np.cumsum(kept) - 1
    there = kept[tracks.point]
    return Tracks(tracks.image[there], tracks.x_px[there], renumbered[tracks.point[there]], points[kept])


def _adjusted(
    tracks: Tracks,
    recon_from_camera: Float[ndarray, "n 4 4"],
    pinhole: Intrinsics,
    loss_px: float,
    hold: bool,
) -> _Adjusted | None:
    """Bundle adjustment of cameras and points, and of the focal length unless it is held; wrong matches leave.

    The unit stays that of the prediction: its depths keep their median. None where it does not converge.
    """
    model = pycolmap.Reconstruction()
    centre = [pinhole.cx + 0.5, pinhole.cy + 0.5]
    name, params = ("PINHOLE", [pinhole.fx, pinhole.fy]) if hold else ("SIMPLE_PINHOLE", [pinhole.fx])
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model=name, width=pinhole.width, height=pinhole.height, params=[*params, *centre], camera_id=1
        )
    )
    count = len(recon_from_camera)
    element = np.zeros(len(tracks.image), int)
    for k in range(count):
        mine = np.flatnonzero(tracks.image == k)
        element[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=str(k),
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in tracks.x_px[mine] + 0.5]),
            camera_id=1,
            image_id=k + 1,
        )
        pose = pycolmap.Rigid3d(inverse(recon_from_camera[k])[:3])
        model.add_image_with_trivial_frame(image, pose)
    order = np.argsort(tracks.point, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(tracks.point[order])) + 1)
    ids = [
        model.add_point3D(
            tracks.points_in_recon[tracks.point[group[0]]],
            pycolmap.Track([pycolmap.TrackElement(int(tracks.image[o]) + 1, int(element[o])) for o in group]),
        )
        for group in groups
    ]
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params = not hold, False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    with log_level(False):
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    moved = np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        moved[k, :3] = model.image(k + 1).cam_from_world().matrix()
    moved = inverse(moved)
    points = np.array([model.point3D(point_id).xyz for point_id in ids])
    if not np.isfinite(moved).all() or not np.isfinite(points).all():
        return None
    fitted = pinhole if hold else zoomed(pinhole, float(model.camera(1).params[0]) / pinhole.fx)
    before = _depths(tracks, recon_from_camera, tracks.points_in_recon)
    after = _depths(tracks, moved, points)
    both = (before > 0) & (after > 0)
    if both.sum() < 0.5 * len(both):
        return None
    unit = float(np.exp(np.median(np.log(before[both] / after[both]))))
    origin = moved[0, :3, 3].copy()
    moved[:, :3, 3] = origin + unit * (moved[:, :3, 3] - origin)
    points = origin + unit * (points - origin)
    made = _Adjusted(moved, fitted, replace(tracks, points_in_recon=points))
    return _without_outliers(made, after > 0)


def _depths(
    tracks: Tracks, recon_from_camera: Float[ndarray, "n 4 4"], points: Float[ndarray, "p 3"]
) -> Float[ndarray, " k"]:
    """Depth of every observation's point in its camera."""
    camera_from_recon = inverse(recon_from_camera)[tracks.image]
    return (
        np.einsum("kj,kj->k", camera_from_recon[:, 2, :3], points[tracks.point]) + camera_from_recon[:, 2, 3]
    )


def _residuals(adjusted: _Adjusted) -> Float[ndarray, "k 2"]:
    tracks = adjusted.tracks
    camera_from_recon = inverse(adjusted.recon_from_camera)[tracks.image]
    x = np.einsum("kij,kj->ki", camera_from_recon[:, :3, :3], tracks.points_in_recon[tracks.point])
    return project(adjusted.pinhole, x + camera_from_recon[:, :3, 3]) - tracks.x_px


def _without_outliers(adjusted: _Adjusted, in_front: Bool[ndarray, " k"]) -> _Adjusted:
    """Without matches far from their points, and without points that fewer than two views are left to see."""
    tracks = adjusted.tracks
    error = np.where(in_front, np.linalg.norm(_residuals(adjusted), axis=1), np.inf)
    good = error < LARGEST_PX * max(float(np.median(error)), 0.1)
    seen = np.bincount(tracks.point[good], minlength=len(tracks.points_in_recon)) >= 2
    good &= seen[tracks.point]
    renumbered = np.cumsum(seen) - 1
    kept = Tracks(
        tracks.image[good], tracks.x_px[good], renumbered[tracks.point[good]], tracks.points_in_recon[seen]
    )
    return replace(adjusted, tracks=kept)


def depth_changes(
    tracks: Tracks, recon_from_camera: Float[ndarray, "n 4 4"], depth: Float[ndarray, "n h w"]
) -> Sequence[Float[ndarray, "6"]]:
    """Per view a quadratic in the image's coordinates, for the logarithm by which its depth is too small.

    `depth` is on the grid in whose pixels `tracks` counts, 0 where nothing is known. Robust least squares on the tracks'
    points, with a prior on all but its constant: five points in a corner do not bend the rest.
    """
    z = _depths(tracks, recon_from_camera, tracks.points_in_recon)
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


def _capture_px(images: PreparedImages, x_px: Float[ndarray, "k 2"]) -> Float[ndarray, "k 2"]:
    """Pixels of the undistorted images in the capture's own."""
    return images.original_px(images.grid.grid_from_original(x_px))


def _covariance(adjusted: _Adjusted, focal_free: bool) -> Float[ndarray, "r r"]:
    """Of the cameras' steps, the points eliminated, the first camera and the scale held.

    The inverse of the reduced camera system (Triggs et al., "Bundle adjustment — a modern synthesis", 2000, section
    6); a focal length that was adjusted is eliminated, too. Matches of one region err together, in all views: how far
    the regions' gradients scatter about zero is measured, and the inverse scaled to it on average, as direct alignment
    does it.
    """
    tracks, count = adjusted.tracks, len(adjusted.recon_from_camera)
    rotation, center = adjusted.recon_from_camera[:, :3, :3], adjusted.recon_from_camera[:, :3, 3]
    arm = tracks.points_in_recon[tracks.point] - center[tracks.image]
    back = np.swapaxes(rotation, 1, 2)[tracks.image]
    x = np.einsum("kij,kj->ki", back, arm)
    by_x = by_point(adjusted.pinhole, x) @ back
    by_step = np.concatenate([-by_x, by_x @ skew(arm)], axis=2)
    residual = _residuals(adjusted)
    spread = 1.4826 * float(np.median(np.abs(residual)))
    weight = 1 / (1 + (np.linalg.norm(residual, axis=1) / (3 * spread)) ** 2)
    size, points = 6 * count + focal_free, len(tracks.points_in_recon)
    jacobian = np.zeros((len(weight), 2, size))
    for axis in range(6):
        jacobian[np.arange(len(weight)), :, 6 * tracks.image + axis] = by_step[:, :, axis]
    if focal_free:
        jacobian[:, :, -1] = by_parameters(adjusted.pinhole, x)[..., :2].sum(-1)
    block, cross = np.zeros((points, 3, 3)), np.zeros((points, size, 3))
    np.add.at(block, tracks.point, np.einsum("k,kij,kil->kjl", weight, by_x, by_x))
    for k in range(count):
        mine = tracks.image == k
        np.add.at(
            cross, tracks.point[mine], np.einsum("k,kij,kil->kjl", weight[mine], jacobian[mine], by_x[mine])
        )
    block += 1e-9 * np.trace(block, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    away = cross @ np.linalg.inv(block)
    # A larger scene seen from farther away looks the same: that step, and all of the first camera's, is held.
    growth = np.zeros(size)
    growth[: 6 * count].reshape(count, 6)[:, :3] = center - center[0]
    free = np.eye(size)[:, 6:]
    basis = free @ np.linalg.svd((free.T @ growth)[None])[2][1:].T
    heavy = np.sqrt(weight)[:, None, None] * jacobian
    flat = heavy.reshape(-1, size)
    system = flat.T @ flat - np.einsum("pij,plj->il", away, cross)
    inverse_system = np.linalg.inv(basis.T @ system @ basis)
    by_camera = np.einsum("k,kij,ki->kj", weight, jacobian, residual)
    by_match = np.einsum("k,kij,ki->kj", weight, by_x, residual)
    gradient = np.zeros((points, size))
    np.add.at(gradient, tracks.point, by_camera)
    by_point_sum = np.zeros((points, 3))
    np.add.at(by_point_sum, tracks.point, by_match)
    gradient -= np.einsum("pij,pj->pi", away, by_point_sum)
    cell = np.floor(tracks.points_in_recon / (REGION * float(np.median(np.linalg.norm(arm, axis=1)))))
    region = np.unique(cell.astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    score = np.zeros((region.max() + 1, basis.shape[1]))
    np.add.at(score, region, gradient @ basis)
    variance = np.einsum("bp,pq,bq->", score, inverse_system, score) / basis.shape[1]
    steps = basis[: 6 * count]
    return variance * steps @ inverse_system @ steps.T
