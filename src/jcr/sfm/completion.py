"""Completion of tracks: points of a map are searched in an image near the pixels to which its camera projects them.

Matching of whole images loses features that resemble others of the image. Near a projection few compete with them.
"""

from collections.abc import Callable, Set

import numpy as np
import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import KDTree

from jcr.camera import HALF_PIXEL
from jcr.features.matchers import Matcher

RADII_PX = (8.0, 4.0)
"""Largest distances from a projection in turn; the camera is adjusted after each."""
RATIO = 0.85
"""Largest ratio of a descriptor's distances to the best and second best keypoint near the projection."""
LARGEST_PX = 4.0
"""Reprojection error above which an observation is a mismatch, as COLMAP's."""


def complete_images(
    model: pycolmap.Reconstruction,
    rows: Set[int],
    matcher: Matcher,
    adjust: Callable[[pycolmap.Reconstruction], None],
) -> None:
    """Add observations of the model's points to images of these rows, and adjust the model with them."""
    images = {row + 1 for row in rows}
    for radius_px in RADII_PX:
        for image_id in sorted(images):
            _complete(model, image_id, matcher, radius_px)
        _filter(model, images)
        adjust(model)
        _filter(model, images)


def _filter(model: pycolmap.Reconstruction, images: set[int]) -> None:
    """Delete observations of the images' points with large reprojection errors."""
    pycolmap.ObservationManager(model).filter_points3D_in_images(LARGEST_PX, 0.0, images)


def _complete(model: pycolmap.Reconstruction, image_id: int, matcher: Matcher, radius_px: float) -> None:
    """Add the keypoints of one image that match points projected near them."""
    image, x_px = model.image(image_id), matcher.x_px[image_id - 1]
    observed = {keypoint.point3D_id for keypoint in image.points2D if keypoint.has_point3D()}
    free = np.array([k for k, keypoint in enumerate(image.points2D) if not keypoint.has_point3D()], int)
    point_ids = np.array(sorted(set(model.point3D_ids()) - observed), int)
    if not len(free) or not len(point_ids):
        return
    xyz = np.array([model.point3D(int(one)).xyz for one in point_ids])
    pose = image.cam_from_world()
    x_in_camera = xyz @ pose.rotation.matrix().T + pose.translation
    ahead = x_in_camera[:, 2] > 0
    point_ids = point_ids[ahead]
    near = KDTree(x_px[free] + HALF_PIXEL).query_ball_point(
        np.asarray(model.camera(image.camera_id).img_from_cam(x_in_camera[ahead])).reshape(-1, 2), radius_px
    )
    point = np.repeat(np.arange(len(near)), [len(some) for some in near])
    if not len(point):
        return
    keypoint = free[np.concatenate([np.array(some, int) for some in near])]
    wanted = _mean_descriptors(model, point_ids, matcher)
    cosine = (wanted[point] * matcher.descriptors[image_id - 1][keypoint]).sum(1)
    for k in _mutual_best(point, keypoint, np.sqrt(np.maximum(2 - 2 * cosine, 0)), matcher.farthest):
        element = pycolmap.TrackElement(image_id, int(keypoint[k]))
        model.add_observation(int(point_ids[point[k]]), element)


def _mean_descriptors(
    model: pycolmap.Reconstruction, point_ids: Int[ndarray, " p"], matcher: Matcher
) -> Float[ndarray, "p d"]:
    """Return the mean descriptor of each point's observations, of unit length."""
    mean = np.zeros((len(point_ids), matcher.descriptors[0].shape[1]))
    for row, point_id in enumerate(point_ids):
        for element in model.point3D(int(point_id)).track.elements:
            mean[row] += matcher.descriptors[element.image_id - 1][element.point2D_idx]
    return mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)


def _mutual_best(
    point: Int[ndarray, " c"], keypoint: Int[ndarray, " c"], distance: Float[ndarray, " c"], farthest: float
) -> Int[ndarray, " m"]:
    """Return the candidates that are the best of their point and of their keypoint, and pass the ratio test."""
    order = np.argsort(distance, kind="stable")
    best_of_point, best_of_keypoint = (
        order[np.unique(of[order], return_index=True)[1]] for of in (point, keypoint)
    )
    others = order[~np.isin(order, best_of_point)]
    second = np.full(point.max() + 1, np.inf)
    listed, first = np.unique(point[others], return_index=True)
    second[listed] = distance[others[first]]
    best = np.intersect1d(best_of_point, best_of_keypoint)
    return best[(distance[best] < farthest) & (distance[best] < RATIO * second[point[best]])]
