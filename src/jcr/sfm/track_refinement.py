"""Least-squares matching of the observations of a track with one of them, its reference.

Method: Gruen, "Adaptive least squares correlation", 1985, with derivatives of the reference (inverse composition; Baker
and Matthews, IJCV 2004). The warp is that of a plane that faces the cameras, with a free affine part, gain and offset.
Of three sizes of the patch, the one with the smallest variance is used (Förstner 1982, geometric precision).
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import by_point, project, unproject
from jcr.compiled import compiled
from jcr.geometry import inverse
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
_POINTS_AT_ONCE = 256
"""Number of tracks that a thread aligns at a time."""
_FLAT = 1e-3
"""Standard deviation, in grey levels, below which a patch has no texture."""


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

    def align(level: UInt8[ndarray, "m h2 w2"], job: tuple[Any, ...], first: int) -> None:
        """Align the tracks from number `first` on; each thread writes only to observations of its own tracks."""
        some = slice(first, first + _POINTS_AT_ONCE)
        _align_all(level, image, ends[first : some.stop + 1], reference[some], *job)

    start_px, start_affine = x_px.copy(), warp
    found, variance = x_px.copy(), np.full(len(point), KEYPOINT_STD_PX**2)
    for reduced in _REDUCED:
        size = max(greys.shape[2] // reduced, 1), max(greys.shape[1] // reduced, 1)
        level = np.stack([cv2.resize(grey, size, interpolation=cv2.INTER_AREA) for grey in greys])
        factor = np.array(size) / [intrinsics.width, intrinsics.height]
        keypoint_px, aligned_px = ((at + 0.5) * factor - 0.5 for at in (x_px, start_px))
        affine, variance_px = start_affine.copy(), np.full(len(point), np.inf)
        job = (keypoint_px, (aligned_px, affine, bend * reduced), variance_px, MOST_PX / reduced)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(partial(align, level, job), range(0, len(reference), _POINTS_AT_ONCE)))
        variance_px *= reduced**2
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


@compiled
@no_type_check
def _align_all(greys, image, ends, reference, keypoint_px, warp, variance_px, most_px):
    """Align all observations except the references: update `warp` and `variance_px` (k) in place.

    `warp` has the pixels (k,2), affine parts (k,2,2) and bends (k,2,3) of the k observations; the bends do not change.
    `image` and `keypoint_px` are the image (row of `greys`) and the initial pixel of each observation; `most_px` is the
    largest shift. `ends` are the first observations of the tracks and the end of the last track; `reference` is the
    reference observation of each track. The variance (px²) of an observation that could not be aligned does not change.
    """
    offsets, window = _window(_RADIUS)
    wide, _ = _window(_RADIUS + 1)
    around = np.empty(len(wide))
    template = np.empty(len(offsets))
    patch = np.empty(len(offsets))
    pull = np.empty((len(offsets), _FREE))
    straight = np.zeros((2, 2))
    straight[0, 0] = straight[1, 1] = 1.0
    flat = np.zeros((2, 3))
    for p in range(len(reference)):
        r = reference[p]
        if not _patch(greys[image[r]], keypoint_px[r], straight, flat, wide, around):
            continue
        deviation = _template(around, offsets, window, template, pull)
        if deviation < _FLAT:
            continue
        xx = xy = yy = 0.0
        for k in range(len(offsets)):
            xx += pull[k, 0] * pull[k, 0]
            xy += pull[k, 0] * pull[k, 1]
            yy += pull[k, 1] * pull[k, 1]
        for o in range(ends[p], ends[p + 1]):
            if o != r:
                x_px, affine = warp[0][o], warp[1][o]
                correlation = _align(
                    greys[image[o]], keypoint_px[o], x_px, affine, warp[2][o], offsets, window, template, pull, patch,
                    deviation, most_px
                )  # fmt: skip
                if correlation > LEAST_CORRELATION:
                    # Both patches have noise: their difference has the variance 2 (1 − correlation) deviation².
                    noise = 2 * max(1 - correlation, 1e-6) * deviation * deviation
                    along_x = affine[0, 0] * affine[0, 0] + affine[1, 0] * affine[1, 0]
                    across = affine[0, 0] * affine[0, 1] + affine[1, 0] * affine[1, 1]
                    along_y = affine[0, 1] * affine[0, 1] + affine[1, 1] * affine[1, 1]
                    variance_px[o] = noise * (along_x * xx + 2 * across * xy + along_y * yy) / 2


@compiled
@no_type_check
def _window(radius):
    """Return the offsets (n,2), x and y in px, of the pixels of a patch, row by row, and their weights of sum 1.

    The patch has 2 · radius + 1 pixels on each side; the weights (n) are Gaussian, with standard deviation _WINDOW px.
    """
    side = 2 * radius + 1
    index = np.arange(side * side)
    offsets = np.stack((index % side - radius, index // side - radius), axis=1).astype(np.float64)
    weight = np.exp(-0.5 * (offsets**2).sum(axis=1) / _WINDOW**2)
    return offsets, weight / weight.sum()


@compiled
@no_type_check
def _patch(grey, x_px, affine, bend, offsets, patch):
    """Write to `patch` (n) the grey at the `offsets` (n,2), warped about `x_px`; return whether the image contains all.

    The warp of `_warps`, with `affine` (2,2) and `bend` (2,3), leads to pixels of the image `grey` around the pixel
    `x_px`. The grey is that of a cubic B-spline whose coefficients are the pixels, which blurs by 0.58 px. Without this
    blur, interpolation would smooth differently on pixels and between them, which biases positions.
    """
    for k in range(len(offsets)):
        u = offsets[k, 0]
        v = offsets[k, 1]
        x = x_px[0] + affine[0, 0] * u + affine[0, 1] * v
        y = x_px[1] + affine[1, 0] * u + affine[1, 1] * v
        x += bend[0, 0] * u * u + bend[0, 1] * u * v + bend[0, 2] * v * v
        y += bend[1, 0] * u * u + bend[1, 1] * u * v + bend[1, 2] * v * v
        if not (x >= 1 and y >= 1 and x < grey.shape[1] - 2 and y < grey.shape[0] - 2):
            return False
        column = int(x)
        row = int(y)
        f = x - column
        g = y - row
        across = ((1 - f) ** 3 / 6, 2 / 3 - f * f * (1 - f / 2), 2 / 3 - (1 - f) ** 2 * (1 + f) / 2, f**3 / 6)
        down = ((1 - g) ** 3 / 6, 2 / 3 - g * g * (1 - g / 2), 2 / 3 - (1 - g) ** 2 * (1 + g) / 2, g**3 / 6)
        value = 0.0
        for i in range(4):
            line = grey[row + i - 1]
            for j in range(4):
                value += down[i] * across[j] * line[column + j - 1]
        patch[k] = value
    return True


@compiled
@no_type_check
def _template(around, offsets, window, template, pull):
    """Write the reference patch minus its mean to `template` (n), and the gain matrix of the unknowns to `pull` (n,8).

    `around` has the greys of the patch, row by row, with one more pixel on every side. `offsets` and `window` are its
    pixels and their weights (`_window`). Row k of `pull` is the change of the eight unknowns per grey level of
    difference at pixel k. The unknowns are shift x and y, gain, offset, and the affine part row by row. Returns the
    standard deviation of the patch. Where the texture does not determine the unknowns, `pull` is very large, and the
    resulting variance rejects the patch.
    """
    side = 2 * _RADIUS + 3
    mean = 0.0
    square = 0.0
    jacobian = np.empty((len(offsets), _FREE))
    for k in range(len(offsets)):
        middle = int((offsets[k, 1] + _RADIUS + 1) * side + offsets[k, 0] + _RADIUS + 1)
        template[k] = around[middle]
        jacobian[k, 0] = (around[middle + 1] - around[middle - 1]) / 2
        jacobian[k, 1] = (around[middle + side] - around[middle - side]) / 2
        mean += window[k] * template[k]
        square += window[k] * template[k] * template[k]
    deviation = np.sqrt(max(square - mean * mean, 0.0))
    for k in range(len(offsets)):
        template[k] -= mean
        jacobian[k, 2] = template[k]
        jacobian[k, 3] = deviation
        for i in range(2):
            for j in range(2):
                jacobian[k, 4 + 2 * i + j] = jacobian[k, i] * offsets[k, j] / _WINDOW
    weighted = jacobian * window.reshape((-1, 1))
    normal = jacobian.T @ weighted
    for i in range(_FREE):  # a tiny term for singular directions
        normal[i, i] += 1e-9 * normal[i, i] + 1e-12
    pull[:] = weighted @ np.linalg.inv(normal)
    return deviation


@compiled
@no_type_check
def _align(grey, keypoint_px, x_px, affine, bend, offsets, window, template, pull, patch, deviation, most_px):
    """Align one patch to the template by Gauss-Newton: update `x_px` (2) and `affine` (2,2); return the correlation.

    The correlation is that of patch and template, weighted by `window`. The result is -1 without convergence, if the
    patch leaves the image `grey`, or if its centre `x_px` moves more than `most_px` from `keypoint_px`. `bend` is the
    fixed part of the warp (`_warps`), `offsets` and `window` come from `_window`, and `patch` (n) is overwritten.
    `template`, `pull` and `deviation` come from `_template`: a step is Σ (grey − template)·pull.
    """
    step = np.empty(_FREE)
    for _ in range(_STEPS):
        if not _patch(grey, x_px, affine, bend, offsets, patch):
            return -1.0
        mean = 0.0
        square = 0.0
        for k in range(len(offsets)):
            mean += window[k] * patch[k]
            square += window[k] * patch[k] * patch[k]
        gain = deviation / np.sqrt(max(square - mean * mean, 1e-12))
        for i in range(_FREE):
            step[i] = 0.0
        correlation = 0.0
        for k in range(len(offsets)):
            here = gain * (patch[k] - mean)
            correlation += window[k] * here * template[k]
            for i in range(_FREE):
                step[i] += (here - template[k]) * pull[k, i]
        a, b, c, d = step[4] / _WINDOW + 1, step[5] / _WINDOW, step[6] / _WINDOW, step[7] / _WINDOW + 1
        determinant = a * d - b * c
        if determinant < 0.3:
            return -1.0
        moved = 0.0
        away = 0.0
        for i in range(2):
            first, second = affine[i, 0], affine[i, 1]
            affine[i, 0] = (first * d - second * c) / determinant
            affine[i, 1] = (second * a - first * b) / determinant
            shift = affine[i, 0] * step[0] + affine[i, 1] * step[1]
            x_px[i] -= shift
            moved += shift * shift
            away += (x_px[i] - keypoint_px[i]) ** 2
        if away > most_px * most_px:
            return -1.0
        if moved < _SETTLED_PX * _SETTLED_PX:
            return correlation / (deviation * deviation)
    return -1.0
