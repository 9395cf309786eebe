"""Errors of an arm that go with where its gripper is: an axis of wrong length, a stand that leans, a tool that sags.

Each is a few numbers, linear in the reported poses: a symmetric strain of the positions, whose part that is the
same in all directions is the scale and unobservable; a base that rotates about the horizontal in proportion to the
reach; a gripper that rotates as gravity pulls at a lever in it. A smooth field of errors (systematic.py) holds them only
as far as arms usually err. Each is tested in the mixed model, averaged over the sizes of the other errors as they are
estimated beside it (a Wald test beside F; Seber and Lee, Linear Regression Analysis, 2003, ch. 4).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.distributions import f as f_distribution
from jcr.estimation.components import most_likely, over_sizes
from jcr.estimation.mixed_model import Equations, solve
from jcr.estimation.pose_equations import SCALE, UNKNOWNS, Poses
from jcr.estimation.systematic import Region
from jcr.geometry import skew
from jcr.records import Kind

UP = np.array([0.0, 0.0, 1.0])


def _symmetric(a: int, b: int) -> Float[ndarray, "3 3"]:
    out = np.zeros((3, 3))
    out[a, b] = out[b, a] = 1 / np.sqrt(2)
    return out


STRAINS = np.array(
    [
        np.diag([1.0, -1.0, 0.0]) / np.sqrt(2),
        np.diag([-1.0, -1.0, 2.0]) / np.sqrt(6),
        _symmetric(0, 1),
        _symmetric(0, 2),
        _symmetric(1, 2),
    ]
)
"""An orthonormal basis of the symmetric strains that leave the sum of the three lengths."""


def strained(base_from_gripper: Poses) -> Float[ndarray, "n 6 5"]:
    """Reported poses less true ones (base axes; m) by each of STRAINS of the positions."""
    out = np.zeros((len(base_from_gripper), 6, len(STRAINS)))
    out[:, :3] = np.einsum("kab,nb->nak", STRAINS, base_from_gripper[:, :3, 3])
    return out


def leaning(base_from_gripper: Poses) -> Float[ndarray, "n 6 1"]:
    """Reported poses less true ones (m, rad) of a base that leans towards the gripper by 1 rad per metre of reach."""
    position = base_from_gripper[:, :3, 3]
    lean = np.cross(position, UP)
    return np.concatenate([np.cross(lean, position), lean], axis=1)[..., None]


def sagging(base_from_gripper: Poses) -> Float[ndarray, "n 6 3"]:
    """Reported poses less true ones (rad) of a gripper rotated by its weight at a lever along each of its axes, 1 rad
    where that is level."""
    rotation = base_from_gripper[:, :3, :3]
    out = np.zeros((len(rotation), 6, 3))
    out[:, 3:] = -rotation @ skew(rotation[:, 2])
    return out


@dataclass(frozen=True)
class Way:
    """One way in which poses are bent."""

    steps: Callable[[Poses], Float[ndarray, "n 6 p"]]
    """Of reported poses from true ones, for each of its numbers at 1."""
    std: float
    """Of its numbers, once it was found: so large that the poses decide."""


WAYS: dict[Kind, Way] = {
    Kind.LENGTHS: Way(strained, 0.1),
    Kind.BASE_LEANS: Way(leaning, 0.2),
    Kind.TOOL_SAGS: Way(sagging, 0.1),
}


def bends(kinds: Iterable[Kind], base_from_gripper: Poses) -> Float[ndarray, "s b"]:
    """Errors of one standard deviation each of poses that are bent in these ways, s = 6n."""
    ways = [WAYS[kind] for kind in kinds]
    return np.concatenate([way.std * _flat(way.steps(base_from_gripper)) for way in ways], axis=1)


def _flat(steps: Float[ndarray, "n 6 p"]) -> Float[ndarray, "s p"]:
    return steps.reshape(-1, steps.shape[2])


@dataclass(frozen=True)
class Bent:
    """How far poses are bent in one way, as their residuals show it."""

    kind: Kind
    log_p: float
    """Of this or more where they are not."""
    size: Float[ndarray, " p"]
    """Of each number of the way."""
    covariance: Float[ndarray, "p p"]


def tested(equations: Equations, base_from_gripper: Poses, kind: Kind) -> Bent:
    """Poses that may be bent in one way, by the equations of their residuals."""
    columns, count = _flat(WAYS[kind].steps(base_from_gripper)), equations.jacobian.shape[1]
    p = columns.shape[1]
    prior = np.zeros((count + p, count + p))
    prior[:count, :count] = equations.prior_information
    free = replace(
        equations,
        jacobian=np.concatenate([equations.jacobian, columns], axis=1),
        prior_information=prior,
        prior_gradient=np.r_[equations.prior_gradient, np.zeros(p)],
    )
    likeliest, information = most_likely(free)
    found, freedom = solve(free, likeliest), max(len(equations.residual) - UNKNOWNS - p, 1)
    chance = 0.0
    # Of few poses the sizes of the other errors are hardly known, and larger ones leave more to chance.
    for weight, _, each in over_sizes(free, likeliest, information):
        size, covariance = each.step[:, count:], each.covariance[:, count:, count:]
        ratio = (size * np.linalg.solve(covariance, size[..., None])[..., 0]).sum(1) / p
        chance += float(weight @ np.exp([f_distribution.logsf(float(one), p, freedom) for one in ratio]))
    log_p = float(np.log(max(chance, 1e-300)))
    return Bent(kind, log_p, found.step[count:], found.covariance[count:, count:])


def to_straight(
    equations: Equations, log_sizes: Float[ndarray, " c"], bent: Float[ndarray, "s b"]
) -> Float[ndarray, "7"]:
    """How far X and scale of the true poses are from the effective ones (systematic.py), where poses are `bent`."""
    effective, straight = (
        solve(one, log_sizes).step[:7] for one in (equations, replace(equations, bent=bent @ bent.T))
    )
    return straight - effective


def by_scale(equations: Equations) -> Float[ndarray, "7"]:
    """How far X moves with the logarithm of the scale, where another metre than the robot's decides that."""
    region = Region.of_poses(equations.jacobian[:, :UNKNOWNS])
    return np.r_[-(region.fit @ equations.jacobian[:, SCALE])[:6, 0], 1.0]
