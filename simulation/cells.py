"""Cells with several cameras as numbers, without images: reported poses, observations, and the truth.

Four kinds: `fixed`, a camera beside the table that a wrist camera maps; `wrists`, two cameras on one wrist; `arms`, two
arms with a wrist camera each before one table; `carried`, a fixed camera that watches a box in the gripper. Poses are
those of arms with systematic errors, and the truth is the effective transform.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.arms import arm_named
from jcr.estimation.intrinsics_prior import CameraPrior
from jcr.estimation.problem import Observations, Problem, ReportedPoses, State
from jcr.estimation.robot_noise import smooth_errors
from jcr.geometry import Similarity, inverse, rotation_exp, scale_translation, transform
from jcr.records import Intrinsics
from simulation.arms import (
    EFFECTIVE_POSES,
    PRESETS,
    ArmErrors,
    PresetName,
    about_posture,
    bend,
    effective_fit,
)
from simulation.motion import fixed_camera, motion_over_table
from simulation.poses import looking_at, random_hand_eye
from simulation.problems import INTRINSICS, disturbed, shown_points

Kind = Literal["fixed", "wrists", "arms", "carried"]
FIXED_CAMERA = Intrinsics(905.0, 903.0, 645.0, 355.0, 1280, 720, (0.06, -0.1, 5e-4, 3e-4, 0.02))
TABLE = np.array([[-0.25, -0.25, 0.0], [0.25, 0.25, 0.12]])
"""Box about the middle of the table (m) in which points lie."""
BOX = np.array([0.16, 0.12, 0.1])
"""Sides (m) of the object in the gripper."""
BOX_AHEAD, CAMERA_AWAY = 0.12, 0.75
"""m: from the gripper's frame to the middle of the box, and from a fixed camera to what it shows."""


@dataclass(frozen=True, kw_only=True)
class CellProblem:
    """Reported poses and observations of a cell, and the truth."""

    kind: Kind
    reported: tuple[Float[ndarray, "n 4 4"], ...]
    """base_from_gripper of each arm."""
    observations: Observations
    """Rigs are those of the first arm in order, then of the second, then fixed cameras."""
    world_from_rig: Float[ndarray, "m 4 4"]
    """Rig poses in a frame and unit of their own, as a reconstruction has them."""
    rig_from_camera: Float[ndarray, "c 4 4"]
    """Camera poses in the unit of `world_from_rig`."""
    points_in_world: Float[ndarray, "p 3"]
    cameras: tuple[Intrinsics, ...]
    scale: float
    truth: dict[str, Float[ndarray, "4 4"]]
    """gripper_from_camera, and of a second one or arm; base_from_camera, base1_from_base2, gripper_from_object."""
    starts: tuple[tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]], ...]
    """True X and base_from_world of each arm, as initial estimates."""

    @property
    def arms(self) -> list[ReportedPoses]:
        """Arms as an adjustment takes them, their errors smooth over the poses."""
        count = len(self.reported[0])
        return [
            ReportedPoses(
                rigs=np.arange(count) + count * k,
                base_from_gripper=poses,
                error_covariance=smooth_errors(poses),
                carries="scene" if self.kind == "carried" else "camera",
            )
            for k, poses in enumerate(self.reported)
        ]

    def unsolved(self, cameras: Sequence[CameraPrior], scale: float = 1.0) -> tuple[Problem, State]:
        """Return the adjustment of the cell with priors of its cameras, and the state at the initial estimates.

        `scale` is the initial estimate of the metres per unit of the world.
        """
        count = len(self.world_from_rig)
        problem = Problem(
            arms=tuple(self.arms), n_rigs=count, cameras=tuple(cameras), observations=self.observations
        )
        x, z = (np.stack(each) for each in zip(*self.starts, strict=True))
        return problem, State(
            x=x,
            scale=scale,
            z=z,
            world_from_rig=self.world_from_rig,
            rig_from_camera=self.rig_from_camera,
            points_in_world=self.points_in_world,
        )


def cell_problem(
    kind: Kind,
    preset: PresetName | ArmErrors,
    count: int,
    seed: int,
    noise_px: float = 0.5,
    points: int = 400,
    second: ArmErrors | None = None,
) -> CellProblem:
    """Draw a cell of that kind, of UR5e arms with the errors `preset`, and `count` poses of each.

    `second` are the errors of the second arm; None: those of the first, too.
    """
    rng = np.random.default_rng([seed, 13])
    cell = _Cell(kind=kind)
    first = PRESETS[preset] if isinstance(preset, str) else preset
    bent, white = bend(arm_named("ur5e"), first, rng), first.white
    if kind == "carried":
        gripper_from_object = random_hand_eye(rng)
        gripper_from_object[:3, 3] = BOX_AHEAD * bent.arm.forward
        joints = about_posture(bent.arm, bent.arm.rest, count, rng)
        carried = bent.true(joints) @ gripper_from_object
        middle, side = carried[:, :3, 3].mean(0), rng.uniform(0.3, 1.2) * rng.choice([-1, 1])
        away = CAMERA_AWAY * np.array([np.cos(side), np.sin(side), 0.5]) / np.hypot(1, 0.5)
        base_from_camera = looking_at(middle + away, middle, rng)
        elsewhere = about_posture(bent.arm, bent.arm.rest, EFFECTIVE_POSES, rng)
        pair = base_from_camera, gripper_from_object
        fit = effective_fit(bent, elsewhere, (gripper_from_object, base_from_camera))
        reported = disturbed(bent.reported(joints), white, rng)
        cell.add_arm(inverse(carried) @ base_from_camera, reported, pair, FIXED_CAMERA)
        cell.truth = {"base_from_camera": fit.base_from_recon, "gripper_from_object": fit.gripper_from_camera}
        x_in_object, normal = _box(points, rng)
        return _seen(cell, x_in_object, normal, noise_px, rng)
    own = motion_over_table(bent, count, np.zeros(3), (rng, rng))
    target = own.target_in_base
    cell.add_arm(
        own.base_from_gripper @ own.physical,
        disturbed(own.reported, white, rng),
        (own.physical, np.eye(4)),
        INTRINSICS,
    )
    cell.truth["gripper_from_camera"] = own.effective
    if kind == "wrists":
        mount = transform(rotation_exp(0.05 * rng.normal(size=3)), np.array([0.06, 0.0, 0.0]))
        cell.mounts.append(mount)
        cell.cameras.append(FIXED_CAMERA)
        cell.images += [(k, 1) for k in range(count)]
        cell.truth["gripper_from_second"] = own.effective @ mount
    elif kind == "fixed":
        place = fixed_camera(target, CAMERA_AWAY, rng)
        cell.add_camera(place[None], FIXED_CAMERA)
        cell.truth["base_from_camera"] = own.base_from_true_base @ place
    else:
        errors = second or first
        other = motion_over_table(bend(arm_named("ur5e"), errors, rng), count, np.zeros(3), (rng, rng))
        # The second arm is across the table.
        rotation = rotation_exp(np.array([0.0, 0.0, np.pi + rng.uniform(-0.4, 0.4)]))
        base_from_other = transform(rotation, target - rotation @ other.target_in_base)
        cell.add_arm(
            base_from_other @ other.base_from_gripper @ other.physical,
            disturbed(other.reported, errors.white, rng),
            (other.physical, inverse(base_from_other)),
            FIXED_CAMERA,
        )
        cell.truth["gripper_from_second"] = other.effective
        between = own.base_from_true_base @ base_from_other @ inverse(other.base_from_true_base)
        cell.truth["base1_from_base2"] = between
    x_in_base = target + rng.uniform(TABLE[0], TABLE[1], (points, 3))
    return _seen(cell, x_in_base, None, noise_px, rng)


@dataclass(kw_only=True)
class _Cell:
    """Cell under construction, in the base of its first arm."""

    kind: Kind
    reported: list[Float[ndarray, "n 4 4"]] = field(default_factory=list)
    """base_from_gripper of each arm, with its errors."""
    rigs: list[Float[ndarray, "m 4 4"]] = field(default_factory=list)
    """base_from_rig of each arm, then of fixed cameras."""
    mounts: list[Float[ndarray, "4 4"]] = field(default_factory=list)
    """rig_from_camera of each camera."""
    cameras: list[Intrinsics] = field(default_factory=list)
    images: list[tuple[int, int]] = field(default_factory=list)
    """Row of the rig and of the camera of each image."""
    truth: dict[str, Float[ndarray, "4 4"]] = field(default_factory=dict)
    starts: list[tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]] = field(default_factory=list)

    def add_camera(self, rigs: Float[ndarray, "m 4 4"], camera: Intrinsics) -> None:
        """Add a camera with rigs of its own."""
        first = sum(map(len, self.rigs))
        self.images += [(first + k, len(self.cameras)) for k in range(len(rigs))]
        self.rigs.append(rigs)
        self.mounts.append(np.eye(4))
        self.cameras.append(camera)

    def add_arm(
        self,
        rigs: Float[ndarray, "m 4 4"],
        reported: Float[ndarray, "m 4 4"],
        start: tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]],
        camera: Intrinsics,
    ) -> None:
        """Add an arm with its camera; `start` is the true pair of transforms."""
        self.add_camera(rigs, camera)
        self.reported.append(reported)
        self.starts.append(start)


def _box(points: int, rng: np.random.Generator) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p 3"]]:
    """Draw points on the faces of the box; return them with the faces' normals."""
    axis, side = rng.integers(0, 3, points), rng.choice([-1.0, 1.0], points)
    x = rng.uniform(-0.5, 0.5, (points, 3))
    x[np.arange(points), axis] = 0.5 * side
    return x * BOX, side[:, None] * np.eye(3)[axis]


def _seen(
    cell: _Cell,
    x_in_base: Float[ndarray, "p 3"],
    normal: Float[ndarray, "p 3"] | None,
    noise_px: float,
    rng: np.random.Generator,
) -> CellProblem:
    """Return the problem in a frame and unit of its own, with noisy observations of all points in view."""
    rigs = np.concatenate(cell.rigs)
    rig_of, camera_of = np.array(cell.images).T
    places = rigs[rig_of] @ np.stack(cell.mounts)[camera_of]
    cameras = [cell.cameras[row] for row in camera_of]
    image, point, x_px = shown_points(x_in_base, places, cameras, noise_px, rng, normal)
    world_from_base = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    scale = float(np.exp(rng.uniform(-2, 2)))
    return CellProblem(
        kind=cell.kind,
        reported=tuple(cell.reported),
        observations=Observations(
            rig=rig_of, camera=camera_of, image=image, x_px=x_px, point=point, std_px=np.ones(len(point))
        ),
        world_from_rig=scale_translation(world_from_base @ rigs, 1 / scale),
        rig_from_camera=scale_translation(np.stack(cell.mounts), 1 / scale),
        points_in_world=Similarity(world_from_base, 1.0)(x_in_base) / scale,
        cameras=tuple(cell.cameras),
        scale=scale,
        truth=cell.truth,
        starts=tuple((x, z @ inverse(world_from_base)) for x, z in cell.starts),
    )
