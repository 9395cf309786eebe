"""The back end of a model that sees one view at a time: COLMAP's cameras, its depth.

Structure from motion gives cameras and points, which are exact and few; the model gives every pixel a depth, which
bends. Each view's depth is multiplied by the smooth factor that fits the points (refine.depth_changes). The model's
metre becomes the unit, so that the calibration holds it against the robot's.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jcr.camera import project, rays, unproject
from jcr.errors import InputError
from jcr.geometry import apply
from jcr.progress import Progress, silent
from jcr.reconstruct.hub import Weights
from jcr.reconstruct.preprocess import ImageGrid, prepare_images, resize_and_crop
from jcr.reconstruct.views_at_once.interface import Predict, Views
from jcr.reconstruct.views_at_once.refine import depth_changes, smooth_factor
from jcr.reconstruct.views_at_once.views_at_once import loaded, with_known_rays
from jcr.records import Capture, Pointmaps, Reconstruction

LEAST_POINTS = 5
"""Of structure from motion, in a view; with fewer its depth has the unit of the others."""


@dataclass(frozen=True, kw_only=True)
class SingleViewsOptions:
    """One model, and where the cameras come from."""

    load: Callable[[Path, str], Predict]
    weights: Weights
    cameras: Callable[[Capture, Progress | None], Reconstruction]
    """Cameras and tracks of the images that it can place; its pointmaps are not used."""
    device: str = "cpu"


def reconstruct_single_views(
    capture: Capture,
    options: SingleViewsOptions,
    progress: Progress | None = None,
) -> Reconstruction:
    """Cameras and tracks of the one, pointmaps of the other, in the model's metres.

    Raises what `cameras` raises, and InputError for weights that are missing or damaged.
    """
    report = progress or silent
    predict = loaded(options.load, options.weights.path, options.device)
    sparse = options.cameras(capture, progress)
    placed = replace(
        capture,
        images=tuple(capture.images[row] for row in sparse.image_index),
        base_from_gripper=capture.base_from_gripper[sparse.image_index],
        intrinsics=sparse.intrinsics,
    )
    images = prepare_images(placed, lambda size: ImageGrid.uncropped(size, size))
    assert (
        images.pinhole is not None and images.intrinsics_of_capture is not None
    )  # structure from motion found them
    report("reconstruct", 0.0)
    predicted = with_known_rays(predict(Views(images.colors, images.pinhole)), images)
    report("reconstruct", 1.0)
    grid, there = predicted.grid, predicted.confidence > 0
    undistorted = project(images.pinhole, unproject(images.intrinsics_of_capture, sparse.tracks.x_px))
    tracks = replace(sparse.tracks, x_px=grid.grid_from_original(undistorted))
    depth = np.where(there, predicted.x_in_camera[..., 2], 0)
    changes = np.array(depth_changes(tracks, sparse.recon_from_camera, depth))
    few = np.bincount(tracks.image, minlength=len(depth)) < LEAST_POINTS
    if few.all():
        raise InputError("--backend moge: structure from motion gave too few points; take another")
    typical = float(np.median(changes[~few, 0]))
    changes[few] = [typical, 0, 0, 0, 0, 0]
    # The model's metre: the median over the views, before each is fitted.
    unit = float(np.exp(-typical))
    factor = unit * np.stack([smooth_factor(change, *depth.shape[1:]) for change in changes])
    poses = sparse.recon_from_camera.copy()
    poses[:, :3, 3] *= unit
    in_camera = (factor * depth)[..., None] * rays(grid.grid_intrinsics(images.pinhole))
    points = np.stack([apply(pose, mine) for pose, mine in zip(poses, in_camera, strict=True)])
    return replace(
        sparse,
        recon_from_camera=poses,
        pointmaps=Pointmaps(
            intrinsics=grid.grid_intrinsics(images.pinhole),
            points_in_recon=np.where(there[..., None], points, 0).astype(np.float32),
            confidence=predicted.confidence,
            colors=np.stack([resize_and_crop(image, grid) for image in images.colors]),
        ),
        tracks=replace(sparse.tracks, points_in_recon=unit * sparse.tracks.points_in_recon),
        backend="moge",
        is_metric=predicted.is_metric,
        notes=(options.weights.note, *sparse.notes),
    )
