"""Motion of a gripper with a camera over a table, and the place of a camera beside it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from simulation.arms import BentArm, effective_about, hand_eye_on, table_center, views
from simulation.poses import gripper_poses, looking_at, random_hand_eye


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


def motion_over_table(
    bent: BentArm | None,
    count: int,
    target_in_base: Float[ndarray, "3"],
    streams: Sequence[np.random.Generator],
) -> Motion:
    """Draw varied views of a table about `target_in_base`, or, for an arm, of the table that suits it.

    `streams` draw the motion, and the poses that its effective transform is fitted to.
    """
    motion, elsewhere = streams
    if bent is None:
        x = random_hand_eye(motion)
        poses = gripper_poses("varied", count, target_in_base, x, motion)
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
    joints = views(bent.arm, count, x, motion, target)
    fit = effective_about(bent, x, count, elsewhere, target)
    return Motion(
        target_in_base=target,
        physical=x,
        base_from_gripper=bent.true(joints),
        reported=bent.reported(joints),
        effective=fit.gripper_from_camera,
        base_from_true_base=fit.base_from_recon,
    )


def fixed_camera(
    target: Float[ndarray, "3"], distance_m: float, rng: np.random.Generator
) -> Float[ndarray, "4 4"]:
    """Draw base_from_camera of a camera beside the table, `distance_m` aside and 0.6 to 0.8 m up."""
    azimuth = rng.uniform(-2.6, 2.6)
    away = np.array([distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), rng.uniform(0.6, 0.8)])
    return looking_at(target + away, target, rng)
