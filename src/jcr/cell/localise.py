"""Registration of another camera's image in the reconstruction of the capture's own camera (sfm/register.py).

A focal length is estimated where none is given, or where another one explains clearly more points.
"""

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.camera import usable_intrinsics
from jcr.geometry import apply, inverse
from jcr.records import CellCamera, Intrinsics
from jcr.sfm.register import GATE_PX, KnownImages, Registration, features, registration, shared_points

FOCAL_OF_WIDTH = 0.9
"""Initial focal length of a camera without given intrinsics, in widths of the image."""
CLEARLY_MORE = 1.1
"""Factor of the points that agree with given intrinsics, from which RANSAC alone does not explain more."""


def localise(known: KnownImages, image: UInt8[ndarray, "h w 3"], camera: CellCamera) -> Registration | int:
    """Return the registration of an image, or the number of points that it shares where these are too few."""
    given, _ = usable_intrinsics(camera.intrinsics)
    intrinsics = given or _initial_intrinsics(camera.image_size)
    gate_px = 2 * GATE_PX * max(1.0, intrinsics.width / 1600)
    shared = shared_points(known, features(image, intrinsics))
    free = registration(shared, intrinsics, "free", gate_px)
    if given is None:
        return free
    # Wrong intrinsics leave the points that agree with a wrong pose: another focal length explains more.
    found = registration(shared, intrinsics, "given", gate_px)
    return free if count(free) > CLEARLY_MORE * count(found) else found


def count(found: Registration | int) -> int:
    """Return the number of shared points."""
    return len(found.x_px) if isinstance(found, Registration) else found


def _initial_intrinsics(size: tuple[int, int]) -> Intrinsics:
    """Return initial intrinsics for an image size."""
    width, height = size
    focal = FOCAL_OF_WIDTH * max(size)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def spread(found: Registration) -> float:
    """Return the share of the image's area that the standard deviations of its points span."""
    sides = 4 * np.sqrt(np.linalg.eigvalsh(np.cov(found.x_px.T)))
    return float(sides.prod() / (found.pose.camera.width * found.pose.camera.height))


def distance(found: Registration) -> float:
    """Return the median depth of the points, in the reconstruction's unit."""
    return float(np.median(apply(inverse(found.pose.a_from_camera), found.points_in_recon)[:, 2]))
