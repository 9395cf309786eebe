"""Images until a claimed accuracy is confirmed, and live calibration beside that at once."""

import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.page import folders_with_captures, table
from jcr.calibration.options import CalibrateOptions
from jcr.capture.images import read_image
from jcr.capture.read import read_capture
from jcr.errors import RejectedError
from jcr.estimation.arms import RobotName, arm_named
from jcr.estimation.inverse_kinematics import reach_toward
from jcr.geometry import apply, inverse, retract, rotation_angle, step_between
from jcr.live.calibration import LiveCalibration
from jcr.live.progress import LiveProgress
from jcr.pipeline.run import calibrate
from jcr.records import Intrinsics
from jcr.result import RunResult
from simulation.arms import (
    EFFECTIVE_POSES,
    PRESETS,
    BentArm,
    about_posture,
    bend,
    effective_fit,
    hand_eye_on,
    table_center,
    view_size,
    views,
)
from simulation.capture import pinhole
from simulation.poses import looking_at
from simulation.render import render
from simulation.scenes import Scene, make_scene, moved

REQUIRE = (2.0, 0.3)
"""mm, degrees: 95 % of errors of a point, and of directions there."""
GOAL = f"{REQUIRE[0]:g} mm and {REQUIRE[1]:g}°"
FIRST, MOST = 3, 24
"""Images at varied poses with which every way begins, and images after which a capture ends without a claim."""
SCENES = 2
WAYS = ("varied", "random", "grid")
"""Ways to choose the next pose: by the pattern `varied`, at random, or on a grid."""
ARMS: tuple[RobotName, ...] = ("ur5e", "panda", "fr3", "ur10e", "xarm6")
AROUND = 0.5
"""m, of a UR5e: distance from which random poses look at the middle of the table."""
LATENCY_IMAGES, AT = 40, 12
"""Images of the simulated capture whose latencies are measured, and the image whose latency is stated."""


@dataclass(frozen=True)
class Cell:
    """An arm with errors, a camera on it, and the scene."""

    arm: BentArm
    scene: Scene
    camera: Intrinsics
    physical: Float[ndarray, "4 4"]
    """gripper_from_camera by the true poses of the arm."""
    varied: Float[ndarray, "n dof"]
    """Joint angles of the pattern `varied`."""
    seed: int


class Run(NamedTuple):
    """One simulated capture, ended by its claim or by the last image that was allowed."""

    way: str
    images: int
    claimed: bool
    is_true: bool
    """Whether both errors are within what was required."""
    cells: list[str]


class Fed(NamedTuple):
    """One real capture, image by image and at once."""

    same: bool
    """Whether both verdicts are the same."""
    sigmas: float | None
    """Largest difference in standard deviations of the one at once; None where one has no calibration."""
    cells: list[str]


def run(captures: Path, every: int = 1) -> str:
    """Return the page in Markdown: simulated captures by each way, and one real one in `every` image by image."""
    runs = [run_of(cell_of(seed), way) for seed in range(SCENES) for way in WAYS]
    real, seconds = [fed(folder) for folder in folders_with_captures(captures, every)], latencies()
    needed = []
    for way in WAYS:
        counts = [one.images if one.claimed else np.inf for one in runs if one.way == way]
        most = f"more than {MOST}" if np.isinf(max(counts)) else f"{max(counts):g}"
        needed.append(f"{way} {np.median(counts):g} ({min(counts):g} to {most})")
    claimed = [one for one in runs if one.claimed]
    apart = [one.sigmas for one in real if one.sigmas is not None]
    lines = [
        f"> Images until {GOAL} are claimed and confirmed, median and range: {'; '.join(needed)}. "
        f"{sum(one.is_true for one in claimed)} of {len(claimed)} claims are true.",
        f"> Live and at once: the same verdict in {sum(one.same for one in real)} of {len(real)} "
        f"captures, at most {max(apart, default=0.0):.2g} σ apart; {seconds[AT - 1]:.1f} s of processor after image "
        f"{AT}, {seconds[-1]:.1f} s after image {len(seconds)} (640x480).",
        "",
        "A rendered camera on an arm with errors of 0.1° a joint and 0.3 mm a link goes to poses until the calibration "
        f"claims {GOAL} (95 % of errors of a point) and its leave-one-out error confirms it, which takes 8 images "
        "at least. Errors are against the effective transform about the poses of the capture.",
        "",
        *table(
            "scene, arm | poses | images | claimed mm | ° | error mm | ° | claim | last image, s",
            (one.cells for one in runs),
        ),
        "",
        *table(
            f"capture | images | verdict live | at once | apart, σ | image {AT}, s | last, s | slowest, s | end, s | "
            "at once, s",
            (one.cells for one in real),
        ),
    ]
    return "\n".join(lines) + "\n"


def cell_of(seed: int) -> Cell:
    """Draw the cell of a seed."""
    hand_eye, errors, motion, camera = (np.random.default_rng([seed, 40 + k]) for k in (0, 1, 3, 4))
    arm = arm_named(ARMS[seed % len(ARMS)])
    x, target = hand_eye_on(arm, hand_eye), table_center(arm)
    return Cell(
        arm=bend(arm, PRESETS["typical"], errors),
        scene=moved(make_scene("tabletop", seed), target),
        camera=pinhole(camera),
        physical=x,
        varied=views(arm, LATENCY_IMAGES, x, motion, target),
        seed=seed,
    )


def run_of(cell: Cell, way: str) -> Run:
    """Take a capture by one way until its claim is confirmed."""
    white = np.repeat(PRESETS["typical"].white, 3)
    rng = np.random.default_rng([cell.seed, 70])
    state, seconds, joints = LiveProgress(images=()), 0.0, cell.varied[0]
    places, visited, arm = list[Float[ndarray, "4 4"]](), list[Float[ndarray, " dof"]](), cell.arm.arm
    seen = render(cell.scene, cell.camera, (places[-1] for _ in range(MOST)), with_truth=False)
    with tempfile.TemporaryDirectory() as folder:
        live = LiveCalibration(
            Path(folder) / "c",
            intrinsics=cell.camera,
            robot=arm.name,
            options=CalibrateOptions(require=REQUIRE),
        )
        for count in range(MOST):
            if count < FIRST:
                joints = cell.varied[count]
            else:
                joints = reach_toward(arm, _next_pose(cell, way, count)[None], joints[None])[0]
            visited.append(joints)
            places.append(cell.arm.true(joints[None])[0] @ cell.physical)
            reported = retract(cell.arm.reported(joints[None]), white * rng.normal(size=(1, 6)))[0]
            begun = time.process_time()
            state = live.add(next(seen).image, reported, joints)
            seconds = time.process_time() - begun
            if state.requirement_met:
                break
        live.close()
    found = state.hand_eye
    assert found is not None and state.reached is not None and found.uncertainty.seen is not None
    # The truth is the effective transform about the postures of the capture.
    draw, each = np.random.default_rng([cell.seed, 80]), -(-EFFECTIVE_POSES // len(visited))
    around = np.concatenate([about_posture(arm, posture, each, draw) for posture in visited])
    effective = effective_fit(cell.arm, around, (cell.physical, np.eye(4))).gripper_from_camera
    x, ahead = found.gripper_from_camera, np.array([0.0, 0.0, 1e-3 * found.uncertainty.seen.distance_mm])
    mm = 1e3 * float(np.linalg.norm(apply(x, ahead) - apply(effective, ahead)))
    deg = float(np.degrees(rotation_angle(x[:3, :3].T @ effective[:3, :3])))
    is_true = mm <= REQUIRE[0] and deg <= REQUIRE[1]
    claim = ("true" if is_true else "false") if state.requirement_met else "none"
    numbers = [f"{value:.2f}" for value in (*state.reached, mm, deg)]
    cells = [f"{cell.seed}, {arm.name}", way, f"{len(visited)}", *numbers, claim, f"{seconds:.1f}"]
    return Run(way, len(visited), state.requirement_met, is_true, cells)


def _next_pose(cell: Cell, way: str, count: int) -> Float[ndarray, "4 4"]:
    """Return the next base_from_gripper by one of WAYS."""
    if way == "varied":
        return cell.arm.reported(cell.varied[count : count + 1])[0]
    rng = np.random.default_rng([cell.seed, 60, count])
    if way == "grid":
        azimuth, elevation = np.pi / 3 * (count % 6), np.radians([80, 65, 50][count // 6 % 3])
        far = AROUND * [0.9, 1.2][count // 18] * max(view_size(cell.arm.arm), 0.55)
    else:
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(45, 85))
        far = AROUND * rng.uniform(0.8, 1.3) * max(view_size(cell.arm.arm), 0.55)
    toward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    middle = cell.scene.table_center_in_base
    return looking_at(middle + far * np.array(toward), middle, rng) @ inverse(cell.physical)


def fed(folder: Path) -> Fed:
    """Feed a capture on disk image by image, and calibrate the same images and poses at once."""
    capture, latency = read_capture(folder), []
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        own = LiveCalibration(out / "live", intrinsics=capture.intrinsics, robot=capture.robot)
        with closing(own) as live:
            for name, pose in zip(capture.images, capture.base_from_gripper, strict=True):
                image, begun = read_image(folder / name), time.process_time()
                live.add(image, pose)
                latency.append(time.process_time() - begun)
            finished, finish_s = _timed(live.finish)
        shutil.copytree(out / "live", out / "bare", ignore=shutil.ignore_patterns("result"))
        batch, at_once_s = _timed(lambda: calibrate(out / "bare", out / "batch"))
    sigmas = None
    if finished is not None and batch is not None:
        std = np.sqrt(np.diag(batch.found.covariance)[:6])
        away = step_between(finished.found.gripper_from_camera, batch.found.gripper_from_camera)
        sigmas = float(np.abs(away / std).max())
    verdicts = ["none" if one is None else str(one.verdict) for one in (finished, batch)]
    cells = [folder.name, f"{len(capture)}", *verdicts, "" if sigmas is None else f"{sigmas:.2g}"]
    cells.append(f"{latency[AT - 1]:.1f}" if len(latency) >= AT else "")
    cells += [f"{seconds:.1f}" for seconds in (latency[-1], max(latency), finish_s, at_once_s)]
    return Fed(verdicts[0] == verdicts[1], sigmas, cells)


def _timed(calibration: Callable[[], RunResult]) -> tuple[RunResult | None, float]:
    """Return a calibration, None where it is rejected, and its processor seconds."""
    begun = time.process_time()
    try:
        return calibration(), time.process_time() - begun
    except RejectedError:
        return None, time.process_time() - begun


def latencies() -> list[float]:
    """Return processor seconds after each image of a simulated capture at varied poses."""
    cell, found = cell_of(0), []
    seen = render(cell.scene, cell.camera, cell.arm.true(cell.varied) @ cell.physical, with_truth=False)
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(LiveCalibration(Path(folder) / "c", intrinsics=cell.camera)) as live,
    ):
        for view, pose in zip(seen, cell.arm.reported(cell.varied), strict=True):
            begun = time.process_time()
            live.add(view.image, pose)
            found.append(time.process_time() - begun)
    return found
