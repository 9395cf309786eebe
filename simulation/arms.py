"""Simulated arms with systematic errors, the views that they reach, and their effective hand-eye transform.

Joint offsets and link errors are those of estimation/kinematics.py.

The truth for a hand-eye calibration of such an arm is the effective transform: of all hand-eye transforms and bases,
the one that best predicts the camera from the reported poses over the workspace of the capture.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.estimation.inverse_kinematics import reach_toward
from jcr.estimation.kinematics import (
    Arm,
    Joints,
    error_std,
    forward_kinematics,
    kinematic_jacobian,
    perpendicular,
)
from jcr.estimation.pose_equations import Fit, fit_known_scale
from jcr.geometry import inverse, rotation_exp, skew, transform
from simulation.poses import gripper_poses, random_hand_eye

EFFECTIVE_POSES = 120
"""Poses to which the effective hand-eye transform is fitted."""
EFFECTIVE_NOISE = (1e-3, 2e-3)
"""m, rad: errors of equal weight in that fit."""
WRIST_OF_VIEWS = 1.05
"""m: reach without the last link of a UR5e, for which the views of simulation.poses are made; others are scaled."""
TARGET_X = 0.5
"""m: distance of the middle of the table from the base of such an arm."""
LOWER_TABLE, LEAST_SIZE = 0.2, 0.55
"""m by which the table is lower than the base of an arm of no size, and least factor on the distances of the views: a
small arm stands above what it looks at, or objects would fill its images."""
IN_VIEW, LOWEST_VIEW = np.radians(12.0), np.radians(25.0)
"""Largest angle from the optical axis to the aim; least elevation of the camera above the table."""
ASIDE, START_SPREAD, LOOKING_STEPS = 0.35, 0.7, 15
"""Arms with fewer than six joints: rad by which the aim moves about the base, rad about the rest posture at which the
search for a view begins, and its steps."""
STRIDE = 0.4
"""rad by which joints move about a posture while what the gripper carries is watched."""
NEAREST, FARTHEST = 0.6, 1.5
"""Accepted distance to the aim, over that of the wished view."""


@dataclass(frozen=True)
class BentArm:
    """An arm with drawn errors."""

    arm: Arm
    errors: Float[ndarray, " p"]
    """Offset of each joint (rad), then two shifts (m) and two tilts (rad) of each link."""

    def reported(self, joints: Joints) -> Float[ndarray, "n 4 4"]:
        """Return base_from_gripper (n,4,4) as the controller computes it."""
        return forward_kinematics(self.arm, joints)

    def true(self, joints: Joints) -> Float[ndarray, "n 4 4"]:
        """Return the true base_from_gripper (n,4,4)."""
        dof, arm = self.arm.dof, self.arm
        sideways, link = perpendicular(arm.axes), self.errors[dof:].reshape(dof, 2, 2, 1)
        shift, tilt = (sideways @ link[:, part] for part in range(2))
        moved = transform(rotation_exp(tilt[..., 0]), shift[..., 0])
        return forward_kinematics(
            replace(arm, parent_from_joint=arm.parent_from_joint @ moved), joints + self.errors[:dof]
        )


@dataclass(frozen=True)
class ArmErrors:
    """One-sigma errors of an arm's reported poses."""

    white: tuple[float, float] = (0.0, 0.0)
    """m, rad per axis, independent at each pose."""
    joint_offset: float = 0.0
    """rad, of each joint, the same for all poses."""
    link: float = 0.0
    """m, of each translation of a link; its rotations go with it (kinematics.error_std)."""


PresetName = Literal["white", "factory-calibrated", "typical", "poor", "low-cost"]


def _bent(joint_offset_deg: float, link_mm: float) -> ArmErrors:
    return ArmErrors((5e-5, np.radians(0.01)), np.radians(joint_offset_deg), 1e-3 * link_mm)


PRESETS: dict[PresetName, ArmErrors] = {
    "white": ArmErrors((5e-4, np.radians(0.1))),
    "factory-calibrated": _bent(0.03, 0.1),
    "typical": _bent(0.1, 0.3),
    "poor": _bent(0.3, 1.0),
    "low-cost": _bent(1.0, 1.0),
}
"""Random noise alone, or systematic errors beside a small repeatability (0.05 mm, 0.01°)."""


def bend(arm: Arm, errors: ArmErrors, rng: np.random.Generator) -> BentArm:
    """Draw an arm with random errors of the given sizes."""
    std = error_std(arm, errors.joint_offset, errors.link)
    return BentArm(arm, std * rng.normal(size=len(std)))


def hand_eye_on(arm: Arm, rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    """Draw a plausible gripper_from_camera (4,4) that looks where the gripper points."""
    normal = np.cross([0.0, 0.0, 1.0], arm.forward)
    angle = np.arctan2(np.linalg.norm(normal), arm.forward[2])
    axis = normal / max(float(np.linalg.norm(normal)), 1e-12)
    return transform(rotation_exp(angle * axis), np.zeros(3)) @ random_hand_eye(rng)


def view_size(arm: Arm) -> float:
    """Return the size of the arm, 1 for a UR5e."""
    return (arm.reach - float(np.linalg.norm(arm.last_from_gripper[:3, 3]))) / WRIST_OF_VIEWS


def table_center(arm: Arm) -> Float[ndarray, "3"]:
    """Return the middle of a table that suits the arm (m): where its rest posture points, or farther ahead."""
    at_rest = forward_kinematics(arm, arm.rest[None])[0]
    ahead = at_rest[:3, :3] @ arm.forward
    meets = at_rest[:3, 3] - ahead * at_rest[2, 3] / ahead[2]
    ahead_m = max(TARGET_X * view_size(arm), float(np.hypot(*meets[:2])))
    return np.array([ahead_m, 0.0, -LOWER_TABLE * max(1 - view_size(arm), 0.0)])


def views(
    arm: Arm,
    count: int,
    gripper_from_camera: Float[ndarray, "4 4"],
    rng: np.random.Generator,
    target_in_base: Float[ndarray, "3"] | None = None,
) -> Joints:
    """Joint angles (n,dof) at which the camera looks at a table from varied directions and distances.

    Distances, and the target unless given, scale with the arm's reach. Where the arm cannot reach a view it takes the
    nearest pose that it can; InputError where too few of these show the target.
    """
    size = max(view_size(arm), LEAST_SIZE)
    target = table_center(arm) if target_in_base is None else target_in_base
    kept = np.zeros((0, arm.dof))
    for _ in range(8):
        # The pattern `varied` at the arm's size, and where each optical axis meets the table.
        wished = gripper_poses("varied", max(count, 12), np.zeros(3), gripper_from_camera, rng)
        wished = wished @ gripper_from_camera
        aim = wished[:, :3, 3] - wished[:, :3, 2] * (wished[:, 2, 3] / wished[:, 2, 2])[:, None]
        wished = transform(wished[:, :3, :3], size * wished[:, :3, 3] + target)
        aim = size * aim + target
        start = np.tile(arm.rest, (len(wished), 1))
        # The first joint faces the target.
        start[:, 0] += np.arctan2(target[1], target[0])
        if arm.dof < 6:
            about_base = rotation_exp(ASIDE * rng.uniform(-1, 1, len(aim))[:, None] * [0.0, 0.0, 1.0])
            wished = transform(about_base, np.zeros(3)) @ wished
            aim = (about_base @ aim[..., None])[..., 0]
            start += START_SPREAD * rng.uniform(-1, 1, start.shape)
            joints = _looking(arm, wished, aim, gripper_from_camera, start)
        else:
            joints = reach_toward(arm, wished @ inverse(gripper_from_camera), start)
        camera = forward_kinematics(arm, joints) @ gripper_from_camera
        to_aim = aim - camera[:, :3, 3]
        distance = np.linalg.norm(to_aim, axis=1)
        ratio = distance / np.linalg.norm(aim - wished[:, :3, 3], axis=1)
        shows = (to_aim * camera[:, :3, 2]).sum(1) > np.cos(IN_VIEW) * distance
        shows &= -to_aim[:, 2] > np.sin(LOWEST_VIEW) * distance
        shows &= (ratio > NEAREST) & (ratio < FARTHEST)
        kept = np.concatenate([kept, joints[shows]])[:count]
        if len(kept) == count:
            return kept
    raise InputError(
        f"a {arm.name} shows a table at x = {target[0]:.2f} m, y = {target[1]:.2f} m in {len(kept)} of {count} images; "
        "choose an arm of longer reach"
    )


def _looking(
    arm: Arm,
    wished: Float[ndarray, "n 4 4"],
    aim: Float[ndarray, "n 3"],
    gripper_from_camera: Float[ndarray, "4 4"],
    start: Joints,
) -> Joints:
    """Joint angles near `start` that put each aim on the optical axis at the wished distance, from whatever direction.

    For arms with fewer than six joints, which can take up hardly any given pose.
    """
    in_camera = np.zeros_like(aim)
    in_camera[:, 2] = np.linalg.norm(aim - wished[:, :3, 3], axis=1)
    joints = np.clip(start, *arm.limits.T)
    for _ in range(LOOKING_STEPS):
        gripper, jacobian = kinematic_jacobian(arm, joints)
        camera = gripper @ gripper_from_camera
        to_camera = np.swapaxes(camera[:, :3, :3], 1, 2)
        error = in_camera - (to_camera @ (aim - camera[:, :3, 3])[..., None])[..., 0]
        moved = jacobian[:, :3] - skew(aim - gripper[:, :3, 3]) @ jacobian[:, 3:]
        step = -np.linalg.pinv(to_camera @ moved, rcond=1e-3) @ error[..., None]
        joints = np.clip(joints + np.clip(step[..., 0], -0.3, 0.3), *arm.limits.T)
    return joints


def effective_about(
    bent: BentArm,
    gripper_from_camera: Float[ndarray, "4 4"],
    count: int,
    rng: np.random.Generator,
    target_in_base: Float[ndarray, "3"] | None = None,
) -> Fit:
    """Fit the effective gripper_from_camera and base of a bent arm over the workspace of `count` `views`.

    Other poses of the same views are used, since few poses do not reach where the pattern's later ones are.
    """
    captures = -(-EFFECTIVE_POSES // count)
    others = [views(bent.arm, count, gripper_from_camera, rng, target_in_base) for _ in range(captures)]
    return effective_fit(bent, np.concatenate(others), (gripper_from_camera, np.eye(4)))


def effective_fit(
    bent: BentArm,
    joints: Joints,
    start: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]],
) -> Fit:
    """Fit the pair of transforms by which reported poses best predict the camera, from the true pair `start`.

    The pair is gripper_from_camera and base_from_recon; for a fixed camera gripper_from_object and base_from_camera.
    """
    x, z = start
    return fit_known_scale(bent.reported(joints), inverse(z) @ bent.true(joints) @ x, start, EFFECTIVE_NOISE)


def about_posture(arm: Arm, posture: Float[ndarray, " dof"], count: int, rng: np.random.Generator) -> Joints:
    """Draw joint angles (count,dof) about those of a posture; the wrist moves most."""
    width = STRIDE * np.array([0.5] * (arm.dof - 3) + [1.5, 1.5, 2.0])
    return posture + width * rng.uniform(-1, 1, (count, arm.dof))
