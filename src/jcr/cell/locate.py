"""The other cameras of a cell, each by what it sees: the scene of the calibrated one, another scene, or the gripper."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jcr.calibration.options import CalibrateOptions
from jcr.cell.alone import calibrated_elsewhere, sees_another_scene
from jcr.cell.background import write_moving_parts
from jcr.cell.carried import calibrated_alone, exchanged
from jcr.cell.found import CellFound
from jcr.cell.stage import place_cameras
from jcr.progress import Progress
from jcr.reconstruct.backends import ReconstructOptions
from jcr.records import Capture, CellCamera, HandEye, Reconstruction


def locate_cameras(
    capture: Capture,
    others: Sequence[CellCamera],
    reconstruction: Reconstruction,
    hand_eye: HandEye,
    moving: Path,
    reconstruct_options: ReconstructOptions,
    options: CalibrateOptions,
    progress: Progress,
) -> CellFound:
    """Where the other cameras of a calibrated capture are, in their order.

    `moving` is a folder for images of what moves before those that watch the gripper.
    """
    of_scene = [camera for camera in others if not camera.watches_gripper]
    found = place_cameras(capture, of_scene, reconstruction, hand_eye, options, progress)
    by_name = {camera.name: camera for camera in found.cameras}
    for camera in others:
        if camera.watches_gripper:
            by_name[camera.name] = calibrated_alone(
                capture, camera, moving / camera.name, reconstruct_options, options, progress
            )
        elif hand_eye.is_sound and sees_another_scene(camera, by_name[camera.name]):
            by_name[camera.name] = calibrated_elsewhere(
                capture, camera, by_name[camera.name], reconstruct_options, options, progress
            )
    return replace(found, cameras=tuple(by_name[camera.name] for camera in others))


def carried_scene(capture: Capture, moving: Path) -> Capture:
    """A fixed camera that watches the gripper, as a camera that moves about what is carried; `moving` as above."""
    write_moving_parts(capture.folder, capture.images, moving)
    return replace(exchanged(capture), folder=moving)
