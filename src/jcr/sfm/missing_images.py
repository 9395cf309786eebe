"""Models near predicted cameras: images that the mapper left out, and cameras predicted by a network.

Points are triangulated and adjusted alternately. Cameras of images that the mapper left out are predicted from the
gripper poses and the hand-eye transform X of the model itself; keypoints near projected points are matched.
"""

from collections import Counter
from collections.abc import Container, Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from jcr.camera import HALF_PIXEL
from jcr.estimation.outlier_rejection import least_trimmed, robust_fit
from jcr.features.matchers import Matcher
from jcr.geometry import Transform, inverse
from jcr.sfm.model import adjust_robustly, poses_of, rows_of, triangulated_model

PASSES = ((32.0, 1, 4.0), (8.0, 1, 1.0), (4.0, 5, 0.5))
"""Settings of the passes of triangulation and adjustment: largest reprojection error of a point (px), number of
refinements of the triangulation, and scale (px) of the adjustment's Cauchy loss."""
ROUGHLY = 1e-3
"""Relative change of the cost that ends these adjustments."""
LEAST_SHARED = 15
"""Least number of points of an image that images of the map see, too; an image with fewer is removed."""
LEAST_MAPPED = 4
"""Least number of mapped cameras from which the others are predicted."""
RADII_PX = (8.0, 4.0)
"""Largest distance, px, of a keypoint from the projection of its point in each pass, before an adjustment."""
LOCAL_RATIO = 0.85
"""Largest ratio of the descriptor distances to the best and the second-best keypoint near the projection."""
MISMATCH_PX = 4.0
"""Reprojection error, px, above which an observation is a mismatch, as in COLMAP."""

COMPARED_FROM = 5e-3
"""rms error (m) of the better part of the gripper poses from which a map is compared with one near their cameras."""
BETTER_RATIO = 3.0
"""Ratio of the errors of both maps from which the one near the predicted cameras is used."""


def nearer_to_robot(
    database: Path,
    model: pycolmap.Reconstruction,
    base_from_gripper: Float[ndarray, "n 4 4"],
    x: Transform,
    matcher: Matcher,
) -> pycolmap.Reconstruction:
    """Return a map near the cameras that the gripper poses predict, if it agrees with them much better than `model`.

    Otherwise `model` is returned. It is kept, too, if it has fewer than LEAST_MAPPED images, or if its rms distance from
    the gripper poses, over the images that fit best, is below COMPARED_FROM (m). Much better means an rms distance
    smaller by the factor BETTER_RATIO. The mapper goes astray if its first two images show one plane (two
    solutions), or if objects moved while the images were taken. `x` is a rough estimate of gripper_from_camera; matches
    that contradict the predicted cameras are left out.
    """
    rows = rows_of(model)
    if len(rows) < LEAST_MAPPED:
        return model
    error = least_trimmed(base_from_gripper[rows], poses_of(model, rows))[1]
    if error < COMPARED_FROM:
        return model
    predicted = dict(enumerate(base_from_gripper @ x))
    nearer = model_near_cameras(database, model.camera(1), predicted, matcher.known)
    if (now := rows_of(nearer)) and len(now) >= len(rows):
        _complete_images(nearer, {row + 1 for row in now}, matcher)
        after = least_trimmed(base_from_gripper[now], poses_of(nearer, now))[1]
        return nearer if BETTER_RATIO * after < error else model
    return model


def with_missing_images(
    database: Path,
    model: pycolmap.Reconstruction,
    base_from_gripper: Float[ndarray, "n 4 4"],
    matcher: Matcher,
) -> pycolmap.Reconstruction:
    """Return the model with those missing images whose predicted camera poses are confirmed by LEAST_SHARED points.

    The poses are predicted from the gripper poses by the hand-eye transform of the images in the model.
    `base_from_gripper` has a row per image of the matcher. `model` itself is returned if it has fewer than LEAST_MAPPED
    images, or if no image can be added.
    """
    rows = rows_of(model)
    poses = poses_of(model, rows)
    if len(rows) < LEAST_MAPPED:
        return model
    fit = robust_fit(base_from_gripper[rows], poses)
    agree, state = fit.problem.used, fit.state
    assert agree is not None
    if state.scale <= 0 or agree.sum() < LEAST_MAPPED - 1:
        return model
    predicted = inverse(state.z[0]) @ base_from_gripper @ state.x[0]
    predicted[:, :3, 3] /= state.scale
    cameras = dict(enumerate(predicted)) | dict(zip(rows, poses, strict=True))
    larger = model_near_cameras(database, model.camera(1), cameras, matcher.known, rows)
    if larger.num_reg_images() <= len(rows):
        return model
    _complete_images(larger, {row + 1 for row in rows_of(larger) if row not in rows}, matcher)
    return larger


def _complete_images(model: pycolmap.Reconstruction, images: set[int], matcher: Matcher) -> None:
    """Match the images with COLMAP ids `images` with points near their cameras; adjust all cameras and points.

    `model` is changed. Observations with a reprojection error above MISMATCH_PX are removed.
    """
    filters = pycolmap.ObservationManager(model)
    for radius_px in RADII_PX:
        for image_id in sorted(images):
            _complete(model, image_id, matcher, radius_px)
        filters.filter_points3D_in_images(MISMATCH_PX, 0.0, images)
        adjust_robustly(model, matcher.known, ROUGHLY, PASSES[-1][2])
        filters.filter_points3D_in_images(MISMATCH_PX, 0.0, images)


def model_near_cameras(
    database: Path,
    camera: pycolmap.Camera,
    recon_from_camera: Mapping[int, Float[ndarray, "4 4"]],
    known: bool,
    mapped: Container[int] | None = None,
) -> pycolmap.Reconstruction:
    """Return COLMAP's model, adjusted to all verified matches of the database from predicted camera poses.

    `recon_from_camera` has the predicted poses by image row. The intrinsics of `camera` are held if `known`. Images
    with fewer than LEAST_SHARED points are removed. Only points that an image of the rows `mapped` sees are counted, or
    all points if `mapped` is None.
    """
    model, cameras = pycolmap.Reconstruction(), dict(recon_from_camera)
    for largest_px, refinements, scale_px in PASSES:
        model = triangulated_model(database, camera, cameras, largest_px, refinements)
        tied = Counter[int]()
        for point in model.points3D.values():
            seen_by = {element.image_id - 1 for element in point.track.elements}
            if mapped is None or any(row in mapped for row in seen_by):
                tied.update(seen_by)
        for row in cameras:
            if tied[row] < LEAST_SHARED:
                model.deregister_frame(model.image(row + 1).frame_id)
        if not model.num_reg_images():
            break
        adjust_robustly(model, known, ROUGHLY, scale_px)
        camera, rows = model.camera(1), rows_of(model)
        cameras = dict(zip(rows, poses_of(model, rows), strict=True))
    return model


def _complete(model: pycolmap.Reconstruction, image_id: int, matcher: Matcher, radius_px: float) -> None:
    """Add observations to the image with COLMAP id `image_id`: unused keypoints near a projected point.

    A keypoint within `radius_px` (working size) is added if its descriptor is the nearest one to the point's mean
    descriptor. Its distance must be below the features' `farthest` and below LOCAL_RATIO times that of the second
    nearest.
    """
    image, x_px, descriptors = model.image(image_id), matcher.features.x_px, matcher.features.descriptors
    observed = {keypoint.point3D_id for keypoint in image.points2D if keypoint.has_point3D()}
    free = np.array([k for k, keypoint in enumerate(image.points2D) if not keypoint.has_point3D()], int)
    point_ids = np.array(sorted(set(model.point3D_ids()) - observed), int)
    if not len(free) or not len(point_ids):
        return
    pose = image.cam_from_world()
    xyz = np.array([model.point3D(int(one)).xyz for one in point_ids])
    x_in_camera = xyz @ pose.rotation.matrix().T + pose.translation
    point_ids, x_in_camera = (part[x_in_camera[:, 2] > 0] for part in (point_ids, x_in_camera))
    projected = np.asarray(model.camera(image.camera_id).img_from_cam(x_in_camera)).reshape(-1, 2)
    near = KDTree(x_px[image_id - 1][free] + HALF_PIXEL).query_ball_point(projected, radius_px)
    # The distances of each point's mean descriptor to the keypoints near its projection; a keypoint has one point.
    candidates = []
    for point_id, some in zip(point_ids.tolist(), near, strict=True):
        if not len(some):
            continue
        track = model.point3D(point_id).track.elements
        mean = sum(descriptors[element.image_id - 1][element.point2D_idx] for element in track)
        cosine = descriptors[image_id - 1][free[some]] @ (mean / max(float(np.linalg.norm(mean)), 1e-9))
        distance = np.sqrt(np.maximum(2 - 2 * cosine, 0))
        first, second = np.sort(np.append(distance, np.inf))[:2]
        candidates.append((first, second, int(free[some[int(distance.argmin())]]), point_id))
    taken = set()
    for first, second, keypoint, point_id in sorted(candidates):
        if keypoint not in taken:
            taken.add(keypoint)
            if first < matcher.features.farthest and first < LOCAL_RATIO * second:
                model.add_observation(point_id, pycolmap.TrackElement(image_id, keypoint))
