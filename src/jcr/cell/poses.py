"""Poses of the images of a cell's further cameras in the base frame of the capture's own arm."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.cell.placement import CameraPlacement, CamerasFile
from jcr.records import CellCamera


def base_from_camera(
    camera: CellCamera,
    found: CameraPlacement,
    cameras: CamerasFile,
    base_from_gripper: Mapping[int, Float[ndarray, "4 4"]],
) -> dict[int, Float[ndarray, "4 4"]]:
    """Return base_from_camera of every used image, by its number, as far as its gripper's pose is known.

    `base_from_gripper` is that of the capture's own arm, by the row of the capture.
    """
    if found.parent_from_camera is None:
        return {}
    parent_from_camera = np.array(found.parent_from_camera)
    bases = {arm.name: np.array(arm.base_from_other_base) for arm in cameras.arms}
    out = {}
    for k, image in enumerate(found.images):
        if not image.used:
            continue
        if camera.mount == "base":
            out[k] = parent_from_camera
        elif camera.base_from_gripper is not None and camera.arm is not None:
            out[k] = bases[camera.arm] @ camera.base_from_gripper[k] @ parent_from_camera
        elif camera.frame is not None and int(camera.frame[k]) in base_from_gripper:
            out[k] = base_from_gripper[int(camera.frame[k])] @ parent_from_camera
    return out
