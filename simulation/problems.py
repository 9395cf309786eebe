"""Hand-eye problems with a known answer, and image observations of them, without rendering."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.camera import project
from jcr.estimation.kinematics import Arm
from jcr.geometry import apply, inverse, rotation_exp, scale_translation, step_between, transform
from jcr.records import Intrinsics, Tracks
from simulation.arms import PRESETS, BentArm, PresetName, bend, effective_about, hand_eye_on, views
from simulation.poses import Pattern, gripper_poses, random_hand_eye

INTRINSICS = Intrinsics(620.0, 618.0, 322.0, 236.0, 640, 480, (-0.08, 0.05, 1e-3, -5e-4, 0.01))
TARGET_IN_BASE = np.array([0.5, 0.0, 0.0])


@dataclass(frozen=True)
class HandEyeProblem:
    """Reports of a robot and a reconstruction, and the truth."""

    base_from_gripper: Float[ndarray, "n 4 4"]
    """Reported gripper poses, with the robot pose noise."""
    recon_from_camera: Float[ndarray, "n 4 4"]
    gripper_from_camera: Float[ndarray, "4 4"]
    scale: float
    true_base_from_gripper: Float[ndarray, "n 4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """True camera poses."""
        return self.true_base_from_gripper @ self.gripper_from_camera


def hand_eye_problem(
    rng: np.random.Generator,
    count: int = 10,
    pattern: Pattern = "varied",
    robot_noise: tuple[float, float] = (0.0, 0.0),
    camera_noise: tuple[float, float] = (0.0, 0.0),
    deviation: float = 0.0,
) -> HandEyeProblem:
    """Draw a hand-eye transform, scale and reconstruction frame, and wrist views in the given pattern.

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
    """Add Gaussian errors to transforms, one sigma per axis: position in a's axes (m), rotation in b's (rad)."""
    rotation = a_from_b[:, :3, :3] @ rotation_exp(noise[1] * rng.normal(size=(len(a_from_b), 3)))
    return transform(rotation, a_from_b[:, :3, 3] + noise[0] * rng.normal(size=(len(a_from_b), 3)))


def error(
    problem: HandEyeProblem, gripper_from_camera: Float[ndarray, "4 4"], scale: float
) -> Float[ndarray, "7"]:
    """Return true minus found, in records.COVARIANCE_ORDER."""
    return np.r_[
        step_between(gripper_from_camera, problem.gripper_from_camera), np.log(problem.scale / scale)
    ]


@dataclass(frozen=True)
class BentProblem(HandEyeProblem):
    """Hand-eye problem of a bent arm; `gripper_from_camera` is the effective one."""

    bent: BentArm
    joints: Float[ndarray, "n dof"]
    physical_gripper_from_camera: Float[ndarray, "4 4"]

    @property
    def base_from_camera(self) -> Float[ndarray, "n 4 4"]:
        """True camera poses."""
        return self.true_base_from_gripper @ self.physical_gripper_from_camera


def bent_problem(
    arm: Arm,
    preset: PresetName,
    count: int,
    seed: int,
    camera_noise: tuple[float, float] = (5e-5, np.radians(0.005)),
) -> BentProblem:
    """Draw a bent arm, hand-eye transform, reconstruction frame and scale, and `count` views of a table.

    `camera_noise` is one sigma (m, rad) per axis of the reconstructed cameras.
    """
    errors = PRESETS[preset]
    hand_eye, motion, arms, noise, elsewhere = (np.random.default_rng([seed, k]) for k in range(5))
    physical = hand_eye_on(arm, hand_eye)
    bent = bend(arm, errors, arms)
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


def observed(
    problem: HandEyeProblem,
    rng: np.random.Generator,
    points: int,
    noise_px: float,
    camera: Intrinsics = INTRINSICS,
) -> Tracks:
    """Scatter points over the table, and observe each with noise (px) in all cameras that have it in their images."""
    low, high = np.array([0.25, -0.25, 0.0]), np.array([0.75, 0.25, 0.12])
    x_in_base = rng.uniform(low, high, (points, 3))
    base_from_camera = problem.base_from_camera
    image, point, x_px = shown_points(
        x_in_base, base_from_camera, [camera] * len(base_from_camera), noise_px, rng
    )
    # The reconstruction's frame follows from its first camera.
    recon_from_base = problem.recon_from_camera[0, :3, :3] @ base_from_camera[0, :3, :3].T
    about_camera = (x_in_base - base_from_camera[0, :3, 3]) / problem.scale
    return Tracks(
        image=image,
        x_px=x_px,
        point=point,
        points_in_recon=about_camera @ recon_from_base.T + problem.recon_from_camera[0, :3, 3],
    )


def shown_points(
    x_in_base: Float[ndarray, "p 3"],
    base_from_camera: Float[ndarray, "n 4 4"],
    cameras: Sequence[Intrinsics],
    noise_px: float,
    rng: np.random.Generator,
    normal: Float[ndarray, "p 3"] | None = None,
    pixels: Callable[[int, Float[ndarray, "p 3"]], Float[ndarray, "p 2"]] | None = None,
) -> tuple[Int[ndarray, " k"], Int[ndarray, " k"], Float[ndarray, "k 2"]]:
    """Return image, point and noisy pixel of each observation of points that cameras have in their images.

    With `normal`, points are seen from that side of their surface alone. `pixels` replaces the projection of points in
    the frame of a camera by another one, given the image's number.
    """
    image, point, x_px = [], [], []
    for k, (place, camera) in enumerate(zip(base_from_camera, cameras, strict=True)):
        at = apply(inverse(place), x_in_base)
        there = project(camera, at) if pixels is None else pixels(k, at)
        inside = (at[:, 2] > 0) & ((there > 0) & (there < [camera.width, camera.height])).all(1)
        if normal is not None:
            inside &= ((place[:3, 3] - x_in_base) * normal).sum(1) > 0
        seen = np.flatnonzero(inside)
        image.append(np.full(len(seen), k))
        point.append(seen)
        x_px.append(there[seen] + noise_px * rng.normal(size=(len(seen), 2)))
    return np.concatenate(image), np.concatenate(point), np.concatenate(x_px)
