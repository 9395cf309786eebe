"""Several cameras in one model of camera poses: the wrist's, whose gripper poses a table has, and what the others are.

A camera whose images were taken together with the wrist's (COLMAP's rigs) is on the gripper; one whose images were all
taken from one place is fixed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.checks import checked_capture, image_sizes, require_images
from jcr.capture.formats.table import gripper_poses
from jcr.capture.options import ReadOptions
from jcr.capture.recorded_cameras import camera_names
from jcr.errors import InputError
from jcr.geometry import step_between
from jcr.records import Capture, CellCamera, Intrinsics

ONE_PLACE = (0.02, np.radians(1.0))
"""Share of the model's extent, and rad: images of one fixed camera differ by less."""


@dataclass(frozen=True, kw_only=True)
class ModelCamera:
    """One camera of a model and its images."""

    name: str
    images: tuple[str, ...]
    """Paths relative to the folder of the capture."""
    recon_from_camera: Float[ndarray, "k 4 4"]
    moment: tuple[int, ...]
    """Of each image; the same number where cameras of a rig were triggered together."""
    intrinsics_of_size: Callable[[tuple[int, int]], Intrinsics]


def capture_of_cameras(
    folder: Path, cameras: Sequence[ModelCamera], options: ReadOptions, model: Path
) -> Capture:
    """The images that a table of gripper poses knows, of one camera, and what the others saw.

    `cameras` are in the order in which they may be the wrist's. Raises InputError where the table belongs to none.
    """
    refused: InputError | None = None
    for own in cameras:
        try:
            known, poses, notes = gripper_poses(folder, own.images, options)
        except InputError as error:
            refused = refused or error
            continue
        capture = checked_capture(folder, [own.images[k] for k in known], poses, str(model))
        row_of = {own.moment[k]: row for row, k in enumerate(known)}
        others, left_out = [], []
        everywhere = np.concatenate([camera.recon_from_camera[:, :3, 3] for camera in cameras])
        extent = float(np.linalg.norm(np.ptp(everywhere, axis=0)))
        rest = [camera for camera in cameras if camera is not own]
        names = camera_names([capture.camera_name, *(camera.name for camera in rest)])[1:]
        for name, camera in zip(names, rest, strict=True):
            require_images(folder, camera.images, str(model))
            other = _other(name, camera, row_of, extent, folder, model)
            if other is None:
                left_out.append(
                    f"{len(camera.images)} images of another camera ({camera.images[0]}) are neither of one place nor "
                    "of a rig with the wrist's: left out"
                )
            else:
                others.append(other)
        return replace(
            capture,
            intrinsics=own.intrinsics_of_size(capture.image_size),
            source=model,
            cameras=model,
            notes=(*notes, *left_out),
            others=tuple(others),
        )
    raise refused or InputError(f"{model}: has no camera")


def one_each(counts: Sequence[int]) -> bool:
    """Whether most images have a camera of their own, as some tools write what was one camera."""
    return 2 * sum(count == 1 for count in counts) > sum(counts)


def _other(
    name: str, camera: ModelCamera, row_of: dict[int, int], extent: float, folder: Path, model: Path
) -> CellCamera | None:
    """What carries a camera; None where its images do not tell."""
    in_rig = [k for k, moment in enumerate(camera.moment) if moment in row_of]
    off = np.abs(step_between(camera.recon_from_camera[0], camera.recon_from_camera))
    still = off[:, :3].max() <= ONE_PLACE[0] * extent and off[:, 3:].max() <= ONE_PLACE[1]
    if in_rig:
        in_rig.sort(key=lambda k: row_of[camera.moment[k]])
        images = tuple(camera.images[k] for k in in_rig)
    elif still:
        images = camera.images
    else:
        return None
    sizes = set(image_sizes(folder, images))
    if len(sizes) > 1:
        raise InputError(f"{model}: images of one camera, {images[0]} among them, differ in size")
    (size,) = sizes
    frame = np.array([row_of[camera.moment[k]] for k in in_rig]) if in_rig else None
    mount = "gripper" if in_rig else "base"
    return CellCamera(
        name=name,
        mount=mount,
        images=images,
        image_size=size,
        intrinsics=camera.intrinsics_of_size(size),
        frame=frame,
    )
