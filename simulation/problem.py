"""Hand-eye problems without images: poses with a known answer, for tests and tables of the calibration."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import rotation_exp, scale_translation, step_between, transform
from simulation.poses import Pattern, gripper_poses, random_hand_eye

TARGET_IN_BASE = np.array([0.5, 0.0, 0.0])


@dataclass(frozen=True)
class HandEyeProblem:
    """What a robot and a reconstruction would report, and the truth."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    """As reported, with the robot pose noise."""
    recon_from_camera: Float[ndarray, "n 4 4"]
    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    true_base_from_gripper: Float[ndarray, "n 4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """Where the cameras were."""
        return self.true_base_from_gripper @ self.gripper_from_camera


def hand_eye_problem(
    rng: np.random.Generator,
    count: int = 10,
    pattern: Pattern = "varied",
    robot_noise: tuple[float, float] = (0.0, 0.0),
    camera_noise: tuple[float, float] = (0.0, 0.0),
    deviation: float = 0.0,
) -> HandEyeProblem:
    """A random hand-eye transform, scale and reconstruction frame, and wrist views in the given pattern.

    Noises are one sigma per axis (m, rad) of the reported gripper poses and of the reconstructed cameras;
    `deviation` (rad) rotates every view by so much about a random axis, off a degenerate pattern.
    """
    gripper_from_camera = random_hand_eye(rng)
    true = gripper_poses(pattern, count, TARGET_IN_BASE, gripper_from_camera, rng)
    axes = rng.normal(size=(len(true), 3))
    axes *= deviation / np.linalg.norm(axes, axis=1, keepdims=True)
    true = true @ transform(rotation_exp(axes), np.zeros(3))
    recon_from_base = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    scale = float(np.exp(rng.uniform(-2, 2)))
    cameras = disturbed(recon_from_base @ true @ gripper_from_camera, camera_noise, rng)
    return HandEyeProblem(
        disturbed(true, robot_noise, rng),
        scale_translation(cameras, 1 / scale),
        gripper_from_camera,
        scale,
        true,
    )


def disturbed(
    a_from_b: Float[ndarray, "n 4 4"], noise: tuple[float, float], rng: np.random.Generator
) -> Float[ndarray, "n 4 4"]:
    """Transforms with Gaussian errors, one sigma per axis: position in a's axes (m), rotation in b's (rad)."""
    rotation = a_from_b[:, :3, :3] @ rotation_exp(noise[1] * rng.normal(size=(len(a_from_b), 3)))
    return transform(rotation, a_from_b[:, :3, 3] + noise[0] * rng.normal(size=(len(a_from_b), 3)))


def error(
    problem: HandEyeProblem, gripper_from_camera: Float[ndarray, "4 4"], scale: float
) -> Float[ndarray, "7"]:
    """True minus found, in records.COVARIANCE_ORDER."""
    return np.r_[
        step_between(gripper_from_camera, problem.gripper_from_camera), np.log(problem.scale / scale)
    ]
