"""The images of a cell's further cameras in the base frame, beside those of the capture's own."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.cell.cameras_json import CameraPlaced, CamerasFile
from jcr.export.views import PosedImages
from jcr.geometry import inverse
from jcr.records import Capture, CellCamera, Tracks

NOTHING = Tracks(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0, int), np.zeros((0, 3)))


def posed_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    cameras: CamerasFile,
    views: PosedImages,
    rows: Int[ndarray, " m"],
    gripper_from_camera: Float[ndarray, "4 4"],
) -> list[PosedImages]:
    """Those of the used images of every camera that sees the scene; `views` are the own camera's, at `rows`."""
    bases = {arm.name: np.array(arm.base_from_other_base) for arm in cameras.arms}
    grippers = dict(zip(rows.tolist(), views.base_from_camera @ inverse(gripper_from_camera), strict=True))
    placed = {camera.name: camera for camera in cameras.cameras}
    out = []
    for camera in others:
        found = placed.get(camera.name)
        if (
            found is None
            or found.parent_from_camera is None
            or found.intrinsics is None
            or camera.watches_gripper
        ):
            continue
        used = [k for k, picture in enumerate(found.pictures) if picture.used]
        poses = np.stack([_pose(camera, found, k, grippers, bases) for k in used])
        out.append(
            PosedImages(
                camera.folder or capture.folder,
                tuple(camera.images[k] for k in used),
                poses,
                found.intrinsics.record(),
                NOTHING,
                np.zeros((0, 3)),
            )
        )
    return out


def _pose(
    camera: CellCamera,
    found: CameraPlaced,
    k: int,
    grippers: dict[int, Float[ndarray, "4 4"]],
    bases: dict[str, Float[ndarray, "4 4"]],
) -> Float[ndarray, "4 4"]:
    """base_from_camera of one image."""
    parent_from_camera = np.array(found.parent_from_camera)
    if camera.base_from_gripper is not None and camera.arm is not None:
        return bases[camera.arm] @ camera.base_from_gripper[k] @ parent_from_camera
    if camera.frame is not None:
        return grippers[int(camera.frame[k])] @ parent_from_camera
    return parent_from_camera
