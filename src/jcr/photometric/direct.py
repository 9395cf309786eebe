"""Direct alignment: poses of wrist cameras by photometric alignment, for plain tables where features find no match.

With the robot's poses, the only unknowns are the hand-eye transform, and the focal length if the intrinsics are not
known. No initial estimate is needed: the cameras look at a common place, which gives their viewing direction in the
gripper frame. Rotations about this direction and tilts of it are tried on images 15 pixels high. The alignment then
goes from coarse to fine, with a depth for each of a few thousand pixels. In the last stages every camera moves by
itself, so that disagreement with the robot's motion shows.

Pointmaps are matched near edges; plain surfaces between them are filled with planes (jcr/depth/planar_priors.py). The
page `plain-tables` describes when this back end works, and its errors.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.linalg import block_diag

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
from jcr.photometric.hand_eye_search import HEIGHTS, search
from jcr.photometric.residuals import (
    LOCATED_FROM,
    Cameras,
    Level,
    Points,
    equations,
    in_base,
    in_view,
    make_level,
    sample,
    squared_misfit,
)
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, Intrinsics, Reconstruction, Tracks

FREED = (PyramidLevel(60, 300, 3, 0.12), PyramidLevel(120, 300, 3, 0.1))
"""Pyramid levels of the stages in which every camera moves by itself, before the finest one."""
FINEST = PyramidLevel(240, 300, 3, 0.1)
BEFORE_GAINS = PyramidLevel(60, 300, 1, 0.2)
"""Stage after which the brightness of the images is compared."""
GAIN_ROUNDS = 3
"""Number of times that the gains are estimated; the number of points that agree grows each time."""
SHARED = 5
"""Least number of points that two images must share for their brightness to be compared."""
LEAST_GAIN = 0.05
"""Largest log gain of any image at which all gains are ignored: shading and gloss have the same effect."""
LEAST_AGREED = 0.25
"""Least share of the points whose colour the views agree on after the finest stage."""
LEAST_COMPARED = 100
"""Least denominator of the share that is compared with LEAST_AGREED, so that a few points cannot reach it."""
LEAST_CONFIRMED = 0.4
"""Least share of the other images' points that an image must confirm, relative to the median image. Images with wrong
poses have 0.1 to 0.25; images of a robot that is off by 5 mm and 1° have 0.8."""
REGION = 0.05
"""Side, m, of the cubes within which points share their errors: they are pixels of one edge seen from many sides."""


def reconstruct_direct(capture: Capture, progress: Progress = silent) -> Reconstruction:
    """Reconstruct camera poses by photometric alignment, initialised from the gripper poses.

    Known intrinsics are kept; otherwise a focal length is estimated. The recon frame is the first camera's, and its
    unit is only roughly the metre. `evidence` holds the covariance of the cameras. Raises InputError with fewer than
    three images. Raises RejectedError where another hand-eye transform fits as well, or where the views agree on less
    than the share LEAST_AGREED of the points.
    """
    if len(capture) < 3:
        raise InputError(f"direct alignment needs 3 images or more, there are {len(capture)}; take more")
    images = [read_image(capture.folder / name) for name in capture.images]
    given, warnings = usable_intrinsics(capture.intrinsics)
    notes = ()
    intrinsics = given or guessed_intrinsics(capture.image_size)
    levels = pyramid(images, intrinsics)
    known = given is not None
    found = search(levels, capture.base_from_gripper, known, progress)
    factor = exposure_gains(levels[FREED[0].height], found)
    levels = {height: level.times(factor) for height, level in levels.items()}
    rows, cameras = images_that_fit(levels[FREED[0].height], found, known)
    if len(rows) < len(capture):
        names = ", ".join(name for k, name in enumerate(capture.images) if k not in rows)
        notes = (f"direct alignment: left out, for they fit nowhere near their poses: {names}",)
        levels = {height: level.rows(rows) for height, level in levels.items()}
    for k, stage in enumerate(FREED):
        progress("direct alignment", 0.7 + 0.1 * k)
        cameras, _ = align_photometrically(
            levels[stage.height], cameras, stage, free_directions(cameras, known)
        )
    level = levels[FINEST.height]
    cameras, points = align_photometrically(level, cameras, FINEST, free_directions(cameras, known))
    progress("direct alignment", 1.0)
    if (agreed := points.agreed.sum() / max(len(points.agreed), LEAST_COMPARED)) < LEAST_AGREED:
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
    """Return a factor per image that makes all images equally bright; all are 1 if no |log factor| exceeds LEAST_GAIN.

    The brightness of two images is compared at points of one that the other shows within twice BEFORE_GAINS.sigma. The
    logs of the factors have mean 0.
    """
    factor, dark, images = np.ones(level.count), 10 * LOCATED_FROM, np.arange(level.count)
    for _ in range(GAIN_ROUNDS):
        even = level.times(factor)
        _, points = align_photometrically(even, cameras, BEFORE_GAINS, np.zeros((7, 0)))
        _, u, v, seen = in_view(even, cameras, points)
        shown, own = sample(even.color, even, u, v).mean(-1), points.color.mean(-1)
        used = seen & points.agreed & (shown > dark) & (own > dark)
        used &= squared_misfit(even, points, u, v) < (2 * BEFORE_GAINS.sigma) ** 2
        ratio = np.log(np.maximum(shown, dark) / np.maximum(own, dark))
        # The logs of the brightness by least squares from those of their ratios; their mean is 0.
        rows, values = [np.ones(level.count)], [0.0]
        for image, host in np.ndindex(level.count, level.count):
            of_pair = used[image] & (points.host == host)
            if (count := of_pair.sum()) >= SHARED:
                rows.append(np.sqrt(count) * ((images == image) - 1.0 * (images == host)))
                values.append(np.sqrt(count) * np.median(ratio[image, of_pair]))
        factor /= np.exp(np.linalg.lstsq(np.stack(rows), np.array(values), rcond=None)[0])
    return factor if np.abs(np.log(factor)).max() > LEAST_GAIN else np.ones(level.count)


def images_that_fit(
    level: Level, cameras: Cameras, intrinsics_known: bool
) -> tuple[Int[ndarray, " m"], Cameras]:
    """Return the rows of the images that fit together, and their cameras, moved as one to fit these images alone.

    The measure is the share of the points of other images that an image shows in the same colour. An image with less
    than LEAST_CONFIRMED of the median share, even with a free camera, has a wrong pose or shows another scene. Raises
    RejectedError where fewer than three images are left.
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
        fits = share > LEAST_CONFIRMED * np.median(share)
        if fits.all():
            return rows, cameras
        if fits.sum() < 3:
            raise RejectedError("direct alignment: fewer than three images fit together", "take more")
        rows, level = rows[fits], level.rows(np.flatnonzero(fits))
        cameras = Cameras(cameras.base_from_camera[fits], cameras.zoom)


def pyramid(images: Sequence[UInt8[ndarray, "h w 3"]], intrinsics: Intrinsics) -> dict[int, Level]:
    """Undistort images (RGB, 0 to 255) and reduce them to the height of each stage; return the levels by height in px.

    `intrinsics` are those of the images as given, with distortion.
    """
    width, height = intrinsics.width, intrinsics.height
    grid = pinhole_inside(intrinsics, round(FINEST.height * max(width, height) / min(width, height)))
    stack = np.stack(list(map(undistortion(intrinsics, grid), images))).astype(np.float32) / 255
    heights = {*HEIGHTS, *(stage.height for stage in FREED), FINEST.height}
    return {height: make_level(stack, grid, height) for height in heights}


def camera_covariance(
    level: Level, cameras: Cameras, points: Points, sigma: float, directions: Float[ndarray, "p q"]
) -> Float[ndarray, "r r"]:
    """Return the covariance (6n,6n) of the camera poses' steps (records.CameraEvidence), in the first camera's axes.

    Each camera has six rows, translation (m) and rotation (rad). Residuals within one region of the scene are
    correlated. So the inverse normal matrix is scaled by the measured scatter of the regions' gradients. It is one
    factor, because there are too few regions for a full sandwich estimate. `sigma` is the colour difference of the
    robust cost (`equations`). The columns of `directions` are the free steps (`free_directions`).
    """
    system = equations(level, cameras, points, sigma, tied=False)
    inverse_normal = np.linalg.inv(directions.T @ system.normal @ directions)
    cell = np.floor(in_base(level, cameras, points) / REGION).astype(np.int64)
    region = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    score = np.zeros((region.max() + 1, directions.shape[1]))
    np.add.at(score, region, system.gradient @ directions)
    spread = np.einsum("bp,pq,bq->", score, inverse_normal, score) / directions.shape[1]
    first_from_camera = inverse(cameras.base_from_camera[0]) @ cameras.base_from_camera
    steps = block_diag(*step_axes(first_from_camera[:, :3, :3])) @ directions[:-1]
    return spread * steps @ inverse_normal @ steps.T


def _tracks(level: Level, cameras: Cameras, points: Points, sigma: float, intrinsics: Intrinsics) -> Tracks:
    """Return tracks of the points: a pixel in the point's host image, and one in each image that shows its colour.

    An image shows the colour if it differs by less than `sigma` (RGB, 0 to 1). Pixels are those of images with
    `intrinsics`, and points are in the first camera's frame, m.
    """
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
