"""Which images to believe: a stale or shuffled gripper pose spoils one image, not one motion.

Candidates come from triples of images whose motions are congruent (a rotation and its conjugate turn by the
same angle, whatever X is: the screw congruence of Chen 1991). The candidate with the least trimmed squares
over images (Rousseeuw 1984) starts a maximum-likelihood fit, which images join and leave by a test that
knows how well it predicts each of them.
"""

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.stats import f as f_distribution

from jcr.geometry import ARM, rotation_angle, transform
from jcr.handeye.closed_form import closed_form, initial_estimate, motions, sine_axis
from jcr.handeye.equation import predict
from jcr.handeye.fit import Cues, PoseFit, Poses, fit_poses
from jcr.handeye.systematic import smooth_errors

LARGER = 2.0
"""Times the errors of the trusted images: wrong poses are farther off than that."""
SHARE_RIGHT = 0.65
"""Share of images that the trimmed fit relies on; up to the rest may be wrong."""
MAX_TRIPLES = 1500
CONCENTRATED = 20
"""Best triples from which the trimmed fit is sought: with 5 its cost was 2 % above the least that was found, with 20
0.1 % (240 simulated problems of 6 to 15 images, a fifth of them wrong)."""
REJECT_AT = 1e-5
"""Chance that a sound image is rejected, by the F distribution of its deleted residual."""
TOLERANCE = (1e-3, np.radians(0.2))
"""No image is rejected for less than this (m, rad): smaller errors are vision's, and harm nobody."""


def robust_fit(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    noise: tuple[float, float] | None = None,
    cues: Cues | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    systematic: Float[ndarray, "r r"] | None = None,
) -> tuple[PoseFit, Bool[ndarray, " n"]]:
    """The fit to the images that agree with each other, and which those are.

    With fewer than five images there is nothing to vote with, and all are kept. The arguments are those of fit_poses.
    Solved in a frame at the middle of the cameras and in their extent as unit: a frame far away makes a rotation about
    its origin look like a translation.
    """
    n, centers = len(base_from_gripper), recon_from_camera[:, :3, 3]
    middle = centers.mean(0)
    unit = float(np.sqrt(((centers - middle) ** 2).sum(1).mean()))
    unit = unit if unit > 1e-12 * np.abs(centers).max() else 1.0
    recon_from_camera = transform(recon_from_camera[:, :3, :3], (centers - middle) / unit)
    if cues is not None and cues.scale is not None:
        cues = replace(cues, scale=(unit * cues.scale[0], cues.scale[1]))
    if camera_covariance is not None:
        per_unit = np.tile(np.repeat([1 / unit, 1.0], 3), n)
        camera_covariance = per_unit[:, None] * camera_covariance * per_unit
    given = (
        noise,
        cues,
        camera_covariance,
        smooth_errors(base_from_gripper) if systematic is None else systematic,
    )

    def fitted(trusted: Bool[ndarray, " n"], averaged: bool) -> PoseFit:
        start = initial_estimate(base_from_gripper, recon_from_camera, trusted.astype(float))
        return fit_poses(base_from_gripper, recon_from_camera, start, trusted, *given, averaged=averaged)

    trusted = np.ones(n, dtype=bool)
    if n >= 5:
        trusted, _ = least_trimmed(base_from_gripper, recon_from_camera)
        for _ in range(10):
            agreeing = _agreeing(fitted(trusted, averaged=False))
            if agreeing.sum() < 4 or (agreeing == trusted).all():
                break
            trusted = agreeing
        if not trusted.all() and _alike(
            fitted(np.ones_like(trusted), averaged=False), fitted(trusted, averaged=False)
        ):
            trusted = np.ones_like(trusted)
    fit = fitted(trusted, averaged=True)
    scale, z = fit.scale / unit, fit.base_from_recon
    z = transform(z[:3, :3], z[:3, 3] - z[:3, :3] @ (scale * middle))
    return replace(fit, scale=scale, base_from_recon=z), trusted


def _alike(everything: PoseFit, trusted: PoseFit) -> bool:
    """Whether all images agree among each other with errors hardly larger than those of the trusted ones.

    Images that were trusted first are those that a bent arm bends least: the others of a sound capture are farther off
    than these let expect.
    """
    sizes, before = ((*fit.noise, fit.systematic) for fit in (everything, trusted))
    larger = max(size / least for size, least in zip(sizes, before, strict=True))
    return larger < LARGER and bool(_agreeing(everything).all())


def _agreeing(fit: PoseFit) -> Bool[ndarray, " n"]:
    """Images whose distance from a fit *without them* is within what noise explains."""
    gap = np.linalg.solve(fit.missed_covariance, fit.missed[..., None])[..., 0]
    distance = np.einsum("ni,ni->n", fit.missed, gap)
    nu = min(*fit.degrees_of_freedom, 1e6)
    within_noise = distance < 6 * f_distribution.isf(REJECT_AT, 6, nu)
    small = (np.linalg.norm(fit.translation_residual, axis=1) < TOLERANCE[0]) & (
        np.linalg.norm(fit.rotation_residual, axis=1) < TOLERANCE[1]
    )
    return within_noise | small


def least_trimmed(base_from_gripper: Poses, recon_from_camera: Poses) -> tuple[Bool[ndarray, " n"], float]:
    """The subset of images with the least trimmed squared error over all candidate triples, and its root mean (m)."""
    n = len(base_from_gripper)
    keep = max(4, int(np.ceil(SHARE_RIGHT * n)))
    triples = _congruent_triples(motions(base_from_gripper), motions(recon_from_camera))
    x, scale, z = closed_form(base_from_gripper[triples], recon_from_camera[triples], rounds=0)
    error = _squared_error(x, scale, z, base_from_gripper, recon_from_camera)
    error[scale <= 0] = np.inf
    ranked = np.argsort(np.sort(error, axis=1)[:, :keep].sum(1), kind="stable")[:CONCENTRATED]

    best, best_cost, tried = np.ones(n, dtype=bool), np.inf, set()
    for candidate in ranked:
        subset = error[candidate]
        for _ in range(4):  # concentration steps (Rousseeuw and Van Driessen 1999)
            chosen = np.zeros(n, dtype=bool)
            chosen[np.argsort(subset, kind="stable")[:keep]] = True
            if chosen.tobytes() in tried:
                break
            tried.add(chosen.tobytes())
            weights = chosen.astype(float)
            subset = _squared_error(
                *closed_form(base_from_gripper, recon_from_camera, weights),
                base_from_gripper,
                recon_from_camera,
            )
            cost = float(np.sort(subset)[:keep].sum())
            if cost < best_cost:
                best, best_cost = chosen, cost
    return best, float(np.sqrt(best_cost / keep))


def _squared_error(
    x: Float[ndarray, "*batch 4 4"],
    scale: Float[ndarray, "*batch"] | np.floating,
    z: Float[ndarray, "*batch 4 4"],
    base_from_gripper: Poses,
    recon_from_camera: Poses,
) -> Float[ndarray, "*batch n"]:
    """Squared distance (m²) of every reported gripper pose from its prediction, rotation counted by ARM."""
    gap = predict(x, scale, z, recon_from_camera) - base_from_gripper
    return (gap[..., :3, 3] ** 2).sum(-1) + ARM**2 * (gap[..., :3, :3] ** 2).sum((-1, -2)) / 2


def _congruent_triples(a: Float[ndarray, "n n 4 4"], b: Float[ndarray, "n n 4 4"]) -> Int[ndarray, "h 3"]:
    """Triples of images whose three motions turn by the same angle in gripper and camera, best first."""
    n = len(a)
    gap = np.abs(rotation_angle(a[..., :3, :3]) - rotation_angle(b[..., :3, :3]))
    i, j, k = np.array(list(combinations(range(n), 3))).T
    worst = np.maximum(np.maximum(gap[i, j], gap[i, k]), gap[j, k])
    # Two motions about one axis fix nothing: prefer triples that turn about two.
    axes_ij, axes_ik = sine_axis(a[i, j, :3, :3]), sine_axis(a[i, k, :3, :3])
    spread = np.linalg.norm(np.cross(axes_ij, axes_ik), axis=1)
    # The 0.3 quantile of all gaps comes from pairs of sound images even when 30 % of the images are wrong.
    typical = max(float(np.quantile(gap[np.triu_indices(n, 1)], 0.3)), np.radians(0.05))
    order = np.argsort(worst / typical + 0.02 / np.maximum(spread, 1e-6), kind="stable")[:MAX_TRIPLES]
    return np.stack([i[order], j[order], k[order]], axis=1)
