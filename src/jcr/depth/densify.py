"""The stage densify: a reconstruction's cameras and tracks to dense pointmaps, whichever back end found them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.camera import pinhole_inside, undistortion
from jcr.capture.images import read_image
from jcr.depth.dense import dense_pointmaps
from jcr.depth.options import DepthOptions
from jcr.depth.views import choose_neighbours, sweep_planes
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks

RISE = 0.4
"""Share of a camera's distance to a board that things beside it may rise towards the camera."""


def densify(
    capture: Capture,
    reconstruction: Reconstruction,
    options: DepthOptions | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Return the reconstruction with pointmaps of its images; those that a network predicted stay.

    Only cameras, intrinsics and tracks are used, so that it may come before or after the calibration.
    Raises InputError where an image cannot be read.
    """
    if reconstruction.pointmaps is not None:
        return reconstruction
    options = options or DepthOptions()
    names = np.array([capture.images[row] for row in reconstruction.image_index])
    order = np.argsort(names, kind="stable")  # so that the order of the frames changes nothing
    place = np.argsort(order)
    cameras = reconstruction.recon_from_camera[order]
    tracks = replace(reconstruction.tracks, image=place[reconstruction.tracks.image])
    pinhole, colors = undistorted(
        capture.folder, names[order].tolist(), reconstruction.intrinsics, options.pointmap_size_px
    )
    pointmaps = dense_pointmaps(
        colors,
        cameras,
        pinhole,
        choose_neighbours(tracks, cameras, options.neighbours),
        _planes(tracks, cameras),
        progress or silent,
        priors=options.priors,
    )
    return replace(reconstruction, pointmaps=pointmaps.of_rows(place))


def undistorted(
    folder: Path, names: Sequence[str], intrinsics: Intrinsics, size_px: int = DepthOptions.pointmap_size_px
) -> tuple[Intrinsics, UInt8[ndarray, "m h w 3"]]:
    """Return the pinhole grid of pointmaps whose long side is `size_px` at most, and the images on it."""
    pinhole = pinhole_inside(intrinsics, size_px)
    undistort = undistortion(intrinsics, pinhole)
    return pinhole, np.stack([undistort(read_image(folder / name)) for name in names])


def _planes(tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"]) -> Float[ndarray, "m 2 3"]:
    """Return the two planes of each image that bound its surfaces."""
    return sweep_planes(
        _raised(tracks, recon_from_camera) if tracks.from_board else tracks, recon_from_camera
    )


def _raised(tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"]) -> Tracks:
    """Return the points, and the same points raised as far towards the cameras as objects beside the board may rise."""
    on_board = tracks.points_in_recon
    middle = recon_from_camera[:, :3, 3].mean(0)
    raised = on_board + RISE * (middle - on_board)
    return replace(
        tracks,
        image=np.tile(tracks.image, 2),
        x_px=np.tile(tracks.x_px, (2, 1)),
        point=np.concatenate([tracks.point, tracks.point + len(on_board)]),
        points_in_recon=np.concatenate([on_board, raised]),
    )
