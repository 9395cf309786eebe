"""Cells with several cameras as numbers, without images: what robots report and images show, and the truth.

Four kinds: `fixed`, a camera beside the table that a wrist camera maps; `wrists`, two cameras on one wrist; `arms`, two
arms with a wrist camera each before one table; `carried`, a fixed camera that watches a box in the gripper. Poses are
those of arms that bend of bent_arm.py, and the truth is the effective transform.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import project
from jcr.estimation.arms import arm_named
from jcr.estimation.image_robots import ArmPoses
from jcr.estimation.known_scale import Fit, fit_known_scale
from jcr.estimation.scene import Observations
from jcr.estimation.systematic import smooth_errors
from jcr.geometry import (
    apply,
    apply_similarity,
    inverse,
    rotation_exp,
    scale_translation,
    transform,
)
from jcr.records import Intrinsics
from simulation.arm_errors import PRESETS, PresetName
from simulation.bent_arm import BentArm, bend
from simulation.observations import INTRINSICS
from simulation.poses import looking_at, random_hand_eye
from simulation.problem import disturbed
from simulation.robots import (
    EFFECTIVE_NOISE,
    EFFECTIVE_POSES,
    about_posture,
    effective_exchanged,
    hand_eye_on,
    table_center,
    views,
)

Kind = Literal["fixed", "wrists", "arms", "carried"]
FIXED_CAMERA = Intrinsics(905.0, 903.0, 645.0, 355.0, 1280, 720, (0.06, -0.1, 5e-4, 3e-4, 0.02))
TABLE = np.array([[-0.25, -0.25, 0.0], [0.25, 0.25, 0.12]])
"""m about the middle of the table: where points lie."""
BOX = np.array([0.16, 0.12, 0.1])
"""m: the thing in the gripper, its middle this far ahead of the gripper's frame."""
BOX_AHEAD = 0.12


@dataclass(frozen=True, kw_only=True)
class CellProblem:
    """What is reported and seen, and the truth."""

    kind: Kind
    reported: tuple[Float[ndarray, "n 4 4"], ...]
    """base_from_gripper of each arm."""
    observations: Observations
    """Rigs are those of the first arm in order, then of the second, then fixed cameras."""
    world_from_rig: Float[ndarray, "m 4 4"]
    """In a frame and unit of their own, as a reconstruction has them."""
    rig_from_camera: Float[ndarray, "c 4 4"]
    """In that unit."""
    points_in_world: Float[ndarray, "p 3"]
    cameras: tuple[Intrinsics, ...]
    scale: float
    truth: dict[str, Float[ndarray, "4 4"]]
    """gripper_from_camera, and of a second one or arm; base_from_camera, base1_from_base2, gripper_from_object."""
    starts: tuple[tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]], ...]
    """True X and base_from_world of each arm, where a search may start."""

    @property
    def arms(self) -> list[ArmPoses]:
        """As an adjustment takes them, their errors smooth over the poses."""
        count = len(self.reported[0])
        return [
            ArmPoses(
                rigs=np.arange(count) + count * k,
                base_from_gripper=poses,
                systematic=smooth_errors(poses),
                start=start,
                exchanged=self.kind == "carried",
            )
            for k, (poses, start) in enumerate(zip(self.reported, self.starts, strict=True))
        ]


def cell_problem(
    kind: Kind, preset: PresetName, count: int, seed: int, noise_px: float = 0.5, points: int = 400
) -> CellProblem:
    """A random cell of that kind, of UR5e arms with errors of `preset`, and `count` poses of each."""
    make = _carried if kind == "carried" else _before_table
    return make(kind, preset, count, np.random.default_rng([seed, 13]), noise_px, points)


@dataclass
class _Cell:
    """A cell as it is, in the base of its first arm."""

    kind: Kind
    reported: list[Float[ndarray, "n 4 4"]] = field(default_factory=list)
    """base_from_gripper of each arm, with its errors."""
    rigs: list[Float[ndarray, "m 4 4"]] = field(default_factory=list)
    """base_from_rig of each arm, then of fixed cameras."""
    mounts: list[Float[ndarray, "4 4"]] = field(default_factory=lambda: [np.eye(4)])
    """rig_from_camera of each camera."""
    cameras: list[Intrinsics] = field(default_factory=lambda: [INTRINSICS])
    images: list[tuple[int, int]] = field(default_factory=list)
    """Row of the rig and of the camera that took each."""
    truth: dict[str, Float[ndarray, "4 4"]] = field(default_factory=dict)
    starts: list[tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]] = field(default_factory=list)


def _before_table(
    kind: Kind, preset: PresetName, count: int, rng: np.random.Generator, noise_px: float, points: int
) -> CellProblem:
    arms = [_drawn(preset, rng) for _ in range(2 if kind == "arms" else 1)]
    base_from_second = transform(
        rotation_exp(np.array([0.0, 0.0, np.pi + rng.uniform(-0.3, 0.3)])), np.zeros(3)
    )
    target = table_center(arms[0].arm)
    base_from_second[:3, 3] = target - base_from_second[:3, :3] @ target + 0.03 * rng.normal(size=3)
    cell, fits = _Cell(kind, images=[(k, 0) for k in range(count)]), []
    for bent, world_from_base in zip(arms, [np.eye(4), base_from_second], strict=False):
        x = hand_eye_on(bent.arm, rng)
        joints = views(bent.arm, count, x, rng)
        others = np.concatenate([views(bent.arm, count, x, rng) for _ in range(-(-EFFECTIVE_POSES // count))])
        cameras = world_from_base @ bent.true(others) @ x
        start = x, inverse(world_from_base)
        fits.append(fit_known_scale(bent.reported(others), cameras, start, EFFECTIVE_NOISE))
        cell.rigs.append(world_from_base @ bent.true(joints) @ x)
        cell.reported.append(disturbed(bent.reported(joints), PRESETS[preset].white, rng))
        cell.starts.append(start)
    cell.truth["gripper_from_camera"] = fits[0].gripper_from_camera
    _add_second_camera(cell, fits, target, count, rng)
    x_in_base = target + rng.uniform(TABLE[0], TABLE[1], (points, 3))
    return _seen(cell, x_in_base, None, noise_px, rng)


def _add_second_camera(
    cell: _Cell, fits: list[Fit], target: Float[ndarray, "3"], count: int, rng: np.random.Generator
) -> None:
    """Add the second wrist camera, the other arm's or the fixed one to a cell whose arms have their poses."""
    mount = np.eye(4)
    if cell.kind == "wrists":
        mount = transform(rotation_exp(0.05 * rng.normal(size=3)), np.array([0.055, 0.0, 0.0]))
        cell.images += [(k, 1) for k in range(count)]
        cell.truth["gripper_from_second"] = fits[0].gripper_from_camera @ mount
    if cell.kind == "arms":
        cell.images += [(count + k, 1) for k in range(count)]
        cell.truth["gripper_from_second"] = fits[1].gripper_from_camera
        cell.truth["base1_from_base2"] = fits[0].base_from_recon @ inverse(fits[1].base_from_recon)
    if cell.kind == "fixed":
        azimuth = rng.uniform(-2.5, 2.5)
        away = np.array([0.75 * np.cos(azimuth), 0.75 * np.sin(azimuth), rng.uniform(0.6, 1.1)])
        base_from_camera = looking_at(target + away, target, rng)
        cell.rigs.append(base_from_camera[None])
        cell.images.append((count, 1))
        cell.truth["base_from_camera"] = fits[0].base_from_recon @ base_from_camera
    cell.mounts.append(mount)
    cell.cameras.append(FIXED_CAMERA)


def _carried(
    kind: Kind, preset: PresetName, count: int, rng: np.random.Generator, noise_px: float, points: int
) -> CellProblem:
    bent = _drawn(preset, rng)
    posture = bent.arm.rest.copy()
    posture[0] += rng.uniform(-1, 1)
    joints = about_posture(bent.arm, posture, count, rng)
    true = bent.true(joints)
    gripper_from_object = random_hand_eye(rng)
    gripper_from_object[:3, 3] = BOX_AHEAD * bent.arm.forward
    middle = (true @ gripper_from_object)[:, :3, 3].mean(0)
    away = rng.normal(size=3)
    away[2] = abs(away[2])
    base_from_camera = looking_at(middle + 0.75 * away / np.linalg.norm(away), middle, rng)
    others = about_posture(bent.arm, posture, EFFECTIVE_POSES, rng)
    start = base_from_camera, gripper_from_object
    effective = effective_exchanged(bent, others, *start)
    x_in_object, normal = _box(points, rng)
    rigs = inverse(true @ gripper_from_object) @ base_from_camera
    truth = {"base_from_camera": effective[0], "gripper_from_object": effective[1]}
    cell = _Cell(
        kind,
        reported=[disturbed(bent.reported(joints), PRESETS[preset].white, rng)],
        rigs=[rigs],
        cameras=[FIXED_CAMERA],
        images=[(k, 0) for k in range(count)],
        truth=truth,
        starts=[start],
    )
    return _seen(cell, x_in_object, normal, noise_px, rng)


def _drawn(preset: PresetName, rng: np.random.Generator) -> BentArm:
    return bend(arm_named("ur5e"), PRESETS[preset].sizes, rng)


def _box(points: int, rng: np.random.Generator) -> tuple[Float[ndarray, "p 3"], Float[ndarray, "p 3"]]:
    """Points on the faces of the box, and the faces' normals."""
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
    """The problem in a frame and unit of its own, every point seen with noise by all cameras that have it in view."""
    image, x_px, point = [], [], []
    rigs = np.concatenate(cell.rigs)
    for k, (rig, row) in enumerate(cell.images):
        camera, place = cell.cameras[row], rigs[rig] @ cell.mounts[row]
        x = apply(inverse(place), x_in_base)
        pixels = project(camera, x)
        shown = (x[:, 2] > 0) & ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        if normal is not None:
            shown &= ((place[:3, 3] - x_in_base) * normal).sum(1) > 0
        point.append(np.flatnonzero(shown))
        image.append(np.full(shown.sum(), k))
        x_px.append(pixels[shown] + noise_px * rng.normal(size=(int(shown.sum()), 2)))
    world_from_base = transform(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    scale = float(np.exp(rng.uniform(-2, 2)))
    rig_of, camera_of = np.array(cell.images).T
    return CellProblem(
        kind=cell.kind,
        reported=tuple(cell.reported),
        observations=Observations(
            rig=rig_of,
            camera=camera_of,
            image=np.concatenate(image),
            x_px=np.concatenate(x_px),
            point=np.concatenate(point),
            std_px=np.ones(sum(map(len, point))),
        ),
        world_from_rig=scale_translation(world_from_base @ rigs, 1 / scale),
        rig_from_camera=scale_translation(np.stack(cell.mounts), 1 / scale),
        points_in_world=apply_similarity(world_from_base, 1.0, x_in_base) / scale,
        cameras=tuple(cell.cameras),
        scale=scale,
        truth=cell.truth,
        starts=tuple((x, z @ inverse(world_from_base)) for x, z in cell.starts),
    )
