"""`benchmarks live`: how many images does a capture need that is calibrated while it is taken, and is its claim true?"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.estimation.arms import RobotName, arm_named
from jcr.estimation.inverse_kinematics import reach_toward
from jcr.estimation.known_scale import fit_known_scale
from jcr.geometry import apply, inverse, retract, rotation_angle, transform
from jcr.live.calibration import LiveCalibration
from jcr.live.calibration_progress import Progress
from jcr.records import Intrinsics
from simulation.arms import (
    EFFECTIVE_NOISE,
    EFFECTIVE_POSES,
    PRESETS,
    BentArm,
    about_posture,
    bend,
    hand_eye_on,
    table_center,
    view_size,
    views,
)
from simulation.poses import looking_at
from simulation.render import render
from simulation.scenes import Scene, make_scene, moved
from simulation.taken import pinhole

REQUIRE = (2.0, 0.3)
"""mm, degrees: 95 % of errors of a seen point, and of directions there."""
FIRST = 3
"""Images at poses of the pattern `varied`, with which every way begins: before them nothing can be proposed."""
ARMS: tuple[RobotName, ...] = ("ur5e", "panda", "fr3", "ur10e", "xarm6")
AROUND = 0.5
"""m, of a UR5e: distance from which random poses and those of the grid look at the middle of the table."""
GRID = (6, 3)
"""Azimuths and elevations."""

Way = Callable[["Cell", Progress, int], Float[ndarray, "4 4"]]
"""The next base_from_gripper that somebody wishes, of a cell, from the state and the number of images so far."""


@dataclass(frozen=True)
class Cell:
    """An arm with errors, a camera on it, and what it looks at."""

    arm: BentArm
    scene: Scene
    camera: Intrinsics
    physical: Float[ndarray, "4 4"]
    """gripper_from_camera by the true poses of the arm."""
    varied: Float[ndarray, "n dof"]
    """Joint angles of the pattern `varied`."""
    seed: int

    def nearest(
        self, wished: Float[ndarray, "4 4"], joints: Float[ndarray, " dof"]
    ) -> Float[ndarray, " dof"]:
        """The joint angles at which the gripper comes nearest to a pose."""
        return reach_toward(self.arm.arm, wished[None], joints[None])[0]

    def looking(self, place: Float[ndarray, "3"], rng: np.random.Generator) -> Float[ndarray, "4 4"]:
        """base_from_gripper from which the camera at a place looks at the middle of the table."""
        return looking_at(place, self.scene.table_center_in_base, rng) @ inverse(self.physical)

    def effective(self, joints: Float[ndarray, "n dof"]) -> Float[ndarray, "4 4"]:
        """gripper_from_camera that a capture at these joint angles is to find: the effective one where it was taken."""
        rng = np.random.default_rng([self.seed, 80])
        count = -(-EFFECTIVE_POSES // len(joints))
        around = np.concatenate([about_posture(self.arm.arm, posture, count, rng) for posture in joints])
        cameras = self.arm.true(around) @ self.physical
        start = self.physical, np.eye(4)
        return fit_known_scale(self.arm.reported(around), cameras, start, EFFECTIVE_NOISE).gripper_from_camera


@dataclass(frozen=True)
class Run:
    """One capture that ended by itself, or with the last image that was allowed."""

    scene: str
    way: str
    images: int
    claimed: bool
    claimed_mm: float
    claimed_deg: float
    error_mm: float
    """Of a seen point at the distance of the scene."""
    error_deg: float
    seconds: float
    """Processor time of the last image's calibration."""

    @property
    def is_true(self) -> bool:
        """Whether both errors are within what was required."""
        return self.error_mm <= REQUIRE[0] and self.error_deg <= REQUIRE[1]


def run() -> str:
    """Markdown: two scenes, or ten."""
    runs = [run_of(cell_of(seed), name, way, 24) for seed in range(2) for name, way in WAYS.items()]
    return page(runs)


def page(runs: Sequence[Run]) -> str:
    """Markdown of measured captures."""
    of_way = {name: [one for one in runs if one.way == name] for name in WAYS}
    claimed = [one for one in runs if one.claimed]
    goal = f"{REQUIRE[0]:g} mm and {REQUIRE[1]:g}°"
    lines = [
        "> "
        + "; ".join(f"{name} {_images(some)}" for name, some in of_way.items() if some)
        + " images, median and range",
        f"> {sum(one.is_true for one in claimed)} of {len(claimed)} claims of {goal} true",
        "",
        "A rendered camera on an arm with errors (typical ones: 0.1° a joint, 0.3 mm a link) goes to poses until the "
        f"calibration that grows with the images claims {goal} (95 % of errors of a seen point) and its leave-one-out "
        f"error confirms it, which takes 8 images at least. Every way begins with {FIRST} varied poses. Errors are "
        "against the effective transform about the poses of the capture: between workspaces of one arm it differs by "
        "up to 2.5 mm.",
        "",
        "| poses | captures | images | claims mm | ° | error mm | ° | claims true |",
        "|---" * 8 + "|",
        *(_way_line(name, some) for name, some in of_way.items() if some),
        "",
        "Each cell is the median, and the range in brackets.",
        "",
        "| scene, arm | poses | images | claims mm | ° | error mm | ° | claim | last image, s of processor |",
        "|---" * 9 + "|",
        *map(_line, runs),
    ]
    return "\n".join(lines) + "\n"


def _images(runs: Sequence[Run]) -> str:
    """Median and range; a capture that ended without a claim needs more than it had."""
    ended = max(one.images for one in runs)
    counts = [one.images if one.claimed else np.inf for one in runs]
    words = [
        f"more than {ended}" if np.isinf(value) else f"{value:g}"
        for value in (np.median(counts), min(counts), max(counts))
    ]
    return f"{words[0]} ({words[1]} to {words[2]})"


def _way_line(name: str, runs: Sequence[Run]) -> str:
    columns = ((one.claimed_mm, one.claimed_deg, one.error_mm, one.error_deg) for one in runs)
    spread = [
        f"{np.median(values):.2g} ({min(values):.2g} to {max(values):.2g})"
        for values in zip(*columns, strict=True)
    ]
    claimed = [one for one in runs if one.claimed]
    is_true = f"{sum(one.is_true for one in claimed)} of {len(claimed)}"
    return "| " + " | ".join([name, str(len(runs)), _images(runs), *spread, is_true]) + " |"


def _line(one: Run) -> str:
    claim = ("true" if one.is_true else "false") if one.claimed else "none"
    cells = [one.scene, one.way, str(one.images), f"{one.claimed_mm:.2f}", f"{one.claimed_deg:.3f}"]
    cells += [f"{one.error_mm:.2f}", f"{one.error_deg:.3f}", claim, f"{one.seconds:.1f}"]
    return "| " + " | ".join(cells) + " |"


def cell_of(seed: int) -> Cell:
    """The cell of a seed."""
    hand_eye, errors, motion, camera = (np.random.default_rng([seed, 40 + k]) for k in (0, 1, 3, 4))
    arm = arm_named(ARMS[seed % len(ARMS)])
    bent = bend(arm, PRESETS["typical"].sizes, errors)
    target = table_center(arm)
    x = hand_eye_on(arm, hand_eye)
    return Cell(
        arm=bent,
        scene=moved(make_scene("tabletop", seed), target),
        camera=pinhole(camera),
        physical=x,
        varied=views(arm, 40, x, motion, target),
        seed=seed,
    )


def _proposed(cell: Cell, state: Progress, count: int) -> Float[ndarray, "4 4"]:
    assert state.next_pose is not None
    return state.next_pose.base_from_gripper


def _varied(cell: Cell, state: Progress, count: int) -> Float[ndarray, "4 4"]:
    return cell.arm.reported(cell.varied[count : count + 1])[0]


def _random(cell: Cell, state: Progress, count: int) -> Float[ndarray, "4 4"]:
    rng = np.random.default_rng([cell.seed, 60, count])
    azimuth, elevation = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(45, 85))
    return cell.looking(_place(cell, azimuth, elevation, rng.uniform(0.8, 1.3)), rng)


def _grid(cell: Cell, state: Progress, count: int) -> Float[ndarray, "4 4"]:
    """In rows of equal elevation, without a rotation about the line of sight."""
    row, column = divmod((count - FIRST) % (GRID[0] * GRID[1]), GRID[0])
    azimuth, elevation = np.pi * (0.5 + (column + 0.5) / GRID[0]), np.radians(50 + 15 * row)
    place = _place(cell, azimuth, elevation, 1.0)
    z = cell.scene.table_center_in_base - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    camera = transform(np.stack([x, np.cross(z, x), z], axis=1), place)
    start = _facing(cell)
    roll = np.arctan2(start[:3, 1] @ camera[:3, 0], start[:3, 0] @ camera[:3, 0])
    about = transform(
        np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]), np.zeros(3)
    )
    return camera @ inverse(about) @ inverse(cell.physical)


def _facing(cell: Cell) -> Float[ndarray, "4 4"]:
    """base_from_camera of the first image, whose roll the grid keeps."""
    return cell.arm.reported(cell.varied[:1])[0] @ cell.physical


def _place(cell: Cell, azimuth: float, elevation: float, factor: float) -> Float[ndarray, "3"]:
    far = AROUND * factor * max(view_size(cell.arm.arm), 0.55)
    toward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    return cell.scene.table_center_in_base + far * np.array(toward)


WAYS: dict[str, Way] = {"proposed": _proposed, "varied": _varied, "random": _random, "grid": _grid}


def run_of(cell: Cell, name: str, way: Way, most: int) -> Run:
    """A capture by one way, until its claim is confirmed."""
    white = PRESETS["typical"].white
    rng = np.random.default_rng([cell.seed, 70])
    state, seconds, joints = Progress(images=()), 0.0, cell.varied[0]
    arm = cell.arm.arm
    wanted: list[Float[ndarray, "4 4"]] = []
    visited: list[Float[ndarray, " dof"]] = []

    def poses() -> Iterator[Float[ndarray, "4 4"]]:
        while True:
            yield wanted[-1]

    seen = render(cell.scene, cell.camera, poses(), with_truth=False)
    with tempfile.TemporaryDirectory() as folder:
        options = CalibrateOptions(require=REQUIRE)
        live = LiveCalibration(
            Path(folder) / "capture", intrinsics=cell.camera, robot=arm.name, options=options
        )
        for count in range(most):
            if count < FIRST:
                joints = cell.varied[count]
            elif name == "proposed" and state.next_joints is not None:
                joints = state.next_joints
            else:
                joints = cell.nearest(way(cell, state, count), joints)
            visited.append(joints)
            wanted.append(cell.arm.true(joints[None])[0] @ cell.physical)
            reported = retract(
                cell.arm.reported(joints[None]), np.repeat(white, 3) * rng.normal(size=(1, 6))
            )[0]
            begun = time.process_time()
            state = live.add(next(seen).image, reported, joints)
            seconds = time.process_time() - begun
            if state.requirement_met:
                break
        live.close()
    return _measured(cell, name, state, seconds, np.array(visited))


def _measured(
    cell: Cell, name: str, state: Progress, seconds: float, visited: Float[ndarray, "n dof"]
) -> Run:
    found = state.hand_eye
    assert found is not None and state.now is not None and found.in_use is not None
    ahead = np.array([0.0, 0.0, 1e-3 * found.in_use.seen.distance_mm])
    x, effective = found.gripper_from_camera, cell.effective(visited)
    away = float(np.linalg.norm(apply(x, ahead) - apply(effective, ahead)))
    return Run(
        scene=f"{cell.seed}, {cell.arm.arm.name}",
        way=name,
        images=len(state.images),
        claimed=state.requirement_met,
        claimed_mm=state.now.translation_mm,
        claimed_deg=state.now.rotation_deg,
        error_mm=1e3 * away,
        error_deg=float(np.degrees(rotation_angle(x[:3, :3].T @ effective[:3, :3]))),
        seconds=seconds,
    )
