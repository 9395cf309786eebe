"""How a calibration is told on the terminal, the same for every command that ends with one."""

import sys
from typing import TYPE_CHECKING

import numpy as np

from jcr.cli.output import Output
from jcr.errors import NotTrustedError
from jcr.rounding import significant

if TYPE_CHECKING:
    from jcr.results import PosesResult, RunResult


def show(result: "RunResult | PosesResult", output: Output, after: str = "") -> int:
    """Print the calibration, its doubts on stderr, and for people what comes after it.

    Returns exit status 0, or raises NotTrustedError.
    """
    content = result.calibration
    output.result(summary(result) + after, content.model_dump())
    for warning in content.warnings[0 if content.converged else 1 :]:
        sys.stderr.write(f"warning: {warning}\n")
    if not content.converged:
        raise NotTrustedError(f"not to be trusted: {content.warnings[0]}")
    return 0


def summary(result: "RunResult | PosesResult") -> str:
    """A few lines a person reads: the transform, how sure it is, what was left out."""
    hand_eye, content = result.hand_eye, result.calibration
    uncertainty = content.uncertainty
    assert uncertainty is not None  # a result has been calibrated
    with np.printoptions(precision=6, suppress=True):
        matrix = "\n  ".join(str(hand_eye.gripper_from_camera).splitlines())
    x, y, z = uncertainty.translation_std_mm
    rx, ry, rz = uncertainty.rotation_std_deg
    used = sum(image.used for image in content.images)
    lines = [
        f"gripper_from_camera ({used} of {len(content.images)} images, back end {content.backend})",
        f"  {matrix}",
        f"  ± {x:.2f} {y:.2f} {z:.2f} mm, {rx:.3f} {ry:.3f} {rz:.3f} ° (1 σ; worst {uncertainty.worst})",
        f"scale {hand_eye.scale:.6g} m per unit ± {uncertainty.scale_std_percent:.2g} %",
    ]
    if hand_eye.scale_check is not None:
        from jcr.calibration.stage import in_words

        lines.append(f"  {in_words(hand_eye.scale_check)}")
    if content.held_out is not None:
        held_out = content.held_out
        pixels = "" if held_out.reprojection_px is None else f", {held_out.reprojection_px:.2f} px"
        error = f"{held_out.translation_mm:.2f} mm, {held_out.rotation_deg:.3f}°{pixels}"
        lines.append(f"held out: {error} ({held_out.how})")
    lines += [f"  not used: {image.image}: {image.reason}" for image in content.images if not image.used]
    if content.next_poses:
        after = content.next_poses[-1].expected_std
        offset = " ".join(significant(1e3 * value) for value in after[:3])
        near = ", ".join(f"{pose.like}" for pose in content.next_poses)
        lines.append(
            f"{len(content.next_poses)} more views, like {near} but turned (next_poses in calibration.json), "
            f"would give ± {offset} mm"
        )
    return "\n".join(lines) + "\n"
