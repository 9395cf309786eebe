"""Tests of effects that the model lacks, on gripper poses and cameras: Rao's score test ranks, Wald's test confirms.

The score test (Proc. Cambridge Phil. Soc. 44, 1948) uses the error sizes of the solution, which absorb part of an
effect. The confirmation estimates the sizes again together with the effect (Seber and Lee, Linear Regression Analysis,
2003, chapter 4).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.distributions import f as f_distribution
from jcr.estimation.elimination import cholesky, over
from jcr.estimation.image_equations import ImageEvidence, image_evidence
from jcr.estimation.intrinsics_prior import ESTIMATED, camera_with_prior
from jcr.estimation.kinematics import Arm, Joints, error_jacobian
from jcr.estimation.pose_equations import PoseEquations, pose_equations
from jcr.estimation.problem import (
    OF_IMAGE,
    PRISM,
    UNKNOWNS,
    Effect,
    State,
    columns_of_arm,
    rows_of,
    with_free,
)
from jcr.estimation.robot_noise import Equations, most_likely, over_sizes, solve_equations
from jcr.estimation.solve import Solution, solve_again
from jcr.findings import FindingKind
from jcr.geometry import Poses, Transform, skew, step_between
from jcr.records import Intrinsics, JointOffsets, RobotNoise

ORDERS = 200
"""Number of random image orders in a permutation test."""
BY_CHANCE = 0.02
"""Largest share of random orders with at least the gain of the actual order."""
LEAST_PART, LEAST_ZOOMED = 3, 2
"""Smallest number of images before and after a slip or a push, of which fewer are single wrong poses; and a zoom."""
MANY_PLACES = 60
"""Largest number of images at which a slip is tested; longer captures are sampled evenly."""
UP = np.array([0.0, 0.0, 1.0])
"""Direction against gravity in the base frame."""
STRAINS = np.zeros((5, 3, 3))
"""Orthonormal basis of the traceless symmetric strain matrices; the trace is a scale, which is unobservable."""
STRAINS[0], STRAINS[1] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2), np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6)
for _k, (_a, _b) in enumerate(((0, 1), (0, 2), (1, 2)), start=2):
    STRAINS[_k, _a, _b] = STRAINS[_k, _b, _a] = 1 / np.sqrt(2)


@dataclass(frozen=True, kw_only=True)
class Scores:
    """Quadratic cost of c coordinates, of which effects free some directions; all adjusted unknowns are eliminated."""

    information: Float[ndarray, "c c"]
    gradient: Float[ndarray, " c"]
    """Negative gradient of half the cost."""
    freedom: int
    """Degrees of freedom of the reported poses' residuals, used for F tests; images have far more."""
    dispersion: float = 1.0
    """Ratio of the gradient's actual variance to the variance that the weights imply."""

    def gain(self, free: Float[ndarray, "c r"]) -> tuple[float, int]:
        """Return the decrease of the cost (squared standard deviations) by the best step along the columns of `free`.

        The gain is gᵀS⁻¹g with S = AᵀPA and g = Aᵀ·gradient, A being `free` and P the information. The second result is
        the rank of S.
        """
        return squared_length(free.T @ self.gradient, free.T @ self.information @ free)

    def log_p(self, effect: Effect) -> float:
        """Return the natural log p-value of the score test of an effect: the chance of its gain without the effect.

        The gain of `Effect.both` minus that of `Effect.beside`, over `dispersion` and the number of parameters, is
        tested by an F distribution. The p-value is multiplied by `effect.places`.
        """
        (without, fewer), (gain, more) = self.gain(effect.beside), self.gain(effect.both)
        d = max(more - fewer, 1)
        ratio = max(gain - without, 0.0) / self.dispersion / d
        return float(f_distribution.logsf(ratio, d, self.freedom) + np.log(effect.places))


@dataclass(frozen=True, kw_only=True)
class Test:
    """Result of Wald's test of one effect."""

    effect: Effect
    estimate: Float[ndarray, " d"]
    """Estimate of the d parameters of the effect."""
    covariance: Float[ndarray, "d d"]
    """Covariance of the estimate."""
    log_p: float
    """Log p-value: chance of such an estimate without the effect, times the number of places tested."""
    shift: Float[ndarray, "7"]
    """Change when the effect is estimated too: of the camera's pose (m, rad; axes of its parent) and of log scale."""
    noise: RobotNoise
    """Robot pose noise estimated together with the effect."""
    solution: Solution | None = None
    """Solution with the effect; None for an effect on the poses."""


@dataclass(frozen=True, kw_only=True)
class Examined:
    """Solution of a problem, and the camera and the arm of it whose effects are tested."""

    solution: Solution
    names: Sequence[str]
    """Names of the camera's images."""
    std: Float[ndarray, "6"]
    """Standard deviations of the camera's pose (m, rad) without effects; 0 for a rejected calibration."""
    is_given: bool = False
    """Whether the intrinsics were given; otherwise the reconstruction estimated them."""
    camera: int | None = 0
    """Index of the camera among the adjusted cameras; None: the problem has no observations."""
    place: Callable[[State], Transform] = lambda state: state.x[0]
    """Function that returns the camera's pose, in the gripper or base frame, from the state."""
    arm: int | None = 0
    """Index of the arm whose poses are tested; None if another camera's tests include them."""

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Effects on the tested camera and arm that the solution includes."""
        every = self.solution.problem.effects
        return tuple(one for one in every if one.part == (self.camera if one.of_camera else self.arm))

    def with_effects(self, *effects: Effect) -> "Examined":
        """Return the solution that includes, of the tested camera and arm, exactly these effects.

        The sizes of all errors are estimated anew. Raises LinAlgError if the problem becomes singular.
        """
        others = (one for one in self.solution.problem.effects if one not in self.effects)
        return replace(self, solution=solve_again(self.solution, effects=(*others, *effects)))

    @property
    def intrinsics(self) -> Intrinsics:
        """Adjusted intrinsics of the tested camera; only if `camera` is not None."""
        assert self.camera is not None
        return self.solution.images.view.cameras[self.camera]

    @property
    def poses(self) -> tuple[Poses, slice]:
        """Used reported base_from_gripper of the tested arm, and the slice of their residuals in `solution.equations`.

        The equations have six residuals for each used pose, arm after arm.
        """
        used, arms, arm = self.solution.poses.used, self.solution.problem.arms, self.arm or 0
        first = sum(len(one.rigs) for one in arms[:arm])
        own = used[first : first + len(arms[arm].rigs)]
        start = 6 * int(used[:first].sum())
        return arms[arm].base_from_gripper[own], slice(start, start + 6 * int(own.sum()))

    @cached_property
    def pose_scores(self) -> Scores:
        """Quadratic cost of errors of the reported poses, with the unknowns of `solution` eliminated.

        Its c coordinates are the residuals of the used poses of all arms (m, rad; base axes).
        """
        at = self.solution.at_mode
        freedom = max(len(at.weighed_left) - self.solution.problem.arm_unknowns, 1)
        return Scores(information=at.projection, gradient=at.weighed_left, freedom=freedom)

    @cached_property
    def camera_scores(self) -> Scores:
        """Quadratic cost of changes of the tested camera's e parameters (`Effect`) from their values in `solution`.

        Units and weak prior are those of problem.rows_of. All other unknowns, and the freed directions, are eliminated.
        """
        assert self.camera is not None
        solution, state = self.solution, self.solution.images.state
        problem, likely = solution.problem, solution.most_likely
        rows, units, weak = rows_of(problem, self.camera)
        first = problem.columns.cameras.stop
        each = np.zeros((len(problem.directions), len(rows)))
        each[rows] = np.diag(units)
        wider = image_evidence(
            with_free(problem, freed=each, freed_std=weak),
            replace(state, camera_steps=np.insert(state.camera_steps, first, np.zeros(len(rows)))),
        )
        # The arms are at the most likely state, the images at the state of the evidence.
        at = replace(wider.state, x=likely.x, scale=likely.scale, z=likely.z)
        equations = pose_equations(wider.problem, at, wider).equations
        found = solve_equations(equations, solution.log_sizes)
        hessian = equations.jacobian.T @ found.weighed + equations.prior_information
        right = -(found.weighed.T @ equations.residual + equations.prior_gradient)
        rest = problem.arm_unknowns + first + np.arange(len(rows))
        kept = np.setdiff1d(np.arange(len(hessian)), rest)
        coupling = hessian[np.ix_(kept, rest)]
        by_column = over(cholesky(hessian[np.ix_(kept, kept)]), coupling)
        return Scores(
            information=hessian[np.ix_(rest, rest)] - coupling.T @ by_column,
            gradient=right[rest] - by_column.T @ right[kept],
            freedom=max(len(equations.residual) - problem.arm_unknowns, 1),
            dispersion=_dispersion(solution.images),
        )


def rank(model: Examined, effects: Sequence[Effect]) -> list[tuple[Effect, float]]:
    """Return `effects` with the natural log p-values of their score tests (`Scores.log_p`), the smallest first."""
    each = [
        (model.camera_scores if effect.of_camera else model.pose_scores).log_p(effect) for effect in effects
    ]
    return sorted(zip(effects, each, strict=True), key=lambda one: one[1])


def confirm(model: Examined, effect: Effect) -> Test:
    """Return Wald's test of one possible effect: whether its estimate differs significantly from 0.

    The error sizes are estimated anew together with the effect. An effect on the poses is estimated in the linearised
    equations of `model`. An effect on the camera is estimated by a new adjustment with all confirmed effects of
    `model`, which raises LinAlgError if it is singular.
    """
    if not effect.of_camera:
        return confirm_in_equations(model.solution.equations, effect, model.arm or 0)
    after = model.with_effects(*model.effects, effect)
    assert model.camera is not None
    problem, solution, d = after.solution.problem, after.solution, effect.columns.shape[1]
    # The effect is the part of the freed directions along its columns, which no nuisance direction shares.
    rows, units, _ = rows_of(problem, model.camera)
    freed = slice(problem.columns.cameras.stop - len(problem.of_effects[1]), problem.columns.cameras.stop)
    along = np.linalg.pinv(effect.both)[-d:] @ (problem.directions[rows, freed] / units[:, None])
    unknowns = solution.camera_unknowns(freed)
    estimate = along @ solution.images.state.camera_steps[freed]
    covariance = along @ solution.covariance[unknowns, unknowns] @ along.T
    # As in the score test, the dispersion is that of the residuals without the effect.
    scores = model.camera_scores
    ratio = squared_length(estimate, covariance)[0] / d / scores.dispersion
    step = step_between(model.place(model.solution.state), model.place(solution.state))
    growth = np.log(solution.state.scale / model.solution.state.scale)
    return Test(
        effect=effect,
        estimate=estimate,
        covariance=_dispersion(solution.images) * covariance,
        log_p=float(f_distribution.logsf(ratio, d, scores.freedom) + np.log(effect.places)),
        shift=np.r_[step, growth],
        noise=solution.equations.noise(solution.log_sizes, model.arm or 0),
        solution=solution,
    )


def squared_length(vector: Float[ndarray, " d"], covariance: Float[ndarray, "d d"]) -> tuple[float, int]:
    """Return vᵀC⁺v of a vector v with covariance C, C⁺ being the pseudo-inverse, and the rank of C."""
    scale = 1 / np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(scale[:, None] * covariance * scale)
    kept = values > 1e-9 * values.max(initial=1e-300)
    whitened = vectors[:, kept].T @ (scale * vector) / np.sqrt(values[kept])
    return float(whitened @ whitened), int(kept.sum())


def confirm_in_equations(equations: Equations, effect: Effect, arm: int) -> Test:
    """Return Wald's test of an effect on the poses: an F test of its parameters, averaged over the error sizes.

    The rows of `effect.columns` are those of `equations.residual`. The average weighs each choice of the sizes by its
    posterior (`over_sizes`). The denominator's degrees of freedom are those of all residuals, which is conservative.
    `arm` is the arm whose noise and shift the result has; log scale counts as unchanged.
    """
    count, d = equations.jacobian.shape[1], effect.columns.shape[1]
    free = replace(
        equations,
        jacobian=np.concatenate([equations.jacobian, effect.columns], axis=1),
        prior_information=np.pad(equations.prior_information, (0, d)),
        prior_gradient=np.pad(equations.prior_gradient, (0, d)),
    )
    likeliest, information = most_likely(free)
    found = solve_equations(free, likeliest)
    without = solve_equations(equations, likeliest)
    under = float(max(len(equations.residual) - UNKNOWNS - d, 1))
    log_shares = []
    # Few poses determine the sizes badly, and with larger sizes the same estimate is less significant.
    for weight, _, each in over_sizes(free, likeliest, information, arm=arm):
        size, covariance = each.step[:, count:], each.covariance[:, count:, count:]
        ratio = (size * np.linalg.solve(covariance, size[..., None])[..., 0]).sum(1) / d
        log_tail = np.array([f_distribution.logsf(float(one), d, under) for one in ratio])
        log_shares.append(np.log(np.maximum(weight, 1e-300)) + log_tail)
    return Test(
        effect=effect,
        estimate=found.step[count:],
        covariance=found.covariance[count:, count:],
        log_p=float(np.logaddexp.reduce(np.concatenate(log_shares)) + np.log(effect.places)),
        shift=np.r_[(found.step[:count] - without.step)[columns_of_arm(arm)[:6]], 0.0],
        noise=free.noise(likeliest, arm),
    )


def explains_by_order(scores: Scores, effect: Effect) -> bool:
    """Return whether at most the share BY_CHANCE of random orders of the images reach the score gain of a motion.

    `effect` must have `motion` and `share`. ORDERS permutations of the share among the poses that move are compared by
    `Scores.gain` of motion times share. This permutation test allows for errors with heavy tails and single wrong
    poses.
    """
    assert effect.motion is not None and effect.share is not None
    rng, own = np.random.default_rng(0), effect.motion[::6].any(axis=1)
    centred, shares = effect.share[own] - effect.share[own].mean(), [effect.share]
    for _ in range(ORDERS):
        order = rng.permutation(centred)
        # A constant is absorbed by the hand-eye transform and the sign is arbitrary: such orders are equivalent.
        if not (np.allclose(order, centred) or np.allclose(order, -centred)):
            shares.append(effect.share.copy())
            shares[-1][own] = order
    found, *others = (scores.gain(effect.motion * np.repeat(share, 6)[:, None])[0] for share in shares)
    return sum(one >= found - 1e-9 for one in others) <= BY_CHANCE * len(others)


def pose_effects(model: Examined) -> Iterator[Effect]:
    """Yield the effects on the poses of the tested arm: those of the image order, then those of the gripper pose.

    They are drift, slip of the camera, base moved and delayed poses; then those of `arm_effects`. Slip and moved base
    have one effect for each of at most MANY_PLACES images at which they may happen. Parameters are steps (m, rad) of X
    for drift and slip, of Z for a moved base, and a number of images for the delay. The arm needs six poses or more.
    """
    # These imports are slow and rarely needed.
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    (gripper, own), part = model.poses, model.arm or 0
    n, jacobian = len(gripper), model.solution.equations.jacobian
    by_x, by_z = np.split(jacobian[:, columns_of_arm(part)], 2, axis=1)

    count = min(n - 2 * LEAST_PART + 1, MANY_PLACES)
    places = np.unique(np.linspace(LEAST_PART, n - LEAST_PART, count).astype(int)).tolist()
    changes = [(FindingKind.DRIFT, by_x, np.linspace(-0.5, 0.5, n), 0)]
    for k in places:
        after = (np.arange(n) >= k).astype(float)
        changes += [(FindingKind.SLIP, by_x, after, k), (FindingKind.BASE_MOVED, by_z, after, k)]
    for kind, motion, factor, k in changes:
        share = np.zeros(len(jacobian) // 6)
        share[own.start // 6 : own.stop // 6] = factor
        columns = motion * np.repeat(share, 6)[:, None]
        count = len(places) if k else 1
        yield Effect(kind=kind, part=part, columns=columns, motion=motion, share=share, place=k, places=count)
    # The velocity (m, rad per image) at each pose, by splines through all poses.
    moment, little = np.arange(n, dtype=float), 1e-3
    rotation = RotationSpline(moment, Rotation.from_matrix(gripper[:, :3, :3]))
    turned = (rotation(moment + little) * rotation(moment - little).inv()).as_rotvec()
    velocity = np.concatenate(
        [CubicSpline(moment, gripper[:, :3, 3])(moment, 1), turned / (2 * little)], axis=1
    )
    late = Effect(kind=FindingKind.DELAY, columns=velocity.reshape(-1, 1))
    for one in (late, *arm_effects(gripper)):
        yield replace(
            one, part=part, columns=np.pad(one.columns, ((own.start, len(jacobian) - own.stop), (0, 0)))
        )


def arm_effects(base_from_gripper: Poses) -> Iterator[Effect]:
    """Yield the effects that depend on the gripper pose: strain of all lengths, leaning base, sagging tool.

    Columns are errors of n poses (6n rows: m, then rad, pose by pose; base axes, z up). Parameters of the strain are
    the coefficients of the five STRAINS. The lean is in rad per metre of horizontal distance of the gripper. The sag is
    in rad for a weight on a horizontal lever, along each of the three gripper axes.
    """
    position, rotation = base_from_gripper[:, :3, 3], base_from_gripper[:, :3, :3]
    n = len(position)
    strain = np.zeros((n, 6, len(STRAINS)))
    strain[:, :3] = np.einsum("kab,nb->nak", STRAINS, position)
    yield Effect(kind=FindingKind.LENGTHS, columns=strain.reshape(6 * n, -1), unit=0.1)
    # The base leans towards the gripper by 1 rad per metre of horizontal distance.
    lean = np.cross(position, UP)
    columns = np.concatenate([np.cross(lean, position), lean], axis=1).reshape(6 * n, 1)
    yield Effect(kind=FindingKind.BASE_LEANS, columns=columns, unit=0.2)
    # The gripper rotates under a weight on a lever along each of its axes, by 1 rad for a horizontal lever.
    sag = np.zeros((n, 6, 3))
    sag[:, 3:] = -rotation @ skew(rotation[:, 2])
    yield Effect(kind=FindingKind.TOOL_SAGS, columns=sag.reshape(6 * n, -1), unit=0.1)


def joint_offsets(poses: PoseEquations, arm: Arm, joints: Joints) -> JointOffsets:
    """Return each joint's offset (rad), true minus reported angle, with its standard deviation.

    `joints` (n,dof) are the reported angles (rad) of the n used poses; the systematic errors of `poses` must be those
    of `arm_errors`. The method is best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at
    the most likely error sizes. An unobservable offset, such as the first joint's, keeps its prior standard deviation:
    the size σ_s of the systematic errors.
    """
    sizes = most_likely(poses.equations)[0]
    solution = solve_equations(poses.equations, sizes)
    size = float(np.sqrt(poses.equations.variances(sizes)[2]))
    columns = error_jacobian(arm, joints)[:, :, : arm.dof].reshape(-1, arm.dof)
    columns = columns - poses.region.basis @ (poses.region.coordinates @ columns)
    offset = size**2 * columns.T @ solution.weighed_left
    known = np.diag(columns.T @ solution.projection @ columns)
    return JointOffsets(offset, size * np.sqrt(np.maximum(1 - size**2 * known, 0.0)), size)


TESTED_IF_GIVEN = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""Intrinsics that are tested if they were given."""
TESTED_IF_ESTIMATED = ("fx", "p1", "p2")
"""Intrinsics that are tested of estimated ones, for which fx = fy and p1 = p2 = 0 was assumed."""


def tested_intrinsics(model: Examined) -> list[str]:
    """Return the names of the camera's parameters that the test of FindingKind.INTRINSICS frees.

    They are TESTED_IF_GIVEN or TESTED_IF_ESTIMATED, as far as the camera has them. A given distortion coefficient is
    not tested if its prior is at least as wide as in ESTIMATED: its value was not used.
    """
    assert model.camera is not None
    prior, tested = model.solution.problem.cameras[model.camera], TESTED_IF_ESTIMATED
    names, loose = parameter_names(prior.intrinsics), set[str]()
    if model.is_given:
        tested, usual = TESTED_IF_GIVEN, camera_with_prior(prior.intrinsics, ESTIMATED).parameter_std
        each = zip(names[4:], prior.parameter_std[4:], usual[4:], strict=True)
        loose = {name for name, one, most in each if one >= most > 0}
    return [name for name in tested if name in names and name not in loose]


def camera_effects(model: Examined, min_images: int) -> Iterator[Effect]:
    """Yield the possible effects on the tested camera: wrong intrinsics, effects on its images, then a thin prism.

    Effects on images are focal lengths and shears (rolling shutter). They include a zoom, with one effect for each image
    at which it may happen. Each has the common error of the focal length as nuisance; the prism also has the principal
    point. With fewer than `min_images` images, wrong intrinsics are the only effect. The
    prism is tested only if there is one camera.
    """
    problem, view = model.solution.problem, model.solution.images.view
    observations = problem.observations
    assert observations is not None and model.camera is not None
    camera = problem.cameras[model.camera].intrinsics
    mine = np.flatnonzero(observations.camera == model.camera)
    names, m = parameter_names(camera), len(mine)
    every = np.eye(len(names) + OF_IMAGE * m + PRISM)
    # Directions of the focal length and of the shear of each image.
    focal, shear = np.split(every[:, len(names) : -PRISM], OF_IMAGE, axis=1)
    effect = partial(Effect, part=model.camera)
    tested = every[:, [names.index(name) for name in tested_intrinsics(model)]]
    yield effect(kind=FindingKind.INTRINSICS, columns=tested)
    if m < min_images:
        return
    common = every[:, :2].sum(1, keepdims=True)
    of_centre = np.concatenate([common, every[:, 2:4]], axis=1)
    # An image without points, or with points behind its camera, gets the median distance.
    distance = np.array([np.median(view.depth[observations.image == k]) if (observations.image == k).any() else np.nan
                         for k in mine])  # fmt: skip
    ahead = distance > 0  # neither NaN nor behind the camera
    far = np.log(np.where(ahead, distance, np.median(distance[ahead]) if ahead.any() else 1.0))
    by_distance, unit = focal @ (far - far.mean())[:, None], float(np.ptp(far))
    # An orthonormal basis of the vectors whose sum is 0.
    each = focal @ np.linalg.svd(np.eye(m) - 1 / m)[0][:, : m - 1]
    yield effect(kind=FindingKind.FOCUS_BY_DISTANCE, columns=by_distance, nuisance=common, unit=unit)
    yield effect(kind=FindingKind.FOCUS_BY_IMAGE, columns=each, nuisance=common)
    sheared = shear.sum(1, keepdims=True)
    yield effect(kind=FindingKind.ROLLING_SHUTTER, columns=sheared, nuisance=common, unit=camera.fx)
    places = range(LEAST_ZOOMED, m - LEAST_ZOOMED + 1)
    for k in places:
        after = focal @ ((np.arange(m) >= k) - (m - k) / m)[:, None]
        yield effect(kind=FindingKind.ZOOM, columns=after, nuisance=common, place=k, places=len(places))
    if len(problem.cameras) == 1:  # all images have the same lens
        yield effect(kind=FindingKind.THIN_PRISM, columns=every[:, -PRISM:], nuisance=of_centre)


def _dispersion(images: ImageEvidence) -> float:
    """Return the actual variance of the weighted residuals (weight · px) over the variance that their weights imply.

    The larger of two estimates is returned: from single residuals, and from their sums over image cells, which are
    clusters in the sense of Liang and Zeger (Biometrika 73, 1986).
    """
    problem, weight = images.problem, images.weight
    pull = weight[:, None] * images.view.residual_px
    taken = 3 * len(images.state.points_in_world) + 6 * len(problem.seen.rows)
    expected = 2 * weight.sum() * max(1 - taken / (2 * len(weight)), 0.1)
    return max(float((pull**2).sum()), problem.layout.squares_of_cells(pull)) / expected
