"""Joint angles from gripper poses by damped least squares, and the base and tool of an arm from both.

Limits of what poses can show: an arm with six joints reaches a pose in up to eight ways; the branch with the least
change from image to image and nearest the arm's rest posture is chosen. Poses of any tool within reach fit an arm with
six joints or more: a wrong robot is recognised only where its reach or its limits exclude a pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.closed_form import closed_form
from jcr.estimation.kinematics import (
    Arm,
    Joints,
    forward_kinematics,
    kinematic_jacobian,
    with_tool,
)
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

STARTS = 12
STEPS = 30
LAST = 8
"""Number of last steps in which a redundant arm no longer moves towards its rest posture."""
FITS = (1e-4, 1e-3)
"""Largest misfit (m, rad) of a pose that the arm reaches."""
REFUSED = (0.01, np.radians(1.0))
"""Misfit, as a share of the reach and in rad, from which poses are not of this arm."""
TO_REST = 0.5
"""Share of the way to its rest posture that a redundant arm goes in one step."""
MISFIT_WEIGHT, REST_WEIGHT = 1e10, 0.05
"""Weights of the squared misfit (m²) and the squared distance from rest (rad²), beside squared change between poses."""
TOOL_STD = (0.15, 1.0)
"""Standard deviation (m, rad) of a weak prior on an unknown tool."""
TOOLS = (0.0, 0.0), (0.1, 0.0), (0.1, -np.pi / 4), (0.2, 0.0), (0.2, -np.pi / 4)
"""Initial estimates of an unknown tool: translation along z (m) and rotation about it (rad)."""


@dataclass(frozen=True)
class Posture:
    """Joint angles of gripper poses, and the misfit."""

    joints: Float[ndarray, "n dof"]
    flange_from_tool: Transform
    """Given, the identity, or estimated."""
    misfit: Float[ndarray, "n 2"]
    """Distance (m) and angle (rad) from each pose."""

    @property
    def fits(self) -> bool:
        """Whether the arm reaches every pose."""
        return bool((self.misfit < FITS).all())


def inverse_kinematics(
    arm: Arm, base_from_gripper: Float[ndarray, "n 4 4"], flange_from_tool: Transform | None = None
) -> Posture:
    """Return joint angles (n,dof) within the limits, continuous over the poses, and the misfit of each pose.

    `flange_from_tool` is the frame of the poses in the gripper frame of `arm`. None: the identity, or where the poses
    are then out of reach, a constant tool that explains them, estimated together with the angles.
    """
    rng = np.random.default_rng(0)
    tool = np.eye(4) if flange_from_tool is None else flange_from_tool
    posture = _posture(arm, base_from_gripper, tool, rng)
    if posture.fits or flange_from_tool is not None:
        return posture
    tried = [posture]
    for ahead, yaw in TOOLS:
        start = transform(rotation_exp(np.array([0.0, 0.0, yaw])), np.array([0.0, 0.0, ahead]))
        first = _posture(arm, base_from_gripper, start, rng)
        joints, found = _with_tool(arm, base_from_gripper, first.joints, start)
        tried.append(_posture(arm, base_from_gripper, found, rng, joints))
        if tried[-1].fits:
            break
    return min(tried, key=lambda one: float(((one.misfit * (1.0, ARM)) ** 2).sum()))


def reach_toward(
    arm: Arm, base_from_gripper: Float[ndarray, "n 4 4"], start: Joints, steps: int = STEPS
) -> Joints:
    """Return joint angles (n,dof) within the limits that bring the gripper as near each pose as it gets from `start`.

    Damped least squares, the damping after Sugihara ("Solvability-unconcerned inverse kinematics by the
    Levenberg-Marquardt method", IEEE Trans. Robotics 27, 2011), all poses at once. The free motion of a redundant arm
    goes towards its rest posture (gradient projection, Liegeois 1977).
    """
    low, high = arm.limits.T
    joints = np.clip(start, low, high)
    for k in range(steps):
        error, jacobian = _error(arm, joints, base_from_gripper)
        free = np.zeros_like(joints)
        if arm.dof > 6 and k < steps - LAST:
            free = TO_REST * (arm.rest - joints)
        step = _damped_step(error, jacobian, free)
        # A joint at its limit that would move beyond it takes no part in this step.
        stuck = ((joints <= low) & (step < 0)) | ((joints >= high) & (step > 0))
        rows = stuck.any(1)
        if rows.any():
            moving = ~stuck[rows]
            step[rows] = moving * _damped_step(
                error[rows], jacobian[rows] * moving[:, None], free[rows] * moving
            )
        step /= np.abs(step).max(1, keepdims=True).clip(1.0)
        joints = np.clip(joints + step, low, high)
    return joints


def _damped_step(
    error: Float[ndarray, "n 6"], jacobian: Float[ndarray, "n 6 dof"], free: Joints
) -> Float[ndarray, "n dof"]:
    """Return the sum of `free` and the smallest damped change that removes the remaining error."""
    damping = 0.5 * (error**2).sum(1) + 1e-9
    square = jacobian @ np.swapaxes(jacobian, 1, 2) + damping[:, None, None] * np.eye(6)
    left = error[..., None] - jacobian @ free[..., None]
    return free + (np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(square, left))[..., 0]


def _error(
    arm: Arm, joints: Joints, base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 dof"]]:
    """Return the difference to the pose in base axes, rotations times geometry.ARM (m), and the gripper's Jacobian."""
    now, jacobian = kinematic_jacobian(arm, joints)
    rotation = rotation_log(base_from_gripper[:, :3, :3] @ np.swapaxes(now[:, :3, :3], 1, 2))
    jacobian[:, 3:] *= ARM
    return np.concatenate([base_from_gripper[:, :3, 3] - now[:, :3, 3], ARM * rotation], axis=1), jacobian


def _posture(
    arm: Arm,
    base_from_tool: Float[ndarray, "n 4 4"],
    flange_from_tool: Transform,
    rng: np.random.Generator,
    known: Joints | None = None,
) -> Posture:
    """Return the best path through the solutions from many initial estimates, for a known tool."""
    base_from_gripper = base_from_tool @ inverse(flange_from_tool)
    # The rest posture, and random angles within the limits (within the middle rotation of wider ones).
    half = np.minimum(np.diff(arm.limits)[:, 0] / 2, np.pi)
    starts = arm.limits.mean(1) + half * rng.uniform(-1, 1, (len(base_from_tool), STARTS, arm.dof))
    starts[:, 0] = arm.rest
    if known is not None:
        starts = np.concatenate([known[:, None], starts], axis=1)
    n, s, dof = starts.shape
    found = reach_toward(arm, np.repeat(base_from_gripper, s, 0), starts.reshape(-1, dof)).reshape(n, s, dof)
    misfit = _misfit(arm, found.reshape(-1, dof), np.repeat(base_from_tool, s, 0), flange_from_tool)
    joints = _path(arm, found, ((misfit * (1.0, ARM)) ** 2).sum(1).reshape(n, s))
    return Posture(joints, flange_from_tool, _misfit(arm, joints, base_from_tool, flange_from_tool))


def _misfit(
    arm: Arm, joints: Joints, base_from_tool: Float[ndarray, "n 4 4"], flange_from_tool: Transform
) -> Float[ndarray, "n 2"]:
    """Return the distance (m) and the angle (rad) from each pose."""
    off = inverse(forward_kinematics(arm, joints) @ flange_from_tool) @ base_from_tool
    return np.stack([np.linalg.norm(off[:, :3, 3], axis=1), rotation_angle(off[:, :3, :3])], 1)


def _path(arm: Arm, found: Float[ndarray, "n s dof"], misfit: Float[ndarray, "n s"]) -> Joints:
    """Return one solution for each pose, with the least change between poses (Viterbi), near the rest posture."""
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
    """Return the change from angles a to b, the shorter way where the joint has a full rotation."""
    return np.where(np.diff(arm.limits)[:, 0] >= 2 * np.pi, (b - a + np.pi) % (2 * np.pi) - np.pi, b - a)


def _with_tool(
    arm: Arm, base_from_tool: Float[ndarray, "n 4 4"], joints: Joints, flange_from_tool: Transform
) -> tuple[Joints, Transform]:
    """Return joint angles and one tool by Gauss-Newton, with the angles of each pose eliminated."""
    weight = 1e-6 / np.repeat(np.square(TOOL_STD), 3)
    for _ in range(STEPS):
        error, jacobian = _error(arm, joints, base_from_tool @ inverse(flange_from_tool))
        rotation = base_from_tool[:, :3, :3] @ flange_from_tool[:3, :3].T
        by_tool = np.zeros((len(joints), 6, 6))
        # A twist of the tool, in flange axes, moves the required gripper pose back by this.
        by_tool[:, :3, :3] = rotation
        by_tool[:, :3, 3:] = rotation @ skew(flange_from_tool[:3, 3])
        by_tool[:, 3:, 3:] = ARM * rotation
        transposed = np.swapaxes(jacobian, 1, 2)
        damping = 0.5 * (error**2).sum(1) + 1e-9
        own = np.linalg.inv(jacobian @ transposed + damping[:, None, None] * np.eye(6))
        # Projector of what the joints cannot explain: I - J (JᵀJ + μ)⁻¹ Jᵀ = μ (JJᵀ + μ)⁻¹.
        left = damping[:, None, None] * own
        moved = np.concatenate([flange_from_tool[:3, 3], rotation_log(flange_from_tool[:3, :3])])
        normal = (np.swapaxes(by_tool, 1, 2) @ left @ by_tool).sum(0) + np.diag(weight)
        wish = (np.swapaxes(by_tool, 1, 2) @ left @ error[..., None]).sum(0)[:, 0] - weight * moved
        twist = np.linalg.solve(normal, wish)
        twist /= max(1.0, np.abs(twist / (0.1, 0.1, 0.1, 0.5, 0.5, 0.5)).max())
        step = (transposed @ own @ (error - (by_tool @ twist))[..., None])[..., 0]
        step /= np.abs(step).max(1, keepdims=True).clip(1.0)
        joints = np.clip(joints + step, *arm.limits.T)
        flange_from_tool = retract(flange_from_tool, twist)
    return joints, flange_from_tool


def posed(arm: Arm, joints: Joints | None, base_from_gripper: Poses) -> tuple[Arm, Joints]:
    """Return the arm with its tool, and its joint angles at the poses, computed where `joints` is None.

    Raise InputError where poses, joints and arm do not fit.
    """
    if joints is not None:
        return mounted_arm(arm, joints, base_from_gripper), joints
    posture = inverse_kinematics(arm, base_from_gripper)
    metres, radians = posture.misfit.max(0)
    if metres > REFUSED[0] * arm.reach or radians > REFUSED[1]:
        raise InputError(
            f"poses do not fit a {arm.name}: {1e3 * metres:.0f} mm, {np.degrees(radians):.1f}° off; name another robot, "
            "or leave it out"
        )
    return with_tool(arm, posture.flange_from_tool), posture.joints


NOISE = (1e-3, 1e-3 / ARM)
"""Differences (m, rad) of equal weight."""
AGREE = (0.015, np.radians(1.5))
"""Largest rms difference of agreeing angles and poses, as a share of the reach and in rad (factory calibration)."""
ALIKE, SURE = 0.01, 5.0
"""Difference of lengths beyond a factory's calibration: relative, and in standard deviations."""


class LengthError(InputError):
    """Error for gripper positions that are longer or shorter than the arm's by one factor, which no image shows."""


def mounted_arm(arm: Arm, joints: Joints, base_from_gripper: Poses) -> Arm:
    """Return the arm with the base and tool whose forward kinematics fits the reported poses best.

    Where the motions do not determine them, they are nearest the arm's own. Raise InputError where angles and poses
    disagree, and LengthError where they do by a factor of all positions.
    """
    nominal = forward_kinematics(arm, joints)
    half_rotation = transform(rotation_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    tool, _, base = closed_form(base_from_gripper, nominal)
    fits = [
        fit_known_scale(base_from_gripper, nominal, start, NOISE)
        for start in ((np.eye(4), np.eye(4)), (np.eye(4), half_rotation), (tool, base))
    ]
    _require_length(arm, base_from_gripper, nominal)
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


def _require_length(arm: Arm, base_from_gripper: Poses, nominal: Poses) -> None:
    """Raise LengthError where one factor other than 1 on all positions makes them agree with the nominal arm."""
    tool, scale, base = closed_form(base_from_gripper, nominal)
    factor = float(scale)
    if factor <= 0:  # unobservable
        return
    residual, j = pose_residuals(tool, factor, base, base_from_gripper, nominal)
    metres, radians = _apart(residual)
    if metres > AGREE[0] * arm.reach * factor or radians > AGREE[1]:
        return
    left = max(6 * len(nominal) - j.shape[2], 1)
    noise = np.maximum(np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum((0, 2)) * 2 / left), NOISE)
    j /= np.repeat(noise, 3)[:, None]
    std = factor * float(np.sqrt(expected_covariance(np.einsum("nij,nik->jk", j, j))[6, 6]))
    if abs(factor - 1) > max(ALIKE, SURE * std):
        raise LengthError(
            f"the gripper positions are {100 * abs(factor - 1):.1f} ± {100 * std:.1f} % too "
            f"{'long' if factor > 1 else 'short'} for a {arm.name} with these joint angles; check the unit of the "
            "positions, and that this is the robot"
        )


def _apart(residual: Float[ndarray, "n 6"]) -> Float[ndarray, "2"]:
    """Return the rms difference in m and rad."""
    return np.sqrt((residual.reshape(-1, 2, 3) ** 2).sum(2).mean(0))
