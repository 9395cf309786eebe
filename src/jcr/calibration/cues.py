"""What a user can measure with a ruler to replace what the motions do not show."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import LengthInImage
from jcr.camera import project, unproject
from jcr.errors import InputError
from jcr.findings import Finding, FindingKind
from jcr.geometry import Poses, rotation_angle
from jcr.records import Capture, HandEye, Reconstruction

LENGTH_STD = 0.01
"""Relative: a pixel's breadth at either end of a length of a hundred pixels."""
HEIGHT_STD = 1e-3
"""m, one sigma of a height measured with a ruler."""
CONTRADICTED = (4.0, 0.02)
"""Standard deviations, and share of the scale, from which a known scale and the robot's motion exclude each other."""
ONE_AXIS = np.radians(6)
"""Planar motion keeps its axis within this, on average."""


def height_cue(base_from_gripper: Poses, height: float) -> tuple[Float[ndarray, "3"], float, float]:
    """The camera's height (m) above the gripper's origin along the axis that all rotations share.

    Raises InputError where they share none: the height is then no cue, but a result.
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
    """Raise InputError, before any work, if the image of a known length, or a pixel of it, is not in the capture."""
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
    capture: Capture,
    reconstruction: Reconstruction,
    image: str,
    ends_px: Float[ndarray, "2 2"],
    length: float,
) -> tuple[float, float]:
    """Metres per recon unit from the length (m) between two pixels of one image.

    Raises InputError when the image or a surface at either pixel is not there.
    """
    first, second = (surface_at(capture, reconstruction, image, end, "--known-length") for end in ends_px)
    return length / float(np.linalg.norm(second - first)), LENGTH_STD


def surface_at(
    capture: Capture, reconstruction: Reconstruction, image: str, x_px: Float[ndarray, "2"], asked_by: str
) -> Float[ndarray, "3"]:
    """The surface point (recon frame) that a pixel of an image shows.

    Raises InputError, which names who asked, when the image or a surface at that pixel is not there.
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


def scale_contradiction(free: HandEye, metric_std: float) -> Finding | None:
    """That the robot's motion excludes that the reconstruction is in metres; None where it does not.

    `free` is a calibration that was not given it; `metric_std` is how well the metre is known (relative one
    sigma).
    """
    if not free.converged:
        return None
    off, std = float(np.log(free.scale)), float(np.sqrt(free.covariance[6, 6]))
    sigmas, share = CONTRADICTED
    if abs(off) < max(share, sigmas * float(np.hypot(std, metric_std))):
        return None
    return Finding.of(FindingKind.BOARD_SIZE, "rejects", "poses", value=float(np.expm1(off)), std=std)
