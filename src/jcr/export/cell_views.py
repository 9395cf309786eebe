"""The images of a cell's further cameras in the base frame, beside those of the capture's own."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.cell.cameras_json import CamerasFile
from jcr.cell.poses import base_from_camera
from jcr.export.views import PosedImages
from jcr.geometry import inverse
from jcr.records import Capture, CellCamera, Tracks

NOTHING = Tracks(
    image=np.zeros(0, int), x_px=np.zeros((0, 2)), point=np.zeros(0, int), points_in_recon=np.zeros((0, 3))
)


def posed_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    cameras: CamerasFile,
    views: PosedImages,
    rows: Int[ndarray, " m"],
    gripper_from_camera: Float[ndarray, "4 4"],
) -> list[PosedImages]:
    """Those of the used images of every camera that sees the scene; `views` are the own camera's, at `rows`."""
    grippers = dict(zip(rows.tolist(), views.base_from_camera @ inverse(gripper_from_camera), strict=True))
    placed = {camera.name: camera for camera in cameras.cameras}
    out = []
    for camera in others:
        found = placed.get(camera.name)
        if found is None or found.intrinsics is None or camera.watches_gripper:
            continue
        poses = base_from_camera(camera, found, cameras, grippers)
        if not poses:
            continue
        beside = None
        if camera.frame is not None:
            beside = tuple(int(np.flatnonzero(rows == camera.frame[k])[0]) for k in poses)
        out.append(
            PosedImages(
                folder=camera.folder or capture.folder,
                images=tuple(camera.images[k] for k in poses),
                base_from_camera=np.stack([*poses.values()]),
                intrinsics=found.intrinsics.record(),
                tracks=NOTHING,
                points_in_base=np.zeros((0, 3)),
                beside=beside,
            )
        )
    return out
