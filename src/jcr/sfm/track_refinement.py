"""Least-squares matching of the observations of a track with one of them, its reference.

Method: Gruen, "Adaptive least squares correlation", 1985, with derivatives of the reference (inverse composition; Baker
and Matthews, IJCV 2004). The warp is that of a plane that faces the cameras, with a free affine part, gain and offset.
Of three sizes of the patch, the one with the smallest variance is used (Förstner 1982, geometric precision).
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import by_point, project, unproject
from jcr.geometry import inverse
from jcr.numba_compile import compiled, inlined
from jcr.records import Intrinsics, Tracks

MOST_PX = 4.0
"""Largest distance, px, of an aligned observation from its keypoint; farther away is another feature, as in COLMAP."""
LEAST_CORRELATION = 0.9
"""Least correlation of an aligned patch with the reference."""
KEYPOINT_STD_PX = 0.3
"""Standard deviation of a keypoint, px, and the largest one of an aligned observation."""
_REDUCED = (4, 2, 1)
"""Factors by which the images are reduced, and so the patch enlarged; each level starts from the one before."""
_RADIUS, _WINDOW = 7, 4.5
"""Half of the patch's side, and standard deviation of its weights, in pixels of the reduced image."""
_STEPS, _SETTLED_PX = 15, 0.01
"""Largest number of Gauss-Newton steps, and shift (px) below which they end."""
_BEND_AT_PX = 6.0
"""Distance, px, from the reference's keypoint at which the warp is sampled for its derivatives."""
_FREE = 8
"""Number of unknowns: shift x and y, gain, offset, and the affine part row by row."""
_STEEPEST = 5.0
"""Largest scale from one image to another; a larger one means that the warp is invalid."""
_POINTS_AT_ONCE = 64
"""Number of tracks that a thread aligns at a time."""
_FLAT = 1e-3
"""Standard deviation, in grey levels, below which a patch has no texture."""
_OFFSETS = np.stack(np.meshgrid(*[np.arange(-_RADIUS, _RADIUS + 1.0)] * 2), -1).reshape(-1, 2)
"""Offsets (n,2), x and y in px, of the pixels of a patch from its centre, row by row."""
_WEIGHTS = np.exp(-0.5 * (_OFFSETS**2).sum(1) / _WINDOW**2)
_WEIGHTS /= _WEIGHTS.sum()
"""Gaussian weights (n) of the pixels of a patch, with the sum 1."""


def align_tracks(
    greys: UInt8[ndarray, "m h w"],
    tracks: Tracks,
    recon_from_camera: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
) -> Tracks:
    """Return the tracks with observations aligned to one reference observation per track by least-squares matching.

    The result has standard deviations in px (`std_px`). `greys` are the images in the order of the cameras. Images,
    tracks and `intrinsics` are of one size. The reference is the observation at the median scale, and keeps its pixel.
    """
    order = np.lexsort((tracks.image, tracks.point))
    image, x_px, point = tracks.image[order], tracks.x_px[order].astype(np.float64), tracks.point[order]
    begins = np.flatnonzero(np.diff(point, prepend=-1))
    ends = np.append(begins, len(point))
    # The normal of a point's assumed plane is the sum of the unit vectors from the point to its cameras. Planes through
    # neighbouring points gave the same result, because the affine part of a warp is free.
    x_in_recon = tracks.points_in_recon[point]
    toward = recon_from_camera[tracks.image, :3, 3] - tracks.points_in_recon[tracks.point]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    facing = np.stack([np.bincount(tracks.point, along) for along in toward.T], axis=1)[point]
    # An area on this plane appears in an image with a factor det [J; nᵀ], times the same constant in all images.
    camera_from_recon = inverse(recon_from_camera)[image]
    by_recon = by_point(intrinsics, _x_in_b(camera_from_recon, x_in_recon)) @ camera_from_recon[:, :3, :3]
    rank = np.lexsort((np.abs(np.linalg.det(np.concatenate([by_recon, facing[:, None]], axis=1))), point))
    reference = rank[(ends[:-1] + ends[1:]) // 2]
    of_reference = np.repeat(reference, np.diff(ends))
    warp, bend = _warps(x_px, image, x_in_recon, facing, of_reference, recon_from_camera, intrinsics)

    first = range(0, len(reference), _POINTS_AT_ONCE)
    parts = [slice(ends[k], ends[min(k + _POINTS_AT_ONCE, len(reference))]) for k in first]
    of_parts = [of_reference[part] - part.start for part in parts]
    start_px, start_affine = x_px.copy(), warp
    found, variance = x_px.copy(), np.full(len(point), KEYPOINT_STD_PX**2)
    for reduced in _REDUCED:
        size = max(greys.shape[2] // reduced, 1), max(greys.shape[1] // reduced, 1)
        level = np.stack([cv2.resize(grey, size, interpolation=cv2.INTER_AREA) for grey in greys])
        factor = np.array(size) / [intrinsics.width, intrinsics.height]
        keypoint_px, aligned_px = ((at + 0.5) * factor - 0.5 for at in (x_px, start_px))
        affine = start_affine.copy()
        # Each thread writes only to observations of its own tracks.
        job = (
            [of_all[part] for part in parts]
            for of_all in (image, keypoint_px, aligned_px, affine, bend * reduced)
        )
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            variances = pool.map(partial(_align_all, level, MOST_PX / reduced), of_parts, *job)
        variance_px = reduced**2 * np.concatenate([np.empty(0), *variances])
        aligned, better = variance_px < KEYPOINT_STD_PX**2, variance_px < variance
        start_px[aligned] = (aligned_px[aligned] + 0.5) / factor - 0.5
        start_affine[aligned] = affine[aligned]
        found[better], variance[better] = start_px[better], variance_px[better]
    # The variance of a reference is the harmonic mean of those of the observations aligned to it.
    aligned = variance < KEYPOINT_STD_PX**2
    count = np.bincount(of_reference, aligned, len(variance))[reference]
    inverse_sum = np.bincount(of_reference, aligned / variance, len(variance))[reference]
    variance[reference] = np.where(count > 0, count / np.maximum(inverse_sum, 1e-12), KEYPOINT_STD_PX**2)
    refined, std_px = np.empty_like(found), np.empty(len(found))
    refined[order], std_px[order] = found, np.sqrt(variance)
    return replace(tracks, x_px=refined, std_px=std_px)


def _warps(
    x_px: Float[ndarray, "k 2"],
    image: Int[ndarray, " k"],
    x_in_recon: Float[ndarray, "k 3"],
    facing: Float[ndarray, "k 3"],
    of_reference: Int[ndarray, " k"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    intrinsics: Intrinsics,
) -> tuple[Float[ndarray, "k 2 2"], Float[ndarray, "k 2 3"]]:
    """Return affine part A and bend B of the warp of each observation, from the image of its reference observation.

    An offset (u, v) px from the reference's keypoint becomes A·(u, v) + B·(u², uv, v²) px in the observation's image.
    Observation k is the pixel `x_px[k]` of point `x_in_recon[k]` in the image `image[k]`; its reference is row
    `of_reference[k]`. The plane around the point has the normal `facing[k]` (recon axes, any length). Both A and B come
    from central differences; B is due to perspective and distortion. Both are 0 where the plane is seen at a grazing
    angle or from behind; such observations are not aligned.
    """
    recon_from_reference = recon_from_camera[image[of_reference]]
    camera_from_recon = inverse(recon_from_camera)[image]
    centre = recon_from_reference[:, :3, 3]
    height = ((x_in_recon - centre) * facing).sum(1)

    def at(u: int, v: int) -> Float[ndarray, "k 2"]:
        rays = unproject(intrinsics, x_px[of_reference] + _BEND_AT_PX * np.array([u, v]))
        ray = np.einsum("kij,kj->ki", recon_from_reference[:, :3, :3], rays)
        on_plane = centre + (height / (ray * facing).sum(1))[:, None] * ray
        return project(intrinsics, _x_in_b(camera_from_recon, on_plane))

    with np.errstate(all="ignore"):
        middle, right, left, below, above = at(0, 0), at(1, 0), at(-1, 0), at(0, 1), at(0, -1)
        cross = (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)) / 4
    affine = np.stack([right - left, below - above], axis=2) / (2 * _BEND_AT_PX)
    bend = np.stack([(right + left) / 2 - middle, cross, (below + above) / 2 - middle], axis=2)
    steepest = np.abs(affine).max((1, 2), initial=0.0)
    tame = (np.isfinite(bend).all((1, 2)) & (steepest < _STEEPEST))[:, None, None]
    return np.where(tame, affine, 0.0), np.where(tame, bend, 0.0) / _BEND_AT_PX**2


def _x_in_b(b_from_a: Float[ndarray, "k 4 4"], x_in_a: Float[ndarray, "k 3"]) -> Float[ndarray, "k 3"]:
    return np.einsum("kij,kj->ki", b_from_a[:, :3, :3], x_in_a) + b_from_a[:, :3, 3]


def _align_all(
    greys: UInt8[ndarray, "m h w"],
    most_px: float,
    of_reference: Int[ndarray, " k"],
    image: Int[ndarray, " k"],
    keypoint_px: Float[ndarray, "k 2"],
    x_px: Float[ndarray, "k 2"],
    affine: Float[ndarray, "k 2 2"],
    bend: Float[ndarray, "k 2 3"],
) -> Float[ndarray, " k"]:
    """Align all observations except the references; return their variances, px², infinite for those not aligned.

    `x_px` (initial pixels) and `affine` are updated in place; they and `bend` are the warp of `_warps`. `image` and
    `keypoint_px` are the image (row of `greys`) and keypoint of each observation, and `of_reference` is the row of its
    reference observation. An aligned observation is at most `most_px` from its keypoint.
    """
    rows, track = np.unique(of_reference, return_inverse=True)
    template, pull, deviation = _templates(greys, image[rows], keypoint_px[rows])
    used = np.flatnonzero((of_reference != np.arange(len(image))) & (deviation >= _FLAT)[track])
    warp, correlation = (keypoint_px, x_px, affine, bend), np.full(len(image), -1.0)
    _align_used(greys, used, image, track, *warp, template, pull, deviation, most_px, correlation)
    # Both patches have noise: their difference has the variance 2 (1 − correlation) deviation².
    noise = 2 * np.maximum(1 - correlation, 1e-6) * deviation[track] ** 2
    by_grey = np.swapaxes(pull[..., :2], 1, 2) @ pull[..., :2]
    variance_px = noise * np.einsum("kij,kjl,kil->k", affine, by_grey[track], affine) / 2
    return np.where(correlation > LEAST_CORRELATION, variance_px, np.inf)


def _templates(
    greys: UInt8[ndarray, "m h w"], image: Int[ndarray, " p"], x_px: Float[ndarray, "p 2"]
) -> tuple[Float[ndarray, "p n"], Float[ndarray, "p n 8"], Float[ndarray, " p"]]:
    """Return reference patches minus their means, the gain matrices of the unknowns, and the standard deviations.

    The patches are those around the pixels `x_px` of the images `image` (rows of `greys`), with the greys of `_patch`,
    row by row. Row k of a gain matrix is the change of the eight unknowns per grey level of difference at pixel k. The
    unknowns are shift x and y, gain, offset, and the affine part row by row. Where the texture does not determine the
    unknowns, the gains are very large, and the resulting variance rejects the patch. The standard deviation is 0 if the
    patch, with one more pixel on every side, leaves its image.
    """
    p, far, size = len(x_px), _RADIUS + 1, np.array(greys.shape[:0:-1])
    inside = ((x_px - far >= 1) & (x_px + far < size - 2)).all(1)
    column, row = np.clip(
        x_px.astype(int)[:, :, None] + np.arange(-far - 1, far + 3), 0, size[:, None] - 1
    ).swapaxes(0, 1)
    patch, side = greys[image[:, None, None], row[:, :, None], column[:, None]].astype(float), 2 * far + 1
    across, down = (np.stack(_spline.py_func(share))[:, :, None, None] for share in (x_px % 1).T)
    patch = np.sum([share * patch[:, :, k : k + side] for k, share in enumerate(across)], axis=0)
    patch = np.sum([share * patch[:, k : k + side] for k, share in enumerate(down)], axis=0)
    template = patch[:, 1:-1, 1:-1].reshape(p, -1)
    slope_x = (patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]).reshape(p, -1) / 2
    slope_y = (patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]).reshape(p, -1) / 2
    mean = template @ _WEIGHTS
    deviation = np.sqrt(np.maximum(template**2 @ _WEIGHTS - mean**2, 0.0))
    template -= mean[:, None]
    constant = np.broadcast_to(deviation[:, None], template.shape)
    along = [slope * offset / _WINDOW for slope in (slope_x, slope_y) for offset in _OFFSETS.T]
    jacobian = np.stack([slope_x, slope_y, template, constant, *along], 2)
    weighted = jacobian * _WEIGHTS[:, None]
    normal = jacobian.swapaxes(1, 2) @ weighted
    normal += np.eye(_FREE) * (1e-9 * normal + 1e-12)  # a tiny term for singular directions
    return template, weighted @ np.linalg.inv(normal), np.where(inside, deviation, 0.0)


@inlined
@no_type_check
def _spline(f):
    """Return the weights of the four pixels around a position, `f` behind the second one, for a cubic B-spline."""
    e = 1 - f
    return e * e * e / 6, 2 / 3 - f * f * (1 - f / 2), 2 / 3 - e * e * (1 + f) / 2, f * f * f / 6


@inlined
@no_type_check
def _patch(greys, image, x_px, affine, bend, o, patch):
    """Write to `patch` (n) the greys around observation `o`, warped; return whether the image contains all of them.

    The warp of `_warps`, with `affine` (k,2,2) and `bend` (k,2,3), leads to pixels of the image with row `image` of
    `greys` around the pixel x_px[o]. The grey is that of a cubic B-spline whose coefficients are the pixels, which
    blurs by 0.58 px. Without this blur, interpolation would smooth differently on pixels and between them, which biases
    positions.
    """
    _, h, w = greys.shape
    n = 0
    for v in range(-_RADIUS, _RADIUS + 1):
        for u in range(-_RADIUS, _RADIUS + 1):
            x = x_px[o, 0] + affine[o, 0, 0] * u + affine[o, 0, 1] * v
            y = x_px[o, 1] + affine[o, 1, 0] * u + affine[o, 1, 1] * v
            x += bend[o, 0, 0] * u * u + bend[o, 0, 1] * u * v + bend[o, 0, 2] * v * v
            y += bend[o, 1, 0] * u * u + bend[o, 1, 1] * u * v + bend[o, 1, 2] * v * v
            if not (x >= 1 and y >= 1 and x < w - 2 and y < h - 2):
                return False
            column, row = int(x), int(y)
            across, down = _spline(x - column), _spline(y - row)
            patch[n] = 0.0
            for i in range(4):
                line = 0.0
                for j in range(4):
                    line += across[j] * greys[image, row + i - 1, column + j - 1]
                patch[n] += down[i] * line
            n += 1
    return True


@compiled
@no_type_check
def _align_used(
    greys,
    used,
    image,
    track,
    keypoint_px,
    x_px,
    affine,
    bend,
    template,
    pull,
    deviation,
    most_px,
    correlation,
):
    """Align the patches of the observations `used` by Gauss-Newton; update `x_px`, `affine` and `correlation` (k).

    `track` is the row of each observation in `template`, `pull` and `deviation`, which come from `_templates`. A step
    is Σ (grey − template)·pull. The correlation is that of patch and template, weighted by _WEIGHTS. It does not change
    without convergence, if the patch leaves the image, or if its centre moves more than `most_px` from `keypoint_px`.
    """
    patch, step = np.empty(len(_WEIGHTS)), np.empty(_FREE)
    for o in used:
        t = track[o]
        for _ in range(_STEPS):
            if not _patch(greys, image[o], x_px, affine, bend, o, patch):
                break
            mean = square = found = moved = away = 0.0
            for k in range(len(patch)):
                mean += _WEIGHTS[k] * patch[k]
                square += _WEIGHTS[k] * patch[k] * patch[k]
            gain = deviation[t] / np.sqrt(max(square - mean * mean, 1e-12))
            for i in range(_FREE):
                step[i] = 0.0
            for k in range(len(patch)):
                here = gain * (patch[k] - mean)
                found += _WEIGHTS[k] * here * template[t, k]
                for i in range(_FREE):
                    step[i] += (here - template[t, k]) * pull[t, k, i]
            a, b, c, d = step[4] / _WINDOW + 1, step[5] / _WINDOW, step[6] / _WINDOW, step[7] / _WINDOW + 1
            determinant = a * d - b * c
            if determinant < 0.3:
                break
            for i in range(2):
                first, second = affine[o, i, 0], affine[o, i, 1]
                affine[o, i, 0] = (first * d - second * c) / determinant
                affine[o, i, 1] = (second * a - first * b) / determinant
                shift = affine[o, i, 0] * step[0] + affine[o, i, 1] * step[1]
                x_px[o, i] -= shift
                moved += shift * shift
                away += (x_px[o, i] - keypoint_px[o, i]) ** 2
            if away > most_px * most_px:
                break
            if moved < _SETTLED_PX * _SETTLED_PX:
                correlation[o] = found / (deviation[t] * deviation[t])
                break
