"""Tests of additional effects on gripper poses and cameras: Rao's score test ranks, Wald's test confirms.

The score test (Proc. Cambridge Phil. Soc. 44, 1948) uses the error sizes of the solution, which absorb part of an
effect. The confirmation estimates the sizes again together with the effect and averages F tests over the sizes (Seber
and Lee, Linear Regression Analysis, 2003, chapter 4).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import parameter_names
from jcr.distributions import f as f_distribution
from jcr.estimation.elimination import cholesky, over
from jcr.estimation.image_equations import ImageEvidence, image_evidence
from jcr.estimation.kinematics import Arm, Joints, error_jacobian
from jcr.estimation.pose_equations import PoseEquations, pose_equations
from jcr.estimation.problem import (
    OF_IMAGE,
    PRISM,
    UNKNOWNS,
    State,
    rows_of,
    spanned,
    with_free,
)
from jcr.estimation.robot_noise import (
    Equations,
    LogSizes,
    most_likely,
    over_sizes,
    solve_equations,
)
from jcr.estimation.solve import Solution
from jcr.findings import FindingKind
from jcr.geometry import Poses, Transform, skew
from jcr.records import Intrinsics, JointOffsets, RobotNoise

CONFIRMED_AT_MOST = 3
"""Number of kinds of effects that are confirmed, those with the largest gains of the score test."""
ORDERS = 200
"""Number of random image orders in a permutation test."""
BY_CHANCE = 0.02
"""Largest share of random orders with at least the gain of the actual order."""
LEAST_PART = 3
"""Smallest number of images before and after a change, such as a slip; fewer are single wrong poses."""
MANY_PLACES = 60
"""Largest number of images at which a change is tested; longer captures are sampled evenly."""
UP = np.array([0.0, 0.0, 1.0])
"""Direction against gravity in the base frame."""
PLAUSIBLE: dict[FindingKind, tuple[float, float]] = {
    FindingKind.SLIP: (0.12, np.radians(45.0)),
    FindingKind.BASE_MOVED: (0.2, np.radians(20.0)),
    FindingKind.DRIFT: (0.03, np.radians(10.0)),
    FindingKind.DELAY: (1.0, 0.0),
    FindingKind.LENGTHS: (0.1, 0.0),
    FindingKind.BASE_LEANS: (0.3, 0.0),
    FindingKind.TOOL_SAGS: (0.3, 0.0),
}
"""Largest plausible estimate of each effect: (m, rad) of a motion with six parameters, else the parameters' norm."""
STRAINS = np.zeros((5, 3, 3))
"""Orthonormal basis of the traceless symmetric strain matrices; the trace is a scale, which is unobservable."""
STRAINS[0], STRAINS[1] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2), np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6)
for _k, (_a, _b) in enumerate(((0, 1), (0, 2), (1, 2)), start=2):
    STRAINS[_k, _a, _b] = STRAINS[_k, _b, _a] = 1 / np.sqrt(2)


@dataclass(frozen=True, kw_only=True)
class Row:
    """One possible effect on the n gripper poses: its d parameters, and the derivative of the residuals by them."""

    kind: FindingKind
    columns: Float[ndarray, "s d"]
    """Derivative of the s = 6n residuals (m, rad; base axes) by the parameters."""
    place: int = 0
    """First image after the change; 0 for an effect that is not a change at one image."""
    prior_std: float = 0.1
    """Prior standard deviation of the parameters when the effect is adopted, large enough to have little influence."""


@dataclass(frozen=True, kw_only=True)
class Test:
    """Result of Wald's test of one effect."""

    row: Row
    estimate: Float[ndarray, " d"]
    """Estimate of the d parameters of the effect."""
    covariance: Float[ndarray, "d d"]
    """Covariance of the estimate."""
    log_p: float
    """Log p-value: chance of such an estimate without the effect, times the number of places tested."""
    shift: Float[ndarray, " p"]
    """Change of the p unknowns when the effect is estimated too."""
    noise: RobotNoise
    """Robot pose noise estimated together with the effect."""

    def is_within(self, limits: tuple[float, float]) -> bool:
        """Return whether the estimate is within limits: (m, rad) for a motion with six parameters.

        Other effects are compared by the norm of their parameters with the first limit.
        """
        if self.row.columns.shape[1] != 6:
            return bool(np.linalg.norm(self.estimate) <= limits[0])
        return bool((np.linalg.norm(self.estimate.reshape(2, 3), axis=1) <= limits).all())


def rank(equations: Equations, log_sizes: LogSizes, every: Sequence[Float[ndarray, "s _"]]) -> list[float]:
    """Return how much each candidate effect would reduce the weighted squared residuals (gain of the score test).

    Each matrix A in `every` is the derivative of the residuals by an effect's parameters. The gain is gᵀS⁻¹g with g =
    AᵀV⁻¹(r + Jθ) and S = AᵀPA; V, r + Jθ and P are the covariance, residuals and `projection` of the fit without the
    effect.
    """
    solution = solve_equations(equations, log_sizes)
    projection, left = solution.projection, solution.weighed_left
    return [float(left @ a @ np.linalg.lstsq(a.T @ projection @ a, a.T @ left, rcond=1e-9)[0]) for a in every]


def best_tests(equations: Equations, log_sizes: LogSizes, rows: Sequence[Row]) -> list[Test]:
    """Return Wald's tests of the most promising effects, at most one row of each kind, the smallest p-value first.

    A p-value is multiplied by the number of rows of the same kind, since the best of these rows was selected.
    """
    # The penalty d · log(s) of Schwarz (1978).
    penalty = [np.log(len(equations.residual)) * row.columns.shape[1] for row in rows]
    gain = np.subtract(rank(equations, log_sizes, [row.columns for row in rows]), penalty)
    best: dict[FindingKind, int] = {}
    for k in np.argsort(-gain).tolist():
        best.setdefault(rows[k].kind, k)
    places = Counter(row.kind for row in rows)
    chosen = list(best.items())[:CONFIRMED_AT_MOST]
    return sorted(
        (confirm(equations, rows[k], places[kind]) for kind, k in chosen), key=lambda one: one.log_p
    )


def confirm(equations: Equations, row: Row, places: int = 1, freedom: float | None = None) -> Test:
    """Return Wald's test of an effect, with the error sizes estimated together with the effect.

    The p-value is averaged over the sizes and multiplied by `places`, the number of alternatives from which `row` was
    selected. `freedom` is the denominator's degrees of freedom of each F test; None: those of all residuals, which is
    conservative.
    """
    count, d = equations.jacobian.shape[1], row.columns.shape[1]
    free = replace(
        equations,
        jacobian=np.concatenate([equations.jacobian, row.columns], axis=1),
        prior_information=np.pad(equations.prior_information, (0, d)),
        prior_gradient=np.pad(equations.prior_gradient, (0, d)),
    )
    likeliest, information = most_likely(free)
    found = solve_equations(free, likeliest)
    without = solve_equations(equations, likeliest)
    under = float(max(len(equations.residual) - UNKNOWNS - d, 1)) if freedom is None else freedom
    log_shares = []
    # Few poses determine the sizes badly, and with larger sizes the same estimate is less significant.
    for weight, _, each in over_sizes(free, likeliest, information):
        size, covariance = each.step[:, count:], each.covariance[:, count:, count:]
        ratio = (size * np.linalg.solve(covariance, size[..., None])[..., 0]).sum(1) / d
        log_tail = np.array([f_distribution.logsf(float(one), d, under) for one in ratio])
        log_shares.append(np.log(np.maximum(weight, 1e-300)) + log_tail)
    return Test(
        row=row,
        estimate=found.step[count:],
        covariance=found.covariance[count:, count:],
        log_p=float(np.logaddexp.reduce(np.concatenate(log_shares)) + np.log(places)),
        shift=found.step[:count] - without.step,
        noise=free.noise(likeliest),
    )


def explains_by_order(
    equations: Equations,
    log_sizes: LogSizes,
    by_motion: Float[ndarray, "n 6 6"],
    share: Float[ndarray, " n"],
    own: slice,
) -> bool:
    """Return whether a motion explains the residuals better than it does in nearly all random orders of the images.

    `by_motion` is the derivative of the residuals by a motion, `share` (n,) the motion's factor at each image; the
    factors of the images `own` are permuted. This permutation test of the score gain allows for errors with heavy tails
    and single wrong poses.
    """
    rng, centred, shares = np.random.default_rng(0), share[own] - share[own].mean(), [share]
    for _ in range(ORDERS):
        order = rng.permutation(centred)
        # A constant is absorbed by the hand-eye transform and the sign is arbitrary: such orders are equivalent.
        if not (np.allclose(order, centred) or np.allclose(order, -centred)):
            shares.append(share.copy())
            shares[-1][own] = order
    found, *others = rank(equations, log_sizes, [_flat(by_motion * s[:, None, None]) for s in shares])
    return sum(one >= found - 1e-9 for one in others) <= BY_CHANCE * len(others)


def order_rows(
    base_from_gripper: Poses, by_x: Float[ndarray, "n 6 6"], by_z: Float[ndarray, "n 6 6"]
) -> Iterator[Row]:
    """Yield the effects that depend on the image order: slip of the camera, base moved, drift, delayed poses.

    `by_x` and `by_z` are the derivatives of the residuals by the hand-eye transform X and by Z (base_from_recon). Slip
    and moved base have one row for each of several images at which they may happen.
    """
    n = len(base_from_gripper)
    count = min(n - 2 * LEAST_PART + 1, MANY_PLACES)
    if count < 1:
        return
    for k in np.unique(np.linspace(LEAST_PART, n - LEAST_PART, count).astype(int)).tolist():
        after = (np.arange(n) >= k).astype(float)[:, None, None]
        yield Row(kind=FindingKind.SLIP, columns=_flat(by_x * after), place=k)
        yield Row(kind=FindingKind.BASE_MOVED, columns=_flat(by_z * after), place=k)
    share = np.linspace(-0.5, 0.5, n)[:, None, None]
    yield Row(kind=FindingKind.DRIFT, columns=_flat(by_x * share))
    yield Row(kind=FindingKind.DELAY, columns=_flat(velocity(base_from_gripper)[..., None]))


def arm_rows(base_from_gripper: Poses) -> Iterator[Row]:
    """Yield the effects that depend on the gripper pose: strain of all lengths, leaning base, sagging tool."""
    position, rotation = base_from_gripper[:, :3, 3], base_from_gripper[:, :3, :3]
    n = len(position)
    strain = np.zeros((n, 6, len(STRAINS)))
    strain[:, :3] = np.einsum("kab,nb->nak", STRAINS, position)
    yield Row(kind=FindingKind.LENGTHS, columns=_flat(strain), prior_std=0.1)
    # The base leans towards the gripper by 1 rad per metre of horizontal distance.
    lean = np.cross(position, UP)
    yield Row(
        kind=FindingKind.BASE_LEANS,
        columns=_flat(np.concatenate([np.cross(lean, position), lean], axis=1)[..., None]),
        prior_std=0.2,
    )
    # The gripper rotates under a weight on a lever along each of its axes, by 1 rad for a horizontal lever.
    sag = np.zeros((n, 6, 3))
    sag[:, 3:] = -rotation @ skew(rotation[:, 2])
    yield Row(kind=FindingKind.TOOL_SAGS, columns=_flat(sag), prior_std=0.1)


def velocity(base_from_gripper: Poses) -> Float[ndarray, "n 6"]:
    """Return the gripper's velocity at each of n poses (m, rad per image; base axes), by splines through all poses."""
    # These imports are slow and rarely needed.
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    moment, little = np.arange(len(base_from_gripper), dtype=float), 1e-3
    position = CubicSpline(moment, base_from_gripper[:, :3, 3])
    rotation = RotationSpline(moment, Rotation.from_matrix(base_from_gripper[:, :3, :3]))
    rotation_between = rotation(moment + little) * rotation(moment - little).inv()
    return np.concatenate([position(moment, 1), rotation_between.as_rotvec() / (2 * little)], axis=1)


def _flat(columns: Float[ndarray, "n 6 d"]) -> Float[ndarray, "s d"]:
    """Return the columns (n,6,d) as a matrix with s = 6n rows."""
    return columns.reshape(-1, columns.shape[2])


def joint_offsets(poses: PoseEquations, arm: Arm, joints: Joints) -> JointOffsets:
    """Return each joint's offset (rad), true minus reported angle, with its standard deviation.

    The method is best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at the most likely
    error sizes. An unobservable offset, such as the first joint's, keeps its prior standard deviation: the size σ_s of
    the systematic errors.
    """
    sizes = most_likely(poses.equations)[0]
    solution = solve_equations(poses.equations, sizes)
    size = float(np.sqrt(poses.equations.variances(sizes)[2]))
    columns = _flat(error_jacobian(arm, joints)[:, :, : arm.dof])
    columns = columns - poses.region.by_unknown @ (poses.region.fit @ columns)
    offset = size**2 * columns.T @ solution.weighed_left
    known = np.diag(columns.T @ solution.projection @ columns)
    return JointOffsets(offset, size * np.sqrt(np.maximum(1 - size**2 * known, 0.0)), size)


OfImage = Literal["focal", "shear", "x", "y"]
"""Names of the OF_IMAGE parameters of each image, in the order of the rows of `Problem.directions`."""


@dataclass(frozen=True, kw_only=True)
class Alternatives:
    """Normal equations of e parameters of one camera that may be freed; all adjusted unknowns are eliminated.

    The e parameters are the camera's q intrinsics in `units`; then focal lengths, shears, x and y offsets of its m
    images (problem.OF_IMAGE); then s1 to s4 of the thin prism.
    """

    hessian: Float[ndarray, "e e"]
    right: Float[ndarray, " e"]
    """Negative gradient."""
    total: Float[ndarray, " e"]
    """Present value of each parameter from `Problem.freed`, 0 if none was freed."""
    place_by_column: Float[ndarray, "6 e"]
    """Derivative of the camera's pose (m, rad; axes of its parent) by each parameter."""
    images: int
    """Number of images of the camera."""
    freedom: int
    """Degrees of freedom of the reported poses' residuals, used for F tests; images have far more."""
    dispersion: float
    """Ratio of the gradient's actual variance to the variance that the observations' weights imply."""
    names: tuple[str, ...]
    """Names of the camera's parameters."""
    units: Float[ndarray, " q"]
    """Unit of each intrinsic parameter: fx and fy for focal lengths, image width for cx and cy, else 1."""
    distance: Float[ndarray, " m"]
    """Median depth of the points of each image (m)."""
    down_in_camera: Float[ndarray, "m 3"]
    """Direction of gravity (−z of the base) in the camera frame of each image."""

    @property
    def columns(self) -> int:
        """Number e of parameters that may be freed."""
        return len(self.right)

    def of_camera(self, names: tuple[str, ...]) -> Float[ndarray, "e p"]:
        """Return p unit vectors (columns), each of which selects one of the camera's intrinsics by its name."""
        return np.eye(self.columns)[:, [self.names.index(name) for name in names]]

    def of_images(self, parameter: OfImage, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Return p directions (columns) that change one parameter of the m images by the columns of `shares`."""
        out = np.zeros((self.columns, shares.shape[1]))
        first = len(self.names) + get_args(OfImage).index(parameter) * self.images
        out[first : first + self.images] = shares
        return out


@dataclass(frozen=True)
class ScoreTest:
    """Result of the score test of p linear combinations of camera parameters."""

    log_p: float
    """Log p-value: chance of this gain or a larger one without the effect."""
    covariance: Float[ndarray, "p p"]
    """Covariance of the p coefficients."""
    shift: Float[ndarray, "6"]
    """Change of the camera's pose when the combinations are free (m, rad; axes of its parent)."""


def first_x(state: State) -> Transform:
    """Return gripper_from_camera of the arm's first wrist camera."""
    return state.x[0]


def alternatives(
    solution: Solution,
    camera: int = 0,
    place: Callable[[State], Transform] = first_x,
    model_error_std: float | None = None,
) -> Alternatives:
    """Return the normal equations of all parameters of one camera that may be freed, or were freed, about a solution.

    `place` returns the pose of the camera on its parent (gripper or base). `model_error_std` is the size (image widths)
    of the distortion that no camera model expresses; None: as estimated.
    """
    problem, images = solution.problem, solution.images
    observations = problem.observations
    assert observations is not None
    mine = np.flatnonzero(observations.camera == camera)
    units, names = (
        rows_of(problem, camera, mine, problem.n_images)[1],
        parameter_names(problem.cameras[camera].intrinsics),
    )
    wider, total, first = _with_one_camera_free(solution, camera, mine, model_error_std)
    # The arms are at the most likely state, the images at the state of the evidence.
    at, likely, begin = wider.state, solution.most_likely, problem.arm_unknowns
    at = replace(at, x=likely.x, scale=likely.scale, z=likely.z)
    equations = pose_equations(wider.problem, at, wider).equations
    found = solve_equations(equations, solution.log_sizes)
    hessian = equations.jacobian.T @ found.weighed + equations.prior_information
    right = -(found.weighed.T @ equations.residual + equations.prior_gradient)
    rest = begin + first + np.arange(len(units))
    kept = np.setdiff1d(np.arange(len(hessian)), rest)
    coupling = hessian[np.ix_(kept, rest)]
    by_column = over(cholesky(hessian[np.ix_(kept, kept)]), coupling)
    # The camera's pose does not depend on intrinsics or parameters of images.
    derivative = solution.derivative(place)
    after = derivative.shape[1] - begin - problem.columns.boards.start
    by_kept = np.zeros((6, len(hessian)))
    by_kept[:, :begin] = derivative[:, :begin]
    by_kept[:, len(hessian) - after :] = derivative[:, derivative.shape[1] - after :]
    now, rig, image = solution.state, observations.rig[mine], observations.image
    # An image without points gets the median distance.
    depth = wider.view.depth
    distance = np.array([np.median(depth[image == k]) if (image == k).any() else np.nan for k in mine])
    return Alternatives(
        hessian=hessian[np.ix_(rest, rest)] - coupling.T @ by_column,
        right=right[rest] - by_column.T @ right[kept],
        total=total,
        place_by_column=-by_kept[:, kept] @ by_column,
        images=len(mine),
        freedom=max(len(equations.residual) - begin, 1),
        dispersion=_dispersion(images),
        names=names,
        units=units[: len(names)],
        distance=np.where(np.isfinite(distance), distance, np.nanmedian(distance)),
        down_in_camera=-(now.z[0] @ now.world_from_rig[rig] @ now.rig_from_camera[camera])[:, 2, :3],
    )


def _with_one_camera_free(
    solution: Solution, camera: int, mine: Int[ndarray, " m"], model_error_std: float | None
) -> tuple[ImageEvidence, Float[ndarray, " f"], int]:
    """Return the images' evidence with all parameters of one camera free.

    Also return the present values of these parameters, in their units, and the first of their columns. `mine` are the
    images of the camera. The new columns replace those that were freed for this camera.
    """
    problem, state = solution.problem, solution.images.state
    rows, units, weak = rows_of(problem, camera, mine, problem.n_images)
    own = len(problem.directions.T) - len(problem.freed_std)
    before, steps = problem.directions[:, own:], state.camera_steps[own : problem.columns.cameras.stop]
    others, each = ~before[rows].any(0), np.zeros((len(before), len(rows)))
    each[rows] = np.diag(units)
    total, sizes = before[rows] @ steps / units, state.model_error_std
    camera_steps = np.r_[
        state.camera_steps[:own], steps[others], total, state.camera_steps[own + len(steps) :]
    ]
    freed = np.concatenate([before[:, others], each], axis=1)
    wider = image_evidence(
        with_free(problem, freed=freed, freed_std=np.r_[problem.freed_std[others], weak]),
        replace(
            state,
            camera_steps=camera_steps,
            model_error_std=sizes if model_error_std is None else np.full_like(sizes, model_error_std),
        ),
    )
    return wider, total, own + int(others.sum())


def _dispersion(images: ImageEvidence) -> float:
    """Return the variance of the weighted residuals over the variance that their weights imply.

    The larger of two estimates is returned: from single residuals, and from their sums over image cells, which are
    clusters in the sense of Liang and Zeger (Biometrika 73, 1986).
    """
    problem, weight = images.problem, images.weight
    pull = weight[:, None] * images.view.residual_px
    taken = 3 * len(images.state.points_in_world) + 6 * len(problem.seen.rows)
    expected = 2 * weight.sum() * max(1 - taken / (2 * len(weight)), 0.1)
    return max(float((pull**2).sum()), problem.layout.squares_of_cells(pull)) / expected


def focal_lengths(camera: Intrinsics, images: int) -> Float[ndarray, "e p"]:
    """Return directions (columns) in the e parameters of `Alternatives` that give each of p images its own focal length.

    The first column is the common focal length, the others are differences between images; `images` is p.
    """
    q = len(parameter_names(camera))
    out = np.zeros((q + OF_IMAGE * images + PRISM, images))
    out[:2, 0] = 1.0
    out[q : q + images, 1:] = differences(images)
    return out


def differences(count: int) -> Float[ndarray, "n d"]:
    """Return an orthonormal basis (columns) of the vectors of length n = `count` whose sum is 0; d = n − 1."""
    return np.linalg.svd(np.eye(count) - 1 / count)[0][:, : count - 1]


def test_combinations(
    equations: Alternatives, free: Float[ndarray, "e p"], beside: Float[ndarray, "e q"]
) -> ScoreTest:
    """Return the score test of p directions `free` (columns over the e parameters of `equations`).

    The q directions `beside` are free in both hypotheses.
    """
    q, both = beside.shape[1], np.concatenate([beside, free], axis=1)
    fewer, more = spanned(beside), spanned(both)
    (without, gain_without, _), (step, gain, covariance) = (_step(equations, one) for one in (fewer, more))
    spread, p = equations.dispersion, max(more.shape[1] - fewer.shape[1], 1)
    to_value = np.linalg.pinv(both)[q:] @ more
    return ScoreTest(
        float(f_distribution.logsf(max(gain - gain_without, 0.0) / spread / p, p, equations.freedom)),
        spread * to_value @ covariance @ to_value.T,
        equations.place_by_column @ (more @ step - fewer @ without),
    )


def _step(
    equations: Alternatives, free: Float[ndarray, "e r"]
) -> tuple[Float[ndarray, " r"], float, Float[ndarray, "r r"]]:
    """Return the estimate of r coefficients, the gain (decrease of twice the cost), and the estimate's covariance.

    The coefficients belong to the columns of `free`, directions in the e parameters of `equations`.
    """
    covariance = np.linalg.inv(free.T @ equations.hessian @ free)
    right = free.T @ equations.right
    step = covariance @ right
    return step, float(right @ step), covariance
