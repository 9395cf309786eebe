"""Matched depths, checked across views, and planes where there are none: one depth, reason and sigma a pixel."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from jcr.camera import rays
from jcr.depth.consistency import agreement
from jcr.depth.matched import grid, relative
from jcr.depth.priors import ON_PLANE, Prior, evened, planar_prior, support_plane
from jcr.geometry import apply
from jcr.records import BOTH, MATCHED, NO_DEPTH, PRIOR, Intrinsics

LEAST_CORRELATION = 0.3
"""Where even the best neighbours correlate less, what is found there is no estimate."""
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
"""Of a depth on which two images agree and no third: it counts where it lies on its region's plane, too. Without the
plane, a third of such depths are off by 5 mm."""
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
    """The depths that views agree on, and with `priors` those of planes that nothing seen contradicts.

    A matched depth needs two images that agree (one, if there are no more than two) and, but for `changing` scenes, more
    than twice as many as see through it. To see through, an image's own depth must have as many that agree: what is
    found where nothing matches is as often behind a surface as before it.
    """
    m = len(colors)
    views = [relative(i, others, recon_from_camera, pinhole) for i, others in enumerate(neighbours)]
    needed = np.array([1 if len(view.others) < 3 else 2 for view in views])[:, None, None]
    with ThreadPoolExecutor(threads) as pool:

        def check(
            depth: Float[ndarray, "m h w"],
            known: Bool[ndarray, "m h w"],
            trusted: Bool[ndarray, "m h w"],
            tolerance: float,
        ) -> list[ndarray]:
            def one(i: int) -> tuple[ndarray, ...]:
                v = views[i]
                return agreement(
                    i, depth, known, trusted, v.others, v.a, v.b, v.centre, grid(pinhole), tolerance
                )

            return [np.stack(maps) for maps in zip(*pool.map(one, range(m)), strict=True)]

        known = score >= LEAST_CORRELATION
        count = through = information = np.zeros(0)
        trusted = known
        for tolerance in AGREEMENT:
            inverse_depth, count, through, information = check(inverse_depth, known, trusted, tolerance)
            trusted = known & (count >= needed)
        report(0.2)
        matched = known & (count >= needed)
        if not changing:
            matched &= count > 2 * through
        std = MATCHING_STD_PX / np.sqrt(np.maximum(information, 1e-12)) / inverse_depth
        reason = np.where(matched, MATCHED, NO_DEPTH).astype(np.uint8)
        confidence = (np.minimum(score, 1) * count).astype(np.float32)
        if not priors or matched.sum() < FEWEST_MATCHED:
            nothing = np.float32(0)
            return FusedDepth(
                inverse_depth,
                np.where(matched, confidence, nothing),
                reason,
                np.where(matched, std, nothing).astype(np.float32),
            )

        support = _support(inverse_depth, matched, recon_from_camera, pinhole)
        even = evened(colors, inverse_depth, matched, views, pinhole)
        even = np.stack([cv2.GaussianBlur(image, (0, 0), 1.0) for image in even])
        report(0.4)

        def prior(i: int) -> Prior:
            return planar_prior(
                i, even, inverse_depth, matched, views[i], support, recon_from_camera[i], pinhole
            )

        found = list(pool.map(prior, range(m)))
        report(0.8)
        of_plane, holds, confirms, agreeing, contradicts, plane_std = (
            np.stack([getattr(one, name) for one in found])
            for name in ("inverse_depth", "holds", "confirms", "agreeing", "contradicts", "std")
        )
        plane_std = np.hypot(plane_std, PRIOR_FLOOR)
        on_plane = np.abs(of_plane / inverse_depth - 1) < ON_PLANE
        pair = known & (count == 1) & (through == 0) & (score >= PAIR_CORRELATION) & confirms & on_plane
        matched = (matched & ~contradicts) | pair
        both = matched & confirms & on_plane
        filled = holds & ~matched
        inverse_depth = np.where(filled, of_plane, inverse_depth)
        there = matched | filled
        _, count, through, _ = check(inverse_depth, there, there, ON_PLANE)
        filled &= (count >= np.minimum(needed, agreeing)) & (count > 2 * through)
        # Beside outlines two images may give the nearer depth alike; a third that has the plane behind it knows better.
        through = check(inverse_depth, there, both | filled, ON_PLANE)[2]
        matched &= both | (through == 0)
        report(1.0)
    reason = np.select([both, matched, filled], [BOTH, MATCHED, PRIOR], NO_DEPTH).astype(np.uint8)
    confidences = [BOTH_CONFIDENCE * confidence, confidence, PRIOR_CONFIDENCE * count]
    confidence = np.select([both, matched, filled], confidences, 0).astype(np.float32)
    stds = [1 / np.sqrt(std**-2 + plane_std**-2), std, plane_std]
    std = np.select([both, matched, filled], stds, 0).astype(np.float32)
    return FusedDepth(inverse_depth, confidence, reason, std)


def _support(
    inverse_depth: Float[ndarray, "m h w"],
    matched: Bool[ndarray, "m h w"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
) -> Float[ndarray, "4"]:
    """The plane of most matched points, in the recon frame."""
    direction = rays(pinhole)
    x_in_recon = [
        apply(pose, (direction / depth[..., None].astype(float))[there][::10])
        for pose, depth, there in zip(recon_from_camera, inverse_depth, matched, strict=True)
    ]
    tolerance = 0.004 / float(np.median(inverse_depth[matched]))
    return support_plane(np.concatenate(x_in_recon), tolerance)
