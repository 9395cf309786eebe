"""How a gripper with a camera on it moves over a table: by an arm with systematic errors, or by none."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.arms import RobotName, arm_named
from simulation.bent_arm import BentArm, ErrorSizes, bend
from simulation.options import SimulateOptions
from simulation.poses import gripper_poses, random_hand_eye
from simulation.robots import effective_about, hand_eye_on, patterned, table_center


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Gripper poses of a capture, in the base of the arm, and the hand-eye transform to be found from them."""

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
    """The base in which `reported` and `effective` predict the camera, from the one of `base_from_gripper`."""
    joints: Float[ndarray, "n dof"] | None = None
    """rad; None without an arm."""
    bent: BentArm | None = None


def motion_of(
    options: SimulateOptions, target_in_base: Float[ndarray, "3"], streams: Sequence[np.random.Generator]
) -> Motion:
    """The motion over a table about `target_in_base`, or, of an arm, about the table that suits it.

    `streams` draw the errors of the arm, its motion, and the poses that its effective transform is fitted to.
    """
    errors, motion, elsewhere = streams
    if options.robot is None:
        x = random_hand_eye(motion)
        poses = gripper_poses(options.pattern, options.images, target_in_base, x, motion)
        return Motion(
            target_in_base=target_in_base,
            physical=x,
            base_from_gripper=poses,
            reported=poses,
            effective=x,
            base_from_true_base=np.eye(4),
        )
    bent = bent_arm(options, options.robot, errors)
    target = table_center(bent.arm)
    x = hand_eye_on(bent.arm, motion)
    joints = patterned(bent.arm, options.pattern, options.images, target, x, motion)
    fit = effective_about(bent, x, options.images, elsewhere, target)
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


def bent_arm(options: SimulateOptions, robot: RobotName, rng: np.random.Generator) -> BentArm:
    """The arm with systematic errors of the sizes that the options give."""
    sizes = ErrorSizes(
        joint_offset=np.radians(options.joint_offsets),
        link=1e-3 * options.link_errors,
        sag=np.radians(options.sag),
        gear=np.radians(options.gear_errors),
    )
    return bend(arm_named(robot), sizes, rng)
