"""`jcr check`: checks a capture before any heavy work."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from jcr.capture.options import ReadOptions
from jcr.cli.output import VerboseOutput
from jcr.cli.source import looked_at

if TYPE_CHECKING:
    from jcr.pipeline.check import Examination
    from jcr.records import Capture, PosePairs


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Check a capture: files, units, motion, observability, pose convention, and which poses to add.

    The exit status is 3 if its calibration would be rejected; the message has the reason and the remedy.

    examples:
      jcr check captures/table
      jcr check captures/table --suggest 3 --robot-noise 0.1 0.05
      jcr check captures/table --poses-only --json
      jcr check samples.yaml
      jcr check scan.mcap --base-frame base_link --gripper-frame tool0
    """

    capture: Annotated[Path, tyro.conf.Positional]
    """Folder of the capture, or another format (jcr docs captures)."""
    read: ReadOptions = field(default_factory=ReadOptions)
    suggest: int = 0
    """Propose this many gripper poses, those that would reduce the uncertainty most."""
    poses_only: bool = False
    """Check files, units and motion only; look for no features in the images."""
    thorough: bool = False
    """Register all images at full size. By default 8 are registered, in seconds, and all only if these show a fault."""
    robot_noise: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="MM DEG")] = None
    """Noise (1 sigma per axis) of the gripper poses; unset: estimated, or 0.5 mm and 0.1°."""
    reach: Annotated[
        tuple[float, float, float, float, float, float] | None,
        tyro.conf.arg(metavar="XMIN YMIN ZMIN XMAX YMAX ZMAX"),
    ] = None
    """Box that contains all proposed gripper positions (m, base frame)."""
    seed: int = 0
    """Seed of the registration and of the proposals."""
    output: VerboseOutput = field(default_factory=VerboseOutput)


def main(arguments: Arguments) -> int:
    """Examine the capture and print the verdict."""
    from jcr.calibration.options import CalibrateOptions, check_options
    from jcr.errors import InputError
    from jcr.pipeline.check import check_capture, read_and_compare
    from jcr.progress import progress_bars

    if arguments.suggest < 0:
        raise InputError(f"--suggest {arguments.suggest}: give how many poses to propose, 0 or more")
    options = CalibrateOptions(robot_noise=arguments.robot_noise)
    check_options(options)
    with (
        progress_bars() as progress,
        looked_at(arguments.capture, arguments.read, progress, read_and_compare) as capture,
    ):
        found = check_capture(
            capture,
            arguments.suggest,
            not arguments.poses_only,
            options.robot_noise_m_rad,
            None if arguments.reach is None else np.array(arguments.reach).reshape(2, 3),
            arguments.seed,
            progress,
            arguments.thorough,
        )
        facts = _as_json(capture, found)
        arguments.output.result("" if arguments.output.json else _as_text(arguments, capture, found), facts)
    return 3 if found.verdict == "rejected" else 0


def _as_text(arguments: Arguments, capture: "Capture | PosePairs", found: "Examination") -> str:
    """Return the verdict with its cause and remedy, or with what a calibration is expected to reach."""
    from jcr.calibration.words import MOST_LINES, actions, labelled, verdict_in_words
    from jcr.findings import sentence

    is_rejected = found.verdict == "rejected"
    outcome = "a calibration would be rejected" if is_rejected else "good to calibrate"
    lines = [f"{verdict_in_words(found.findings)}: {outcome}. {_as_read(capture)}"]
    rotation = np.degrees(found.largest_rotation_rad)
    motion = f"up to {1e3 * found.largest_move_m:.0f} mm and {rotation:.0f}° between two poses"
    if not is_rejected:
        lines += [*labelled("Motion", motion), *_expected(len(capture), found)]
    closing = labelled("Next", "jcr docs troubleshooting")
    if not is_rejected:
        closing = labelled(
            "Next", shlex.join(["jcr", "run", str(arguments.capture), f"out/{arguments.capture.stem}"])
        )
    notes = [line for note in found.notes for line in labelled("Note", note)]
    acting = actions(found.findings, MOST_LINES - len(lines) - 1)
    room = MOST_LINES - len(lines) - len(acting) - 1
    if arguments.output.verbose:
        acting += [f"{one.severity}: {sentence(one)}" for one in found.findings]
    lines += [*acting, *(notes if arguments.output.verbose else notes[:room])]
    return "\n".join([*lines, *_suggested(capture, found), *closing]) + "\n"


def _suggested(capture: "Capture | PosePairs", found: "Examination") -> list[str]:
    """Return the proposed gripper poses, each with the accuracy expected once it is added."""
    from jcr.calibration.words import labelled
    from jcr.rounding import significant

    lines = []
    for k, pose in enumerate(found.suggestions, start=1):
        matrix = np.array2string(pose.base_from_gripper, precision=4, suppress_small=True).splitlines()
        then = f"{significant(pose.within_95_mm)} mm, {significant(pose.rotation_95_deg)}°"
        near = f"{1e3 * pose.moved_m:.0f} mm, {np.degrees(pose.rotation_rad):.0f}° from {capture.images[pose.like]}"
        lines += labelled(f"Add pose {k}", f"{near}; then {then} (95 %); base_from_gripper:", *matrix)
    return lines


def _as_read(capture: "Capture | PosePairs") -> str:
    from jcr.records import PosePairs

    if isinstance(capture, PosePairs):
        return f"{len(capture)} samples with the poses of gripper and camera, no images"
    width, height = capture.image_size
    intrinsics = "given" if capture.intrinsics is not None else "unknown, to be estimated"
    return f"{len(capture)} images of {width}x{height}, intrinsics {intrinsics}"


def _expected(images: int, found: "Examination") -> list[str]:
    """Return the accuracy that the calibration is expected to report, and how well poses and images agree."""
    from jcr.calibration.words import labelled
    from jcr.pipeline.check import QUICK
    from jcr.rounding import significant

    lines = []
    if found.expected is not None:
        seen, std = found.expected.in_use.seen, found.expected.std
        offset = " ".join(significant(1e3 * value) for value in std[:3])
        rotation = " ".join(significant(float(np.degrees(value))) for value in std[3:6])
        errors = "found in the images" if found.hand_eye is not None else "usual"
        lines = labelled(
            "Expected",
            f"a point at {significant(1e-3 * seen.distance_mm)} m: {significant(seen.within_95_mm)} mm, "
            f"{significant(seen.rotation_95_deg)}° (95 %), from {len(found.counted)} images; errors as {errors}",
            f"1σ: {offset} mm, {rotation}°, scale {significant(100 * std[6])} %",
        )
    if found.hand_eye is not None:
        noise, inliers = found.hand_eye.robot_noise, found.hand_eye.inliers
        agreement = f"{1e3 * noise.translation:.2f} mm, {np.degrees(noise.rotation):.3f}° per axis"
        looked = f"{int(inliers.sum())} of {len(inliers)} images"
        if len(inliers) == QUICK < images:
            looked += f"; distortion and focus show with all {images}: --thorough"
        lines += labelled("Agreement", f"poses and images: {agreement} ({looked})")
    return lines


def _as_json(capture: "Capture | PosePairs", found: "Examination") -> dict[str, Any]:
    from jcr.calibration.findings_json import as_json
    from jcr.findings import warnings_of

    noise = None if found.hand_eye is None else found.hand_eye.robot_noise
    return {
        "verdict": found.verdict,
        "images": [
            {"image": name, "sharpness": float(found.sharpness[k]) if len(found.sharpness) else None}
            for k, name in enumerate(capture.images)
        ],
        "largest_move_mm": 1e3 * found.largest_move_m,
        "largest_turn_deg": float(np.degrees(found.largest_rotation_rad)),
        "observability": {
            "observable": found.observability.observable,
            "unobservable": list(found.observability.unobservable),
            "advice": list(found.observability.advice),
        },
        "expected_std": None if found.expected_std is None else found.expected_std.tolist(),
        "expected_seen": None if found.expected is None else vars(found.expected.in_use.seen),
        "expected_images": [capture.images[row] for row in found.counted],
        "robot_noise": None
        if noise is None
        else {
            "translation_mm": 1e3 * noise.translation,
            "rotation_deg": float(np.degrees(noise.rotation)),
        },
        "suggestions": [
            {
                "base_from_gripper": pose.base_from_gripper.tolist(),
                "expected_std": pose.expected_std.tolist(),
                "within_95_mm": pose.within_95_mm,
                "rotation_95_deg": pose.rotation_95_deg,
                "like": capture.images[pose.like],
            }
            for pose in found.suggestions
        ],
        "findings": [as_json(one) for one in found.findings],
        "warnings": list(warnings_of(found.findings)),
        "notes": list(found.notes),
    }
