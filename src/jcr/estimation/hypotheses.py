"""Effects on the gripper poses (slip, drift, delay, moved base, strains): Rao's score test ranks, Wald's test confirms.

The score test uses the error sizes of the solution, which were estimated with the effect inside and absorb part of it
(Rao 1948; with 8 images no slip reaches a threshold of 1e-4). The confirmation estimates the sizes again with the
columns free and averages F tests over them (Seber and Lee, Linear Regression Analysis, 2003, chapter 4).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.distributions import f as f_distribution
from jcr.estimation.equation import UNKNOWNS
from jcr.estimation.kinematics import Arm, Joints, error_jacobian
from jcr.estimation.pose_equations import PoseEquations
from jcr.estimation.robot_noise import (
    Equations,
    LinearSolution,
    LogSizes,
    most_likely,
    over_sizes,
    solve_equations,
)
from jcr.findings import FindingKind
from jcr.geometry import Poses, skew
from jcr.records import JointOffsets, RobotNoise

CONFIRMED_AT_MOST = 3
"""Kinds of effects that are confirmed: those with the largest gains of the score test."""
ORDERS = 200
"""Orders of the images that a permutation test draws."""
BY_CHANCE = 0.02
"""Share of other orders that may explain as much."""
LEAST_PART = 3
"""Images on either side of a change: fewer are single wrong poses."""
MANY_PLACES = 60
"""Largest number of places of a change that are tested; longer captures are sampled evenly."""
UP = np.array([0.0, 0.0, 1.0])
PLAUSIBLE: dict[FindingKind, tuple[float, float]] = {
    FindingKind.SLIP: (0.12, np.radians(45.0)),
    FindingKind.BASE_MOVED: (0.2, np.radians(20.0)),
    FindingKind.DRIFT: (0.03, np.radians(10.0)),
    FindingKind.DELAY: (1.0, 0.0),
    FindingKind.LENGTHS: (0.1, 0.0),
    FindingKind.BASE_LEANS: (0.3, 0.0),
    FindingKind.TOOL_SAGS: (0.3, 0.0),
}
"""Largest estimate that the cause can produce: m and rad of a motion, else the norm of the parameters. A clamped camera
slips by centimetres, and another tool frame is rarely farther away; a delay of a whole interval is a wrong pairing. An
estimate beyond these points to poses that contradict the images."""
STRAINS = np.zeros((5, 3, 3))
"""Orthonormal basis of the symmetric strains without a common factor, which is the scale and unobservable."""
STRAINS[0], STRAINS[1] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2), np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6)
for _k, (_a, _b) in enumerate(((0, 1), (0, 2), (1, 2)), start=2):
    STRAINS[_k, _a, _b] = STRAINS[_k, _b, _a] = 1 / np.sqrt(2)


@dataclass(frozen=True, kw_only=True)
class Row:
    """Columns that one effect adds to the equations of the gripper poses."""

    kind: FindingKind
    columns: Float[ndarray, "s d"]
    """Derivative of the residuals (m, rad, base axes) by the d parameters of the effect."""
    place: int = 0
    """Image before which a change happens; 0 for an effect without a place."""
    prior_std: float = 0.1
    """Standard deviation of the parameters once the effect is adopted: so large that the poses decide."""


@dataclass(frozen=True, kw_only=True)
class Test:
    """Result of one confirmed row."""

    row: Row
    estimate: Float[ndarray, " d"]
    covariance: Float[ndarray, "d d"]
    log_p: float
    """Logarithm of the probability of this estimate or a larger one without the effect, times the places tested."""
    shift: Float[ndarray, " p"]
    """Step of the unknowns that comes with the effect."""
    noise: RobotNoise
    """Robot pose noise that the effect leaves."""

    def is_within(self, limits: tuple[float, float]) -> bool:
        """Return whether the estimate is within limits (m and rad of a motion, else the norm of the parameters)."""
        if self.row.columns.shape[1] != 6:
            return bool(np.linalg.norm(self.estimate) <= limits[0])
        return bool((np.linalg.norm(self.estimate.reshape(2, 3), axis=1) <= limits).all())


def _gain(
    solution: LinearSolution, columns: Float[ndarray, "s d"], projection: Float[ndarray, "s s"]
) -> float:
    """Return the gain of the score test, gᵀS⁻¹g with g = Aᵀ V⁻¹(r + Jθ) and S = Aᵀ P A, P being the projection."""
    pull = columns.T @ solution.weighed_left
    return float(pull @ np.linalg.lstsq(columns.T @ projection @ columns, pull, rcond=1e-9)[0])


def best_tests(equations: Equations, log_sizes: LogSizes, rows: Sequence[Row]) -> list[Test]:
    """Return confirmed tests of the best rows, one of a kind, the most significant first.

    The probability of a kind is multiplied by the number of its rows, the places that were searched.
    """
    if not rows:
        return []
    solution = solve_equations(equations, log_sizes)
    projection, penalty = solution.projection, np.log(len(equations.residual))
    # The penalty d · log(s) of Schwarz (1978).
    gain = np.array([_gain(solution, r.columns, projection) - r.columns.shape[1] * penalty for r in rows])
    best: dict[FindingKind, int] = {}
    for k in np.argsort(-gain).tolist():
        best.setdefault(rows[k].kind, k)
    chosen = list(best.values())[:CONFIRMED_AT_MOST]
    places = {kind: sum(row.kind is kind for row in rows) for kind in best}
    tests = (confirm(equations, rows[k], places[rows[k].kind]) for k in chosen)
    return sorted(tests, key=lambda test: test.log_p)


def confirm(equations: Equations, row: Row, places: int = 1, freedom: float | None = None) -> Test:
    """Return Wald's test of a row, with the sizes of the errors estimated again while its columns are free.

    The chance is averaged over the sizes. `freedom` is that of the sizes at each point of the average; None: of all
    residuals, which counts their uncertainty twice and is on the safe side.
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
    # With few poses the sizes are hardly known, and larger ones leave more to chance.
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
    """Return whether a motion with these shares explains more than in nearly all other orders of the images `own`.

    A permutation test of the score gain: the errors of real arms have heavy tails, and one wrong pose is no motion.
    """
    rng = np.random.default_rng(0)
    solution = solve_equations(equations, log_sizes)
    projection = solution.projection

    def gain(of_image: Float[ndarray, " n"]) -> float:
        return _gain(solution, _flat(by_motion * of_image[:, None, None]), projection)

    found, shuffled, centred = gain(share), share.copy(), share[own] - share[own].mean()
    as_much = others = 0
    for _ in range(ORDERS):
        order = rng.permutation(centred)
        # The hand-eye transform takes up a constant, and the sign is free: such an order is the same one.
        if np.allclose(order, centred) or np.allclose(order, -centred):
            continue
        others += 1
        shuffled[own] = order
        as_much += gain(shuffled) >= found - 1e-9
    return as_much <= BY_CHANCE * others


def order_rows(
    base_from_gripper: Poses, by_x: Float[ndarray, "n 6 6"], by_z: Float[ndarray, "n 6 6"]
) -> Iterator[Row]:
    """Yield the effects that depend on the order of the images.

    `by_x` and `by_z` are the derivatives of the residuals by the hand-eye transform X and by base_from_recon.
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
    """Yield the effects of the arm that depend on where its gripper is; n poses, residuals in base axes (m, rad)."""
    position, rotation = base_from_gripper[:, :3, 3], base_from_gripper[:, :3, :3]
    n = len(position)
    strain = np.zeros((n, 6, len(STRAINS)))
    strain[:, :3] = np.einsum("kab,nb->nak", STRAINS, position)
    yield Row(kind=FindingKind.LENGTHS, columns=_flat(strain), prior_std=0.1)
    # The base rotates towards the gripper by 1 rad per metre of horizontal reach.
    lean = np.cross(position, UP)
    yield Row(
        kind=FindingKind.BASE_LEANS,
        columns=_flat(np.concatenate([np.cross(lean, position), lean], axis=1)[..., None]),
        prior_std=0.2,
    )
    # The gripper rotates by its weight at a lever along each of its axes, 1 rad where that lever is level.
    sag = np.zeros((n, 6, 3))
    sag[:, 3:] = -rotation @ skew(rotation[:, 2])
    yield Row(kind=FindingKind.TOOL_SAGS, columns=_flat(sag), prior_std=0.1)


def velocity(base_from_gripper: Poses) -> Float[ndarray, "n 6"]:
    """Return the steps per image interval (base axes; m, rad) of an arm that moves smoothly through all poses."""
    # These imports take as long as all of SciPy that every command needs.
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    moment, little = np.arange(len(base_from_gripper), dtype=float), 1e-3
    position = CubicSpline(moment, base_from_gripper[:, :3, 3])
    rotation = RotationSpline(moment, Rotation.from_matrix(base_from_gripper[:, :3, :3]))
    rotation_between = rotation(moment + little) * rotation(moment - little).inv()
    return np.concatenate([position(moment, 1), rotation_between.as_rotvec() / (2 * little)], axis=1)


def _flat(columns: Float[ndarray, "n 6 d"]) -> Float[ndarray, "s d"]:
    """Return columns with one row per residual, s = 6n."""
    return columns.reshape(-1, columns.shape[2])


def joint_offsets(poses: PoseEquations, arm: Arm, joints: Joints) -> JointOffsets:
    """Return the offset of each joint (rad), true angle less reported one, and its standard deviation.

    Best linear unbiased prediction (Searle, Casella and McCulloch 1992, chapter 7) at the most likely sizes of the
    errors of the poses. An offset that no pose shows, as of the first joint, keeps the standard deviation of any joint.
    """
    sizes = most_likely(poses.equations)[0]
    solution = solve_equations(poses.equations, sizes)
    size = float(np.sqrt(poses.equations.variances(sizes)[2]))
    columns = _flat(error_jacobian(arm, joints)[:, :, : arm.dof])
    columns = columns - poses.region.by_unknown @ (poses.region.fit @ columns)
    offset = size**2 * columns.T @ solution.weighed_left
    known = np.diag(columns.T @ solution.projection @ columns)
    return JointOffsets(offset, size * np.sqrt(np.maximum(1 - size**2 * known, 0.0)), size)
