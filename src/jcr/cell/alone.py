"""A further camera with a capture of its own: its images, and the gripper's poses at which they were taken.

So is calibrated what sees nothing that the capture's own camera saw: a fixed camera that watches the gripper, and a
second camera on the gripper that looks elsewhere. One robot joins them; scene, scale and transform are each its own.
"""

from dataclasses import replace

import numpy as np

from jcr.calibration.calibration_json import image_verdicts
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.stage import calibrate
from jcr.cell.found import CameraFound, ImageFound
from jcr.errors import RejectedError
from jcr.geometry import apply, inverse
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions, reconstruct
from jcr.records import (
    Capture,
    CellCamera,
    Finding,
    HandEye,
    Kind,
    Reconstruction,
    no_reconstruction,
    strongest_first,
)
from jcr.sfm.relocate import MIN_POINTS

LEAST_POSES = 3
"""Fewer images than this are not reconstructed."""


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
    few = all(image.points < MIN_POINTS for image in found.images)
    return on_gripper and few and len(camera.images) >= LEAST_POSES


def calibrated_elsewhere(
    capture: Capture,
    camera: CellCamera,
    shared: CameraFound,
    reconstruct_options: ReconstructOptions,
    options: CalibrateOptions,
    progress: Progress,
) -> CameraFound:
    """A second camera on the gripper whose views do not overlap the first one's; `shared` is what those showed of it."""
    own = of_camera(capture, camera)
    other_scene = Finding.of(Kind.ANOTHER_SCENE, "warns", camera=capture.camera_name)
    try:
        reconstruction = reconstruct(own, replace(reconstruct_options, backend="auto"), progress)
        found = calibrate(own, reconstruction, options)
    except RejectedError as error:
        return replace(shared, findings=strongest_first((*no_reconstruction(error), other_scene)))
    depth = [
        float(np.median(apply(inverse(pose), reconstruction.tracks.points_in_recon)[:, 2]))
        for pose in reconstruction.recon_from_camera
    ]
    alone = found_alone(own, camera, reconstruction, found, found.scale * float(np.median(depth)))
    other_scene = replace(other_scene, value=float(len(own)))
    return replace(alone, findings=strongest_first((*alone.findings, other_scene)))


def found_alone(
    own: Capture, camera: CellCamera, reconstruction: Reconstruction, found: HandEye, scene_distance: float
) -> CameraFound:
    """A camera as the calibration by its own images places it."""
    images = []
    for verdict in image_verdicts(own, reconstruction, found):
        row = own.images.index(verdict.image)
        points = int((reconstruction.tracks.image == np.flatnonzero(reconstruction.image_index == row)).sum())
        images.append(
            ImageFound(
                image=verdict.image,
                used=verdict.used,
                points=points,
                reprojection_px=verdict.reprojection_px,
                reason=verdict.reason,
            )
        )
    return CameraFound(
        name=camera.name,
        mount=camera.mount,
        arm=camera.arm,
        images=tuple(images),
        parent_from_camera=found.gripper_from_camera,
        covariance=found.covariance[:6, :6],
        scene_distance=scene_distance,
        intrinsics=found.intrinsics,
        intrinsics_std=found.estimate.intrinsics_std,
        findings=found.findings,
    )


def not_registered(camera: CellCamera, error: RejectedError) -> CameraFound:
    """Of a camera whose images could not be reconstructed."""
    count = len(camera.images)
    return CameraFound.not_placed(camera, no_reconstruction(error), [0] * count, ["not registered"] * count)
