"""A further camera with a capture of its own: its images, and the gripper's poses at which they were taken.

So is calibrated what sees nothing that the capture's own camera saw: a fixed camera that watches the gripper, and a
second camera on the gripper that looks elsewhere. One robot joins them; scene, scale and transform are each its own.
"""

from dataclasses import replace

import numpy as np

from jcr.calibration.calibration_json import image_verdicts
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.stage import calibrate
from jcr.cell.found import CameraFound, PictureFound
from jcr.errors import NotTrustedError
from jcr.geometry import apply, inverse
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions, reconstruct
from jcr.reconstruct.relocate import MIN_POINTS
from jcr.records import Capture, CellCamera, HandEye, Reconstruction

LEAST_POSES = 3
"""With fewer images nothing is reconstructed."""


def of_camera(capture: Capture, camera: CellCamera) -> Capture:
    """The capture of a further camera at poses of this gripper."""
    assert camera.frame is not None
    rows = camera.frame
    return replace(
        capture,
        folder=camera.folder or capture.folder,
        images=camera.images,
        base_from_gripper=capture.base_from_gripper[rows],
        image_size=camera.image_size,
        intrinsics=camera.intrinsics,
        intrinsics_std=camera.intrinsics_std,
        joints=None if capture.joints is None else capture.joints[rows],
        depths=None,
        cameras=None,
        camera_name=camera.name,
        mount=camera.mount,
        others=(),
    )


def sees_another_scene(camera: CellCamera, found: CameraFound) -> bool:
    """Whether a camera on the capture's own gripper shares nothing with its images, and has enough of its own."""
    on_gripper = camera.mount == "gripper" and camera.frame is not None
    few = all(picture.points < MIN_POINTS for picture in found.pictures)
    return on_gripper and few and len(camera.images) >= LEAST_POSES


def calibrated_elsewhere(
    capture: Capture,
    camera: CellCamera,
    shared: CameraFound,
    reconstruct_options: ReconstructOptions,
    options: CalibrateOptions,
    progress: Progress,
) -> CameraFound:
    """A second camera on the gripper whose views do not overlap the first one's; `shared` is what those said of it."""
    own = of_camera(capture, camera)
    try:
        reconstruction = reconstruct(own, replace(reconstruct_options, backend="auto"), progress)
        found = calibrate(own, reconstruction, options)
    except NotTrustedError as error:
        why = f"it shares nothing with the {capture.camera_name} camera's images, and by its own images: {error}"
        return replace(shared, warnings=(why,))
    depth = [
        float(np.median(apply(inverse(pose), reconstruction.tracks.points_in_recon)[:, 2]))
        for pose in reconstruction.recon_from_camera
    ]
    note = (
        f"it shares nothing with the {capture.camera_name} camera's images: calibrated by its own {len(own)} images, "
        "and what it sees is not in the map"
    )
    alone = found_alone(own, camera, reconstruction, found, found.scale * float(np.median(depth)))
    return replace(alone, warnings=(*alone.warnings, note))


def found_alone(
    own: Capture, camera: CellCamera, reconstruction: Reconstruction, found: HandEye, scene_distance: float
) -> CameraFound:
    """What the calibration of a camera by its own images says of it."""
    pictures = []
    for verdict in image_verdicts(own, reconstruction, found):
        row = own.images.index(verdict.image)
        points = int((reconstruction.tracks.image == np.flatnonzero(reconstruction.image_index == row)).sum())
        pictures.append(
            PictureFound(verdict.image, verdict.used, points, verdict.reprojection_px, verdict.reason)
        )
    std = found.estimate.intrinsics_covariance
    return CameraFound(
        camera.name,
        camera.mount,
        camera.arm,
        tuple(pictures),
        found.gripper_from_camera,
        found.covariance[:6, :6],
        scene_distance,
        found.intrinsics,
        None if std is None else np.sqrt(np.diag(std)),
        found.converged,
        found.warnings,
    )


def not_registered(camera: CellCamera, why: str) -> CameraFound:
    """Of a camera whose images gave no reconstruction."""
    pictures = tuple(PictureFound(image, False, 0, None, "not registered") for image in camera.images)
    return CameraFound(camera.name, camera.mount, camera.arm, pictures, warnings=(why,))
