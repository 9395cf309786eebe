"""Where an image of another camera was taken from, in the reconstruction of the capture's own camera.

Features that it shares with two or more images of known pose become points; the image's place follows from those that
agree (P3P in RANSAC, with a focal length where none is given). Points and all their observations are kept, for the
bundle adjustment of all images.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.camera import project
from jcr.geometry import apply, inverse, transform
from jcr.match.verify import HALF_PIXEL
from jcr.reconstruct.relocate import GATE_PX, MIN_POINTS, Features, features, matches, triangulated
from jcr.reconstruct.sfm import camera_of
from jcr.records import Intrinsics

FOCAL_OF_WIDTH = 0.9
"""Of a camera without known intrinsics: where the search for its focal length starts."""
LEAST_SPREAD = 0.05
"""Of the image's area that the points must span; crowded ones say little of the place."""
TRIALS = 20_000


@dataclass(frozen=True)
class Known:
    """The images of known pose and what is found in them."""

    lens: Intrinsics
    recon_from_camera: Float[ndarray, "m 4 4"]
    found: tuple[Features, ...]


@dataclass(frozen=True)
class Shared:
    """The points that an image shares with images of known pose, and where it was taken from."""

    recon_from_camera: Float[ndarray, "4 4"]
    lens: Intrinsics
    points_in_recon: Float[ndarray, "p 3"]
    x_px: Float[ndarray, "p 2"]
    """In the image."""
    row: Int[ndarray, " k"]
    """Image of known pose of each further observation."""
    row_x_px: Float[ndarray, "k 2"]
    row_point: Int[ndarray, " k"]


def known_images(
    images: Sequence[UInt8[ndarray, "h w 3"]], lens: Intrinsics, recon_from_camera: Float[ndarray, "m 4 4"]
) -> Known:
    """Images of one camera, whose poses are known, made ready."""
    return Known(lens, recon_from_camera, tuple(features(image, lens) for image in images))


def guessed_lens(size: tuple[int, int]) -> Intrinsics:
    """Of images of a size, where nothing is known of their camera."""
    width, height = size
    focal = FOCAL_OF_WIDTH * max(size)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def localised(
    known: Known, picture: UInt8[ndarray, "h w 3"], lens: Intrinsics, lens_is_known: bool, seed: int = 0
) -> Shared | int:
    """The image's place, or how few points it shares with the known images where these do not show it."""
    found = features(picture, lens)
    pairs = [matches(found.descriptors, other.descriptors) for other in known.found]
    feature = np.concatenate([mine for mine, _ in pairs])
    row = np.repeat(np.arange(len(pairs)), [len(mine) for mine, _ in pairs])
    rays, seen = (
        np.concatenate([getattr(known.found[k], of)[theirs] for k, (_, theirs) in enumerate(pairs)])
        for of in ("rays", "x_px")
    )
    gate = GATE_PX / known.lens.fx
    points, _, good = triangulated(feature, row, rays, known.recon_from_camera, gate, len(found.x_px))
    if good.sum() < MIN_POINTS:
        return int(good.sum())
    candidate = np.flatnonzero(good)
    placed = _placed(found.x_px[candidate], points[candidate], lens, lens_is_known, seed)
    if placed is None:
        return 0
    recon_from_camera, lens, inlier = placed
    if inlier.sum() < MIN_POINTS:
        return int(inlier.sum())
    agreed = candidate[inlier]
    # Of the known images' observations those that the point meets.
    in_camera = np.einsum(
        "cji,cj->ci",
        known.recon_from_camera[row, :3, :3],
        points[feature] - known.recon_from_camera[row, :3, 3],
    )
    ahead = in_camera[:, 2] > 1e-6
    miss = np.full(len(row), np.inf)
    miss[ahead] = np.linalg.norm(project(known.lens, in_camera[ahead]) - seen[ahead], axis=1)
    kept = (miss < GATE_PX) & np.isin(feature, agreed)
    number = np.zeros(len(found.x_px), int)
    number[agreed] = np.arange(len(agreed))
    return Shared(
        recon_from_camera,
        lens,
        points[agreed],
        found.x_px[agreed],
        row[kept],
        seen[kept],
        number[feature[kept]],
    )


def _placed(
    x_px: Float[ndarray, "p 2"],
    points: Float[ndarray, "p 3"],
    lens: Intrinsics,
    lens_is_known: bool,
    seed: int,
) -> tuple[Float[ndarray, "4 4"], Intrinsics, ndarray] | None:
    """Pose, intrinsics and inliers; None where no pose has enough of these."""
    estimation, refinement = (
        pycolmap.AbsolutePoseEstimationOptions(),
        pycolmap.AbsolutePoseRefinementOptions(),
    )
    estimation.estimate_focal_length = not lens_is_known
    estimation.ransac.max_error = 2 * GATE_PX * max(1.0, lens.width / 1600)
    estimation.ransac.max_num_trials, estimation.ransac.random_seed = TRIALS, seed
    refinement.refine_focal_length = not lens_is_known
    refinement.print_summary = False
    camera = camera_of(lens, lens_is_known)
    found = pycolmap.estimate_and_refine_absolute_pose(
        x_px + HALF_PIXEL, points, camera, estimation, refinement
    )
    if found is None:
        return None
    motion = found["cam_from_world"]
    recon_from_camera = inverse(transform(motion.rotation.matrix(), motion.translation))
    if not lens_is_known:
        focal, cx, cy, k1, k2 = (float(value) for value in camera.params)
        lens = Intrinsics(
            focal, focal, cx - HALF_PIXEL, cy - HALF_PIXEL, lens.width, lens.height, (k1, k2, 0.0, 0.0, 0.0)
        )
    return recon_from_camera, lens, np.asarray(found["inlier_mask"], bool)


def spread(shared: Shared) -> float:
    """Share of the image's area within which its points lie, as their standard deviations span it."""
    sides = 4 * np.sqrt(np.linalg.eigvalsh(np.cov(shared.x_px.T)))
    return float(sides.prod() / (shared.lens.width * shared.lens.height))


def distance(shared: Shared) -> float:
    """Median depth of the points, in the reconstruction's unit."""
    return float(np.median(apply(inverse(shared.recon_from_camera), shared.points_in_recon)[:, 2]))
