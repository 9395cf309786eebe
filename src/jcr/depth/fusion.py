"""Fusion of matched depths, checked across views, with planes where no match is found."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays
from jcr.depth.consistency import agreement, inverse_depth_evidence
from jcr.depth.patch_match_stereo import Relative, grid, relative
from jcr.depth.planar_priors import ON_PLANE, PlanarPrior, evened, planar_prior
from jcr.depth.support_plane import support_plane
from jcr.geometry import apply
from jcr.records import BOTH, MATCHED, NO_DEPTH, PRIOR, Intrinsics

USABLE_CORRELATION = 0.3
"""Least correlation with the best neighbours for a depth to be used."""
AGREEMENT = (0.01, 0.005, 0.003, 0.003)
"""Largest relative difference of two depths of one point that are averaged, one per round. On simulated views the
rounds halve the median error and the share of gross errors."""
FEWEST_OF_SCENE = 300
"""Least number of matched pixels of all images together from which planes are fitted."""
EVERY = 20
"""Step between the matched pixels of an image that the fit of the support plane uses."""
MATCHING_STD_PX = 0.6
"""Standard deviation of a matched pixel in a neighbour, px. Fitted to simulated scenes; it is larger than the scatter
of single pixels because the errors of adjacent windows are correlated."""
PRIOR_FLOOR = 0.002
"""Relative standard deviation of a plane's depth, added in quadrature to the scatter of its supporting pixels."""
PAIR_CORRELATION = 0.5
"""Least correlation of a depth that only one other image agrees with, and that the plane of its region confirms.
Without the confirmation, a third of such depths are off by 5 mm."""
BOTH_CONFIDENCE = 2.0
"""Factor of confidence for a matched depth that lies on its region's plane; at most a quarter as many of these are off
by 5 mm."""
PRIOR_CONFIDENCE = 0.5
"""Confidence of a depth taken from a plane, per image that agrees; a matched depth has its correlation instead."""


def fused_depth(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    neighbours: Sequence[Int[ndarray, " _"]],
    inverse_depth: Float[ndarray, "m h w"],
    score: Float[ndarray, "m h w"],
    *,
    changing: bool,
    priors: bool,
    threads: int,
    report: Callable[[float], None],
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return maps (m,h,w) of inverse depth, confidence, reason (origin of the depth) and relative standard deviation.

    `inverse_depth` (1/z) and `score` (correlation) are the matches of the images; `neighbours` are the indices of the
    images to check each with. A matched depth needs a correlation of 0.3 and two other images that agree (one, with
    fewer than three neighbours). Except in `changing` scenes, more than twice as many images must agree as see through
    the point. Only pixels with enough agreeing images count as seeing through. With `priors`, pixels without a match
    get the depth of a fitted plane where no image contradicts it. Confidence is that of `dense_pointmaps`; the reason
    is NO_DEPTH, MATCHED, PRIOR or BOTH. Without depth, confidence and standard deviation are 0 and the inverse depth
    has no meaning. `report` is called with the finished fraction.
    """
    views = [relative(i, others, recon_from_camera, pinhole) for i, others in enumerate(neighbours)]
    needed = np.array([1 if len(others) < 3 else 2 for others in neighbours])[:, None, None]
    known = score >= USABLE_CORRELATION
    with ThreadPoolExecutor(threads) as pool:
        check = partial(_checked, pool, views, pinhole)
        consistent, count, through, information = known, *[np.zeros(0)] * 3
        for tolerance in AGREEMENT:
            inverse_depth, count, through, information = check(inverse_depth, known, consistent, tolerance)
            consistent = known & (count >= needed)
        report(0.2)
        matched = consistent if changing else consistent & (count > 2 * through)
        std = MATCHING_STD_PX / np.sqrt(np.maximum(information, 1e-12)) / inverse_depth
        confidence = np.minimum(score, 1) * count
        if not priors or matched.sum() < FEWEST_OF_SCENE:
            return _chosen(inverse_depth, [matched], [confidence], [MATCHED], [std])
        plane = _priors(pool, colors, inverse_depth, matched, views, recon_from_camera, pinhole)
        report(0.8)
        plane_std = np.hypot(plane.std, PRIOR_FLOOR)
        on_plane = plane.confirms & (np.abs(plane.inverse_depth / inverse_depth - 1) < ON_PLANE)
        pair = known & (count == 1) & (through == 0) & (score >= PAIR_CORRELATION)
        matched = (matched & ~plane.contradicts) | (pair & on_plane)
        both, filled = matched & on_plane, plane.holds & ~matched
        inverse_depth = np.where(filled, plane.inverse_depth, inverse_depth)
        there = matched | filled
        _, count, through, _ = check(inverse_depth, there, there, ON_PLANE)
        filled &= (count >= np.minimum(needed, plane.agreeing)) & (count > 2 * through)
        # Beside outlines, two images may agree on the nearer depth; a third image that sees the plane contradicts it.
        through = check(inverse_depth, there, both | filled, ON_PLANE)[2]
        matched &= both | (through == 0)
        report(1.0)
    return _chosen(
        inverse_depth,
        [both, matched, filled],
        [BOTH_CONFIDENCE * confidence, confidence, PRIOR_CONFIDENCE * count],
        [BOTH, MATCHED, PRIOR],
        [1 / np.sqrt(std**-2 + plane_std**-2), std, plane_std],
    )


def _checked(
    pool: ThreadPoolExecutor,
    views: Sequence[Relative],
    pinhole: Intrinsics,
    depth: Float[ndarray, "m h w"],
    known: Bool[ndarray, "m h w"],
    sees: Bool[ndarray, "m h w"],
    tolerance: float,
) -> list[ndarray]:
    """Return the four maps of `agreement` for all images, (m,h,w) each; `tolerance` is relative to the inverse depth.

    `depth` is the inverse depth 1/z of each pixel, and `known` marks the pixels that have one. The first map is the
    averaged inverse depth, and `depth` itself at other pixels. `views` are the projections of each image into its
    neighbours (`relative`). Only pixels of `sees` can contradict the depth of other images.
    """
    compared, k = inverse_depth_evidence(depth, known, sees), grid(pinhole)
    sums = np.zeros((len(views), 4, *depth.shape[1:]), np.float32)
    list(pool.map(lambda i: agreement(sums[i], i, compared, *views[i], k, tolerance), range(len(views))))
    mean, *others = np.moveaxis(sums, 1, 0)
    return [np.where(known, mean, depth), *others]


def _priors(
    pool: ThreadPoolExecutor,
    colors: UInt8[ndarray, "m h w 3"],
    inverse_depth: Float[ndarray, "m h w"],
    matched: Bool[ndarray, "m h w"],
    views: Sequence[Relative],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
) -> PlanarPrior:
    """Return the maps of `planar_prior` for all images, (m,h,w) each: planes of colour regions and their checks.

    The support plane that these need is fitted first, to `inverse_depth` (1/z) at the pixels of `matched`. `views` are
    the projections of each image into its neighbours (`relative`).
    """
    ray, x_in_recon = rays(pinhole), []
    for pose, per_depth, there in zip(recon_from_camera, inverse_depth, matched, strict=True):
        some = np.flatnonzero(there)[::EVERY]
        x_in_recon.append(apply(pose, ray.reshape(-1, 3)[some] / per_depth.ravel()[some, None].astype(float)))
    far = 1 / float(np.median(inverse_depth[matched]))
    found = support_plane(np.concatenate(x_in_recon), recon_from_camera[:, :3, 3], far, z_is_up=False)
    support = np.zeros(4) if found is None else np.append(found[0], -found[0] @ found[1])
    even = evened(colors, inverse_depth, matched, views, pinhole)
    smooth = np.stack([cv2.GaussianBlur(image, (0, 0), 1.0) for image in even])
    surfaces = np.where(matched, inverse_depth, 0).astype(np.float32), smooth

    def prior(i: int) -> PlanarPrior:
        image = surfaces, inverse_depth[i], matched[i], views[i]
        return planar_prior(i, *image, support, recon_from_camera[i], (grid(pinhole), ray))

    images = [vars(one) for one in pool.map(prior, range(len(colors)))]
    return PlanarPrior(**{name: np.stack([one[name] for one in images]) for name in images[0]})


def _chosen(
    inverse_depth: Float[ndarray, "m h w"],
    which: list[Bool[ndarray, "m h w"]],
    confidences: list[Float[ndarray, "m h w"]],
    reasons: list[int],
    stds: list[Float[ndarray, "m h w"]],
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return inverse depth (unchanged), confidence, reason and standard deviation of each pixel, chosen by masks.

    The elements of the four lists belong together. At each pixel, the first mask of `which` that is true selects
    confidence, reason and standard deviation. These are 0, NO_DEPTH and 0 where no mask is true.
    """
    return (
        inverse_depth,
        np.select(which, confidences, 0).astype(np.float32),
        np.select(which, reasons, NO_DEPTH).astype(np.uint8),
        np.select(which, stds, 0).astype(np.float32),
    )
