"""`benchmarks expected DIR`: does `jcr check` expect what the calibration then reports?"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.page import folders_with, table
from benchmarks.seen import WAYS, Knowledge
from jcr.calibration.adjust import adjusted
from jcr.calibration.case import of_images
from jcr.calibration.expected import Expectation, assumed, assumed_of, expected, typical_camera
from jcr.calibration.fit import fitted
from jcr.calibration.options import CalibrateOptions
from jcr.calibration.robot_errors import errors_of, robot_errors
from jcr.calibration.seen import within_95
from jcr.calibration.stage import calibrate
from jcr.capture.read import read_capture
from jcr.check import QUICK, check_capture, spread_rows
from jcr.errors import RejectedError
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.pipeline import calibrate as run_calibrate
from jcr.records import Capture, HandEye, Reconstruction
from simulation.arms import PresetName
from simulation.problems import bent_problem, observed

ROBOTS: tuple[PresetName, ...] = ("typical", "white", "typical", "typical", "white")
COUNTS = (6, 8, 12, 20)
PIXELS_STD = (0.1, 0.3)
POINTS = 400
DRAWS = 20
FACTOR = 2.0


@dataclass(frozen=True)
class Row:
    """One capture: what was expected, and what its calibration reports."""

    capture: str
    how: str
    images: str
    expected: tuple[float, float, float] | None
    """Of a seen point (mm), the camera (mm) and its rotation (degrees), 95 % of errors; None: nothing."""
    live: tuple[float, float, float]
    """The same by the poses alone, of a usual robot and usual images."""
    reported: tuple[float, float, float]

    @property
    def ratios(self) -> tuple[float, ...]:
        """Expected over reported."""
        return () if self.expected is None else tuple(np.divide(self.expected, self.reported))

    @property
    def live_ratios(self) -> tuple[float, ...]:
        """The same by the poses alone."""
        return tuple(np.divide(self.live, self.reported))


def run(captures: Path) -> str:
    """Markdown: real captures below `captures`, and simulated ones; InputError where there is no capture."""
    folders = folders_with(captures, "capture.json")
    return page([row for folder in folders if (row := of_capture(folder)) is not None], simulated())


def page(real: Sequence[Row], made: Sequence[Row]) -> str:
    """Markdown of measured rows."""
    lines = [
        *(_claim(name, rows) for name, rows in (("real captures", real), ("simulated ones", made)) if rows),
        "",
        "Expected by `jcr check` over what the calibration reports, 95 % of errors: a point seen at the centre "
        "of the image and the distance of the scene, the camera on the gripper, its rotation. Poses alone: the same by "
        "`--poses-only`, which takes robot and images for usual. A simulated capture has observations "
        f"instead of images; of more than {QUICK} images, {QUICK} are looked at.",
        "",
        *table(
            "capture | | images | seen point: expected mm | reported | ratio | camera: expected mm | reported | ratio | "
            "rotation: expected ° | reported | ratio | poses alone, seen point: ratio",
            map(_cells, [*real, *made]),
        ),
    ]
    return "\n".join(lines) + "\n"


def _claim(name: str, rows: Sequence[Row]) -> str:
    ratios = np.array([row.ratios for row in rows if row.ratios]).T
    parts = [
        f"{what} within a factor of {FACTOR:g} in {(np.abs(np.log(each)) < np.log(FACTOR)).sum()} of {len(each)}, "
        f"at most {np.exp(np.abs(np.log(each)).max()):.2f}"
        for what, each in zip(("seen point", "camera", "rotation"), ratios, strict=True)
    ]
    return f"> Expected error over reported error, {len(rows)} {name}: {'; '.join(parts)}"


def _cells(row: Row) -> list[str]:
    cells = [row.capture, row.how, row.images]
    for k in range(3):
        ahead = "" if row.expected is None else f"{row.expected[k]:.3g}"
        share = f"{row.ratios[k]:.2f}" if row.ratios else ""
        cells += [ahead, f"{row.reported[k]:.3g}", share]
    return [*cells, f"{row.live_ratios[0]:.2f}"]


def of_capture(folder: Path) -> Row | None:
    """Of images on disk; None where the calibration is rejected."""
    capture = read_capture(folder)
    found = check_capture(capture)
    try:
        with tempfile.TemporaryDirectory() as out:
            result = run_calibrate(capture, out)
    except RejectedError:
        return None
    ahead = None if found.expected is None else _numbers(found.expected)
    used = sum(image.used for image in result.calibration.images)
    how = "intrinsics given" if capture.intrinsics is not None else "not given"
    images = f"{len(found.counted)} / {used} of {len(capture)}"
    return Row(folder.name, how, images, ahead, _live(capture), _reported(result.hand_eye))


def simulated(draws: int = DRAWS) -> list[Row]:
    """Of captures that differ in arm, its errors, images, intrinsics and noise."""
    rows = (_of_draw(seed) for seed in range(draws))
    return [row for row in rows if row is not None]


def _of_draw(seed: int) -> Row | None:
    name = ROBOT_NAMES[seed % len(ROBOT_NAMES)]
    preset, count = ROBOTS[seed % len(ROBOTS)], COUNTS[seed % len(COUNTS)]
    known, std_px = WAYS[seed % 3], PIXELS_STD[seed // 2 % 2]
    capture, reconstruction = _made(seed, name, preset, count, known, std_px)
    options = CalibrateOptions()
    robot = robot_errors(capture, options)
    rows = spread_rows(count)
    case = fitted(capture, _of_rows(reconstruction, rows), CalibrateOptions(), robot.of(rows))
    case = adjusted(case) if case.hand_eye.converged else case
    hand_eye = calibrate(capture, reconstruction, options)
    if not hand_eye.converged or not case.hand_eye.converged:
        return None
    ahead = expected(assumed_of(case), capture.base_from_gripper, robot.systematic)
    how = f"{preset}, {'joints known, ' if capture.joints is not None else ''}{std_px} px, intrinsics {known.name}"
    return Row(name, how, str(count), _numbers(ahead), _live(capture), _reported(hand_eye))


def _made(
    seed: int, name: str, preset: PresetName, count: int, known: Knowledge, std_px: float
) -> tuple[Capture, Reconstruction]:
    """A capture without images and its reconstruction; every other one with the joint angles of a named arm."""
    rng = np.random.default_rng([seed, 7])
    problem = bent_problem(arm_named(name), preset, count, seed)
    start = known.start(rng)
    capture = Capture(
        folder=Path(),
        images=tuple(f"{k}.png" for k in range(count)),
        base_from_gripper=problem.base_from_gripper,
        image_size=(start.width, start.height),
        intrinsics=None if known.name.startswith("not") else start,
        joints=problem.joints if seed % 2 else None,
        robot=name if seed % 2 else None,
    )
    return capture, Reconstruction(
        image_index=np.arange(count),
        recon_from_camera=problem.recon_from_camera,
        intrinsics=start,
        tracks=observed(problem, rng, POINTS, std_px, known.camera),
        backend="simulated",
    )


def _of_rows(made: Reconstruction, rows: np.ndarray) -> Reconstruction:
    among = np.isin(np.arange(len(made.image_index)), rows)
    return Reconstruction(
        image_index=rows,
        recon_from_camera=made.recon_from_camera[rows],
        intrinsics=made.intrinsics,
        tracks=of_images(made.tracks, among),
        backend=made.backend,
    )


def _live(capture: Capture) -> tuple[float, float, float]:
    gripper = capture.base_from_gripper
    camera = typical_camera(capture.intrinsics, capture.image_size)
    return _numbers(expected(assumed(gripper, camera), gripper, errors_of(gripper).systematic))


def _numbers(ahead: Expectation) -> tuple[float, float, float]:
    return ahead.reached("seen")[0], *ahead.reached("camera")


def _reported(hand_eye: HandEye) -> tuple[float, float, float]:
    assert hand_eye.in_use is not None
    covariance = hand_eye.covariance
    return (
        hand_eye.in_use.seen.within_95_mm,
        1e3 * within_95(covariance[:3, :3]),
        float(np.degrees(within_95(covariance[3:6, 3:6]))),
    )
