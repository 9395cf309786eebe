"""Rejection of images whose gripper pose contradicts the others (stale or shuffled poses), by Bayesian evidence.

Candidates come from triples of images with congruent motions: gripper and camera rotate by the same angle for every X
(screw congruence, Chen 1991). The candidate with the least trimmed squares over images (Rousseeuw 1984) starts a
maximum-likelihood fit, which images join while the evidence grows. The evidence is the marginal density of all
residuals; those of wrong poses may have any size (Box and Tiao, Biometrika 55, 1968). Large systematic errors of an arm
therefore give a larger estimated noise rather than many rejected poses.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import closed_form, initial_estimate
from jcr.estimation.problem import PoseModel, State, pose_problem
from jcr.estimation.robot_noise import MOST_FOR_SIZES
from jcr.estimation.solve import Solution, solve, with_covariance
from jcr.geometry import ARM, Poses, Transform, inverse, sine_axis

Images = Bool[ndarray, " n"]
"""Mask of the used images."""

SHARE_RIGHT = 0.65
"""Share of the images that the least-trimmed-squares fit uses; the others may be wrong."""
MAX_TRIPLES, MOST_TRIPLES = 1500, 30_000
"""Largest number of triples that are solved in closed form, and of triples to choose from (all, up to 57 images)."""
CONCENTRATED = 20
"""Number of best triples that start a trimmed fit; its cost is 0.1 % above the best known one, with 5 it is 2 %."""
WRONG = 1e-5
"""Prior share of wrong gripper poses. Correct poses of low-cost arms that were rejected: 5 % at 0.02, 2 % at 1e-5; at
1e-7 a wrong pose of the capture doosan_bench is accepted."""
LEAST_WRONG, MOST_WRONG = (1e-3, np.radians(0.2)), (1.0, np.pi)
"""Smallest and largest errors of wrong poses (m, rad); images with smaller errors are not rejected."""


class _Trial(NamedTuple):
    """Fit with some of n images, as far as the search compares it."""

    used: Images
    state: State
    """Most likely state."""
    evidence: float
    """Log evidence of the used poses, plus `log_wrong` of the unused poses."""
    distance: Float[ndarray, " n"]
    """Squared Mahalanobis length of each pose's leave-one-out error."""
    log_right: Float[ndarray, " n"]
    """Log((2π)³ d) of each pose: d is the density of its leave-one-out error if the pose is right."""
    log_wrong: Float[ndarray, " n"]
    """Log((2π)³ w d) of each pose: w odds of a wrong pose, d density of its leave-one-out error if wrong."""


def robust_fit(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    model: PoseModel | None = None,
    agreeing: Images | None = None,
) -> Solution:
    """Solve for hand-eye transform, scale and base_from_recon with the images that agree with each other.

    The mask `problem.used` of the solution has these images; fewer than five are all used. The search compares the log
    evidence of masks. It starts from the mask `agreeing` (None: that of `least_trimmed`), and from all images. Of more
    images than MOST_FOR_SIZES it starts only from as many agreeing ones, evenly spaced. `model` is that of
    `pose_problem`.
    """
    n, fits, model = len(base_from_gripper), dict[bytes, _Trial](), model or PoseModel()
    moving, unknown = model.moving(base_from_gripper), (np.eye(4), 1.0, np.eye(4))
    every, state = pose_problem(base_from_gripper, recon_from_camera, unknown, model)

    def fitted(used: Images, near: State | None = None) -> _Trial:
        """Return the fit with the used images, without averaging over error sizes.

        With more than MOST_FOR_SIZES images it starts from the state `near`, because a step takes the cube of their
        number.
        """
        if used.tobytes() not in fits:
            start = near
            if start is None or used.sum() <= MOST_FOR_SIZES:
                x, scale, z = initial_estimate(moving[used], recon_from_camera[used])
                start = replace(state, x=x[None], scale=scale, z=z[None])
            fits[used.tobytes()] = _trial(solve(replace(every, used=used), start, averaged=False), used)
        return fits[used.tobytes()]

    best = fitted(np.ones(n, dtype=bool)) if n <= MOST_FOR_SIZES else None
    if n >= 5:
        if agreeing is None:
            agreeing = least_trimmed(moving, recon_from_camera)[0]
        if best is None:
            rows = np.flatnonzero(agreeing)
            few = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_FOR_SIZES)).astype(int)]
            agreeing = np.isin(np.arange(n), few)
        more = _improved(fitted, fitted(agreeing), adding=True)
        fewer = more if best is None else _improved(fitted, best, adding=False)
        best = fewer if fewer.evidence >= more.evidence else more
    assert best is not None
    problem = replace(every, used=best.used)
    # Of many images the state is settled, and each further step takes the cube of their number.
    return solve(problem, best.state) if n <= MOST_FOR_SIZES else with_covariance(problem, best.state, None)


def _improved(fitted: Callable[[Images, State], _Trial], best: _Trial, adding: bool) -> _Trial:
    """Return the fit with the largest log evidence, by a greedy search from the fit `best`.

    `fitted` returns the fit for a mask, near a state. `adding`: each step adds all images whose pose is more likely
    right than wrong, or else the likeliest one; not `adding`: it removes the image of the largest leave-one-out error,
    down to four images.
    """
    while True:
        used = best.used
        if adding:
            likelier = np.where(used, -np.inf, best.log_right - best.log_wrong)
            joining = () if used.all() else (likelier > 0, likelier == likelier.max())
            changes = [used | some for some in joining if some.any()]
        else:
            worst = np.arange(len(used)) == np.where(used, best.distance, -np.inf).argmax()
            changes = [used & ~worst] if used.sum() > 4 else []
        better = (
            tried for changed in changes if (tried := fitted(changed, best.state)).evidence > best.evidence
        )
        if (found := next(better, None)) is None:
            return best
        best = found


def _trial(fit: Solution, used: Images) -> _Trial:
    """Return what the search compares of a fit with the `used` images.

    The errors of wrong poses have a uniform direction and a log-uniform size between LEAST_WRONG and MOST_WRONG. A pose
    with errors below LEAST_WRONG in translation and rotation is never wrong.
    """
    left_out, covariance = fit.leave_one_out
    gap = np.linalg.solve(covariance, left_out[..., None])[..., 0]
    distance = np.einsum("ni,ni->n", left_out, gap)
    off = np.linalg.norm(left_out.reshape(-1, 2, 3), axis=2)
    least, most = np.array(LEAST_WRONG), np.array(MOST_WRONG)
    density = -np.log(4 * np.pi * np.log(most / least)) - 3 * np.log(np.maximum(off, least))
    odds = np.log(WRONG / (1 - WRONG)) + 3 * np.log(2 * np.pi)
    wrong = np.where((off < least).all(1), -np.inf, density.sum(1) + odds)
    return _Trial(
        used,
        fit.most_likely,
        fit.log_evidence + float(wrong[~used].sum()),
        distance,
        -(distance + np.linalg.slogdet(covariance)[1]) / 2,
        wrong,
    )


def least_trimmed(base_from_gripper: Poses, recon_from_camera: Poses) -> tuple[Images, float]:
    """Return the mask of images with the least trimmed squared error over fits to image triples, and the rms error (m).

    The trimmed error is the sum over the best SHARE_RIGHT of the images; the mask has just these images. Rotation
    errors count as ARM times the angle.
    """
    n = len(base_from_gripper)
    keep = max(4, int(np.ceil(SHARE_RIGHT * n)))
    triples = _congruent_triples(base_from_gripper, recon_from_camera)
    x, scale, z = closed_form(base_from_gripper[triples], recon_from_camera[triples], rounds=0)
    error = np.full((len(triples), n), np.inf)
    for k in np.flatnonzero(scale > 0):
        error[k] = _squared_error(x[k], np.asarray(scale)[k], z[k], base_from_gripper, recon_from_camera)
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
            found = closed_form(base_from_gripper[chosen], recon_from_camera[chosen])
            subset = _squared_error(*found, base_from_gripper, recon_from_camera)
            cost = float(np.sort(subset)[:keep].sum())
            if cost < best_cost:
                best, best_cost = chosen, cost
    return best, float(np.sqrt(best_cost / keep))


def _squared_error(
    x: Transform,
    scale: Float[ndarray, ""] | np.floating,
    z: Transform,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
) -> Float[ndarray, " n"]:
    """Return the squared error (m²) of each reported gripper pose from its prediction; an angle counts as ARM times rad.

    The prediction is from `recon_from_camera`, `x` (gripper_from_camera), `scale` and `z` (base_from_recon).
    """
    # Both are turned to the axes of the reconstruction, with one product of matrices for all poses.
    n, scaled_camera_from_gripper = len(base_from_gripper), inverse(x)
    scaled_camera_from_gripper[3, 3] = scale
    predicted = recon_from_camera[:, :3].reshape(3 * n, 4) @ scaled_camera_from_gripper
    reported = z[:3, :3].T @ base_from_gripper[:, :3].swapaxes(0, 1).reshape(3, 4 * n)
    gap = predicted.reshape(n, 3, 4) - reported.reshape(3, n, 4).swapaxes(0, 1)
    gap[..., 3] += z[:3, :3].T @ z[:3, 3]
    return (gap[..., 3] ** 2).sum(1) + ARM**2 * (gap[..., :3] ** 2).sum((1, 2)) / 2


def pair_angles(a_from_b: Poses) -> Float[ndarray, "n n"]:
    """Return the rotation angles (rad) between all pairs of n poses; those near 0 and π are wrong by 1e-8."""
    flat = a_from_b[:, :3, :3].reshape(-1, 9)
    return np.arccos(np.clip((flat @ flat.T - 1) / 2, -1, 1))


def _congruent_triples(gripper: Poses, camera: Poses) -> Int[ndarray, "h 3"]:
    """Return h triples of images between which gripper and camera turn by the most similar angles, best first.

    Rows of the result are image numbers.
    """
    n = len(gripper)
    gap = np.abs(pair_angles(gripper) - pair_angles(camera))
    if n * (n - 1) * (n - 2) > 6 * MOST_TRIPLES:
        drawn = np.sort(np.random.default_rng(0).integers(n, size=(MOST_TRIPLES, 3)), axis=1)
        i, j, k = drawn[(np.diff(drawn, axis=1) > 0).all(1)].T
    else:
        row = np.arange(n)
        i, j, k = np.nonzero((row[:, None, None] < row[:, None]) & (row[:, None] < row))
    worst = np.maximum(np.maximum(gap[i, j], gap[i, k]), gap[j, k])
    # Motions about one axis do not determine X, so triples with two different axes are preferred.
    rotation = gripper[:, :3, :3]
    back = np.swapaxes(rotation[i], 1, 2)
    spread = np.linalg.norm(np.cross(sine_axis(back @ rotation[j]), sine_axis(back @ rotation[k])), axis=1)
    # The 0.3 quantile comes from pairs of correct images even if 30 % of the images are wrong.
    typical = max(float(np.quantile(gap[np.triu_indices(n, 1)], 0.3)), np.radians(0.05))
    order = np.argsort(worst / typical + 0.02 / np.maximum(spread, 1e-6), kind="stable")[:MAX_TRIPLES]
    return np.stack([i[order], j[order], k[order]], axis=1)
