"""The map of many images from where the robot puts their cameras: all triangulated at once, not one after the other.

X from confirmed pairs of images (features/epipolar.py) and the gripper poses put every camera to some millimetres and
tenths of a degree. Points are triangulated from there, everything is adjusted, and the points are triangulated once
more; COLMAP adjusts the whole map again and again while it grows, which takes more than in proportion to the images.
Of 50 images the same points came from an X that was 12 mm and 1° off.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.closed_form import motions
from jcr.features.epipolar import translation_of_x
from jcr.features.gate import Gate
from jcr.features.verify import Geometries
from jcr.sfm.placed import retriangulated

LEAST_POINTS = 30
"""Fewest points of an image that is where the robot puts it."""
LEAST_SHARE = 0.5
"""Least share of the keypoints that match in other images, that must end in points."""


def primed(
    database: Path,
    camera: pycolmap.Camera,
    found: Gate,
    geometries: Geometries,
    base_from_gripper: Float[ndarray, "n 4 4"],
    adjust: Callable[[pycolmap.Reconstruction], None],
) -> pycolmap.Reconstruction | None:
    """A model of the images that are where the robot puts them, to be adjusted; None where they are elsewhere.

    `geometries` are those in the database; the camera's intrinsics are known. `adjust` adjusts a model.
    """
    x = translation_of_x(found, motions(base_from_gripper))
    if x is None:
        return None
    model = retriangulated(
        database, camera, dict(enumerate(base_from_gripper @ x.gripper_from_camera)), adjust
    )
    if model.compute_num_observations() < LEAST_SHARE * _matching_keypoints(geometries):
        return None
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        if image.num_points3D < LEAST_POINTS:
            model.deregister_frame(image.frame_id)
    return model


def _matching_keypoints(geometries: Geometries) -> int:
    """How many keypoints match in some other image, of all images together."""
    matching: dict[int, set[int]] = {}
    for key, geometry in geometries.items():
        rows = np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
        for image, of_image in zip(key, rows.T, strict=True):
            matching.setdefault(image, set()).update(of_image.tolist())
    return sum(map(len, matching.values()))
