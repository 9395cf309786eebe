"""Motion of a gripper with a camera over a table, and the places of further cameras and arms of a cell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import inverse, rotation_exp, transform
from simulation.arms import (
    EFFECTIVE_POSES,
    BentArm,
    about_posture,
    effective_about,
    effective_fit,
    hand_eye_on,
    patterned,
    table_center,
)
from simulation.poses import Pattern, gripper_poses, looking_at, random_hand_eye

ROTATIONS, SHIFTS = np.array([0.55, 0.55, 1.0]), 0.07
"""rad and m to either side: motion of a carried object without an arm before its camera."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Gripper poses of a capture in the base of the arm, and the hand-eye transform to be found from them."""

    target_in_base: Float[ndarray, "3"]
    """Middle of the table (m)."""
    physical: Float[ndarray, "4 4"]
    """gripper_from_camera of the mounted camera."""
    base_from_gripper: Float[ndarray, "n 4 4"]
    reported: Float[ndarray, "n 4 4"]
    """base_from_gripper by the nominal kinematics of the arm."""
    effective: Float[ndarray, "4 4"]
    """gripper_from_camera that best predicts the camera from reported poses; `physical` without systematic errors."""
    base_from_true_base: Float[ndarray, "4 4"]
    """Base in which `reported` and `effective` predict the camera, from the one of `base_from_gripper`."""
    joints: Float[ndarray, "n dof"] | None = None
    """rad; None without an arm."""
    bent: BentArm | None = None


def motion_over_table(
    bent: BentArm | None,
    pattern: Pattern,
    count: int,
    target_in_base: Float[ndarray, "3"],
    streams: Sequence[np.random.Generator],
) -> Motion:
    """Draw a motion over a table about `target_in_base`, or, for an arm, about the table that suits it.

    `streams` draw the motion, and the poses that its effective transform is fitted to.
    """
    motion, elsewhere = streams
    if bent is None:
        x = random_hand_eye(motion)
        poses = gripper_poses(pattern, count, target_in_base, x, motion)
        return Motion(
            target_in_base=target_in_base,
            physical=x,
            base_from_gripper=poses,
            reported=poses,
            effective=x,
            base_from_true_base=np.eye(4),
        )
    target = table_center(bent.arm)
    x = hand_eye_on(bent.arm, motion)
    joints = patterned(bent.arm, pattern, count, target, x, motion)
    fit = effective_about(bent, x, count, elsewhere, target)
    return Motion(
        target_in_base=target,
        physical=x,
        base_from_gripper=bent.true(joints),
        reported=bent.reported(joints),
        effective=fit.gripper_from_camera,
        base_from_true_base=fit.base_from_recon,
        joints=joints,
        bent=bent,
    )


def fixed_camera(
    target: Float[ndarray, "3"], distance_m: float, rng: np.random.Generator
) -> Float[ndarray, "4 4"]:
    """Draw base_from_camera of a camera beside the table, `distance_m` aside and 0.6 to 0.8 m up."""
    azimuth = rng.uniform(-2.6, 2.6)
    away = np.array([distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), rng.uniform(0.6, 0.8)])
    return looking_at(target + away, target, rng)


def second_on_wrist(rng: np.random.Generator) -> Float[ndarray, "4 4"]:
    """Draw first_from_second of a second camera beside the first one on a wrist."""
    return transform(rotation_exp(0.05 * rng.normal(size=3)), np.array([0.06, 0.0, 0.0]))


def base_across_table(
    target: Float[ndarray, "3"], other_target: Float[ndarray, "3"], rng: np.random.Generator
) -> Float[ndarray, "4 4"]:
    """Draw base_from_other of a second arm across the table; its `other_target` is this arm's `target`."""
    rotation = rotation_exp(np.array([0.0, 0.0, np.pi + rng.uniform(-0.4, 0.4)]))
    return transform(rotation, target - rotation @ other_target)


@dataclass(frozen=True, kw_only=True)
class CarriedMotion:
    """Motion of an object in the gripper before a fixed camera."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    reported: Float[ndarray, "n 4 4"]
    base_from_camera: Float[ndarray, "4 4"]
    gripper_from_object: Float[ndarray, "4 4"]
    effective: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]
    """base_from_camera and gripper_from_object by which reported poses best predict what the camera sees."""
    joints: Float[ndarray, "n dof"] | None = None


def carried_motion(
    bent: BentArm | None,
    count: int,
    middle_in_base: Float[ndarray, "3"],
    ahead_m: float,
    away_m: float,
    rng: np.random.Generator,
) -> CarriedMotion:
    """Draw the motion of an object `ahead_m` before the gripper, `away_m` from the camera that watches it.

    Without an arm the gripper rotates about `middle_in_base`.
    """
    gripper_from_object, joints = random_hand_eye(rng), None
    if bent is None:
        rotations = rotation_exp(ROTATIONS * rng.uniform(-1, 1, (count, 3))) @ rotation_exp(
            rng.normal(size=3)
        )
        true = reported = transform(rotations, middle_in_base + SHIFTS * rng.uniform(-1, 1, (count, 3)))
        gripper_from_object[:3, 3] = [0.0, 0.0, ahead_m]
    else:
        joints = about_posture(bent.arm, bent.arm.rest, count, rng)
        true, reported = bent.true(joints), bent.reported(joints)
        gripper_from_object[:3, 3] = ahead_m * bent.arm.forward
    middle = (true @ gripper_from_object)[:, :3, 3].mean(0)
    side = rng.uniform(0.3, 1.2) * rng.choice([-1, 1])
    away = away_m * np.array([np.cos(side), np.sin(side), 0.5]) / np.hypot(1, 0.5)
    base_from_camera = looking_at(middle + away, middle, rng)
    effective = base_from_camera, gripper_from_object
    if bent is not None:
        others = about_posture(bent.arm, bent.arm.rest, EFFECTIVE_POSES, rng)
        fit = effective_fit(bent, others, effective, exchanged=True)
        effective = fit.gripper_from_camera, fit.base_from_recon
    return CarriedMotion(
        base_from_gripper=true,
        reported=reported,
        base_from_camera=base_from_camera,
        gripper_from_object=gripper_from_object,
        effective=effective,
        joints=joints,
    )


def base_from_other_base(
    own: Motion, other: Motion, base_from_other: Float[ndarray, "4 4"]
) -> Float[ndarray, "4 4"]:
    """Return base_from_other_base between the effective bases of two arms."""
    return own.base_from_true_base @ base_from_other @ inverse(other.base_from_true_base)
