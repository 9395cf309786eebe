"""Checks of a further camera's pose: an image that contradicts it, large uncertainty, crowded points, distance."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.cell.camera_views import CameraViews
from jcr.cell.localise import spread
from jcr.cell.placement import ImageUse
from jcr.estimation.hand_eye import MAX_STD
from jcr.findings import Finding, FindingKind
from jcr.records import Intrinsics, Mount

CONTRADICTS = 5.0
"""Factor of the median reprojection error of all images of the cell from which an image contradicts a pose."""
LEAST_PX = 1.0
"""Smallest median reprojection error (px) that contradicts a pose, for images up to 1600 px wide."""
LEAST_SPREAD = 0.05
"""Smallest share of the image's area that the points should span; crowded points determine a pose badly."""
FAR_FROM_GRIPPER = 0.5
"""Distance (m) from the gripper's frame beyond which a camera is likely to be mounted elsewhere."""


def contradicting_image(images: Sequence[ImageUse], views: CameraViews, typical_px: float) -> Finding | None:
    """Return the finding of an image that contradicts the pose of all the camera's images.

    `typical_px` is the median reprojection error of all images of the cell.
    """
    worst = max(images, key=lambda image: image.reprojection_px or 0.0)
    px, camera = worst.reprojection_px or 0.0, views.camera
    if px <= max(CONTRADICTS * typical_px, LEAST_PX * max(1.0, camera.image_size[0] / 1600)):
        return None
    return Finding.of(FindingKind.IMAGE_MISSES, "rejects", "mount", worst.image, value=px, mount=camera.mount)


def place_uncertain(
    covariance: Float[ndarray, "6 6"], intrinsics: Intrinsics, focal_std_px: float, is_given: bool
) -> Finding | None:
    """Return the finding of a pose that is too uncertain; for unknown intrinsics with that of the focal length."""
    metres, radians = np.sqrt(np.diag(covariance)).reshape(2, 3).max(1).tolist()
    if metres <= MAX_STD[0] and radians <= MAX_STD[1]:
        return None
    details = {"rotation": radians} | ({} if is_given else {"focal_std": focal_std_px / intrinsics.fx})
    remedy = "images" if is_given else "intrinsics"
    return Finding.of(FindingKind.PLACE_UNCERTAIN, "rejects", remedy, value=metres, **details)


def crowded_points(views: CameraViews) -> Finding | None:
    """Return the finding of points that span little of every image."""
    widest = max(map(spread, views.registered.values()))
    if widest >= LEAST_SPREAD:
        return None
    return Finding.of(FindingKind.POINTS_CROWDED, "warns", "images", value=widest)


def far_from_gripper(parent_from_camera: Float[ndarray, "4 4"], mount: Mount) -> Finding | None:
    """Return the finding of a camera that is said to be on a gripper and is far from it."""
    away = float(np.linalg.norm(parent_from_camera[:3, 3]))
    if mount == "base" or away <= FAR_FROM_GRIPPER:
        return None
    return Finding.of(FindingKind.FAR_FROM_GRIPPER, "warns", "mount", value=away)
