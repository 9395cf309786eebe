"""Reconstruction from pointmaps: bundle adjustment of matches where the images match, else the predicted cameras."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import without_distortion
from jcr.errors import InputError
from jcr.extras import xfeat_is_installed
from jcr.features.matchers import FeatureName
from jcr.geometry import apply, inverse
from jcr.pointmaps.global_alignment.align import global_align
from jcr.pointmaps.image_grid import PreparedImages
from jcr.pointmaps.pair_predictions import PairPredictions
from jcr.pointmaps.posed_pointmaps import FOCAL_STD, PosedPointmaps, fit_pinhole, published_covariance
from jcr.progress import Progress, silent
from jcr.records import CameraEvidence, Capture, Intrinsics, Pointmaps, Reconstruction, Tracks
from jcr.sfm.colmap import reconstruct_near_cameras

NO_TRACKS = Tracks(
    image=np.zeros(0, int), x_px=np.zeros((0, 2)), point=np.zeros(0, int), points_in_recon=np.zeros((0, 3))
)

UNCONFIRMED = (
    f"the focal length is that of the network and known to {100 * FOCAL_STD:.0f} % only, for too few matches between "
    "the images confirm it; give the intrinsics"
)
LEAST_MATCHES = 70
"""Least number of observations in every image for a refinement. The calibration adjusts the tracks of three images from
200 observations on."""
BEND_STD = 0.03
"""Prior standard deviation of the coefficients, except the constant, of the log of a depth correction."""


def align_pairs(
    predictions: PairPredictions, images: PreparedImages, progress: Progress = silent
) -> PosedPointmaps:
    """Return pointmaps and camera poses in the first image's camera frame, from pairwise pointmaps by global alignment.

    The focal length is estimated from the pointmaps, even if the intrinsics are known. With another focal length, the
    pointmaps do not fit each other, and the cameras move.
    """
    alignment = global_align(replace(predictions, intrinsics=images.intrinsics), progress=progress)
    return PosedPointmaps(
        grid=images.grid,
        recon_from_camera=alignment.recon_from_camera,
        x_in_camera=alignment.x_in_camera(),
        confidence=alignment.confidence,
        is_metric=predictions.is_metric,
        covariance=alignment.covariance,
        notes=alignment.notes,
        warnings=alignment.warnings,
    )


def reconstruct_pointmaps(
    capture: Capture,
    images: PreparedImages,
    maps: PosedPointmaps,
    backend: str,
    progress: Progress = silent,
    image_index: Int[ndarray, " m"] | None = None,
    refining: bool = True,
) -> Reconstruction:
    """Return the reconstruction of the capture's images `image_index` (None: all) from their pointmaps and matches.

    If the images have too few matches (`refine`), or without `refining`, the predicted cameras are kept, and their
    covariance is in `evidence`. Raises InputError where the points fit no pinhole camera.
    """
    rows = np.arange(len(capture)) if image_index is None else image_index
    part = capture.of_rows(rows)
    found, misfit_px = fit_pinhole(maps)
    predicted = maps.grid.original_intrinsics(found) if np.isfinite(misfit_px) else None
    if (pinhole := images.pinhole or predicted) is None:
        raise InputError(f"backend {backend}: its points lie on no pinhole's rays; give the intrinsics")
    maps = maps.on_rays(maps.grid.grid_intrinsics(pinhole))
    refined = refine(part, images, maps, pinhole, progress) if refining else None
    if refined is None:
        intrinsics = images.intrinsics_of_capture or pinhole
        covariance = published_covariance(maps) if maps.covariance is None else maps.covariance
        tracks, evidence = NO_TRACKS, CameraEvidence(maps.recon_from_camera, covariance)
        note = "too few matches between the images: the cameras are as predicted" if refining else ""
        if images.pinhole is None and refining:
            maps = replace(maps, warnings=(*maps.warnings, UNCONFIRMED))
    else:
        (made, maps), evidence = refined, None
        tracks, intrinsics = made.tracks, made.intrinsics
        pinhole = images.pinhole or without_distortion(intrinsics)
        maps = maps.on_rays(maps.grid.grid_intrinsics(pinhole))
        note = f"cameras refined by {len(tracks.image)} matches"
    points = np.stack([apply(*each) for each in zip(maps.recon_from_camera, maps.x_in_camera, strict=True)])
    pointmaps = Pointmaps(
        intrinsics=maps.grid.grid_intrinsics(pinhole),
        points_in_recon=np.where((maps.confidence > 0)[..., None], points, 0).astype(np.float32),
        confidence=maps.confidence,
        colors=images.colors,
    )
    return Reconstruction(
        image_index=rows,
        recon_from_camera=maps.recon_from_camera,
        intrinsics=intrinsics,
        pointmaps=pointmaps,
        tracks=tracks,
        backend=backend,
        is_metric=maps.is_metric,
        notes=(*maps.notes, *filter(None, [note])),
        warnings=(*images.warnings, *maps.warnings),
        evidence=evidence,
        predicted_focal=None if refined or predicted is None else (predicted.fx, FOCAL_STD),
    )


def refine(
    capture: Capture,
    images: PreparedImages,
    maps: PosedPointmaps,
    pinhole: Intrinsics,
    report: Progress = silent,
) -> tuple[Reconstruction, PosedPointmaps] | None:
    """Adjust the predicted cameras to matches of SIFT, or else of learned features, and the depth maps to the points.

    `capture` has the images of `maps`, in the same order. Returns the reconstruction from the matches and the adjusted
    pointmaps, both in the unit of the prediction. Returns None where an image has fewer than LEAST_MATCHES
    observations. `pinhole` belongs to the undistorted images and is the initial estimate of unknown intrinsics.
    """
    given = images.intrinsics_of_capture
    kinds: tuple[FeatureName, ...] = ("sift", "xfeat") if xfeat_is_installed() else ("sift",)
    for kind in kinds:
        made = reconstruct_near_cameras(
            capture, maps.recon_from_camera, given or pinhole, given is not None, kind, report
        )
        if made is None or np.bincount(made.tracks.image).min() < LEAST_MATCHES:
            continue
        change, unit = _depth_changes(made, maps, images.grid_px(made.tracks.x_px))
        poses, tracks = made.recon_from_camera.copy(), made.tracks
        poses[:, :3, 3] *= unit
        tracks = replace(tracks, points_in_recon=unit * tracks.points_in_recon)
        v, u = np.mgrid[: maps.grid.size[1], : maps.grid.size[0]]
        factor = np.exp(np.einsum("hwc,nc->nhw", _basis(np.stack([u, v], -1), maps.grid.size), change))
        maps = replace(
            maps, recon_from_camera=poses, x_in_camera=maps.x_in_camera * factor[..., None].astype(np.float32)
        )
        return replace(made, recon_from_camera=poses, tracks=tracks), maps
    return None


def _basis(x_px: Float[ndarray, "*k 2"], size: tuple[int, int]) -> Float[ndarray, "*k 6"]:
    """Return 1, x, y, x², xy, y² of pixels, with x and y scaled to -1 … 1 over an image of `size` (width, height)."""
    scaled = 2 * x_px / (np.array(size) - 1) - 1
    x, y = scaled[..., 0], scaled[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _depth_changes(
    made: Reconstruction, maps: PosedPointmaps, x_px: Float[ndarray, "k 2"]
) -> tuple[Float[ndarray, "n 6"], float]:
    """Fit a smooth correction of each image's depth map to the points; return its coefficients (n,6) and a unit.

    The correction factor multiplies the z of `maps`, read at the nearest pixel. Its log is quadratic in the image, with
    coefficients in the order of `_basis`; they are 0 for an image without points. The unit is that of the
    reconstruction `made`, in units of the prediction. `x_px` are the pixels of the k observations in `made.tracks` on
    the pointmaps' grid. The fit is robust. A prior on all coefficients but the constant (BEND_STD) keeps five points in
    a corner from changing the depth elsewhere.
    """
    tracks, size = made.tracks, maps.grid.size
    camera_from_recon = inverse(made.recon_from_camera)[tracks.image]
    z = np.einsum("kj,kj->k", camera_from_recon[:, 2, :3], tracks.points_in_recon[tracks.point])
    z += camera_from_recon[:, 2, 3]
    column, row = np.clip(np.rint(x_px), 0, np.array(size) - 1).astype(int).T
    own = maps.x_in_camera[tracks.image, row, column, 2]
    usable = (maps.confidence[tracks.image, row, column] > 0) & (own > 0) & (z > 0)
    usable &= ((x_px > -0.5) & (x_px < np.array(size) - 0.5)).all(1)
    target = np.log(np.where(usable, z, 1.0) / np.where(usable, own, 1.0))
    shift = float(np.median(target[usable])) if usable.any() else 0.0
    found = np.zeros((len(maps.recon_from_camera), 6))
    for view, coefficients in enumerate(found):
        mine = usable & (tracks.image == view)
        if not mine.any():
            continue
        design, wanted = _basis(x_px[mine], size), target[mine] - shift
        coefficients[0] = np.median(wanted)
        for _ in range(10):
            off = wanted - design @ coefficients
            sigma = 1.4826 * np.median(np.abs(off)) + 1e-4
            weight = 1 / (1 + (off / (2 * sigma)) ** 2) / sigma**2
            normal = design.T @ (weight[:, None] * design) + 1e-9 * np.eye(6)
            normal[1:, 1:] += np.eye(5) / BEND_STD**2
            coefficients[:] = np.linalg.solve(normal, design.T @ (weight * wanted))
    return found, float(np.exp(-shift))
