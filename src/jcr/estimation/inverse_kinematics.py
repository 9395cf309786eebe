"""Inverse kinematics by damped least squares, and estimation of an arm's base and tool from joint angles and poses.

An arm with six joints reaches a pose with up to eight sets of angles; the set with the least change between images and
the nearest to the rest posture is chosen. Six joints or more reach any pose within reach, so a wrong robot is
recognised only if its reach or its joint limits exclude a pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.closed_form import closed_form
from jcr.estimation.kinematics import Arm, Joints, forward_kinematics, kinematic_jacobian, with_tool
from jcr.estimation.pose_equations import expected_covariance, fit_known_scale, pose_residuals
from jcr.geometry import (
    ARM,
    Poses,
    Transform,
    inverse,
    retract,
    rotation_angle,
    rotation_exp,
    rotation_log,
    skew,
    transform,
)
from jcr.least_squares import minimise

STARTS = 12
"""Number of sets of initial joint angles for each pose."""
JOINT_STEPS = 30
"""Largest number of Gauss-Newton steps."""
MOST_FOR_TOOL = 30
"""Largest number of poses from which an unknown tool is estimated."""
FITS = (1e-4, 1e-3)
"""Largest misfit (m, rad) of a pose that counts as reached."""
TO_REST = 3e-4
"""Weight (m/rad) of the distance from the rest posture; it changes determined angles by only 1e-6 rad."""
MISFIT_WEIGHT, REST_WEIGHT = 1e10, 0.05
"""Weights of squared misfit (m²) and squared distance from rest (rad²); squared change between poses has weight 1."""
TOOL_STD = (0.15, 1.0)
"""Standard deviation (m, rad) of a weak prior on an unknown tool."""
TOOLS = (0.0, 0.0), (0.1, 0.0), (0.1, -np.pi / 4), (0.2, 0.0), (0.2, -np.pi / 4)
"""Initial estimates of an unknown tool: translation along z (m) and rotation about it (rad)."""


@dataclass(frozen=True)
class Posture:
    """Result of inverse kinematics for n gripper poses."""

    joints: Float[ndarray, "n dof"]
    """Joint angles (rad)."""
    flange_from_tool: Transform
    """Estimated pose of the tool on the flange; the identity if no tool was estimated."""
    misfit: Float[ndarray, "n 2"]
    """Distance (m) and angle (rad) of the reached pose from each given one."""

    @property
    def fits(self) -> bool:
        """Whether the arm reaches every pose with a misfit below FITS."""
        return bool((self.misfit < FITS).all())


def inverse_kinematics(arm: Arm, base_from_gripper: Float[ndarray, "n 4 4"]) -> Posture:
    """Return joint angles (n,dof) within the limits for n poses, with little change between poses, and the misfits.

    Angles are in rad. If the arm does not reach all poses (misfits above FITS), a constant tool (flange_from_tool) is
    estimated together with the angles.
    """
    rng = np.random.default_rng(0)
    tried = [_posture(arm, base_from_gripper, np.eye(4), rng)]
    for ahead, yaw in TOOLS:
        if tried[-1].fits:
            break
        start = transform(rotation_exp(np.array([0.0, 0.0, yaw])), np.array([0.0, 0.0, ahead]))
        first = _posture(arm, base_from_gripper, start, rng)
        found = _with_tool(arm, base_from_gripper, first.joints, start)
        tried.append(_posture(arm, base_from_gripper, found, rng))
    return min(tried, key=lambda one: float(((one.misfit * (1.0, ARM)) ** 2).sum()))


def reach_toward(arm: Arm, base_from_gripper: Float[ndarray, "n 4 4"], start: Joints) -> Joints:
    """Return joint angles (n,dof) within the limits that bring the gripper nearest to each pose, from `start`.

    `start` (n,dof) are the initial angles (rad). An angle counts as 0.3 m (geometry.ARM) per rad. Redundant joints move
    towards the rest posture.
    """
    low, high = arm.limits.T

    def linearised(joints: Joints) -> tuple[Float[ndarray, "n r 1"], Float[ndarray, "n r 1 dof"]]:
        error, jacobian = _error(arm, joints, base_from_gripper)
        residual = np.concatenate([-error, TO_REST * (joints - arm.rest)], axis=1)
        rest = np.broadcast_to(TO_REST * np.eye(arm.dof), (len(joints), arm.dof, arm.dof))
        jacobian = np.concatenate([jacobian, rest], axis=1)
        # A joint at its limit that would move beyond is fixed in this step.
        gradient = (residual[:, None] @ jacobian)[:, 0]
        stuck = ((joints <= low) & (gradient > 0)) | ((joints >= high) & (gradient < 0))
        return residual[..., None], (jacobian * ~stuck[:, None])[:, :, None]

    def moved(joints: Joints, step: Joints) -> Joints:
        return np.clip(joints + step / np.abs(step).max(1, keepdims=True).clip(1.0), low, high)

    return minimise(
        linearised, np.clip(start, low, high), moved, tolerance=1e-9, iterations=JOINT_STEPS
    ).unknowns


def _error(
    arm: Arm, joints: Joints, base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 dof"]]:
    """Return the step from the reached to the given pose, and the derivative of the reached pose by the joint angles.

    Both are in base axes and m: translation, then rotation vector (rad) times geometry.ARM.
    """
    now, jacobian = kinematic_jacobian(arm, joints)
    rotation = rotation_log(base_from_gripper[:, :3, :3] @ np.swapaxes(now[:, :3, :3], 1, 2))
    jacobian[:, 3:] *= ARM
    return np.concatenate([base_from_gripper[:, :3, 3] - now[:, :3, 3], ARM * rotation], axis=1), jacobian


def _posture(
    arm: Arm, base_from_tool: Float[ndarray, "n 4 4"], flange_from_tool: Transform, rng: np.random.Generator
) -> Posture:
    """Return the posture for n poses `base_from_tool` of a tool that is fixed on the flange by `flange_from_tool`.

    Each pose is solved from STARTS initial angles, random ones by `rng`; `_path` chooses one solution of each.
    """
    base_from_gripper = base_from_tool @ inverse(flange_from_tool)
    # The initial angles are the rest posture and random ones within the limits, at most ±180° about their middle.
    half = np.minimum(np.diff(arm.limits)[:, 0] / 2, np.pi)
    starts = arm.limits.mean(1) + half * rng.uniform(-1, 1, (len(base_from_tool), STARTS, arm.dof))
    starts[:, 0] = arm.rest
    n, s, dof = starts.shape
    found = reach_toward(arm, np.repeat(base_from_gripper, s, 0), starts.reshape(-1, dof)).reshape(n, s, dof)
    misfit = _misfit(arm, found.reshape(-1, dof), np.repeat(base_from_tool, s, 0), flange_from_tool)
    joints = _path(arm, found, ((misfit * (1.0, ARM)) ** 2).sum(1).reshape(n, s))
    return Posture(joints, flange_from_tool, _misfit(arm, joints, base_from_tool, flange_from_tool))


def _misfit(
    arm: Arm, joints: Joints, base_from_tool: Float[ndarray, "n 4 4"], flange_from_tool: Transform
) -> Float[ndarray, "n 2"]:
    """Return how far the tool at joint angles `joints` (rad) is from `base_from_tool`: distance (m) and angle (rad)."""
    off = inverse(forward_kinematics(arm, joints) @ flange_from_tool) @ base_from_tool
    return np.stack([np.linalg.norm(off[:, :3, 3], axis=1), rotation_angle(off[:, :3, :3])], 1)


def _path(arm: Arm, found: Float[ndarray, "n s dof"], misfit: Float[ndarray, "n s"]) -> Joints:
    """Return for each pose one of its s solutions `found`, by the Viterbi algorithm.

    The path has the least weighted sum of `misfit` (m²), squared change of the angles between successive poses, and
    squared difference of the angles from the rest posture. Angles are shifted by full turns for the least change within
    the limits.
    """
    own = MISFIT_WEIGHT * misfit + REST_WEIGHT * (_change(arm, arm.rest, found) ** 2).sum(-1)
    cost, back = own[0], []
    for k in range(1, len(found)):
        total = cost[:, None] + (_change(arm, found[k - 1][:, None], found[k][None]) ** 2).sum(-1)
        back.append(total.argmin(0))
        cost = total.min(0) + own[k]
    at = [int(cost.argmin())]
    for pointers in reversed(back):
        at.append(int(pointers[at[-1]]))
    joints = found[range(len(found)), at[::-1]].copy()
    before = arm.rest
    for k, row in enumerate(joints):
        near = before + _change(arm, before, row)
        inside = (near >= arm.limits[:, 0]) & (near <= arm.limits[:, 1])
        joints[k] = before = np.where(inside, near, row)
    return joints


def _change(
    arm: Arm, a: Float[ndarray, "... dof"], b: Float[ndarray, "... dof"]
) -> Float[ndarray, "... dof"]:
    """Return b − a for joint angles a and b (rad), in (−π, π] for joints whose limits span a full rotation."""
    return np.where(np.diff(arm.limits)[:, 0] >= 2 * np.pi, (b - a + np.pi) % (2 * np.pi) - np.pi, b - a)


def _with_tool(
    arm: Arm, base_from_tool: Float[ndarray, "n 4 4"], joints: Joints, flange_from_tool: Transform
) -> Transform:
    """Return flange_from_tool that lets the arm reach all poses best, estimated together with the joint angles.

    `joints` (rad) and `flange_from_tool` are the initial estimates. At most MOST_FOR_TOOL poses, evenly spaced, are
    used.
    """
    some = np.unique(np.linspace(0, len(joints) - 1, min(len(joints), MOST_FOR_TOOL)).astype(int))
    poses, n, dof = base_from_tool[some], len(some), arm.dof
    weight = 1e-3 / np.repeat(TOOL_STD, 3)

    def linearised(at: tuple[Joints, Transform]) -> tuple[Float[ndarray, "r 1"], Float[ndarray, "r 1 p"]]:
        joints, tool = at
        error, by_joints = _error(arm, joints, poses @ inverse(tool))
        rotation = poses[:, :3, :3] @ tool[:3, :3].T
        jacobian = np.zeros((6 * n + 6, n * dof + 6))
        for k in range(n):
            jacobian[6 * k : 6 * k + 6, dof * k : dof * k + dof] = by_joints[k]
        # Derivative of −error by a step of the tool in flange axes.
        by_tool = np.zeros((n, 6, 6))
        by_tool[:, :3, :3] = rotation
        by_tool[:, :3, 3:] = rotation @ skew(tool[:3, 3])
        by_tool[:, 3:, 3:] = ARM * rotation
        jacobian[: 6 * n, -6:] = by_tool.reshape(6 * n, 6)
        jacobian[6 * n :, -6:] = np.diag(weight)
        off = np.concatenate([tool[:3, 3], rotation_log(tool[:3, :3])])
        return np.concatenate([-error.ravel(), weight * off])[:, None], jacobian[:, None]

    def moved(at: tuple[Joints, Transform], step: Float[ndarray, " p"]) -> tuple[Joints, Transform]:
        step = step / max(1.0, float(np.abs(step).max()))
        return np.clip(at[0] + step[:-6].reshape(n, dof), *arm.limits.T), retract(at[1], step[-6:])

    return minimise(
        linearised, (joints[some], flange_from_tool), moved, tolerance=1e-9, iterations=JOINT_STEPS
    ).unknowns[1]


NOISE = (1e-3, 1e-3 / ARM)
"""Position and rotation errors (m, rad) that have equal weight in the fit of base and tool."""
AGREE = (0.015, np.radians(1.5))
"""Largest rms difference between forward kinematics and poses, as a share of the reach and in rad."""
LENGTH_ERROR, LENGTH_SIGMAS = 0.01, 5.0
"""Relative difference of lengths that counts as an error, and the number of standard deviations it must exceed."""


class LengthError(InputError):
    """Error for gripper positions that are a multiple of the arm model's; images do not reveal such a factor."""


def mounted_arm(arm: Arm, joints: Joints, base_from_gripper: Poses) -> Arm:
    """Return the arm with the base and tool whose forward kinematics fits the reported poses best.

    Directions of base and tool that the motions do not determine stay as in `arm`. Raise LengthError if reported
    positions are those of the arm times a factor, InputError if angles and poses disagree otherwise.
    """
    nominal = forward_kinematics(arm, joints)
    half_rotation = transform(rotation_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    tool, scale, base = closed_form(base_from_gripper, nominal)
    scale = float(scale)
    fits = [
        fit_known_scale(base_from_gripper, nominal, start, NOISE)
        for start in ((np.eye(4), np.eye(4)), (np.eye(4), half_rotation), (tool, base))
    ]
    residual, j = pose_residuals(tool, scale, base, base_from_gripper, nominal)
    metres, radians = _apart(residual)
    if scale > 0 and metres <= AGREE[0] * arm.reach * scale and radians <= AGREE[1]:
        left = max(6 * len(nominal) - j.shape[2], 1)
        noise = np.maximum(np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum((0, 2)) * 2 / left), NOISE)
        j /= np.repeat(noise, 3)[:, None]
        std = scale * float(np.sqrt(expected_covariance(np.einsum("nij,nik->jk", j, j))[6, 6]))
        if abs(scale - 1) > max(LENGTH_ERROR, LENGTH_SIGMAS * std):
            raise LengthError(
                f"the gripper positions are {100 * abs(scale - 1):.1f} ± {100 * std:.1f} % too "
                f"{'long' if scale > 1 else 'short'} for a {arm.name} with these joint angles; check the unit of the "
                "positions, and that this is the robot"
            )
    best = min(fits, key=lambda fit: float(((fit.residual / np.repeat(NOISE, 3)) ** 2).sum()))
    metres, radians = _apart(best.residual)
    if metres > AGREE[0] * arm.reach or radians > AGREE[1]:
        raise InputError(
            f"joint angles and gripper poses disagree on a {arm.name}: {1e3 * metres:.0f} mm, "
            f"{np.degrees(radians):.1f}° apart; check the robot, the order of its joints and their unit (rad)"
        )
    frames = arm.parent_from_joint.copy()
    frames[0] = best.base_from_recon @ frames[0]
    return with_tool(replace(arm, parent_from_joint=frames), inverse(best.gripper_from_camera))


def _apart(residual: Float[ndarray, "n 6"]) -> Float[ndarray, "2"]:
    """Return the rms distance (m) and the rms angle (rad) of n residuals: columns translation, rotation vector."""
    return np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum(2).mean(0))
