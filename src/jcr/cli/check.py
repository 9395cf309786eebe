"""`jcr check`: checks a capture before any heavy work."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from jcr.capture.options import ReadOptions
from jcr.cli.output import Output
from jcr.cli.source import looked_at

if TYPE_CHECKING:
    from jcr.calibration.expected import Expectation
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
    output: Output = field(default_factory=Output)


def main(arguments: Arguments) -> int:
    """Examine the capture and print what was found."""
    from jcr.calibration.options import CalibrateOptions, check_options
    from jcr.errors import InputError, RejectedError
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
    arguments.output.result(_as_text(capture, found), _as_json(capture, found))
    if found.faults:
        raise RejectedError(f"rejected: {found.faults[0]}")
    return 0


def _as_text(capture: "Capture | PosePairs", found: "Examination") -> str:
    from jcr.pipeline.check import QUICK
    from jcr.rounding import significant

    rotation = np.degrees(found.largest_rotation_rad)
    lines = [
        _as_read(capture),
        f"the gripper moves by up to {1e3 * found.largest_move_m:.0f} mm and rotates by up to {rotation:.0f}°",
    ]
    # Of what disagrees, what was expected of it and how well the rest agrees are no comfort.
    if found.expected is not None and not found.faults:
        lines += _expected(found.expected, len(found.counted), found.hand_eye is not None)
    if found.hand_eye is not None and not found.faults:
        noise = found.hand_eye.robot_noise
        looked = len(found.hand_eye.inliers)
        agreement = f"{1e3 * noise.translation:.2f} mm and {np.degrees(noise.rotation):.3f}°"
        lines.append(
            f"poses and images agree to {agreement} per axis ({int(found.hand_eye.inliers.sum())} of {looked} images"
            f"{f'; --thorough looks at all {len(capture)}' if looked == QUICK < len(capture) else ''})"
        )
    lines += [f"fault: {fault}" for fault in found.faults]
    lines += [f"remark: {remark}" for remark in found.remarks]
    for k, pose in enumerate(found.suggestions, start=1):
        matrix = np.array2string(pose.base_from_gripper, precision=4, suppress_small=True)
        then = f"{significant(pose.within_95_mm)} mm and {significant(pose.rotation_95_deg)}°"
        lines += [
            f"add pose {k}: {1e3 * pose.moved_m:.0f} mm and {np.degrees(pose.rotation_rad):.0f}° from that of "
            f"{capture.images[pose.like]}; then within {then}; base_from_gripper:",
            *(f"  {row}" for row in matrix.splitlines()),
        ]
    if not found.faults:
        lines.append(f"{found.verdict}: good to calibrate")
    return "\n".join(lines) + "\n"


def _as_read(capture: "Capture | PosePairs") -> str:
    from jcr.records import PosePairs

    if isinstance(capture, PosePairs):
        return f"{len(capture)} samples with the poses of gripper and camera, no images"
    width, height = capture.image_size
    intrinsics = "given" if capture.intrinsics is not None else "unknown, to be estimated"
    return f"{len(capture)} images of {width}x{height}, intrinsics {intrinsics}"


def _expected(expected: "Expectation", images: int, is_measured: bool) -> list[str]:
    """What the calibration of this many images would report, in the words of that report."""
    from jcr.rounding import significant

    seen, std = expected.seen, expected.std
    of = "found in the images" if is_measured else "usual"
    offset = " ".join(significant(1e3 * value) for value in std[:3])
    rotation = " ".join(significant(float(np.degrees(value))) for value in std[3:6])
    return [
        f"expected of {images} images: a point seen at {significant(1e-3 * seen.distance_mm)} m is placed within "
        f"{significant(seen.within_95_mm)} mm and {significant(seen.rotation_95_deg)}° (95 % of errors)",
        f"  the camera on the gripper ± {offset} mm, {rotation} °, scale {significant(100 * std[6])} % (1 σ); "
        f"robot errors and image noise as {of}",
    ]


def _as_json(capture: "Capture | PosePairs", found: "Examination") -> dict[str, Any]:
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
        "expected_seen": None if found.expected is None else vars(found.expected.seen),
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
        "faults": list(found.faults),
        "remarks": list(found.remarks),
    }
