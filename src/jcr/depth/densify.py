"""Stage that estimates dense pointmaps from the cameras and tracks of a reconstruction of any back end."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import pinhole_inside, rays, undistortion
from jcr.capture.images import read_image
from jcr.depth.options import DepthOptions
from jcr.geometry import apply, inverse, transform
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Pointmaps, Reconstruction, Tracks

RISE = 0.4
"""Greatest height of objects beside a board, as a share of the distance from the board to the cameras."""
NO_PLANE = (0.0, 0.0, 1.0)
"""Plane that is searched in an image with no point before its camera, in which no depth is found anyway."""
MOST_THREADS = 16
"""Largest number of images that are matched at once; each takes about 400 bytes per pixel during the matching."""


def densify(
    capture: Capture,
    reconstruction: Reconstruction,
    options: DepthOptions | None = None,
    progress: Progress = silent,
) -> Reconstruction:
    """Return the reconstruction with pointmaps estimated from its images, or unchanged if it has pointmaps.

    Only the capture's images and the reconstruction's cameras, intrinsics and tracks are used. The stage may therefore
    run before or after the calibration. Raises InputError for an image that cannot be read.
    """
    if reconstruction.pointmaps is not None:
        return reconstruction
    options = options or DepthOptions()
    names = np.array([capture.images[row] for row in reconstruction.image_index])
    order = np.argsort(names, kind="stable")  # the result does not depend on the order of the images
    place = np.argsort(order)
    cameras = reconstruction.recon_from_camera[order]
    tracks = replace(reconstruction.tracks, image=place[reconstruction.tracks.image])
    searched = tracks
    if tracks.from_board:  # objects rise above the board: a copy of its points, moved towards the cameras
        on_board = tracks.points_in_recon
        raised = on_board + RISE * (cameras[:, :3, 3].mean(0) - on_board)
        searched = replace(
            tracks,
            image=np.tile(tracks.image, 2),
            x_px=np.tile(tracks.x_px, (2, 1)),
            point=np.concatenate([tracks.point, tracks.point + len(on_board)]),
            points_in_recon=np.concatenate([on_board, raised]),
        )
    pinhole = pinhole_inside(reconstruction.intrinsics, options.pointmap_size_px)
    pointmaps = dense_pointmaps(
        undistorted(capture.folder, names[order].tolist(), reconstruction.intrinsics, pinhole),
        cameras,
        pinhole,
        choose_neighbours(tracks, cameras, options.neighbours),
        sweep_planes(searched, cameras),
        progress,
        priors=options.priors,
    )
    return replace(reconstruction, pointmaps=pointmaps.of_rows(place))


def undistorted(
    folder: Path, names: Sequence[str], intrinsics: Intrinsics, pinhole: Intrinsics
) -> UInt8[ndarray, "m h w 3"]:
    """Read the RGB images `names` in `folder`; return them without distortion, on the pixel grid of `pinhole`.

    `intrinsics` are those of the files' images. Colours are interpolated bilinearly, and averaged over areas if
    `pinhole` has fewer pixels.
    """
    undistort = undistortion(intrinsics, pinhole)
    return np.stack([undistort(read_image(folder / name)) for name in names])


def choose_neighbours(
    tracks: Tracks, recon_from_camera: Float[ndarray, "m 4 4"], count: int
) -> list[Int[ndarray, " _"]]:
    """Return for each of m images the indices of `count` other images to match with, best first.

    There are fewer only if m - 1 is less than `count`. The score is the sum, over shared points, of a weight that
    depends on the angle between the two rays. The weight is largest at 15°, as in MVSNet (Yao et al. 2018).
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
    """Return for each image the farthest and nearest plane of its depth search, as vectors p with p·x_in_camera = 1.

    The inverse depth of a pixel on plane p is p·(x/z, y/z, 1). Both planes share the slope (p₀, p₁) of a plane fitted
    to the image's track points, mostly the table. The fit uses least absolute deviations of inverse depth. Percentiles
    1 to 99 of the points lie between the two planes, with a margin. The margin is 15 % of the interval plus 2 % of the
    median inverse depth. Planes parallel to the image gave 6 % fewer pixels with depth, and 1.6 times the median error.
    """
    planes = np.empty((len(recon_from_camera), 2, 3))
    for i, camera_from_recon in enumerate(inverse(recon_from_camera)):
        x = _before_camera(apply(camera_from_recon, tracks.points_in_recon[tracks.point[tracks.image == i]]))
        if len(x) == 0:  # of an image that shares no point with others, the whole scene is searched
            x = _before_camera(apply(camera_from_recon, tracks.points_in_recon))
        if len(x) == 0:
            planes[i] = NO_PLANE
            continue
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


def _before_camera(x_in_camera: Float[ndarray, "n 3"]) -> Float[ndarray, "k 3"]:
    """Return those of n points that lie before the camera."""
    return x_in_camera[x_in_camera[:, 2] > 0]


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
    """Estimate pointmaps (recon frame) of m undistorted images, with confidence, origin of the depth, and its std.

    All images are on the pixel grid of `pinhole`; `neighbours` and `planes` come from `choose_neighbours` and
    `sweep_planes`. The confidence of a match is its correlation times the number of images that agree, twice that on a
    fitted plane. With `priors`, fitted planes give depth where no match is found, with confidence 0.5 per image that
    agrees. The confidence is 0 without an estimate. `before` are pointmaps of the first images, from an earlier time.
    With `before`, only later images are matched, the scene may have changed, and `priors` is ignored; the result has
    all m images.
    """
    from jcr.depth.fusion import fused_depth
    from jcr.depth.patch_match_stereo import match_depth

    threads = min(os.cpu_count() or 1, MOST_THREADS)
    images = colors, recon_from_camera, pinhole, neighbours
    old = 0 if before is None else len(before.colors)
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
    # Values are rounded as in depth.npz, so that a run that reads the file gives the same map.
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
    """Return pointmaps from the depths (z, recon units) of undistorted images with known camera poses.

    All images are on the pixel grid of `pinhole`. `relative_std` is the standard deviation of a depth divided by the
    depth. `reason` is the origin of a depth: NO_DEPTH, MATCHED, PRIOR or BOTH.
    """
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
    """Compile every numba loop of dense depth, or load it from the cache, by a run on three small random images."""
    pinhole = Intrinsics(75.0, 75.0, 39.5, 29.5, 80, 60)
    wall = np.random.default_rng(0).integers(0, 256, (30, 60, 3)).repeat(2, 0).repeat(2, 1).astype(np.uint8)
    images = np.stack([wall[:, 10 * k : 10 * k + pinhole.width] for k in range(3)])
    cameras = transform(np.eye(3), np.array([[0.1 * k, 0.0, 0.0] for k in range(3)]))
    neighbours = [np.array([1, 2]), np.array([0, 2]), np.array([1, 0])]
    planes = np.tile([[[0.0, 0.0, 0.3], [0.0, 0.0, 2.5]]], (3, 1, 1))
    dense_pointmaps(images, cameras, pinhole, neighbours, planes, silent)
