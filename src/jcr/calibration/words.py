"""A calibration in words: what terminal, log.txt and report say of it alike, each thing put into words once."""

from typing import TYPE_CHECKING

import numpy as np

from jcr.records import Attempt, HeldOut, ScaleCheck
from jcr.rounding import significant

if TYPE_CHECKING:
    from jcr.calibration.calibration_json import CalibrationFile, HeldOutError, NetworkScale


def summary(content: "CalibrationFile") -> str:
    """What was found, what was left out, and what would help."""
    lines = found(content)
    lines += [f"  not used: {image.image}: {image.reason}" for image in content.images if not image.used]
    if content.next_poses:
        then = " ".join(significant(1e3 * std) for std in content.next_poses[-1].expected_std[:3])
        near = ", ".join(pose.like for pose in content.next_poses)
        lines.append(
            f"{len(content.next_poses)} more views, like {near} but turned (next_poses in calibration.json), "
            f"would give ± {then} mm"
        )
    return "\n".join(lines) + "\n"


def found(content: "CalibrationFile") -> list[str]:
    """The transform and how sure it is, a line each; of a failure its reason."""
    uncertainty, scale = content.uncertainty, content.scale
    if uncertainty is None or scale is None:
        return [f"no calibration: {content.doubt}"]
    with np.printoptions(precision=6, suppress=True):
        matrix = str(np.array(content.gripper_from_camera)).splitlines()
    x, y, z = uncertainty.translation_std_mm
    rx, ry, rz = uncertainty.rotation_std_deg
    lines = [
        f"gripper_from_camera ({content.images_used} of {len(content.images)} images, back end {content.backend})",
        *(f"  {row}" for row in matrix),
        f"  ± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ; worst {uncertainty.worst})",
        f"scale {scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %",
    ]
    if content.scale_check is not None:
        lines.append(f"  {scale_in_words(content.scale_check)}")
    if (held_out := content.held_out) is not None:
        lines.append(f"held out: {missed(held_out)}{pixels(held_out)} ({held_out.how})")
    return lines


def log(content: "CalibrationFile") -> str:
    """log.txt: which back ends were tried, how long each stage took, what was found, what the user should know."""
    tried = [
        f"attempt {k}: {attempt_in_words(attempt, len(content.images))}"
        for k, attempt in enumerate(content.attempts, start=1)
    ]
    lines = [
        f"jcr {content.version}, back end {content.backend}",
        *tried,
        *(f"{stage}: {seconds:.2f} s" for stage, seconds in content.timings_s.items()),
        *found(content),
        *(f"{image.image}: {image.reason or 'used'}" for image in content.images),
        *(f"warning: {warning}" for warning in content.warnings),
    ]
    return "\n".join(lines) + "\n"


def attempt_in_words(attempt: Attempt, images: int) -> str:
    """The back end, what it registered of so many images, whether it was kept, and how long it took."""
    registered = (
        "nothing" if attempt.images_registered is None else f"{attempt.images_registered} of {images} images"
    )
    verdict = "kept" if attempt.why_not is None else f"not kept ({attempt.why_not})"
    times = f"reconstruct {attempt.reconstruct_s:.2f} s, calibrate {attempt.calibrate_s:.2f} s"
    features = f" with {attempt.features}" if attempt.features else ""
    return f"{attempt.backend}{features} registered {registered}, {verdict}; {times}"


def missed(held_out: "HeldOut | HeldOutError") -> str:
    """By how much images left out are missed."""
    return f"{significant(held_out.translation_mm)} mm and {significant(held_out.rotation_deg)}°"


def pixels(held_out: "HeldOut | HeldOutError") -> str:
    """The same in their pictures, to follow it; empty where no picture tells."""
    return "" if held_out.reprojection_px is None else f", {significant(held_out.reprojection_px)} px"


def scale_in_words(check: "ScaleCheck | NetworkScale") -> str:
    """How far a network's own scale is from the robot's, and how sure that is."""
    off, std = check.off_percent, check.std_percent
    if abs(off) < 2 * std:
        return f"the network's own metre agrees with the robot's ({off:+.2g} ± {std:.2g} %)"
    if off > 100:
        return f"the network's own lengths are {1 + off / 100:.3g} times the robot's"
    direction = "long" if off > 0 else "short"
    return f"the network's own lengths are {abs(off):.3g} ± {std:.2g} % too {direction} by the robot's"
