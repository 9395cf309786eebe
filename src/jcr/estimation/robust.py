"""Rejection of images whose gripper pose contradicts the others (stale or shuffled poses), by Bayesian evidence.

Candidates come from triples of images with congruent motions: gripper and camera rotate by the same angle for every X
(screw congruence, Chen 1991). The candidate with the least trimmed squares over images (Rousseeuw 1984) starts a
maximum-likelihood fit, which images join while the evidence grows. The evidence is the marginal density of all
residuals; those of wrong poses may have any size (Box and Tiao, Biometrika 55, 1968). Large systematic errors of an arm
therefore give a larger estimated noise rather than many rejected poses.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import closed_form, initial_estimate, motions, sine_axis
from jcr.estimation.pose_equations import pose_equations, predicted_gripper_poses
from jcr.estimation.problem import (
    BASE_ROTATION,
    BASE_TRANSLATION,
    SCALE,
    LinearPrior,
    Problem,
    State,
    pose_problem,
)
from jcr.estimation.robot_noise import TOO_MANY, of_poses, solve_equations
from jcr.estimation.solve import Solution, solve
from jcr.geometry import ARM, Poses, inverse, rotation_angle, skew, transform

Images = Bool[ndarray, " n"]
"""Mask of the used images."""

SHARE_RIGHT = 0.65
"""Share of the images that the least-trimmed-squares fit uses; the others may be wrong."""
MAX_TRIPLES, MOST_TRIPLES = 1500, 30_000
"""Largest number of triples that are solved in closed form, and of triples to choose from (all, up to 57 images)."""
MANY = 50
"""Largest number of images of which some are removed from all in a second search; it needs a fit for each image that
is wrong."""
CONCENTRATED = 20
"""Number of best triples that start a trimmed fit; its cost is 0.1 % above the best known one, with 5 it is 2 %."""
WRONG = 1e-5
"""Prior share of wrong gripper poses. Correct poses of low-cost arms that were rejected: 5 % at 0.02, 2 % at 1e-5; at
1e-7 a wrong pose of the capture doosan_bench is accepted."""
LEAST_WRONG, MOST_WRONG = (1e-3, np.radians(0.2)), (1.0, np.pi)
"""Smallest and largest errors of wrong poses (m, rad); images with smaller errors are not rejected."""


def robust_fit(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    noise: tuple[float, float] | None = None,
    priors: tuple[LinearPrior, ...] = (),
    camera_covariance: Float[ndarray, "r r"] | None = None,
    systematic: Float[ndarray, "r r"] | None = None,
    agreeing: Images | None = None,
    carries: Literal["camera", "scene"] = "camera",
) -> Solution:
    """Solve for hand-eye transform, scale and base_from_recon with the images that agree with each other.

    The mask `problem.used` of the solution has these images; fewer than five are all used. The search compares the log
    evidence of masks. It starts from the mask `agreeing` (None: that of `least_trimmed`), and from all images unless
    they are more than MANY. Other arguments are those of pose_problem (`noise`: noise_floor; `systematic`:
    error_covariance). The problem is solved in a frame at the centre of the cameras with their extent as unit, for
    numerical reasons; the solution is in the given frame.
    """
    n, centers = len(base_from_gripper), recon_from_camera[:, :3, 3]
    middle = centers.mean(0)
    unit = float(np.sqrt(((centers - middle) ** 2).sum(1).mean()))
    unit = unit if unit > 1e-12 * np.abs(centers).max() else 1.0
    given_cameras = recon_from_camera, camera_covariance, priors
    recon_from_camera = transform(recon_from_camera[:, :3, :3], (centers - middle) / unit)
    priors = tuple(
        one._replace(value=one.value + np.log(unit) * float(one.row[SCALE].item())) for one in priors
    )
    if camera_covariance is not None:
        per_unit = np.tile(np.repeat([1 / unit, 1.0], 3), n)
        camera_covariance = per_unit[:, None] * camera_covariance * per_unit
    moving = inverse(base_from_gripper) if carries == "scene" else base_from_gripper
    fits: dict[bytes, Solution] = {}

    def problem_of(rows: Int[ndarray, " k"]) -> tuple[Problem, State]:
        """Return the problem with k of the n images, and an initial state to complete."""
        return pose_problem(
            base_from_gripper[rows],
            recon_from_camera[rows],
            (np.eye(4), 1.0, np.eye(4)),
            camera_covariance=None if camera_covariance is None else of_poses(camera_covariance, rows),
            error_covariance=None if systematic is None else of_poses(systematic, rows),
            noise_floor=noise,
            priors=priors,
            carries=carries,
        )

    every, state = problem_of(np.arange(n))

    def fitted(used: Images) -> Solution:
        """Return the solution with the used images, without averaging over error sizes.

        With more than TOO_MANY images it starts from the solution with as many of them, evenly spaced, because a step
        takes the cube of their number.
        """
        if used.tobytes() not in fits:
            x, scale, z = initial_estimate(moving[used], recon_from_camera[used])
            start = {"x": x[None], "scale": scale, "z": z[None]}
            if (rows := np.flatnonzero(used)).size > TOO_MANY:
                some, begin = problem_of(rows[np.linspace(0, len(rows) - 1, TOO_MANY).astype(int)])
                near = solve(some, replace(begin, **start), averaged=False).most_likely
                start = {name: getattr(near, name) for name in (*start, "robot_log_sizes")}
            fits[used.tobytes()] = solve(replace(every, used=used), replace(state, **start), averaged=False)
        return fits[used.tobytes()]

    used = np.ones(n, dtype=bool)
    if n >= 5:
        if agreeing is None:
            agreeing = least_trimmed(moving, recon_from_camera)[0]
        used, evidence = _improved(fitted, agreeing, adding=True)
        if n <= MANY:
            fewer, other = _improved(fitted, np.ones(n, dtype=bool), adding=False)
            used = fewer if other >= evidence else used
    fit = solve(replace(every, used=used), fitted(used).most_likely)
    return _in_frame(fit, given_cameras, middle, unit)


def _in_frame(
    fit: Solution,
    given: tuple[Poses, Float[ndarray, "r r"] | None, tuple[LinearPrior, ...]],
    middle: Float[ndarray, "3"],
    unit: float,
) -> Solution:
    """Return a solution for cameras (c - `middle`) / `unit` as that for the cameras c.

    `given` holds the camera poses c, their covariance, and the priors. X, Z and scale step as before; only the position
    of Z depends on the frame.
    """
    recon_from_camera, covariance, priors = given

    def moved(state: State) -> State:
        """Return the state with base_from_recon, scale and camera poses in the given frame and unit."""
        z, rigs, scale = state.z[0], state.world_from_rig, state.scale / unit
        z = transform(z[:3, :3], z[:3, 3] - z[:3, :3] @ (scale * middle))
        rigs = transform(rigs[:, :3, :3], unit * rigs[:, :3, 3] + middle)
        return replace(state, scale=scale, z=z[None], world_from_rig=rigs)

    problem = replace(fit.problem, known_rigs=(recon_from_camera, covariance), priors=priors)
    state, likely = moved(fit.state), moved(fit.most_likely)
    poses = pose_equations(problem, likely, None)
    away = state.scale * state.z[0][:3, :3] @ middle
    by_step = np.eye(len(fit.covariance))
    by_step[BASE_TRANSLATION, SCALE], by_step[BASE_TRANSLATION, BASE_ROTATION] = -away[:, None], skew(away)
    found = replace(
        fit,
        problem=problem,
        state=state,
        covariance=by_step @ fit.covariance @ by_step.T,
        most_likely=likely,
        poses=poses,
        at_mode=solve_equations(poses.equations, fit.log_sizes),
    )
    # Leave-one-out errors are the same in all frames; a frame far from the cameras would cost digits.
    found.__dict__["leave_one_out"] = fit.leave_one_out
    return found


def _improved(fitted: Callable[[Images], Solution], used: Images, adding: bool) -> tuple[Images, float]:
    """Return the mask of used images with the largest log evidence, by a greedy search from `used`, and that evidence.

    `fitted` returns the fit for a mask. `adding`: each step adds all images whose pose is more likely right than wrong,
    or else the likeliest one; not `adding`: it removes the image of the largest leave-one-out error, down to four
    images.
    """
    fit = fitted(used)
    best = _evidence(fit, used)
    while True:
        if adding:
            _, spread = np.linalg.slogdet(fit.leave_one_out[1])
            likelier = np.where(used, -np.inf, -(_distance(fit) + spread) / 2 - _log_wrong(fit))
            joining = () if used.all() else (likelier > 0, likelier == likelier.max())
            changes = [used | some for some in joining if some.any()]
        else:
            worst = np.arange(len(used)) == np.where(used, _distance(fit), -np.inf).argmax()
            changes = [used & ~worst] if used.sum() > 4 else []
        for changed in changes:
            tried = fitted(changed)
            evidence = _evidence(tried, changed)
            if evidence > best:
                used, best, fit = changed, evidence, tried
                break
        else:
            return used, best


def _evidence(fit: Solution, used: Images) -> float:
    """Return the log evidence of a fit: log evidence of the used poses, plus `_log_wrong` of the unused poses."""
    return fit.log_evidence + float(_log_wrong(fit)[~used].sum())


def _distance(fit: Solution) -> Float[ndarray, " n"]:
    """Return the squared Mahalanobis length of each pose's leave-one-out error: error squared over its covariance."""
    left_out, covariance = fit.leave_one_out
    gap = np.linalg.solve(covariance, left_out[..., None])[..., 0]
    return np.einsum("ni,ni->n", left_out, gap)


def _log_wrong(fit: Solution) -> Float[ndarray, " n"]:
    """Return log((2π)³ · w · d) of each pose: w odds of a wrong pose, d density of its leave-one-out error if wrong.

    The errors of wrong poses have a uniform direction and a log-uniform size between LEAST_WRONG and MOST_WRONG. The
    result is −∞ for errors below LEAST_WRONG in translation and rotation.
    """
    off = np.linalg.norm(fit.leave_one_out[0].reshape(-1, 2, 3), axis=2)
    least, most = np.array(LEAST_WRONG), np.array(MOST_WRONG)
    density = -np.log(4 * np.pi * np.log(most / least)) - 3 * np.log(np.maximum(off, least))
    odds = np.log(WRONG / (1 - WRONG)) + 3 * np.log(2 * np.pi)
    return np.where((off < least).all(1), -np.inf, density.sum(1) + odds)


def least_trimmed(base_from_gripper: Poses, recon_from_camera: Poses) -> tuple[Images, float]:
    """Return the mask of images with the least trimmed squared error over fits to image triples, and the rms error (m).

    The trimmed error is the sum over the best SHARE_RIGHT of the images; the mask has just these images. Rotation
    errors count as ARM times the angle.
    """
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
            found = closed_form(base_from_gripper[chosen], recon_from_camera[chosen])
            subset = _squared_error(*found, base_from_gripper, recon_from_camera)
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
    """Return the squared error (m²) of each reported gripper pose from its prediction; an angle counts as ARM times rad.

    The prediction is from `recon_from_camera`, `x` (gripper_from_camera), `scale` and `z` (base_from_recon).
    """
    gap = predicted_gripper_poses(x, scale, z, recon_from_camera) - base_from_gripper
    return (gap[..., :3, 3] ** 2).sum(-1) + ARM**2 * (gap[..., :3, :3] ** 2).sum((-1, -2)) / 2


def _congruent_triples(a: Float[ndarray, "n n 4 4"], b: Float[ndarray, "n n 4 4"]) -> Int[ndarray, "h 3"]:
    """Return h triples of images whose motions `a` (gripper) and `b` (camera) have the most similar angles, best first.

    `a` and `b` hold the relative motion of every pair (i, j) of images, as `closed_form.motions`. Rows of the result
    are image numbers.
    """
    n = len(a)
    gap = np.abs(rotation_angle(a[..., :3, :3]) - rotation_angle(b[..., :3, :3]))
    if n * (n - 1) * (n - 2) > 6 * MOST_TRIPLES:
        drawn = np.sort(np.random.default_rng(0).integers(n, size=(MOST_TRIPLES, 3)), axis=1)
        i, j, k = drawn[(np.diff(drawn, axis=1) > 0).all(1)].T
    else:
        row = np.arange(n)
        i, j, k = np.nonzero((row[:, None, None] < row[:, None]) & (row[:, None] < row))
    worst = np.maximum(np.maximum(gap[i, j], gap[i, k]), gap[j, k])
    # Motions about one axis do not determine X, so triples with two different axes are preferred.
    axes = sine_axis(a[..., :3, :3])
    spread = np.linalg.norm(np.cross(axes[i, j], axes[i, k]), axis=1)
    # The 0.3 quantile comes from pairs of correct images even if 30 % of the images are wrong.
    typical = max(float(np.quantile(gap[np.triu_indices(n, 1)], 0.3)), np.radians(0.05))
    order = np.argsort(worst / typical + 0.02 / np.maximum(spread, 1e-6), kind="stable")[:MAX_TRIPLES]
    return np.stack([i[order], j[order], k[order]], axis=1)
