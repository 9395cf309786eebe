"""Lengths given by the user for unobservable motions: the camera's height, or the distance of two pixels' points."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import LengthInImage
from jcr.camera import project, unproject
from jcr.errors import InputError
from jcr.geometry import Poses, rotation_angle
from jcr.records import Capture, Reconstruction

LENGTH_STD = 0.01
"""Relative standard deviation of a known length: one pixel of a length of 100 px."""
HEIGHT_STD = 1e-3
"""Standard deviation (m) of a height measured with a ruler."""
CONTRADICTED = (4.0, 0.02)
"""Smallest difference of a known scale and the robot's scale that is a contradiction: in standard deviations, and as a
fraction of the scale; both limits are exceeded."""
ONE_AXIS = np.radians(6)
"""Largest rms deviation of the rotation axis (rad) for which a motion is planar, and smallest rotation it needs."""


def height_cue(base_from_gripper: Poses, height: float) -> tuple[Float[ndarray, "3"], float, float]:
    """Return the axis that all rotations of a planar motion share, the camera's coordinate along it, and its std.

    The axis is a unit vector in the gripper frame, with its sign such that it points up in the base frame. The
    coordinate (m) counts from the gripper's origin; the third number is its standard deviation (m). `height` (m) is the
    measured height of the camera above the gripper's origin, which is returned as the coordinate.

    Raises InputError if the gripper does not rotate about one common axis.
    """
    u, _, vt = np.linalg.svd(base_from_gripper[:, :3, :3].mean(0))
    up = np.sign(u[2, 0]) or 1.0
    axis_in_base, axis_in_gripper = up * u[:, 0], up * vt[0]
    wander = np.linalg.norm(base_from_gripper[:, :3, :3] @ axis_in_gripper - axis_in_base, axis=1)
    rotation = rotation_angle(np.swapaxes(base_from_gripper[:1, :3, :3], 1, 2) @ base_from_gripper[:, :3, :3])
    if np.sqrt((wander**2).mean()) > ONE_AXIS or rotation.max() < ONE_AXIS:
        raise InputError(
            "--known-height: the gripper does not rotate about one common axis, along which a height could be "
            "known; leave the option out"
        )
    return axis_in_gripper, height, HEIGHT_STD


def check_known_length(capture: Capture, known_length: LengthInImage | None) -> None:
    """Raise InputError if the image of `known_length` is not in the capture, or if a pixel lies outside the image.

    None: no length is known, and nothing is checked.
    """
    if known_length is None:
        return
    image, *ends, _ = known_length
    if image not in capture.images:
        names = ", ".join(capture.images[:3]) + ", …" * (len(capture) > 3)
        raise InputError(f"--known-length: the capture has no image {image}; it has {names}")
    width, height = capture.image_size
    for x, y in (ends[:2], ends[2:]):
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(
                f"--known-length: pixel ({x:g}, {y:g}) is outside {image}, which has {width}x{height} pixels; "
                "give x and y from its upper left corner"
            )


def length_cue(
    capture: Capture, reconstruction: Reconstruction, known_length: LengthInImage
) -> tuple[float, float]:
    """Return the scale (metres per recon unit) from a known length between two pixels, and its relative 1σ error.

    The distance of both pixels' surface points in the recon frame comes from the pointmaps (`surface_at`). Raises
    InputError if the image is not registered or a pixel has no depth.
    """
    image, *ends, length_mm = known_length
    first, second = (
        surface_at(capture, reconstruction, image, end, "--known-length")
        for end in np.array(ends).reshape(2, 2)
    )
    return 1e-3 * length_mm / float(np.linalg.norm(second - first)), LENGTH_STD


def surface_at(
    capture: Capture, reconstruction: Reconstruction, image: str, x_px: Float[ndarray, "2"], asked_by: str
) -> Float[ndarray, "3"]:
    """Return the surface point (recon frame and unit) at the pixel `x_px` of an image, from the pointmaps.

    `image` is a name of the capture, `x_px` a pixel (x, y) of its distorted image; the nearest pixel of the pointmap is
    read. Raises InputError if the image is not registered or the pixel has no depth. The message begins with
    `asked_by`, the command-line option or file that states the pixel.
    """
    rows = [k for k, row in enumerate(reconstruction.image_index) if capture.images[row] == image]
    if not rows:
        raise InputError(f"{asked_by}: {image} is not among the registered images; choose another")
    if (dense := reconstruction.pointmaps) is None:
        raise InputError(
            f"{asked_by}: there is no dense depth to read a surface from; make it with `jcr map`"
        )
    x_px = project(dense.intrinsics, unproject(reconstruction.intrinsics, x_px))
    column, row = np.round(x_px).astype(int)
    height, width = dense.confidence.shape[1:]
    inside = 0 <= column < width and 0 <= row < height
    if not inside or not dense.confidence[rows[0], row, column] > 0:
        raise InputError(f"{asked_by}: no surface was found at that pixel of {image}; choose textured places")
    return dense.points_in_recon[rows[0], row, column].astype(np.float64)
