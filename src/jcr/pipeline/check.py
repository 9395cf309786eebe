"""Check of a capture before a run: files, motion, exposure, and the calibration that a run would make of it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from jcr.calibration.arm_of_capture import robot_errors
from jcr.calibration.checks.images import view_findings
from jcr.calibration.record import AnyCalibration, Calibration
from jcr.calibration.required_accuracy import requirement_of
from jcr.capture.images import exposure_fault, read_image
from jcr.capture.read import read_source
from jcr.cell.cameras_json import CamerasFile
from jcr.errors import count_of
from jcr.estimation.observability import observability
from jcr.estimation.prediction import MIN_PREDICTED_IMAGES, predict
from jcr.findings import Finding, FindingKind, Verdict, strongest_first, verdict_of
from jcr.geometry import largest_motion
from jcr.number_format import significant
from jcr.options import checked_options
from jcr.pipeline.backend_selection import NothingFoundError
from jcr.pipeline.reading_decision import first_reading
from jcr.pipeline.run import calibrate, calibrate_poses, require_valid
from jcr.progress import Progress, silent
from jcr.records import Capture, Observability, PosePairs, Uncertainty
from jcr.result import RunOptions, RunResult, load_run


@dataclass(frozen=True, kw_only=True)
class Examination:
    """Result of the check of a capture: motion, expected uncertainty, findings, and notes."""

    capture: Capture | PosePairs
    """Capture with the reading of its poses; it still has `candidates` if the images were not asked."""
    largest_move_m: float
    """Largest distance between the gripper's origins in two poses."""
    largest_rotation_rad: float
    """Largest angle between two gripper poses."""
    observability: Observability
    expected: Uncertainty | None
    """Uncertainty of `calibration`; from the motion alone, the predicted one of a camera on the gripper with three
    images or more. Else None."""
    counted: Int[ndarray, " c"]
    """Rows of the images that the calibration uses; of the well exposed sharp images, from the motion alone."""
    calibration: AnyCalibration | None = None
    """Calibration that a run makes of the capture; None from the motion alone."""
    cameras: CamerasFile | None = None
    """Calibrations of the cell's other cameras; None without other cameras, and from the motion alone."""
    findings: tuple[Finding, ...]
    """Findings of the calibration or, from the motion alone, of motion and images; strongest first."""
    notes: tuple[str, ...]
    """Sentences on the files, the exposure of images, and the pairing of images with poses."""

    @property
    def verdict(self) -> Verdict:
        """Expected verdict on a calibration of the capture; "not checked" if the reading of its poses is undecided."""
        verdict = verdict_of(self.findings)
        undecided = isinstance(self.capture, Capture) and self.capture.candidates
        return "not checked" if undecided and verdict != "rejected" else verdict

    def __repr__(self) -> str:
        seen = self.expected and self.expected.seen
        point = f", a point within {significant(seen.within_95_mm)} mm (95 %)" if seen else ""
        first = "".join(f"; {one.text}" for one in self.findings[:1])
        return f"<Examination: {self.verdict}, {count_of(len(self.capture), 'image')}{point}{first}>"


def check_capture(
    capture: Capture | PosePairs | str | Path,
    look: bool = True,
    options: RunOptions | Mapping[str, Any] | None = None,
    *,
    progress: Progress = silent,
) -> Examination:
    """Examine a capture, or the capture at a path: its motion, images, and expected uncertainty.

    The capture is calibrated as `calibrate` does with the same options, but no folder is kept. If `look` is False, the
    images are not matched: the uncertainty is predicted from the motion and usual errors. PosePairs have given camera
    poses, which are calibrated. Raises InputError as `calibrate`, for instance if gripper poses and joint angles
    contradict each other.
    """
    options = checked_options(options, RunOptions)
    require_valid(options)
    with TemporaryDirectory(prefix="jcr-check-") as scratch:
        if isinstance(capture, str | Path):
            capture = read_source(capture, into=Path(scratch) / "capture", progress=progress)
        if isinstance(capture, Capture) and not look:
            return _by_motion(capture, options)
        result = _calibrated(capture, Path(scratch) / "run", options, progress)
        made = result.calibration
        decided = (
            capture if isinstance(capture, PosePairs) else replace(result.capture, folder=capture.folder)
        )
        used = np.flatnonzero([one.used for one in made.images])
        return _examination(
            decided,
            observability=made.observability,
            expected=made.uncertainty if isinstance(made, Calibration) else None,
            counted=used,
            calibration=made,
            cameras=None if isinstance(capture, PosePairs) else result.cameras,
            findings=made.findings,
            notes=() if isinstance(decided, PosePairs) else tuple(_exposure(decided)[1]),
        )


def _calibrated(
    capture: Capture | PosePairs, out: Path, options: RunOptions, progress: Progress
) -> RunResult:
    """Return the run of a capture in the folder `out`; a failed one, too."""
    if isinstance(capture, PosePairs):
        return calibrate_poses(capture, out, options.calibrate, options.method)
    try:
        return calibrate(capture, out, options, progress=progress)
    except NothingFoundError:
        return load_run(out)


def _by_motion(capture: Capture, options: RunOptions) -> Examination:
    """Return the examination of a capture by its motion, and by the blur and exposure of its images."""
    undecided = bool(capture.candidates)
    if undecided:
        capture = first_reading(capture)
    robot, views = robot_errors(capture, options.calibrate), view_findings(capture)
    blurred = {name for one in views if one.kind is FindingKind.BLURRED for name in one.images}
    fine, remarks = _exposure(capture)
    clear = np.array([row for row in fine if capture.images[row] not in blurred], dtype=int)
    enough = len(clear) >= MIN_PREDICTED_IMAGES
    rows = clear if enough else np.arange(len(capture))
    gripper, expected = capture.base_from_gripper[rows], None
    seen = observability(gripper)
    found = [*seen.findings, *filter(None, [robot.unused]), *views]
    # A prediction does not simulate the images of a fixed camera.
    if enough and capture.mount == "gripper" and not undecided:
        x, expected = predict(
            capture.of_rows(rows), options.calibrate.robot_noise_m_rad, robot.of(rows).systematic
        )
        found += requirement_of(x, expected, found, len(clear), options.calibrate)[1]
    return _examination(
        capture,
        observability=seen,
        expected=expected,
        counted=clear,
        findings=strongest_first(found),
        notes=remarks,
    )


def _examination(capture: Capture | PosePairs, **found: Any) -> Examination:
    """Return the examination of a capture with its largest motions, its notes, and what was `found`."""
    move_m, rotation_rad = largest_motion(capture.base_from_gripper)
    notes = (*capture.notes, *_unit_doubt(move_m, rotation_rad), *found.pop("notes"))
    return Examination(
        capture=capture, largest_move_m=move_m, largest_rotation_rad=rotation_rad, notes=notes, **found
    )


def _unit_doubt(move_m: float, rotation_rad: float) -> list[str]:
    """Return a note if the largest motion of the gripper is below 5 mm, but rotates; empty otherwise."""
    if move_m >= 5e-3 or rotation_rad <= np.radians(5):
        return []
    moved = f"by at most {1e3 * move_m:.2g} mm while it rotates by {np.degrees(rotation_rad):.0f}°"
    return [f"the gripper moves {moved}: the positions may have been divided by 1000"]


def _exposure(capture: Capture) -> tuple[list[int], list[str]]:
    """Return the rows of well exposed images, and remarks on the exposure of the others."""
    fine, remarks = list[int](), list[str]()
    for row, name in enumerate(capture.images):
        if (fault := exposure_fault(read_image(capture.folder / name))) is None:
            fine.append(row)
        else:
            remarks.append(f"{name} is {fault}; expose it again")
    return fine, remarks
