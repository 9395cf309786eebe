"""Touch test: distances between points that the robot's tip touched and the same points of the surface in images."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.calibration.record import Calibration
from jcr.camera import project, unproject
from jcr.capture.documents import read_tables
from jcr.capture.documents.table import decode_text, read_limited
from jcr.distributions import chi2
from jcr.errors import InputError, count_of
from jcr.files import as_path
from jcr.geometry import Poses, apply, by_similarity, inverse, scale_translation
from jcr.records import Capture, Reconstruction
from jcr.result import RunResult

CSV_COLUMNS = ("image", "x_px", "y_px", "x_m", "y_m", "z_m")
"""Columns of the CSV: image and pixel of a point, and position of the tip that touched the point (base frame)."""
CLICK_PX = 1.0
"""Standard deviation of a selected pixel, and of the nearest pixel of a pointmap, along each axis (px of the image). At
0.5 m and 600 px focal length it moves a point by 0.8 mm; half or twice of it matters only beside robots below 1 mm."""
LEAST_TOUCHES = 3
"""Smallest number of points with which a wrong calibration can be distinguished from one bad touch."""


@dataclass(frozen=True)
class Touch:
    """Row of the CSV: a point in an image, and the position of the tip that touched the point."""

    line: int
    """Line of the file; the header is line 1."""
    image: str
    x_px: Float[ndarray, "2"]
    """Pixel (x, y) of the point in the image file."""
    tip: Float[ndarray, "3"]
    """Position of the tip (m, base frame)."""

    def __str__(self) -> str:
        x, y = self.x_px
        return f"line {self.line}: {self.image}, pixel {x:g}, {y:g}"


@dataclass(frozen=True)
class TouchTest:
    """Result of a touch test: errors at the touched points, their expected sizes, and the p-value of a χ² test."""

    touches: tuple[Touch, ...]
    """Touched points that are compared."""
    error: Float[ndarray, "k 3"]
    """Position of the tip minus position of the surface point (m, base axes), one row per point."""
    std: Float[ndarray, "k 3"]
    """Standard deviations (m) of `error`, predicted from the covariance of the calibration and the robot's noise."""
    p_value: float
    """Probability of errors as large as these or larger, tested for all points together."""
    notes: tuple[str, ...] = ()
    """Rows of the CSV that are left out, and why."""

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
    of the nearest pixel of the image's pointmap. Rows without a surface at their pixel are left out, and equal rows
    count once. Raises InputError for fewer than three remaining points, an image that is not in the run, or a pixel
    outside of the image.
    """
    points = as_path(points, "points")
    run = RunResult(out)
    _, capture, reconstruction = run.of_wrist_camera()
    calibration = run.found
    base_from_recon = calibration.base_from_recon
    touches, surfaces, notes = _located(points, capture, reconstruction)
    count = len(touches)
    row_of = {capture.images[row]: k for k, row in enumerate(reconstruction.image_index)}
    rows = np.array([row_of[one.image] for one in touches])
    error, in_camera, depth_std_m = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for k, (own, (found, std)) in enumerate(zip(touches, surfaces, strict=True)):
        error[k], depth_std_m[k] = own.tip - base_from_recon(found), base_from_recon.scale * std
        camera = scale_translation(reconstruction.recon_from_camera[rows[k]], base_from_recon.scale)
        in_camera[k] = apply(inverse(camera), base_from_recon.scale * found)
    covariance = error_covariance(
        calibration, capture.base_from_gripper[reconstruction.image_index[rows]], rows, in_camera, depth_std_m
    )
    squared = float(error.ravel() @ np.linalg.solve(covariance, error.ravel()))
    std = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    return TouchTest(tuple(touches), error, std, float(chi2.sf(squared, error.size)), tuple(notes))


def _located(
    points: Path, capture: Capture, reconstruction: Reconstruction
) -> tuple[list[Touch], list[tuple[Float[ndarray, "3"], float]], list[str]]:
    """Read the CSV; return its different points with a surface, their surfaces (`surface_at`), and notes on others.

    Raises InputError for fewer than LEAST_TOUCHES remaining points.
    """
    kept, notes = dict[tuple[object, ...], tuple[Touch, tuple[ndarray, float]]](), list[str]()
    for given in _read(points):
        own = replace(given, image=_image_of(points, given, capture))
        same = (own.image, *own.x_px, *own.tip)
        found = surface_at(capture, reconstruction, own.image, own.x_px, f"{points}: {own}")
        if same in kept:
            notes.append(f"{own}: the same as line {kept[same][0].line}, and counts once")
        elif found is None:
            notes.append(
                f"{own}: no surface was found there, and the row is left out; choose textured, flat places"
            )
        else:
            kept[same] = own, found
    if len(kept) < LEAST_TOUCHES:
        left = f" with a surface ({'; '.join(notes)})" if notes else ""
        raise InputError(
            f"{points}: {count_of(len(kept), 'point')}{left}; touch {LEAST_TOUCHES} or more, spread over the scene"
        )
    return [one for one, _ in kept.values()], [surface for _, surface in kept.values()], notes


def _image_of(points: Path, touched: Touch, capture: Capture) -> str:
    """Return the capture's name of an image, which may be given without its folder if that is unique."""
    same = [name for name in capture.images if touched.image in (name, Path(name).name)]
    if touched.image in same:
        return touched.image
    if len(same) != 1:
        why = "is not an image of the run" if not same else f"is one of {', '.join(same)}; give one of these"
        raise InputError(f"{points}: {touched}: {touched.image} {why}")
    return same[0]


def error_covariance(
    calibration: Calibration,
    base_from_gripper: Poses,
    image: Int[ndarray, " k"],
    in_camera: Float[ndarray, "k 3"],
    depth_std_m: Float[ndarray, " k"],
) -> Float[ndarray, "r r"]:
    """Return the covariance (m², base axes, r = 3k) of tip minus surface point, point by point.

    `base_from_gripper` is the reported pose of each point's image, `image` the number of the image. `in_camera` are the
    surface points (m, camera frame), `depth_std_m` the standard deviations of their depths. Errors of the scene are
    common to all points (`Uncertainty.scene`). Without adjusted images these are the errors of the calibration, and
    those of a gripper pose for the points of its image. Each point has errors of its own: of the click (CLICK_PX), of
    the depth, and of the robot at the touch.
    """
    x, noise, count = calibration.gripper_from_camera, calibration.robot_noise, len(image)
    arm, rotation = in_camera @ x[:3, :3].T, base_from_gripper[:, :3, :3]
    lever, scene = (rotation @ (arm + x[:3, 3])[..., None])[..., 0], calibration.uncertainty.scene
    by_calibration, of_points = (rotation @ by_similarity(arm)).reshape(3 * count, 7), noise.together[0] ** 2
    if scene is None:
        covariance = by_calibration @ calibration.covariance @ by_calibration.T
        by_pose = by_similarity(lever)[:, :, :6].reshape(3 * count, 6)
        random = np.square([noise.translation, noise.rotation])
        variance = np.repeat(random + np.square(noise.systematic_left), 3)
        same = np.repeat(np.repeat(image[:, None] == image, 3, axis=0), 3, axis=1)
        covariance = covariance + same * ((by_pose * variance) @ by_pose.T)
    else:
        by_scene = by_similarity(base_from_gripper[:, :3, 3] + lever - scene.middle_in_base)
        by_scene, budget = by_scene.reshape(3 * count, 7), calibration.uncertainty.budget
        covariance = by_scene @ scene.covariance @ by_scene.T
        if budget is not None:
            covariance = covariance + by_calibration @ budget.faults @ by_calibration.T
        of_points += scene.shape_m**2
    # A click moves the point across the ray; an error of the depth moves it along the ray.
    focal = 1.0 if calibration.intrinsics is None else calibration.intrinsics.fx
    own = np.zeros((count, 3, 3))
    own[:, 0, 0] = own[:, 1, 1] = CLICK_PX / focal * in_camera[:, 2]
    own[:, :, 2] = depth_std_m[:, None] * in_camera / in_camera[:, 2:]
    own = rotation @ x[:3, :3] @ own
    each = own @ np.swapaxes(own, 1, 2) + of_points * np.eye(3)
    return covariance + np.asarray(block_diag(*each))


def surface_at(
    capture: Capture, reconstruction: Reconstruction, image: str, x_px: Float[ndarray, "2"], asked_by: str
) -> tuple[Float[ndarray, "3"], float] | None:
    """Return the surface point at the pixel `x_px` of an image, and the standard deviation of its depth (recon units).

    Both come from the pointmaps; the standard deviation is 0 where they do not state it. None: the pixel has no depth.

    `image` is a name of the capture, `x_px` a pixel (x, y) of its distorted image; the nearest pixel of the pointmap is
    read. Raises InputError if the image is not registered or the pixel is outside of it; `asked_by` begins the message.
    """
    rows = [k for k, row in enumerate(reconstruction.image_index) if capture.images[row] == image]
    if not rows:
        raise InputError(f"{asked_by}: {image} is not among the registered images; choose another")
    width, height = capture.image_size
    if not (-0.5 <= x_px[0] < width - 0.5 and -0.5 <= x_px[1] < height - 0.5):
        raise InputError(f"{asked_by}: the pixel is outside of the image ({width} x {height} px); correct it")
    if (dense := reconstruction.pointmaps) is None:
        raise InputError(f"{asked_by}: no dense depth to read a surface from; make it with `jcr map`")
    x_px = project(dense.intrinsics, unproject(reconstruction.intrinsics, x_px))
    column, row = np.round(x_px).astype(int)
    height, width = dense.confidence.shape[1:]
    inside = 0 <= column < width and 0 <= row < height
    if not inside or not dense.confidence[rows[0], row, column] > 0:
        return None
    std = 0.0 if dense.depth_std is None else float(dense.depth_std[rows[0], row, column])
    return dense.points_in_recon[rows[0], row, column].astype(np.float64), std


def _read(path: Path) -> list[Touch]:
    """Read the rows of the CSV of a touch test, in their order."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a CSV with the columns {', '.join(CSV_COLUMNS)}")
    touches = list[Touch]()
    tables = read_tables(path)
    header = decode_text(path, read_limited(path)).partition("\n")[0]
    named = [cell.strip().strip('"') for cell in re.split(r"[,;\t]", header)]
    if missing := [name for name in CSV_COLUMNS if name not in named]:
        raise InputError(f"{path}: has no column {', '.join(missing)}; give {', '.join(CSV_COLUMNS)}")
    rows = next((table.rows for table in tables if set(CSV_COLUMNS) <= set(table.columns)), ())
    for line, row in enumerate(rows, start=2):
        cell_of = dict(zip(named, row, strict=True))
        cells = [cell_of[name] for name in CSV_COLUMNS[1:]]
        if not all(isinstance(cell, float) for cell in cells):
            raise InputError(f"{path}: line {line}: {', '.join(CSV_COLUMNS[1:])} must be numbers")
        own = np.array(cells, dtype=np.float64)
        if not np.isfinite(own).all() or np.abs(own[2:]).max() > 100:
            raise InputError(f"{path}: line {line}: positions are finite and in metres")
        touches.append(Touch(line, str(cell_of["image"] or ""), own[:2], own[2:]))
    return touches
