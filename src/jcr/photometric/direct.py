"""Direct alignment: wrist cameras by photometric alignment, on plain tables too, where features find nothing to match.

The robot's poses leave one unknown for all cameras, the hand-eye transform (and the focal length, if the intrinsics are
not known). That is little enough to find it from nothing: the cameras look at a common place, which tells their viewing
direction in the gripper's frame, and rotations about it and tilts are tried all around, on images 15 pixels high. From
there coarse to fine, with a depth for each of a few thousand pixels; in the end every camera moves by itself, so that
what disagrees with the robot's motion shows.

Pointmaps are matched near edges; plain surfaces between them are filled with planes (jcr/depth/priors.py).
The page `plain-tables` describes when, and with what errors.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import (
    guessed_intrinsics,
    pinhole_inside,
    project,
    undistortion,
    unproject,
    usable_intrinsics,
    zoomed,
)
from jcr.capture.images import read_image
from jcr.errors import InputError, RejectedError
from jcr.geometry import apply, inverse, step_axes
from jcr.photometric.coarse_to_fine import (
    PyramidLevel,
    align_photometrically,
    free_directions,
    tied_directions,
)
from jcr.photometric.residuals import (
    Cameras,
    Level,
    Points,
    equations,
    in_base,
    in_view,
    make_level,
    relative_exposures,
    squared_misfit,
)
from jcr.photometric.search import SIZES, search
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, Intrinsics, Reconstruction, Tracks

FREED = (PyramidLevel(60, 300, 3, 0.12), PyramidLevel(120, 300, 3, 0.1))
"""Found without the robot poses."""
FINEST = PyramidLevel(240, 300, 3, 0.1)
BEFORE_GAINS = PyramidLevel(60, 300, 1, 0.2)
"""Stage after which brightness is compared."""
GAIN_ROUNDS = 3
"""Number of estimates of the gains; each time more points agree."""
LEAST_GAIN = 0.05
"""Difference of log brightness below which it is left alone: shading and gloss look like as much."""
LEAST_AGREED = 0.25
"""Share of the points that the views must agree on in the end."""
LEAST_POINTS = 100
"""Fewer than this count as this many."""
LEAST_SHARE = 0.4
"""Least share of the other images' points that an image shows, relative to the median image: images with wrong poses
have 0.1 to 0.25 of it, those of a robot that is 5 mm and 1° off 0.8."""
REGION = 0.05
"""m. Points within it share their errors: they are pixels of one edge, seen from many sides."""


def reconstruct_direct(capture: Capture, progress: Progress | None = None) -> Reconstruction:
    """Reconstruct camera poses by photometric alignment, initialised from the gripper poses.

    Known intrinsics stay, else a focal length is estimated. The unit is the robot's metre only roughly, the frame
    is the first camera's; `evidence` has the covariance. Raises InputError with fewer than three images, and
    RejectedError where another place of the camera fits as well, or too few pixels are explained.
    """
    if len(capture) < 3:
        raise InputError(f"direct alignment needs 3 images or more, there are {len(capture)}; take more")
    report = progress or silent
    images = [read_image(capture.folder / name) for name in capture.images]
    given, warnings = usable_intrinsics(capture.intrinsics)
    notes = ()
    intrinsics = given or guessed_intrinsics(capture.image_size)
    levels = pyramid(images, intrinsics)
    known = given is not None
    found = search(levels, capture.base_from_gripper, known, report)
    factor = exposure_gains(levels[FREED[0].height], found)
    levels = {height: level.times(factor) for height, level in levels.items()}
    rows, cameras = images_that_fit(levels[FREED[0].height], found, known)
    if len(rows) < len(capture):
        names = ", ".join(name for k, name in enumerate(capture.images) if k not in rows)
        notes = (f"direct alignment: left out, for they fit nowhere near their poses: {names}",)
        levels = {height: level.rows(rows) for height, level in levels.items()}
    for k, stage in enumerate(FREED):
        report("direct alignment", 0.7 + 0.1 * k)
        cameras, _ = align_photometrically(
            levels[stage.height], cameras, stage, free_directions(cameras, known)
        )
    level = levels[FINEST.height]
    cameras, points = align_photometrically(level, cameras, FINEST, free_directions(cameras, known))
    report("direct alignment", 1.0)
    if (agreed := points.agreed.sum() / max(len(points.agreed), LEAST_POINTS)) < LEAST_AGREED:
        raise RejectedError(
            f"direct alignment: the views agree on {100 * agreed:.0f} % of the pixels at edges, too few",
            "take images that overlap more, of a scene that does not move or shine",
        )
    covariance = camera_covariance(level, cameras, points, FINEST.sigma, free_directions(cameras, known))
    points = points.where(points.agreed)
    intrinsics = zoomed(intrinsics, cameras.zoom)
    tracks = _tracks(level, cameras, points, FINEST.sigma, intrinsics)
    recon_from_camera = inverse(cameras.base_from_camera[0]) @ cameras.base_from_camera
    return Reconstruction(
        image_index=rows,
        recon_from_camera=recon_from_camera,
        intrinsics=intrinsics,
        tracks=tracks,
        backend="direct",
        notes=notes,
        warnings=warnings,
        evidence=CameraEvidence(recon_from_camera, covariance),
    )


def exposure_gains(level: Level, cameras: Cameras) -> Float[ndarray, " n"]:
    """Return the factors that make the images equally bright, where the camera changed its exposure."""
    factor = np.ones(level.count)
    for _ in range(GAIN_ROUNDS):
        even = level.times(factor)
        _, points = align_photometrically(even, cameras, BEFORE_GAINS, np.zeros((7, 0)))
        factor /= relative_exposures(even, cameras, points, BEFORE_GAINS.sigma)
    return factor if np.abs(np.log(factor)).max() > LEAST_GAIN else np.ones(level.count)


def images_that_fit(
    level: Level, cameras: Cameras, intrinsics_known: bool
) -> tuple[Int[ndarray, " m"], Cameras]:
    """Return the images that agree with the others, and their cameras, aligned without the images that do not.

    Each image shows a share of the other images' points in their colour. One whose share is far below the others' even
    when its camera is free is not where the robot reports it, or not of this scene. Raises RejectedError where fewer
    than three are left.
    """
    rows = np.arange(level.count)
    while True:
        cameras, _ = align_photometrically(level, cameras, FREED[0], tied_directions(intrinsics_known))
        alone, points = align_photometrically(
            level, cameras, FREED[0], free_directions(cameras, intrinsics_known)
        )
        _, u, v, seen = in_view(level, alone, points)
        shows = seen & (squared_misfit(level, points, u, v) < FREED[0].sigma ** 2)
        share = shows.sum(1) / np.maximum(seen.sum(1), 1)
        fits = share > LEAST_SHARE * np.median(share)
        if fits.all():
            return rows, cameras
        if fits.sum() < 3:
            raise RejectedError("direct alignment: fewer than three images fit together", "take more")
        rows, level = rows[fits], level.rows(np.flatnonzero(fits))
        cameras = Cameras(cameras.base_from_camera[fits], cameras.zoom)


def pyramid(images: Sequence[UInt8[ndarray, "h w 3"]], intrinsics: Intrinsics) -> dict[int, Level]:
    """Undistorted images by height in pixels."""
    width, height = intrinsics.width, intrinsics.height
    grid = pinhole_inside(intrinsics, round(FINEST.height * max(width, height) / min(width, height)))
    stack = np.stack(list(map(undistortion(intrinsics, grid), images))).astype(np.float32) / 255
    heights = {*SIZES, *(stage.height for stage in FREED), FINEST.height}
    return {height: make_level(stack, grid, height) for height in heights}


def camera_covariance(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"]
) -> Float[ndarray, "r r"]:
    """Covariance (6n,6n) of the cameras' steps in the first camera's axes, as records.CameraEvidence has it.

    Residuals of one region of the scene err together, in all images that look there. How far the gradients of regions
    scatter about zero is measured, and the inverse normal matrix scaled to it on average (a sandwich estimate that has
    one number to estimate instead of a full matrix, for which there are too few regions).
    """
    system = equations(level, cameras, points, sigma, tied=False)
    inverse_normal = np.linalg.inv(directions.T @ system.normal @ directions)
    cell = np.floor(in_base(level, cameras, points) / REGION).astype(np.int64)
    region = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    score = np.zeros((region.max() + 1, directions.shape[1]))
    np.add.at(score, region, system.gradient @ directions)
    spread = np.einsum("bp,pq,bq->", score, inverse_normal, score) / directions.shape[1]
    first_from_camera = inverse(cameras.base_from_camera[0]) @ cameras.base_from_camera
    n = len(first_from_camera)
    to_first = np.zeros((6 * n, 6 * n))
    for k, block in enumerate(step_axes(first_from_camera[:, :3, :3])):
        to_first[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    steps = to_first @ directions[:-1]
    return spread * steps @ inverse_normal @ steps.T


def _tracks(level: Level, cameras: Cameras, points: Points, sigma: float, intrinsics: Intrinsics) -> Tracks:
    """Return tracks of the points: their pixels in the host and in the images that show their colour."""
    _, u, v, seen = in_view(level, cameras, points)
    shown = seen & (squared_misfit(level, points, u, v) < sigma**2)
    image, point = np.nonzero(shown)
    host = np.arange(len(points.host))
    x_grid = np.concatenate([points.x_px, np.column_stack([u[shown], v[shown]])])
    return Tracks(
        image=np.concatenate([points.host, image]),
        x_px=project(intrinsics, unproject(zoomed(level.grid, cameras.zoom), x_grid)),
        point=np.concatenate([host, point]),
        points_in_recon=apply(inverse(cameras.base_from_camera[0]), in_base(level, cameras, points)),
        from_pointmaps=True,
    )
