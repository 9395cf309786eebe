"""The stage densify: a reconstruction's cameras and tracks to dense pointmaps, whichever back end found them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.allocator import give_back
from jcr.camera import pinhole_inside, rays, undistortion
from jcr.capture.images import read_image
from jcr.depth.options import DepthOptions
from jcr.geometry import apply, inverse, transform
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Pointmaps, Reconstruction, Tracks

RISE = 0.4
"""Share of a camera's distance to a board that things beside it may rise towards the camera."""
MOST_THREADS = 16
"""Images that are matched at once. Each takes about 400 bytes per pixel while it is matched."""


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
    pinhole = pinhole_inside(reconstruction.intrinsics, options.pointmap_size_px)
    pointmaps = dense_pointmaps(
        undistorted(capture.folder, names[order].tolist(), reconstruction.intrinsics, pinhole),
        cameras,
        pinhole,
        choose_neighbours(tracks, cameras, options.neighbours),
        sweep_planes(_raised(tracks, cameras) if tracks.from_board else tracks, cameras),
        progress or silent,
        priors=options.priors,
    )
    return replace(reconstruction, pointmaps=pointmaps.of_rows(place))


def undistorted(
    folder: Path, names: Sequence[str], intrinsics: Intrinsics, pinhole: Intrinsics
) -> UInt8[ndarray, "m h w 3"]:
    """Return the images on the pinhole grid of pointmaps."""
    undistort = undistortion(intrinsics, pinhole)
    return np.stack([undistort(read_image(folder / name)) for name in names])


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


def choose_neighbours(
    tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"], count: int
) -> list[Int[ndarray, " _"]]:
    """Return the rows of up to `count` others for each image that share most points under a useful angle.

    The angle's weight has the form of MVSNet's (Yao et al., ECCV 2018, section 4.1), its best at 15°.
    """
    m = len(recon_from_camera)
    seen = np.zeros((m, len(tracks.points_in_recon)), dtype=bool)
    seen[tracks.image, tracks.point] = True
    towards = recon_from_camera[:, None, :3, 3] - tracks.points_in_recon
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    chosen = []
    for i in range(m):
        angle_deg = np.degrees(np.arccos(np.clip((towards[i] * towards).sum(-1), -1, 1)))
        weight = np.exp(-(((angle_deg - 15) / np.where(angle_deg < 15, 7, 15)) ** 2) / 2)
        score = (weight * (seen & seen[i])).sum(1)
        score[i] = -1.0
        chosen.append(np.argsort(-score, kind="stable")[: min(count, m - 1)])
    return chosen


def sweep_planes(tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"]) -> Float[ndarray, "m 2 3"]:
    """Return two planes p·x_in_camera = 1 for each image, so that p·(x/z, y/z, 1) is a pixel's inverse depth.

    All have the slope of the plane that the image's points lie on best, mostly the table (least absolute
    deviations of inverse depth); between them lie the points from percentile 1 to 99, with some slack.
    With fronto-parallel planes 6 % fewer pixels got a depth, and its median error was 1.6 times as large.
    """
    planes = np.empty((len(recon_from_camera), 2, 3))
    for i, camera_from_recon in enumerate(inverse(recon_from_camera)):
        x = apply(camera_from_recon, tracks.points_in_recon[tracks.point[tracks.image == i]])
        ray, inverse_depth = x / x[:, 2:], 1 / x[:, 2]
        slope, residual = np.zeros(3), inverse_depth
        for _ in range(20):
            weight = 1 / np.sqrt(np.maximum(np.abs(residual), 1e-3 * np.median(inverse_depth)))
            slope = np.linalg.lstsq(ray * weight[:, None], inverse_depth * weight, rcond=None)[0]
            residual = inverse_depth - ray @ slope
        low, high = np.percentile(residual, [1, 99])
        slack = 0.15 * (high - low) + 0.02 * np.median(inverse_depth)
        planes[i] = slope
        planes[i, :, 2] += low - slack, high + slack
    return planes


def dense_pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    planes: Float[ndarray, "m 2 3"],
    report: Progress,
    *,
    priors: bool = True,
    before: Pointmaps | None = None,
) -> Pointmaps:
    """Estimate points in the recon frame for the pixels of undistorted images, with confidence, reason and sigma.

    The confidence is the correlation times the number of images that agree, 0 for no estimate. `neighbours` and
    `planes` are those of `choose_neighbours` and `sweep_planes`. `before`: pointmaps of the first images, taken at
    another time, whose depth is compared and not matched again; then an image that sees through a point of another one
    may show an earlier scene, and nothing is filled by `priors`.
    """
    from jcr.depth.fused import fused_depth
    from jcr.depth.matched import match_depth

    threads = min(os.cpu_count() or 1, MOST_THREADS)
    images, old = (
        (colors, recon_from_camera, pinhole, neighbours),
        0 if before is None else len(before.colors),
    )
    inverse_depth, score = match_depth(
        *images, planes, range(old, len(colors)), threads, lambda done: report("dense depth", 0.7 * done)
    )
    give_back()
    if before is not None:
        known = before.confidence > 0
        pairs = zip(inverse(recon_from_camera), before.points_in_recon, strict=False)
        z = np.where(known, np.stack([apply(pose, x)[..., 2] for pose, x in pairs]), 1.0)
        inverse_depth = np.concatenate([(1 / z).astype(np.float32), inverse_depth])
        score = np.concatenate([np.where(known, 1, -1).astype(np.float32), score])
    inverse_depth, confidence, reason, std = fused_depth(
        *images,
        inverse_depth,
        score,
        changing=before is not None,
        priors=priors and before is None,
        threads=threads,
        report=lambda done: report("dense depth", 0.7 + 0.3 * done),
    )
    # In the precision of depth.npz, so that a run that reads the file gives the same map.
    depth = (1 / inverse_depth.astype(np.float64)).astype(np.float32)
    precise = depth, std.astype(np.float16), confidence.astype(np.float16)
    return pointmaps_of(*precise, reason, colors, recon_from_camera, pinhole)


def pointmaps_of(
    depth: Float[ndarray, "m h w"],
    relative_std: Float[ndarray, "m h w"],
    confidence: Float[ndarray, "m h w"],
    reason: UInt8[ndarray, "m h w"],
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
) -> Pointmaps:
    """Return the pointmaps of depths (z, recon units) with their relative standard deviation, on known cameras."""
    points, direction = np.empty((*depth.shape, 3)), rays(pinhole)
    for k, pose in enumerate(recon_from_camera):
        points[k] = (depth[k, ..., None].astype(np.float64) * direction) @ pose[:3, :3].T + pose[:3, 3]
    return Pointmaps(
        intrinsics=pinhole,
        points_in_recon=points,
        confidence=confidence.astype(np.float64),
        colors=colors,
        reason=reason,
        depth_std=relative_std.astype(np.float32) * depth,
    )


def compile_loops() -> None:
    """Compile or load every loop of dense depth: estimate the depth of a small wall of noise before three cameras."""
    pinhole = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    wall = np.random.default_rng(0).integers(0, 256, (30, 60, 3)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    images = np.stack([wall[:, 10 * k : 10 * k + pinhole.width] for k in range(3)])
    cameras = transform(np.eye(3), np.array([[0.1 * k, 0.0, 0.0] for k in range(3)]))
    neighbours = [np.array([1, 2]), np.array([0, 2]), np.array([1, 0])]
    planes = np.tile([[[0.0, 0.0, 0.3], [0.0, 0.0, 2.5]]], (3, 1, 1))
    dense_pointmaps(images, cameras, pinhole, neighbours, planes, silent)
