"""Touch test: distances between points that the robot's tip touched and the same points of the surface in images."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import project, unproject
from jcr.capture.plain_files import read_lines, split_cells
from jcr.distributions import chi2
from jcr.errors import InputError
from jcr.geometry import apply, by_similarity, inverse
from jcr.records import Capture, Reconstruction
from jcr.result import RunResult

COLUMNS = ("image", "x_px", "y_px", "x_m", "y_m", "z_m")
"""Columns of the CSV: image and pixel of a point, and position of the tip that touched the point (base frame)."""
LEAST = 3
"""Smallest number of points with which a wrong calibration can be distinguished from one bad touch."""


@dataclass(frozen=True)
class TouchTest:
    """Result of a touch test: errors at the touched points, their expected sizes, and the p-value of a χ² test."""

    images: tuple[str, ...]
    """Image in which each point was selected."""
    error: Float[ndarray, "k 3"]
    """Position of the tip minus position of the surface point (m, base axes), one row per point."""
    std: Float[ndarray, "k 3"]
    """Standard deviations (m) of `error`, predicted from the covariance of the calibration and the robot's noise."""
    p_value: float
    """Probability of errors as large as these or larger, tested for all points together."""

    @property
    def rms(self) -> float:
        """Root mean square length (m) of the errors: tip minus surface point, over all touched points."""
        return float(np.sqrt((self.error**2).sum(1).mean()))

    @property
    def expected(self) -> float:
        """Root mean square length (m) of the errors that is predicted by `std`."""
        return float(np.sqrt((self.std**2).sum(1).mean()))

    @property
    def common(self) -> Float[ndarray, "3"]:
        """Mean over the points of tip minus surface point (m, base axes).

        A wrong position of the tip in the gripper frame causes such a common difference.
        """
        return self.error.mean(0)


def touch(out: str | Path, points: str | Path) -> TouchTest:
    """Compare points that the robot's tip touched with the surface points at their pixels in images of a run.

    `out` is the run folder. `points` is a CSV with the columns image, x_px, y_px (pixel of the point in an image of the
    run) and x_m, y_m, z_m (position of the tip in the base frame when it touched the point). The surface point is that
    of the nearest pixel of the image's pointmap. The expected errors include the covariance of the calibration, common
    to all points, and the robot's errors at each touch. Raises InputError for fewer than three points, an image that is
    not in the run, or a pixel without a surface.
    """
    points = Path(points)
    run = RunResult(out)
    _, capture, reconstruction = run.of_wrist_camera()
    calibration = run.found
    images, numbers = _read(points)
    x, base_from_recon = calibration.gripper_from_camera, calibration.base_from_recon
    row_of = {capture.images[row]: k for k, row in enumerate(reconstruction.image_index)}
    error, jacobian = np.empty((len(images), 3)), np.empty((len(images), 3, 7))
    for k, (image, own) in enumerate(zip(images, numbers, strict=True)):
        found = surface_at(capture, reconstruction, image, own[:2], points.name)
        error[k], row = own[2:] - base_from_recon(found), row_of[image]
        in_camera = apply(inverse(reconstruction.recon_from_camera[row]), found)
        arm = x[:3, :3] @ (base_from_recon.scale * in_camera)
        rotation = capture.base_from_gripper[reconstruction.image_index[row], :3, :3]
        jacobian[k] = rotation @ by_similarity(arm)
    touch_variance = calibration.robot_noise.together[0] ** 2
    stacked = jacobian.reshape(-1, 7)
    covariance = stacked @ calibration.covariance @ stacked.T + touch_variance * np.eye(len(stacked))
    squared = float(error.ravel() @ np.linalg.solve(covariance, error.ravel()))
    std = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    return TouchTest(tuple(images), error, std, float(chi2.sf(squared, error.size)))


def surface_at(
    capture: Capture, reconstruction: Reconstruction, image: str, x_px: Float[ndarray, "2"], asked_by: str
) -> Float[ndarray, "3"]:
    """Return the surface point (recon frame and unit) at the pixel `x_px` of an image, from the pointmaps.

    `image` is a name of the capture, `x_px` a pixel (x, y) of its distorted image; the nearest pixel of the pointmap is
    read. Raises InputError if the image is not registered or the pixel has no depth. The message begins with
    `asked_by`, the file that states the pixel.
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


def _read(path: Path) -> tuple[list[str], list[Float[ndarray, "5"]]]:
    """Read the CSV of a touch test; return the image of each point, and the numbers x_px, y_px, x_m, y_m, z_m.

    Raises InputError for a missing column or fewer than three points.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a CSV with the columns {', '.join(COLUMNS)}")
    images, numbers = list[str](), list[ndarray]()
    header, rows = split_cells(read_lines(path)[0], path)
    if missing := [name for name in COLUMNS if name not in (header or ())]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; give {', '.join(COLUMNS)}")
    for line, row in enumerate(rows, start=2):
        named = dict(zip(header or (), row, strict=False))
        try:
            own = np.array([float(named[name]) for name in COLUMNS[1:]])
        except (KeyError, ValueError):
            raise InputError(f"{path}: line {line}: {', '.join(COLUMNS[1:])} must be numbers") from None
        if not np.isfinite(own).all() or np.abs(own[2:]).max() > 100:
            raise InputError(f"{path}: line {line}: positions are finite and in metres")
        images.append(named.get("image", ""))
        numbers.append(own)
    if len(images) < LEAST:
        raise InputError(f"{path}: {len(images)} points; touch {LEAST} or more, spread over the scene")
    return images, numbers
