"""Hand-eye problems of bent arms: nominal kinematics report the poses, the true ones are those of an arm with errors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.kinematics import Arm
from jcr.geometry import rotation_exp, scale_translation, transform
from simulation.arm_errors import PRESETS, ArmErrors, PresetName
from simulation.bent_arm import BentArm, bend
from simulation.problem import HandEyeProblem, disturbed
from simulation.robots import effective_about, hand_eye_on, views


@dataclass(frozen=True)
class BentProblem(HandEyeProblem):
    """A hand-eye problem of a bent arm; `gripper_from_camera` is the effective one."""

    bent: BentArm
    joints: Float[ndarray, "n dof"]
    physical_gripper_from_camera: Float[ndarray, "4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """Where the cameras were."""
        return self.true_base_from_gripper @ self.physical_gripper_from_camera


def bent_problem(
    arm: Arm,
    errors: ArmErrors | PresetName,
    count: int,
    seed: int,
    camera_noise: tuple[float, float] = (5e-5, np.radians(0.005)),
) -> BentProblem:
    """A random bent arm, hand-eye transform, reconstruction frame and scale, and `count` views of a table.

    `camera_noise` is one sigma (m, rad) per axis of the reconstructed cameras.
    """
    errors = PRESETS[errors] if isinstance(errors, str) else errors
    hand_eye, motion, arms, noise, elsewhere = (np.random.default_rng([seed, k]) for k in range(5))
    physical = hand_eye_on(arm, hand_eye)
    bent = bend(arm, errors.sizes, arms)
    joints = views(arm, count, physical, motion)
    true = bent.true(joints)
    effective = effective_about(bent, physical, count, elsewhere).gripper_from_camera
    recon_from_base = transform(rotation_exp(noise.normal(size=3)), noise.normal(size=3))
    scale = float(np.exp(noise.uniform(-2, 2)))
    cameras = disturbed(recon_from_base @ true @ physical, camera_noise, noise)
    return BentProblem(
        disturbed(bent.reported(joints), errors.white, noise),
        scale_translation(cameras, 1 / scale),
        effective,
        scale,
        true,
        bent,
        joints,
        physical,
    )
