"""Matched depths, checked across views, and planes where there are none: one depth, reason and sigma a pixel."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays
from jcr.depth.consistency import agreement, evidence, padded
from jcr.depth.matched import Relative, grid, relative
from jcr.depth.priors import ON_PLANE, Prior, evened, planar_prior, support_plane
from jcr.geometry import apply
from jcr.records import BOTH, MATCHED, NO_DEPTH, PRIOR, Intrinsics

LEAST_CORRELATION = 0.3
"""Least correlation with the best neighbours; below it there is no estimate."""
AGREEMENT = (0.01, 0.005, 0.003, 0.003)
"""Per round: largest relative difference of two depths of one point that are averaged. On simulated views the
rounds halve the median error and the share of gross ones."""
FEWEST_MATCHED = 300
"""Pixels of all images together from which planes are drawn at least."""
MATCHING_STD_PX = 0.6
"""Error of a matched pixel in a neighbour. Fitted to simulated scenes: the errors of windows side by side go together,
so that it is more than the scatter of one."""
PRIOR_FLOOR = 0.002
"""Relative sigma of a depth that rests on a plane, beside what the pixels scatter that carry it."""
PAIR_CORRELATION = 0.5
"""Largest deviation from its region's plane of a depth on which two images agree and no third; without the plane, a
third of such depths are off by 5 mm."""
BOTH_CONFIDENCE = 2.0
"""Factor of the confidence of a matched depth on its region's plane: at most a quarter as many are off by 5 mm."""
PRIOR_CONFIDENCE = 0.5
"""Confidence of a prior for each image that agrees, where a matched pixel has its correlation."""


@dataclass(frozen=True)
class FusedDepth:
    """Per pixel of every image."""

    inverse_depth: Float[ndarray, "m h w"]
    confidence: Float[ndarray, "m h w"]
    reason: UInt8[ndarray, "m h w"]
    std: Float[ndarray, "m h w"]
    """Relative, one sigma; 0 without depth."""


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
) -> FusedDepth:
    """Return the depths that views agree on, and with `priors` those of planes that no view contradicts.

    A matched depth needs two images that agree (one, if there are no more than two) and, but for `changing` scenes, more
    than twice as many as see through it. To see through, an image's own depth must have as many that agree: what is
    found where nothing matches is as often behind a surface as before it.
    """
    views = [relative(i, others, recon_from_camera, pinhole) for i, others in enumerate(neighbours)]
    needed = np.array([1 if len(view.others) < 3 else 2 for view in views])[:, None, None]
    known = score >= LEAST_CORRELATION
    with ThreadPoolExecutor(threads) as pool:
        check = partial(_check, pool, views, grid(pinhole))
        count = through = information = np.zeros(0)
        consistent = known
        for tolerance in AGREEMENT:
            inverse_depth, count, through, information = check(inverse_depth, known, consistent, tolerance)
            consistent = known & (count >= needed)
        report(0.2)
        matched = consistent if changing else consistent & (count > 2 * through)
        std = MATCHING_STD_PX / np.sqrt(np.maximum(information, 1e-12)) / inverse_depth
        confidence = (np.minimum(score, 1) * count).astype(np.float32)
        if not priors or matched.sum() < FEWEST_MATCHED:
            reason = np.where(matched, MATCHED, NO_DEPTH).astype(np.uint8)
            return FusedDepth(inverse_depth, _where(matched, confidence), reason, _where(matched, std))

        support = _support(inverse_depth, matched, recon_from_camera, pinhole)
        even = evened(colors, inverse_depth, matched, views, pinhole)
        surfaces = _surfaces(np.where(matched, inverse_depth, 0), even)
        report(0.4)

        def prior(i: int) -> Prior:
            return planar_prior(
                i, surfaces, inverse_depth[i], matched[i], views[i], support, recon_from_camera[i], pinhole
            )

        found = _stacked(list(pool.map(prior, range(len(colors)))))
        report(0.8)
        alone = known & (count == 1) & (through == 0) & (score >= PAIR_CORRELATION)
        fused = _with_planes(
            FusedDepth(inverse_depth, confidence, np.where(matched, MATCHED, NO_DEPTH).astype(np.uint8), std),
            found,
            alone,
            needed,
            check,
        )
        report(1.0)
    return fused


def _check(
    pool: Executor,
    views: Sequence[Relative],
    k: Float[ndarray, "4"],
    inverse_depth: Float[ndarray, "m h w"],
    known: Bool[ndarray, "m h w"],
    consistent: Bool[ndarray, "m h w"],
    tolerance: float,
) -> list[ndarray]:
    """Compute `agreement` of all images, (m,h,w) each; inverse depths that are not known stay as they are."""
    compared, width = evidence(inverse_depth, known, consistent), inverse_depth.shape[2]

    def one(i: int) -> Float[ndarray, "4 h w"]:
        v = views[i]
        return agreement(i, compared, v.others, v.a, v.b, v.centre, k, width, tolerance)

    mean, *others = np.stack(list(pool.map(one, range(len(views)))), 1)
    return [np.where(known, mean, inverse_depth), *others]


def _where(there: Bool[ndarray, "m h w"], values: Float[ndarray, "m h w"]) -> Float[ndarray, "m h w"]:
    """Return the values there, and 0 elsewhere."""
    return np.where(there, values, 0).astype(np.float32)


def _stacked(priors: Sequence[Prior]) -> Prior:
    """Return the maps of all images, (m,h,w) each."""
    return Prior(**{one.name: np.stack([getattr(p, one.name) for p in priors]) for one in fields(Prior)})


def _surfaces(
    inverse_depth: Float[ndarray, "m h w"], even: Float[ndarray, "m h w 3"]
) -> Float[ndarray, "m h _ 4"]:
    """Return inverse depths and slightly smoothed colours in the layout of `colours_agree`."""
    smooth = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in even]
    return padded(np.concatenate([inverse_depth[..., None], smooth], -1))


def _with_planes(
    matching: FusedDepth,
    planes: Prior,
    alone: Bool[ndarray, "m h w"],
    needed: Int[ndarray, "m 1 1"],
    check: Callable[..., list[ndarray]],
) -> FusedDepth:
    """Return the matched depths that planes do not contradict, and planes in place of the others.

    `alone` are pixels on whose depth two images agree and no third.
    """
    inverse_depth, matched = matching.inverse_depth, matching.reason == MATCHED
    plane_std = np.hypot(planes.std, PRIOR_FLOOR)
    on_plane = np.abs(planes.inverse_depth / inverse_depth - 1) < ON_PLANE
    matched = (matched & ~planes.contradicts) | (alone & planes.confirms & on_plane)
    both = matched & planes.confirms & on_plane
    filled = planes.holds & ~matched
    inverse_depth = np.where(filled, planes.inverse_depth, inverse_depth)
    there = matched | filled
    _, count, through, _ = check(inverse_depth, there, there, ON_PLANE)
    filled &= (count >= np.minimum(needed, planes.agreeing)) & (count > 2 * through)
    # Beside outlines two images may give the nearer depth alike; a third that has the plane behind it knows better.
    through = check(inverse_depth, there, both | filled, ON_PLANE)[2]
    matched &= both | (through == 0)
    which = [both, matched, filled]
    confidences = [BOTH_CONFIDENCE * matching.confidence, matching.confidence, PRIOR_CONFIDENCE * count]
    stds = [1 / np.sqrt(matching.std**-2 + plane_std**-2), matching.std, plane_std]
    return FusedDepth(
        inverse_depth,
        np.select(which, confidences, 0).astype(np.float32),
        np.select(which, [BOTH, MATCHED, PRIOR], NO_DEPTH).astype(np.uint8),
        np.select(which, stds, 0).astype(np.float32),
    )


def _support(
    inverse_depth: Float[ndarray, "m h w"],
    matched: Bool[ndarray, "m h w"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
) -> Float[ndarray, "4"]:
    """Return the plane of most matched points, in the recon frame."""
    direction = rays(pinhole).reshape(-1, 3)
    x_in_recon = []
    for pose, per_depth, there in zip(recon_from_camera, inverse_depth, matched, strict=True):
        some = np.flatnonzero(there)[::10]
        x_in_recon.append(apply(pose, direction[some] / per_depth.ravel()[some, None].astype(float)))
    tolerance = 0.004 / float(np.median(inverse_depth[matched]))
    return support_plane(np.concatenate(x_in_recon), tolerance)
